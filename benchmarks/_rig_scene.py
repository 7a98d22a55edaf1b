"""A rig made of a rendered scene: a sharp RGB camera and a coarse spectral camera, each with half of the views."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

NUM_BANDS = 12
FACTOR = 4
"""Pixels of the RGB camera along the edge of one of the spectral camera's."""
RESPONSES_NM = {"blue": (455.0, 45.0), "green": (540.0, 50.0), "red": (605.0, 45.0)}
"""Middle and standard deviation of each channel's response, a Gaussian."""


def chosen_bands(count: int) -> list[int]:
    """Of the source's bands, those of the rig."""
    return np.linspace(0, count - 1, NUM_BANDS).round().astype(int).tolist()


def write_rig(source: Path, target: Path, sensors: tuple[str, ...] = ("rgb", "spectral")) -> Path:
    """Write the rig's scene; its evaluation views have all bands at the RGB camera's size.

    Args:
        source: A scene folder whose frames have one size and all bands.
        sensors: Which cameras to keep views of.
    """
    content = json.loads((source / "transforms.json").read_text())
    wavelengths = np.array(content["wavelengths"])
    bands = chosen_bands(len(wavelengths))
    responses = _responses(wavelengths)
    target.mkdir(parents=True)
    table = np.column_stack([wavelengths, responses.T])
    np.savetxt(target / "rgb.csv", table, "%.6g", ",", header="wavelength,blue,green,red", comments="")
    train = set(content["train_filenames"])
    frames: list[dict[str, Any]] = []
    number = 0
    for frame in content["frames"]:
        sensor = "truth"
        if frame["file_path"] in train:
            sensor = ("rgb", "spectral")[number % 2]
            number += 1
        if sensor in ("truth", *sensors):
            frames.append(_write_frame(source, target, content, frame, sensor, bands, responses))
    evaluation = [frame["file_path"] for frame in frames if frame["sensor"] == "truth"]
    written = {
        "wavelengths": wavelengths[bands].tolist(),
        "train_filenames": [f["file_path"] for f in frames if f["file_path"] not in evaluation],
        "test_filenames": evaluation,
        "frames": frames,
    }
    (target / "transforms.json").write_text(json.dumps(written, indent=1))
    return target


def binned(image: np.ndarray, factor: int) -> np.ndarray:
    """Means over squares of pixels."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image.reshape(height, factor, width, factor, *image.shape[2:]).mean(axis=(1, 3))


def _responses(wavelengths: np.ndarray) -> np.ndarray:
    """(3, B) relative responses; 0 at the ends of the range."""
    found = np.stack([np.exp(-0.5 * ((wavelengths - nm) / s) ** 2) for nm, s in RESPONSES_NM.values()])
    found[:, [0, -1]] = 0.0
    return found


def _write_frame(
    source: Path,
    target: Path,
    content: dict[str, Any],
    frame: dict[str, Any],
    sensor: str,
    bands: list[int],
    responses: np.ndarray,
) -> dict[str, Any]:
    cube = np.load(source / frame["hyperspectral_file_path"]).astype(np.float32)
    picture = np.asarray(Image.open(source / frame["file_path"]))
    factor = FACTOR if sensor == "spectral" else 1
    cube = (
        cube @ (responses / responses.sum(axis=1, keepdims=True)).T if sensor == "rgb" else cube[..., bands]
    )
    name = Path(frame["file_path"]).stem
    entry: dict[str, Any] = {
        "file_path": f"images/{name}.png",
        "hyperspectral_file_path": f"cubes/{name}.npy",
        "sensor": sensor,
        "transform_matrix": frame["transform_matrix"],
        **{key: content[key] // factor for key in ("w", "h")},
        **{key: content[key] / factor for key in ("fl_x", "fl_y", "cx", "cy")},
        **({"responses_path": "rgb.csv"} if sensor == "rgb" else {}),
    }
    for folder in ("images", "cubes"):
        (target / folder).mkdir(exist_ok=True)
    np.save(target / entry["hyperspectral_file_path"], binned(cube, factor).astype(np.float16))
    pixels = binned(picture.astype(np.float64), factor).round().astype(np.uint8)
    Image.fromarray(pixels).save(target / entry["file_path"])
    return entry
