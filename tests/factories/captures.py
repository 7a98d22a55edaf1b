"""Small captures as an instrument writes them, with the truth beside them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.factories.files import AXES, header_text
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.process import process_capture
from unmix_plugin.captures.writing.view_files import ViewRecord

HEIGHT, WIDTH, BANDS = 24, 32, 9
WAVELENGTHS_NM = np.linspace(450.0, 850.0, BANDS)


Tell = Callable[[str], None]


@dataclass(frozen=True)
class MadeCapture:
    """A folder and what its cubes show."""

    root: Path
    reflectance: dict[str, np.ndarray]
    """By view, (H, W, B) in [0, 1]."""
    white: np.ndarray
    """Counts of the white panel above dark, (W, B)."""
    dark: np.ndarray
    """(W, B)"""


def make_capture(root: Path, views: int = 4, kind: str = "envi", noise: float = 0.0) -> MadeCapture:
    """A line camera's cubes (counts in 12 bits) with dark and white frames and poses on a ring."""
    generator = np.random.default_rng(0)
    root.mkdir(parents=True)
    dark = 100.0 + 10.0 * generator.random((WIDTH, BANDS))
    white = 3000.0 * (0.5 + 0.5 * generator.random((WIDTH, 1))) * np.linspace(1.0, 0.6, BANDS)
    reflectance = {}
    for index in range(views):
        name = f"view_{index:02d}"
        reflectance[name] = _reflectance(generator)
        counts = reflectance[name] * white + dark + noise * generator.standard_normal((HEIGHT, WIDTH, BANDS))
        write_cube(root, name, np.rint(counts).astype(np.uint16), kind)
    white_lines = np.broadcast_to(white + dark, (12, WIDTH, BANDS))
    write_cube(root, "white", np.rint(white_lines).astype(np.uint16), kind)
    write_cube(root, "dark", np.rint(np.broadcast_to(dark, (12, WIDTH, BANDS))).astype(np.uint16), kind)
    write_poses(root / "transforms.json", list(reflectance))
    return MadeCapture(root, reflectance, np.rint(white + dark) - np.rint(dark), np.rint(dark))


def write_cube(root: Path, name: str, counts: np.ndarray, kind: str = "envi", header: Any = None) -> Path:
    """One image as NAME.hdr and NAME.raw (bil), or as NAME.npy."""
    if kind == "npy":
        np.save(root / f"{name}.npy", counts)
        return root / f"{name}.npy"
    counts.transpose(AXES["bil"]).tofile(root / f"{name}.raw")
    centres = ", ".join(f"{value:g}" for value in WAVELENGTHS_NM[: counts.shape[2]])
    bands = {"wavelength units": "Nanometers", "wavelength": f"{{{centres}}}"}
    (root / f"{name}.hdr").write_text(header_text(counts, "bil", bands | (header or {})), encoding="utf-8")
    return root / f"{name}.hdr"


def write_poses(path: Path, names: list[str], width: int = WIDTH, height: int = HEIGHT) -> None:
    """Cameras on a ring that look at its middle."""
    frames = []
    for index, name in enumerate(names):
        angle = 2 * np.pi * index / len(names)
        position = np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), 1.0])
        back = position / np.linalg.norm(position)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.column_stack([right, np.cross(back, right), back, position])
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()})
    content = {"w": width, "h": height, "fl_x": 1.5 * width, "frames": frames}
    path.write_text(json.dumps(content), encoding="utf-8")


def process(capture: Path, output: Path, layout: str = "cubes", tell: Tell = lambda _: None, /, **options):
    """Make the scene of a capture, of the layout `cubes` with all of each image unless a mask is asked for; gives what
    looks wrong."""
    given = {"poses": "transforms.json", "mask": "none"} if layout == "cubes" else {}
    asked = ProcessOptions(layout, data=capture, output_dir=output, **{**given, **options})
    return process_capture(asked, tell, lambda _, views: views)


def _reflectance(generator: np.random.Generator) -> np.ndarray:
    """A bright square with texture on a dark ground."""
    values = np.full((HEIGHT, WIDTH, BANDS), 0.02)
    square = 0.3 + 0.4 * generator.random((HEIGHT // 2, WIDTH // 2, 1)) * np.linspace(0.5, 1.0, BANDS)
    values[HEIGHT // 4 : HEIGHT // 4 + len(square), WIDTH // 4 : WIDTH // 4 + square.shape[1]] = square
    return values


def record_of(name: str, **facts: float) -> ViewRecord:
    """A record of a view in which nothing is wrong, but for the facts."""
    values = {
        "num_pixels": 120 * 120, "saturated_pixels": 0, "clipped_values": 0, "negative_values": 0,
        "missing_pixels": 0, "matter_share": 0.5, "specks": 0, "holes": 0, "brightness": 0.5, "detail": 1.0,
    }  # fmt: skip
    return ViewRecord(name=name, sensor="", paths={}, mean_spectrum=[], **{**values, **facts})  # type: ignore[arg-type]
