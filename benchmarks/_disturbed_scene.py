"""The demo scene as careless captures would show it: training views are disturbed, evaluation views keep the truth."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

GAIN = 0.2
WRONG_SHARE = 0.05
"""Of the mask's pixels, those whose alpha is turned round."""
HOLE_RADIUS = 0.12
"""Of the hole in one view's mask, as a share of the picture's width."""
NOISE, NOISY_FACTOR, NOISY_BAND = 0.005, 10.0, 20
STRIPES_SHARE, STRIPE_GAIN = 0.02, 0.3
"""Of all columns of all bands, those of a bad detector element, and what it makes of the light."""
SPIKES_SHARE, SPIKE = 0.001, 0.6

Change = Callable[[np.ndarray, np.ndarray, np.random.Generator, int], tuple[np.ndarray, np.ndarray]]
"""From cube (H, W, B) and picture with alpha (H, W, 4) of training view i to disturbed ones."""


def write_disturbed(source: Path, target: Path, change: Change) -> Path:
    """A copy of a scene with changed training views."""
    shutil.copytree(source, target)
    generator = np.random.default_rng(0)
    frames = _frames(target, "train_filenames")
    for index, frame in enumerate(frames):
        cube_path, picture_path = (target / frame[k] for k in ("hyperspectral_file_path", "file_path"))
        cube = np.load(cube_path).astype(np.float32)
        cube, picture = change(cube, np.asarray(Image.open(picture_path)), generator, index)
        np.save(cube_path, cube.clip(0, 1).astype(np.float16))
        Image.fromarray(picture).save(picture_path)
    return target


def write_lit_by_camera(source: Path, target: Path) -> Path:
    """The scene with a lamp that keeps its place beside the camera, in all views; size and bands as in the source."""
    from unmix_plugin.scenes.demo.scene import demo_cameras, frame_name, radiance_cube
    from unmix_plugin.scenes.demo.shading import (
        LAMP_POSITION,
        band_centers_nm,
        lamp_power,
        reflectances,
        render_view,
    )

    shutil.copytree(source, target)
    content = json.loads((target / "transforms.json").read_text(encoding="utf-8"))
    centers = band_centers_nm(len(content["wavelengths"]))
    spectra, lamp = reflectances(centers), lamp_power(centers)
    num_views = len(content["frames"])
    cameras = demo_cameras(content["w"], num_views)
    for index in range(num_views):
        x, y = cameras.camera_to_world[index, :2, 3].tolist()
        angle = np.arctan2(y, x)
        turned = (
            LAMP_POSITION[0] * np.cos(angle) - LAMP_POSITION[1] * np.sin(angle),
            LAMP_POSITION[0] * np.sin(angle) + LAMP_POSITION[1] * np.cos(angle),
            LAMP_POSITION[2],
        )
        cube = radiance_cube(render_view(cameras, index, lamp=turned), spectra, lamp)
        np.save(target / "cubes" / f"{frame_name(index)}.npy", cube.astype(np.float16))
    return target


def gains(
    cube: np.ndarray, picture: np.ndarray, generator: np.random.Generator, _: int
) -> tuple[np.ndarray, np.ndarray]:
    """Exposures that differ from view to view."""
    return cube * generator.uniform(1 - GAIN, 1 + GAIN), picture


def masks(
    cube: np.ndarray, picture: np.ndarray, generator: np.random.Generator, index: int
) -> tuple[np.ndarray, np.ndarray]:
    """Wrong pixels in all masks, and a hole in the first; cubes show what the camera saw."""
    alpha = picture[..., 3] > 127
    wrong = generator.random(alpha.shape) < WRONG_SHARE
    alpha = alpha ^ wrong
    if index == 0:
        size = alpha.shape[0]
        rows, columns = np.mgrid[:size, :size] + 0.5
        inside = (rows - size / 2) ** 2 + (columns - size / 2) ** 2 < (HOLE_RADIUS * size) ** 2
        alpha &= ~inside
    changed = picture.copy()
    changed[..., 3] = np.where(alpha, 255, 0)
    return cube, changed


def noise(
    cube: np.ndarray, picture: np.ndarray, generator: np.random.Generator, _: int
) -> tuple[np.ndarray, np.ndarray]:
    """Noise, ten times as much in one band, bad columns and spikes."""
    sigmas = np.full(cube.shape[-1], NOISE)
    sigmas[NOISY_BAND] *= NOISY_FACTOR
    noisy = cube + generator.normal(size=cube.shape) * sigmas
    # A detector's columns are bad in all views, so they are drawn alike in each.
    bad_columns = np.random.default_rng(1).random(cube.shape[1:]) < STRIPES_SHARE
    noisy = np.where(bad_columns[None], noisy * STRIPE_GAIN, noisy)
    return noisy + SPIKE * (generator.random(cube.shape) < SPIKES_SHARE), picture


def _frames(folder: Path, split: str) -> list[dict[str, Any]]:
    content = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    return [frame for frame in content["frames"] if frame["file_path"] in set(content[split])]
