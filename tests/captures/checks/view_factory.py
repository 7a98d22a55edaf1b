"""Views of a patterned ball for the checks, drawn point by point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from tests.scenes.scene_factory import look_at
from unmix_plugin.captures.checks import SeenView
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.writing.view_files import ViewRecord

SIDE = 120
LENS = Lens(SIDE, SIDE, (150.0, 150.0), (SIDE / 2, SIDE / 2))
RADIUS = 1.0


def record_of(name: str, **facts: float) -> ViewRecord:
    """A record of a view in which nothing is wrong, but for the facts."""
    values = {
        "num_pixels": SIDE * SIDE, "saturated_pixels": 0, "clipped_values": 0, "negative_values": 0,
        "missing_pixels": 0, "matter_share": 0.5, "specks": 0, "holes": 0, "brightness": 0.5, "detail": 1.0,
    }  # fmt: skip
    return ViewRecord(name=name, sensor="", paths={}, mean_spectrum=[], **{**values, **facts})  # type: ignore[arg-type]


def ring_of(
    count: int, span_deg: float = 360.0, elevations_deg: tuple[float, ...] = (10.0, 35.0)
) -> list[np.ndarray]:
    """Positions of cameras around the ball, in turn at the elevations."""
    angles = np.radians(np.linspace(0.0, span_deg, count, endpoint=span_deg < 360.0))
    heights = np.radians([elevations_deg[index % len(elevations_deg)] for index in range(count)])
    around = np.stack(
        [np.cos(angles) * np.cos(heights), np.sin(angles) * np.cos(heights), np.sin(heights)], axis=1
    )
    return list(4.0 * around)


def view_at(
    folder: Path, name: str, position: np.ndarray, light: np.ndarray | None, gain: float = 1.0, **facts: float
):
    """A view of the ball.

    Args:
        light: Where the lamp is; None is at the camera.
        gain: On the brightness of the picture.
        facts: Of its record.
    """
    pose = look_at(position, np.zeros(3))
    x, y = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    rays = np.stack([(x - SIDE / 2) / 150, -(y - SIDE / 2) / 150, -np.ones_like(x)], -1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    towards = rays @ position
    root = towards**2 - (position @ position - RADIUS**2)
    hit = root > 0
    points = position + (-towards - np.sqrt(np.maximum(root, 0)))[..., None] * rays
    lamp = position if light is None else light
    shade = np.clip(points @ (lamp / np.linalg.norm(lamp)), 0.0, None)
    pattern = 0.6 + 0.3 * np.sin(9 * points[..., 0]) * np.sin(9 * points[..., 1]) * np.sin(9 * points[..., 2])
    linear = np.clip(gain * 0.6 * pattern * (0.1 + 0.9 * shade), 0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    rgba = np.dstack([srgb, srgb, srgb, hit.astype(float)])
    folder.mkdir(exist_ok=True)
    Image.fromarray(np.rint(255 * rgba).astype(np.uint8)).save(folder / f"{name}.png")
    return SeenView(record_of(name, **facts), PosedCamera(pose[:3], LENS), folder / f"{name}.png")


def ball_points(count: int = 1500) -> np.ndarray:
    """Points on the ball."""
    directions = np.random.default_rng(0).standard_normal((count, 3))
    return RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)
