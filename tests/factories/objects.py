"""Tiny objects on disk: a ball in a small studio, in colours or bands, and settings with which a training is fast."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from tests.factories.commands import done, run_of
from unmix_plugin.commands.train import train
from unmix_plugin.formats.exr import write_exr

SMALL = [
    "--pipeline.datamanager.train-num-rays-per-batch=256",
    "--pipeline.model.plane-resolution=16",
    "--pipeline.model.eval-samples=16",
    "--pipeline.model.samples=4",
    "--device=cpu",
]
SIZE = 24
NUM_VIEWS = 6
CENTRE = np.array([0.3, -0.2, 1.5])
RADIUS = 0.5
DISTANCE = 3.0
LENS_PX = 60.0
Colour = tuple[float, ...]
COLOUR = (0.5, 0.3, 0.1)
WAVELENGTHS = [450.0, 500.0, 550.0, 600.0, 650.0]
LAMP = np.array([0.4, 0.6, 0.8, 1.0, 0.9])
ENDMEMBERS = np.array([[0.7, 0.5, 0.2, 0.1, 0.1], [0.05, 0.1, 0.2, 0.5, 0.6]])


def trained_on(folder: Path, *words: object, steps: int) -> Path:
    """The run of a small training of an object."""
    place = ["--data", folder, "--output-dir", folder.parent / "outputs", "--max-num-iterations", steps]
    return run_of(done(train, "neumatex", *place, *SMALL, *words))


def write_object(folder: Path, suffix: str = ".exr", **extra: Any) -> Path:
    """Write the object in colours; `extra` are further keys of transforms.json."""
    _write_ball(folder)
    write_views(folder, suffix, COLOUR, **extra)
    write_picture(folder / "truth" / "base_colour" / "000.exr", COLOUR)
    write_light(folder / "relit" / "dim", sky=0.5)
    write_views(folder / "relit" / "dim", suffix, (0.25, 0.15, 0.05), count=2, tone_mapping="linear")
    return folder


def write_spectral_object(folder: Path, **extra: Any) -> Path:
    """Write the object in bands, half of it of each material."""
    _write_ball(folder)
    write_table(folder / "illuminant.csv", ("power",), LAMP[None])
    write_table(folder / "endmembers.csv", ("blue", "red"), ENDMEMBERS)
    keys = {"illuminant_path": "illuminant.csv", "endmembers_path": "endmembers.csv", **extra}
    write_cubes(folder, NUM_VIEWS, 1.0, materials=["blue", "red"], **keys)
    write_light(folder / "relit" / "dim", sky=0.5)
    write_cubes(folder / "relit" / "dim", 2, 0.5)
    return folder


def _write_ball(folder: Path) -> None:
    write_light(folder, sky=1.0)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    ball.apply_translation(CENTRE)
    ball.export(folder / "mesh.ply")


def write_light(folder: Path, sky: float) -> Path:
    """A latitude-longitude map of even light."""
    folder.mkdir(parents=True, exist_ok=True)
    return write_exr(folder / "environment.exr", dict.fromkeys("RGB", np.full((8, 16), sky, np.float32)), {})


def write_views(folder: Path, suffix: str, colour: Colour, count: int = NUM_VIEWS, **extra: Any) -> None:
    """Pictures of the ball in one colour, with alpha, and their transforms.json."""
    names = [f"images/{index:03d}{suffix}" for index in range(count)]
    for name in names:
        write_picture(folder / name, colour)
    _write_transforms(folder, [{"file_path": name} for name in names], **extra)


def write_picture(path: Path, colour: Colour, lit_rows: int = SIZE) -> None:
    """The ball's silhouette filled with a colour; all but the upper `lit_rows` nearly black."""
    path.parent.mkdir(parents=True, exist_ok=True)
    side = np.arange(SIZE) + 0.5 - SIZE / 2
    radius = LENS_PX * RADIUS / math.sqrt(DISTANCE**2 - RADIUS**2)
    alpha = (np.hypot(*np.meshgrid(side, side)) < radius).astype(np.float32)
    if path.suffix == ".exr":
        light = alpha * np.where(np.arange(SIZE) < lit_rows, 1, 1e-4)[:, None].astype(np.float32)
        channels = {name: light * np.float32(value) for name, value in zip("RGB", colour, strict=True)}
        write_exr(path, {**channels, "A": alpha}, {})
        return
    pixels = np.dstack([np.full_like(alpha, value) for value in colour] + [alpha])
    Image.fromarray((pixels * 255 + 0.5).astype(np.uint8)).save(path)


def write_cubes(folder: Path, count: int, sky: float, **extra: Any) -> None:
    """Cubes, pictures with alpha, abundances and transforms.json."""
    above = (np.arange(SIZE) < SIZE / 2)[:, None, None]
    shares = np.where(above, [1.0, 0.0], [0.0, 1.0]) * np.ones((1, SIZE, 1))
    frames = []
    for index in range(count):
        frame = {
            "file_path": f"images/{index:03d}.png",
            "hyperspectral_file_path": f"cubes/{index:03d}.npy",
            "abundance_file_path": f"abundances/{index:03d}.npy",
        }
        write_picture(folder / frame["file_path"], (0.5, 0.5, 0.5))
        for name, numbers in (("cubes", sky * LAMP * (shares @ ENDMEMBERS)), ("abundances", shares)):
            (folder / name).mkdir(exist_ok=True)
            np.save(folder / name / f"{index:03d}.npy", numbers.astype(np.float32))
        frames.append(frame)
    _write_transforms(folder, frames, **{"wavelengths": WAVELENGTHS, **extra})


def _write_transforms(folder: Path, frames: list[dict[str, Any]], **extra: Any) -> None:
    """Poses are evenly spread around the ball; keys that are None are left out."""
    for index, frame in enumerate(frames):
        frame["transform_matrix"] = pose(2 * math.pi * index / len(frames)).tolist()
    content = {"fl_x": LENS_PX, "frames": frames, **extra}
    known = {key: value for key, value in content.items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(known))


def pose(angle: float) -> np.ndarray:
    """A camera that looks at the ball's centre from an angle about +z."""
    back = np.array([math.cos(angle), math.sin(angle), 0.0])
    right = np.array([-math.sin(angle), math.cos(angle), 0.0])
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, np.cross(back, right), back, CENTRE + DISTANCE * back])
    return matrix


def write_table(path: Path, names: tuple[str, ...], spectra: np.ndarray) -> None:
    """A table of spectra at the wavelengths of the cubes."""
    rows = [",".join(map(str, (nm, *values))) for nm, values in zip(WAVELENGTHS, spectra.T, strict=True)]
    path.write_text("\n".join([",".join(("wavelength", *names)), *rows]) + "\n")
