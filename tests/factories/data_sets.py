"""Small data sets in the layouts of others, written with NumPy, OpenEXR and Pillow."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from unmix_plugin.captures.cube import ReadOptions

PLAIN = ReadOptions()


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
    arrays = {name: np.ascontiguousarray(a, dtype=kind) for name, a in channels.items()}
    OpenEXR.File(header, arrays).write(str(path))


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
        frame = {"file_path": f"./{split}/r_{index}", "rotation": 0.01, "transform_matrix": pose(index)}
        frames[split].append(frame)
        for wavelength in wavelengths:
            opacity = np.linspace(0, 1, 35, dtype=np.float32).reshape(5, 7) if alpha else None
            path = root / str(wavelength) / split / f"r_{index}.exr"
            write_exr(path, stokes(intensity(index, wavelength), opacity))
    for split, listed in (*frames.items(), ("test", frames["val"] + frames["train"])):
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": 0.8, "frames": listed})


def write_real(root, views=("v10", "v2"), wavelengths=(450, 460), poses=True):
    for index, view in enumerate(views):
        for wavelength in wavelengths:
            write_exr(root / "exr" / view / f"{wavelength}.exr", stokes(intensity(index, wavelength)))
    if poses:
        rows = []
        for index in range(len(views)):
            right, up, back, place = np.array(pose(index))[:3].T
            matrix = np.column_stack([-up, right, back, place, [5.0, 7.0, 9.0]])
            rows.append([*matrix.ravel(), 0.5, 4.0])
        np.save(root / "poses_bounds.npy", np.array(rows))


LENS = {"fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6}


def cube(index: int) -> np.ndarray:
    return np.random.default_rng(index).random((6, 8, 4)).astype(np.float32)


def write_picture(path, mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(5).integers(0, 256, (6, 8, len(mode)), dtype=np.uint8)
    Image.fromarray(pixels, mode).save(path)
    return pixels


def write_unmix(root, written="eval", named="val", **top):
    """Three training views, and two for evaluation whose paths name one folder and whose files may lie in another."""
    frames = []
    for index in range(5):
        folder, real = ("train", "train") if index < 3 else (named, written)
        name = f"frame_{index:05d}"
        (root / real).mkdir(parents=True, exist_ok=True)
        np.save(root / real / f"{name}.npy", cube(index))
        write_picture(root / real / f"{name}.png")
        Image.fromarray(np.full((6, 8), index, np.uint8)).save(root / real / f"{name}_seg.png")
        files = {"file_path": f"./{folder}/{name}.png", "hyperspectral_file_path": f"{folder}/{name}.npy"}
        frames.append(files | {"seg_file_path": f"{folder}/{name}_seg.png", "transform_matrix": pose(index)})
    bands = {"wavelengths": [450, 500, 550, 600]}
    write_json(root / "transforms.json", LENS | bands | top | {"frames": frames})
