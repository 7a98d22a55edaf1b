"""The demo scene's views: where its cameras are, and pixels from the coefficients that rays gathered.

Notation: `B` bands, `K` materials, `H`, `W` rows and columns.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.upright_cameras import upright_cameras
from unmix_plugin.scenes.demo.shading import ViewCoefficients
from unmix_plugin.scenes.reading.images import UNLABELLED

VIEW_ANGLE_DEG = 38.0
CAMERA_DISTANCE = 4.1
LOOK_AT = (0.0, 0.0, 0.22)
ELEVATIONS_DEG = (16.0, 68.0)


def demo_cameras(size: int, views: int) -> Cameras:
    """Cameras on a dome around the table, azimuths spread by the golden angle."""
    i = np.arange(views)
    azimuths = i * np.pi * (3 - np.sqrt(5))
    # A second irrational stride decouples elevation from order, so that every 4th view samples the whole dome.
    shares = (i * np.sqrt(2) + 0.5 / views) % 1
    low, high = np.sin(np.deg2rad(ELEVATIONS_DEG))
    heights = low + (high - low) * shares
    flat = np.sqrt(1 - heights**2)
    backward = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), heights], axis=1)
    positions = np.asarray(LOOK_AT) + CAMERA_DISTANCE * backward
    return upright_cameras(positions, backward, size, np.deg2rad(VIEW_ANGLE_DEG))


def lens_entries(cameras: Cameras) -> dict[str, Any]:
    """What transforms.json says of the lens that all of the cameras have."""
    focal_px, center_px = float(cameras.focal_px[0, 0]), float(cameras.center_px[0, 0])
    return {
        "camera_model": "OPENCV",
        "w": cameras.width,
        "h": cameras.height,
        "fl_x": focal_px,
        "fl_y": focal_px,
        "cx": center_px,
        "cy": center_px,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def transform_matrix(cameras: Cameras, index: int) -> list[list[float]]:
    """Camera to world as the four rows that transforms.json has."""
    return [*cameras.camera_to_world[index].double().tolist(), [0.0, 0.0, 0.0, 1.0]]


def frame_name(index: int) -> str:
    """`train_000`, `train_001`, `eval_002`, ...: every 4th view is for evaluation."""
    return f"{'eval' if index % 4 == 2 else 'train'}_{index:03d}"


def radiance_cube(
    view: ViewCoefficients, spectra: Float[np.ndarray, "K B"], lamp: Float[np.ndarray, " B"]
) -> Float[np.ndarray, "H W B"]:
    """Spectral radiance of every pixel in [0, 1]: what exceeds 1 saturates, as in a sensor."""
    return (reflected(view, spectra) * lamp.astype(np.float32)).clip(0, 1)


def reflected(view: ViewCoefficients, spectra: Float[np.ndarray, "K B"]) -> Float32[np.ndarray, "H W B"]:
    """What every pixel reflects of the lamp, highlights included; 1 is a white matt panel in irradiance 1."""
    return view.diffuse @ spectra.astype(np.float32) + view.specular[..., None]


def label_image(view: ViewCoefficients) -> UInt8[np.ndarray, "H W"]:
    """The material with the largest abundance where at least half a pixel is covered, otherwise 255."""
    return np.where(view.alpha >= 0.5, view.abundances.argmax(axis=-1), UNLABELLED).astype(np.uint8)
