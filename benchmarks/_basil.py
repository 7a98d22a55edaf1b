"""The scene that training on a real capture is measured with, made from the files of "Basil" of HS-NeRF.

Three bands from the linearised JPEG; alpha is "not white" in connected areas of more than 300 pixels, so that small
gaps between leaves, through which the white background shows, count as blown-out matter; rotations without their scale.
Every 8th view is for evaluation, as the loader's interval split has it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

WAVELENGTHS_NM = (465.0, 550.0, 610.0)
WHITE, SMALLEST_AREA_PX = 0.95, 300


def make_scene(source: Path, folder: Path) -> Path:
    """Write the scene of the files in `source` (images/, transforms_bak.json) to `folder`."""
    content = json.loads((source / "transforms_bak.json").read_text(encoding="utf-8"))
    for name in ("images", "cubes"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames = [_write_frame(source, folder, frame) for frame in content["frames"]]
    lens = {key: value for key, value in content.items() if key != "frames"}
    scene = {**lens, "wavelengths": WAVELENGTHS_NM, "frames": sorted(frames, key=lambda f: f["file_path"])}
    (folder / "transforms.json").write_text(json.dumps(scene, indent=1), encoding="utf-8")
    return folder


def _write_frame(source: Path, folder: Path, frame: dict[str, Any]) -> dict[str, Any]:
    name = Path(frame["file_path"]).stem
    srgb = np.asarray(Image.open(source / frame["file_path"]).convert("RGB"), dtype=np.float64) / 255.0
    alpha = _large(~_large(srgb.min(axis=-1) > WHITE))[..., None]
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.save(folder / "cubes" / f"{name}.npy", (linear * alpha)[..., ::-1].astype(np.float16))
    pixels = np.round(255.0 * np.concatenate([srgb * alpha, alpha], axis=-1)).astype(np.uint8)
    Image.fromarray(pixels).save(folder / "images" / f"{name}.png")
    pose = np.array(frame["transform_matrix"])
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right
    return {
        "file_path": f"images/{name}.png",
        "hyperspectral_file_path": f"cubes/{name}.npy",
        "transform_matrix": pose.tolist(),
    }


def _large(area: np.ndarray) -> np.ndarray:
    """Connected parts of more than `SMALLEST_AREA_PX` pixels."""
    labels, count = ndimage.label(area)  # type: ignore[misc]
    sizes = ndimage.sum(area, labels, range(1, count + 1))
    return np.isin(labels, 1 + np.flatnonzero(np.asarray(sizes) > SMALLEST_AREA_PX))
