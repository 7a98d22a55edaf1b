"""A made-up flight with a camera of four lenses, each of one band: ground with a road, trees and a building.

The land is a height for each place of a grid, and a material; the sun casts shadows. A camera sways as a small aircraft
does. Lengths are in metres; the scene's unit is 100 m, as programs for poses choose theirs.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

LENSES = {"green": 550.0, "red": 660.0, "red_edge": 735.0, "near_infrared": 790.0}
MATERIALS = {
    "soil": (0.22, 0.33, 0.42, 0.48),
    "grass": (0.15, 0.09, 0.45, 0.68),
    "tree": (0.08, 0.05, 0.30, 0.57),
    "road": (0.15, 0.16, 0.18, 0.20),
    "roof": (0.30, 0.52, 0.57, 0.60),
}
ALTITUDE_M, SPACING_M, SWAY_RAD, UNIT_M = 70.0, 12.0, 0.05, 100.0
WIDTH, HEIGHT, HALF_ANGLE_DEG = 320, 240, 31.0
EXTENT_M, CELLS = 240.0, 2048
HIGHEST_M, LOWEST_M, STEP_M = 24.0, -12.0, 0.25
SUN = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])
NOISE = 0.004


@dataclass(frozen=True)
class Land:
    """What lies at each place of a square."""

    heights: np.ndarray
    materials: np.ndarray
    brightness: np.ndarray

    @staticmethod
    def looked_up(values: np.ndarray, x: np.ndarray, y: np.ndarray, order: int = 1) -> np.ndarray:
        """Values at places in metres from the middle."""
        scale = CELLS / EXTENT_M
        places = [(y + EXTENT_M / 2) * scale, (x + EXTENT_M / 2) * scale]
        return ndimage.map_coordinates(values, places, order=order, mode="nearest")


def make_land(seed: int) -> Land:
    """Hills, patches of grass on soil, a road, 70 trees and a building."""
    rng = np.random.default_rng(seed)

    def noise(cells: float) -> np.ndarray:
        smooth = ndimage.gaussian_filter(rng.standard_normal((CELLS, CELLS)), cells, mode="wrap")
        return smooth / smooth.std()

    y, x = np.mgrid[:CELLS, :CELLS] * (EXTENT_M / CELLS) - EXTENT_M / 2
    heights = 1.5 * noise(300) + 0.05 * noise(6)
    materials = np.where(noise(60) + 0.3 * noise(8) > 0.2, 0, 1)
    road = np.abs(x + 0.15 * y - 5) < 3
    heights[road], materials[road] = ndimage.gaussian_filter(heights, 40)[road], 3
    leaves = 1 + 0.1 * noise(4)
    for _ in range(70):
        (east, north), radius = rng.uniform(-100, 100, 2), rng.uniform(1.5, 4)
        away = np.hypot(x - east, y - north)
        crown = (away < radius) & ~road
        tall = rng.uniform(1.5, 2.5) * radius * np.sqrt(np.clip(1 - (away / radius) ** 2, 0, 1))
        heights[crown] += (tall * leaves)[crown]
        materials[crown] = 2
    building = (np.abs(x + 20) < 7) & (np.abs(y - 10) < 5)
    heights[building], materials[building] = heights[building].mean() + 5, 4
    texture = np.clip(1 + 0.12 * noise(2) + 0.10 * noise(12), 0.3, 2)
    return Land(heights, materials, texture * _sunlight(heights))


def _sunlight(heights: np.ndarray) -> np.ndarray:
    """Of a matt surface, with cast shadows and a quarter of the light from the sky."""
    cell = EXTENT_M / CELLS
    down, across = np.gradient(heights, cell)
    normals = np.stack([-across, -down, np.ones_like(heights)], axis=-1)
    facing = np.clip(normals @ SUN / np.linalg.norm(normals, axis=-1), 0, 1)
    lit = np.ones_like(heights)
    for away in np.arange(0.3, 14, 0.3):
        towards = -SUN[[1, 0]] * away / cell
        lit[ndimage.shift(heights, towards, order=1, mode="nearest") > heights + SUN[2] * away] = 0
    return 0.25 + 0.75 * facing * ndimage.gaussian_filter(lit, 1.0)


def write_flight(folder: Path, releases: int, seed: int) -> Path:
    """Write the scene; the release in the middle is for evaluation."""
    land, rng = make_land(seed), np.random.default_rng(seed + 1)
    mounts = {
        name: (rng.normal(0, 0.008, 3), (0.015 * (-1) ** (k % 2), 0.015 * (-1) ** (k // 2), 0.0))
        for k, name in enumerate(LENSES)
    }
    for name in ("cubes", "labels"):
        (folder / name).mkdir(parents=True)
    frames: list[dict[str, Any]] = []
    for release in range(releases):
        body = np.eye(4)
        body[:3, :3] = Rotation.from_rotvec(rng.normal(0, SWAY_RAD, 3) * (1, 1, 0.4)).as_matrix()
        along = (release - (releases - 1) / 2) * SPACING_M
        body[:3, 3] = np.add(rng.normal(0, 1, 3), (0.0, along, ALTITUDE_M))
        for band, (name, (turn, place)) in enumerate(mounts.items()):
            pose = body.copy()
            pose[:3, 3] += body[:3, :3] @ place
            pose[:3, :3] = body[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
            frames.append(_write_frame(folder, land, pose, release, name, band, rng))
    content = {
        "wavelengths": [*LENSES.values()],
        "camera_model": "PINHOLE",
        "materials": [*MATERIALS],
        "test_filenames": [
            frame["hyperspectral_file_path"] for frame in frames if frame["capture"] == f"{releases // 2:04d}"
        ],
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    return folder


def _write_frame(
    folder: Path, land: Land, pose: np.ndarray, release: int, name: str, band: int, rng: np.random.Generator
) -> dict[str, Any]:
    title = f"{release:04d}_{name}"
    offsets = [(x, y) for x in (0.25, 0.75) for y in (0.25, 0.75)]
    seen = np.mean([_render(land, pose, band, offset)[0] for offset in offsets], axis=0)
    seen = np.clip(seen + NOISE * rng.standard_normal(seen.shape), 0, 1)
    np.save(folder / "cubes" / f"{title}.npy", seen[..., None].astype(np.float16))
    _, labels = _render(land, pose, band, (0.5, 0.5))
    Image.fromarray(labels.astype(np.uint8)).save(folder / "labels" / f"{title}.png")
    written = pose.copy()
    written[:3, 3] /= UNIT_M
    return {
        "hyperspectral_file_path": f"cubes/{title}.npy",
        "seg_file_path": f"labels/{title}.png",
        "sensor": name,
        "capture": f"{release:04d}",
        "bands": [band],
        "fl_x": WIDTH / 2 / np.tan(np.radians(HALF_ANGLE_DEG)),
        "transform_matrix": written.tolist(),
    }


def _render(
    land: Land, pose: np.ndarray, band: int, offset: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and materials (H, W) along one ray a pixel: the first place below the land, found by halving."""
    focal = WIDTH / 2 / np.tan(np.radians(HALF_ANGLE_DEG))
    columns, rows = np.meshgrid(np.arange(WIDTH) + offset[0], np.arange(HEIGHT) + offset[1])
    local = np.stack([columns - WIDTH / 2, HEIGHT / 2 - rows, np.full_like(rows, -focal)], axis=-1)
    directions = local @ pose[:3, :3].T
    slopes, origin = directions[..., :2] / -directions[..., 2:], pose[:3, 3]

    def places(heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        across = origin[:2] + slopes * (origin[2] - heights)[..., None]
        return across[..., 0], across[..., 1]

    high = np.full(rows.shape, HIGHEST_M)
    is_under = np.zeros(rows.shape, dtype=bool)
    while not is_under.all() and high.min() > LOWEST_M:
        is_under |= land.looked_up(land.heights, *places(high - STEP_M)) >= high - STEP_M
        high = np.where(is_under, high, high - STEP_M)
    low = high - STEP_M
    for _ in range(6):
        middle = (low + high) / 2
        is_inside = land.looked_up(land.heights, *places(middle)) >= middle
        low, high = np.where(is_inside, middle, low), np.where(is_inside, high, middle)
    labels = land.looked_up(land.materials, *places(high), order=0)
    reflectances = np.array([*MATERIALS.values()])[labels, band]
    return reflectances * land.looked_up(land.brightness, *places(high)), labels
