"""Scenes whose cubes are larger than memory, written in moments.

Rays are cast for each fourth pixel and each stands for a block of them: cheap, and as large to read and to train on as
any other scene. One shows the built-in table through a wide lens, so that most of each picture is black and its files
are holes there. The others show the built-in places without alpha, so that every value lies on the disk.

Notation: `B` bands, `H`, `W` rows and columns.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float16
from PIL import Image

from unmix_plugin.scenes.demo.scene import (
    PLACES,
    demo_cameras,
    frame_name,
    lens_entries,
    radiance_cube,
    transform_matrix,
)
from unmix_plugin.scenes.demo.shading import band_centers_nm, lamp_power, reflectances, render_view

BLOCK = 4
"""Pixels along an edge that look alike."""
WIDE = 0.35
"""Focal length in parts of the built-in scene's."""
NOISE = 0.004
"""Standard deviation, in parts of what stands for 1."""
_WHITE, _LARGEST_UINT16 = 60000.0, 65535


def write_large_scene(folder: Path, size: int, bands: int, views: int) -> int:
    """Write a scene into a new folder; `size` is a multiple of 4. Returns how many bytes lie on the disk."""
    for name in ("images", "cubes"):
        (folder / name).mkdir(parents=True)
    nm = band_centers_nm(bands)
    spectra, lamp = reflectances(nm), lamp_power(nm)
    cameras = demo_cameras(size, views)
    cameras = replace(cameras, focal_px=cameras.focal_px * WIDE)
    coarse = demo_cameras(size // BLOCK, views)
    coarse = replace(coarse, focal_px=coarse.focal_px * WIDE)
    frames: list[dict[str, Any]] = []
    for index in range(views):
        view, name = render_view(coarse, index, subpixels=1), frame_name(index)
        alpha = (255 * view.alpha.repeat(BLOCK, 0).repeat(BLOCK, 1)).astype(np.uint8)
        Image.fromarray(np.stack([alpha] * 4, axis=-1)).save(folder / f"images/{name}.png", compress_level=1)
        _write_sparse(folder / f"cubes/{name}.npy", radiance_cube(view, spectra, lamp).astype(np.float16))
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "hyperspectral_file_path": f"cubes/{name}.npy",
                "transform_matrix": transform_matrix(cameras, index),
            }
        )
    content = {**lens_entries(cameras), "wavelengths": nm.tolist(), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return sum(512 * path.stat().st_blocks for path in folder.rglob("*") if path.is_file())


DENSE_KINDS = ("room", "world", "backdrop", "rig")


def write_dense_scene(folder: Path, size: int, bands: int, views: int, kind: str = "room") -> int:
    """Write a scene without alpha as integers of 16 bits into a new folder; arguments and result as above.

    Args:
        kind: A room, the open world, a table before a black backdrop and without noise, of which more pixels are unlike
            the others than some pixels tell, or the room by two sensors in turn, of which one lacks every other band.
    """
    (folder / "cubes").mkdir(parents=True)
    nm, place = band_centers_nm(bands), PLACES[{"backdrop": "table", "rig": "room"}.get(kind, kind)]
    spectra, lamp = reflectances(nm), lamp_power(nm)
    cameras, coarse = place.cameras(size, views), place.cameras(size // BLOCK, views)
    generator, frames = np.random.default_rng(0), []
    strength = 0.0 if kind == "backdrop" else NOISE * _WHITE
    noise = generator.normal(scale=strength, size=(BLOCK, size, bands)).astype(np.float32)
    for index in range(views):
        view, name = (
            render_view(coarse, index, subpixels=1, things=place.things, sky=place.sky),
            frame_name(index),
        )
        chosen = list(range(0, bands, 2 if kind == "rig" and index % 2 else 1))
        cube = np.lib.format.open_memmap(
            folder / f"cubes/{name}.npy", mode="w+", dtype=np.uint16, shape=(size, size, len(chosen))
        )
        for row, values in enumerate(_WHITE * radiance_cube(view, spectra, lamp)):
            shift = int(generator.integers(size))
            noisy = values.repeat(BLOCK, axis=0) + np.roll(noise, shift, axis=1)
            cube[BLOCK * row : BLOCK * (row + 1)] = noisy.clip(0, _LARGEST_UINT16)[..., chosen]
        frames.append(
            {
                "hyperspectral_file_path": f"cubes/{name}.npy",
                "transform_matrix": transform_matrix(cameras, index),
                **({"sensor": f"{len(chosen)} bands", "bands": chosen} if kind == "rig" else {}),
            }
        )
    content = {**lens_entries(cameras), "wavelengths": nm.tolist(), "value_scale": _WHITE, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def few_views(folder: Path, whole: Path, count: int) -> None:
    """A scene of the first views of another, with the same files."""
    for name in ("images", "cubes"):
        (folder / name).mkdir(parents=True)
    content = json.loads((whole / "transforms.json").read_text(encoding="utf-8"))
    content["frames"] = content["frames"][:count]
    for frame in content["frames"]:
        for key in ("file_path", "hyperspectral_file_path"):
            (folder / frame[key]).hardlink_to(whole / frame[key])
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def _write_sparse(path: Path, coarse: Float16[np.ndarray, "h w B"]) -> None:
    """An (H, W, B) array of blocks, with holes where it is black."""
    height, width, bands = (BLOCK * coarse.shape[0], BLOCK * coarse.shape[1], coarse.shape[2])
    with path.open("wb") as file:
        header = {"descr": "<f2", "fortran_order": False, "shape": (height, width, bands)}
        np.lib.format.write_array_header_1_0(file, header)
        start = file.tell()
        for row, values in enumerate(coarse):
            lit = np.flatnonzero(values.any(axis=-1))
            if len(lit) == 0:
                continue
            first, last = lit[0], lit[-1] + 1
            line = values[first:last].repeat(BLOCK, axis=0).tobytes()
            for below in range(BLOCK):
                file.seek(start + 2 * bands * ((BLOCK * row + below) * width + BLOCK * int(first)))
                file.write(line)
        file.truncate(start + 2 * bands * width * height)
