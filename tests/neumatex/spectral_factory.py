"""A tiny spectral object: the ball of `object_factory`, one material above and another below, in even light."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from tests.neumatex.object_factory import (
    CENTRE,
    LENS_PX,
    NUM_VIEWS,
    RADIUS,
    SIZE,
    pose,
    write_light,
    write_picture,
)

WAVELENGTHS = [450.0, 500.0, 550.0, 600.0, 650.0]
LAMP = np.array([0.4, 0.6, 0.8, 1.0, 0.9])
ENDMEMBERS = np.array([[0.7, 0.5, 0.2, 0.1, 0.1], [0.05, 0.1, 0.2, 0.5, 0.6]])


def write_spectral_object(folder: Path, **extra: Any) -> Path:
    """Write the object; `extra` are further keys of transforms.json."""
    folder.mkdir(parents=True, exist_ok=True)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    ball.apply_translation(CENTRE)
    ball.export(folder / "mesh.ply")
    write_light(folder, sky=1.0)
    write_table(folder / "illuminant.csv", ("power",), LAMP[None])
    write_table(folder / "endmembers.csv", ("blue", "red"), ENDMEMBERS)
    keys = {"illuminant_path": "illuminant.csv", "endmembers_path": "endmembers.csv", **extra}
    write_cubes(folder, NUM_VIEWS, 1.0, materials=["blue", "red"], **keys)
    relit = folder / "relit" / "dim"
    write_light(relit, sky=0.5)
    write_cubes(relit, 2, 0.5)
    return folder


def write_cubes(folder: Path, count: int, sky: float, **extra: Any) -> None:
    """Cubes, pictures with alpha, abundances and transforms.json."""
    above = (np.arange(SIZE) < SIZE / 2)[:, None, None]
    shares = np.where(above, [1.0, 0.0], [0.0, 1.0]) * np.ones((1, SIZE, 1))
    frames = []
    for index in range(count):
        names = {
            "file_path": f"images/{index:03d}.png",
            "hyperspectral_file_path": f"cubes/{index:03d}.npy",
            "abundance_file_path": f"abundances/{index:03d}.npy",
        }
        write_picture(folder / names["file_path"], (0.5, 0.5, 0.5))
        for name, numbers in (("cubes", sky * LAMP * (shares @ ENDMEMBERS)), ("abundances", shares)):
            (folder / name).mkdir(exist_ok=True)
            np.save(folder / name / f"{index:03d}.npy", numbers.astype(np.float32))
        frames.append({**names, "transform_matrix": pose(2 * math.pi * index / count).tolist()})
    content = {"fl_x": LENS_PX, "wavelengths": WAVELENGTHS, "frames": frames, **extra}
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(content))


def write_table(path: Path, names: tuple[str, ...], spectra: np.ndarray) -> None:
    """A table of spectra at the wavelengths of the cubes."""
    rows = [",".join(map(str, (nm, *values))) for nm, values in zip(WAVELENGTHS, spectra.T, strict=True)]
    path.write_text("\n".join([",".join(("wavelength", *names)), *rows]) + "\n")
