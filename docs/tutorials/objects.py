"""The objects of the tutorials, ray-traced: they stand for what a camera would have recorded.

Each function writes a scene folder (docs/reference/scene-folder.md): transforms.json, spectral cubes, sRGB pictures
with alpha, and the true spectra for comparison. Nothing here is needed for data of your own.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from unmix_plugin import Cameras
from unmix_plugin.engine import upright_cameras
from unmix_plugin.scenes.demo.scene import lens_entries, radiance_cube, transform_matrix
from unmix_plugin.scenes.demo.shading import (
    MATERIALS,
    Blend,
    Surface,
    Thing,
    lamp_power,
    plain,
    render_view,
    smooth_step,
)
from unmix_plugin.scenes.demo.shapes import PlacedPrimitive
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

LAMP = (1.6, -2.6, 3.6)
SLOTS = dict(zip(("one", "two", "three", "four", "five", "six"), MATERIALS, strict=True))


def _bump(nm: np.ndarray, centre: float, width: float) -> np.ndarray:
    return np.exp(-(((nm - centre) / width) ** 2))


def _step(nm: np.ndarray, centre: float, width: float) -> np.ndarray:
    return 1 / (1 + np.exp(-(nm - centre) / width))


def write_plant(folder: Path, size: int = 72, num_views: int = 28) -> None:
    """A potted plant on a turntable before a fixed camera and lamp: 41 bands, 400 to 1000 nm.

    Seen from the plant, camera and lamp go round it, so each view has a lamp of its own.
    """
    nm = np.linspace(400, 1000, 41)
    spectra = {
        "leaf": 0.04 + 0.09 * _bump(nm, 552, 32) + 0.45 * _step(nm, 716, 11),
        "dry leaf": 0.06 + 0.34 * _step(nm, 640, 55),
        "terracotta": 0.08 + 0.38 * _step(nm, 588, 20),
        "soil": 0.05 + 0.16 * _step(nm, 720, 110),
        "ceramic": 0.68 + 0.05 * _step(nm, 500, 60),
        "blue plastic": 0.07 + 0.38 * _bump(nm, 455, 42) + 0.5 * _step(nm, 770, 28),
    }
    one, two, three, four, five, six = SLOTS.values()

    def tip(points: np.ndarray) -> np.ndarray:
        return smooth_step(points[:, 1], 0.1, 0.75)

    def bands_of_glaze(points: np.ndarray) -> np.ndarray:
        return smooth_step(np.sin(points[:, 2] * 7 + 0.6), -0.3, 0.3)

    leaves = []
    for number in range(9):
        turn, height = number * 137.5, 0.86 + 0.075 * number
        reach = 0.34 - 0.018 * number
        angle = np.deg2rad(turn + 90)
        centre = (reach * np.cos(angle), reach * np.sin(angle), height)
        placement = PlacedPrimitive(
            "sphere", centre, (0.13, 0.34 - 0.014 * number, 0.035), turn_deg=turn, tilt_deg=28 + 3 * number
        )
        leaves.append(Thing(placement, Surface(one, two, tip if number % 3 == 0 else plain)))
    things = [
        Thing(PlacedPrimitive("cylinder", (0, 0, -0.05), (1.05, 1.05, 0.05)), Surface(six, six, plain), ()),
        Thing(
            PlacedPrimitive("cylinder", (0, 0, 0.3), (0.42, 0.42, 0.3)),
            Surface(three, five, bands_of_glaze),
            ((0, 0, 0.3, 0.4),),
        ),
        Thing(PlacedPrimitive("cylinder", (0, 0, 0.605), (0.36, 0.36, 0.015)), Surface(four, four, plain)),
        Thing(PlacedPrimitive("cylinder", (0, 0, 0.95), (0.03, 0.03, 0.36)), Surface(one, one, plain)),
        *leaves,
    ]
    angles = np.arange(num_views) * 2 * np.pi * 5 / num_views  # five turns, the camera higher in each
    heights = np.deg2rad(18 + 34 * np.arange(num_views) / num_views)
    backward = np.stack(
        [np.cos(heights) * np.cos(angles), np.cos(heights) * np.sin(angles), np.sin(heights)], axis=1
    )
    cameras = upright_cameras(np.array([0, 0, 0.6]) + 4.0 * backward, backward, size, np.deg2rad(37))
    lamps = []
    for angle in angles:
        cosine, sine = np.cos(angle), np.sin(angle)
        lamps.append((cosine * 2.6 + sine * 1.4, sine * 2.6 - cosine * 1.4, 3.4))
    _write(folder, things, cameras, nm, spectra, "E", lamps)


def write_painting(folder: Path, size: int = 72, num_views: int = 24) -> None:
    """A painted panel on an easel's plate: 31 bands, 400 to 700 nm, in daylight (D65).

    A restorer has filled half of the blue field with another blue. In daylight the two have one colour.
    """
    nm = np.linspace(400, 700, 31)
    blue = 0.1 + 0.32 * _bump(nm, 470, 55) + 0.12 * _step(nm, 660, 14)
    spectra = {
        "ground": 0.74 - 0.16 * _bump(nm, 400, 60),
        "vermilion": 0.05 + 0.66 * _step(nm, 598, 11),
        "ochre": 0.07 + 0.46 * _step(nm, 545, 24),
        "green earth": 0.08 + 0.26 * _bump(nm, 540, 48),
        "old blue": blue,
        "new blue": _metamer(blue, nm),
    }
    one, two, three, four, five, six = SLOTS.values()

    def field(
        x: float, y: float, width: float, height: float, first: str, second: str, blend: Blend = plain
    ) -> Thing:
        return Thing(
            PlacedPrimitive("box", (x, y, 0.1), (width, height, 0.012)), Surface(first, second, blend)
        )

    def half(points: np.ndarray) -> np.ndarray:
        return (points[:, 0] + 0.25 * np.sin(7 * points[:, 1]) > 0.1).astype(points.dtype)

    def waves(points: np.ndarray) -> np.ndarray:
        return smooth_step(np.sin(6 * points[:, 0] + 2 * np.sin(3 * points[:, 1])), -0.5, 0.5)

    ball = Thing(
        PlacedPrimitive("sphere", (0.42, -0.32, 0.12), (0.17, 0.17, 0.05)), Surface(two, three, waves)
    )
    things = [
        Thing(PlacedPrimitive("box", (0, 0, 0), (1.0, 0.75, 0.09)), Surface(one, one, plain)),
        field(0, 0.3, 0.86, 0.32, five, six, half),
        field(-0.3, -0.38, 0.56, 0.26, four, three, waves),
        Thing(
            PlacedPrimitive("cylinder", (-0.55, 0.38, 0.11), (0.17, 0.17, 0.014)),
            Surface(three, three, plain),
        ),
        ball,
    ]
    count = np.arange(num_views)
    azimuths, heights = count * np.pi * (3 - np.sqrt(5)), np.deg2rad(38 + 44 * ((count * np.sqrt(2)) % 1))
    backward = np.stack(
        [np.cos(heights) * np.cos(azimuths), np.cos(heights) * np.sin(azimuths), np.sin(heights)], axis=1
    )
    cameras = upright_cameras(3.6 * backward, backward, size, np.deg2rad(36))
    _write(folder, things, cameras, nm, spectra, "D65", [LAMP] * num_views)


def _metamer(reflectance: np.ndarray, nm: np.ndarray) -> np.ndarray:
    """Another reflectance with the same colour in daylight: a change is added that the eye does not see there."""
    bands = Bands.of(nm)
    seen = (rgb_matrix(bands, torch.float64).numpy() * lamp_power(nm, "D65")[:, None]).T
    change = _bump(nm, 610, 28) - _bump(nm, 520, 30)
    unseen = change - np.linalg.pinv(seen) @ (seen @ change)
    return reflectance + unseen * 0.9 * (reflectance / np.maximum(-unseen, 1e-9))[unseen < 0].min()


def _write(
    folder: Path,
    things: Sequence[Thing],
    cameras: Cameras,
    nm: np.ndarray,
    spectra: dict[str, np.ndarray],
    light: str,
    lamps: Sequence[tuple[float, float, float]],
) -> None:
    bands, table = Bands.of(nm), np.stack(list(spectra.values()))
    power, to_rgb = lamp_power(nm, light), rgb_matrix(bands)
    for name in ("cubes", "images"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    write_spectra_csv(folder / "endmembers.csv", SpectraTable(bands, tuple(spectra), table))
    write_spectra_csv(folder / "illuminant.csv", SpectraTable(bands, ("power",), power[None]))
    frames = []
    for index, lamp in enumerate(lamps):
        view = render_view(cameras, index, things=things, lamp=lamp)
        cube = radiance_cube(view, table, power)
        srgb = linear_to_srgb(torch.from_numpy(cube) @ to_rgb).clamp(0, 1).numpy()
        entry = {"file_path": f"images/{index:03d}.png", "hyperspectral_file_path": f"cubes/{index:03d}.npy"}
        picture = np.concatenate([srgb, view.alpha[..., None]], axis=-1)
        Image.fromarray((picture * 255).round().astype(np.uint8)).save(folder / entry["file_path"])
        np.save(folder / entry["hyperspectral_file_path"], cube.astype(np.float16))
        frames.append({**entry, "transform_matrix": transform_matrix(cameras, index)})
    content = {
        **lens_entries(cameras),
        "wavelengths": nm.tolist(),
        "illuminant_path": "illuminant.csv",
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
