"""Small data sets in the layouts of others, written with NumPy, OpenEXR, torch and Pillow."""

import json
from pathlib import Path

import numpy as np
import OpenEXR

from unmix_plugin.captures.layouts.registry import LayoutOptions

PLAIN = LayoutOptions()


def pose(index: int) -> list[list[float]]:
    """Camera to world, looking at the origin from a circle."""
    angle = 0.4 * index
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, 3.0 * rotation[:, 2]
    return matrix.tolist()


def write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_exr(path: Path, channels: dict[str, np.ndarray], kind: type = np.float32) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {name: np.ascontiguousarray(a, dtype=kind) for name, a in channels.items()}).write(
        str(path)
    )


def stokes(intensity: np.ndarray, alpha: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Channels of one file, sorted as OpenEXR sorts them: `w` is the last."""
    channels = {"s0": intensity} | {f"s{k}": intensity * 0.1 * k - 0.05 for k in (1, 2, 3)}
    return channels if alpha is None else channels | {"w": alpha}


def intensity(view: int, wavelength: int, size: tuple[int, int] = (5, 7)) -> np.ndarray:
    """Radiance of a view, some of it above 1."""
    seed = np.random.default_rng(1000 * view + wavelength)
    return (1.6 * seed.random(size)).astype(np.float32)


def write_nespof(root: Path, wavelengths: tuple[int, ...] = (450, 460, 470), alpha: bool = True) -> None:
    """Four training views, one for validation, and all five again in transforms_test.json."""
    frames = {"train": [], "val": []}
    for index in range(5):
        split = "val" if index == 0 else "train"
        frames[split].append(
            {"file_path": f"./{split}/r_{index}", "rotation": 0.01, "transform_matrix": pose(index)}
        )
        for wavelength in wavelengths:
            opacity = np.linspace(0, 1, 35, dtype=np.float32).reshape(5, 7) if alpha else None
            path = root / str(wavelength) / split / f"r_{index}.exr"
            write_exr(path, stokes(intensity(index, wavelength), opacity))
    for split, listed in (*frames.items(), ("test", frames["val"] + frames["train"])):
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": 0.8, "frames": listed})
