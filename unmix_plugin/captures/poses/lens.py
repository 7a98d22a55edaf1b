"""The lens of a camera, and the nearest one of its kind to lenses of models that we do not have.

Notation: `P` points; ideal coordinates are x/z, y/z before the camera, +x right, +y down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import CaptureError

Points = Float64[np.ndarray, "P 2"]
_Project: TypeAlias = Callable[[Points], Points]
"""From ideal coordinates to pixels."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera. Pixels, with the centre of the first pixel at (0.5, 0.5)."""

    width: int
    height: int
    focal_px: tuple[float, float]
    """Along x and y."""
    center_px: tuple[float, float]
    """Principal point x, y."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2 of the OPENCV model; zeros are a pinhole."""
    higher_radial: tuple[float, float] = (0.0, 0.0)
    """k3, k4: radial terms of the sixth and eighth power."""

    @property
    def radial(self) -> tuple[float, float, float, float]:
        """k1 to k4."""
        return (*self.distortion[:2], *self.higher_radial)

    @property
    def tangential(self) -> tuple[float, float]:
        """p1, p2."""
        return self.distortion[2:]

    def pixels_of(self, ideal: Points) -> Points:
        """Where ideal points are seen."""
        return project_opencv(ideal, self.focal_px, self.center_px, self.radial, self.tangential)


_LARGEST_ERROR_PX = 0.5
"""Of a fitted lens anywhere in the image; beyond, the images have to be undistorted."""
_GRID = 21
_STEP = 1e-6


def project_opencv(
    ideal: Points,
    focal_px: tuple[float, float],
    center_px: tuple[float, float],
    radial: tuple[float, ...],
    tangential: tuple[float, float] = (0.0, 0.0),
) -> Points:
    """Pixels of ideal points through a lens with radial terms of r^2, r^4, ... and OpenCV's p1, p2."""
    x, y = ideal.T
    squared = x**2 + y**2
    factor = 1.0 + sum(k * squared ** (power + 1) for power, k in enumerate(radial))
    p1, p2 = tangential
    bent_x = x * factor + 2 * p1 * x * y + p2 * (squared + 2 * x**2)
    bent_y = y * factor + 2 * p2 * x * y + p1 * (squared + 2 * y**2)
    return np.column_stack([focal_px[0] * bent_x + center_px[0], focal_px[1] * bent_y + center_px[1]])


def project_fisheye(
    ideal: Points, focal_px: tuple[float, float], center_px: tuple[float, float], terms: tuple[float, ...]
) -> Points:
    """Pixels of ideal points through an equidistant lens with terms of theta^2, theta^4, ... (OPENCV_FISHEYE)."""
    radius = np.linalg.norm(ideal, axis=1)
    theta = np.arctan(radius)
    bent = theta * (1.0 + sum(k * theta ** (2 * power + 2) for power, k in enumerate(terms)))
    ratio = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 1e-12)
    return ideal * ratio[:, None] * np.array(focal_px) + np.array(center_px)


def fit_lens(
    project: _Project, start: Lens, model: str, where: str, limit_px: float = _LARGEST_ERROR_PX
) -> tuple[Lens, str]:
    """The OPENCV lens that is nearest to another model.

    Args:
        project: The other model.
        start: Size of the image and a first guess of focal length and centre.
        model: What the other model is called.
        where: The file, for messages.
        limit_px: How far it may be off.
    Returns:
        The lens, and a sentence that says how far it is off.
    Raises:
        CaptureError: it is off by more than the limit somewhere in the image, or the model does not cover it.
    """
    from scipy.optimize import least_squares

    pixels = _pixel_grid(start.width, start.height)
    ideal = _invert(project, pixels, start)
    advice = "undistort the images and export the poses with a pinhole or OPENCV lens"
    if ideal is None:
        raise CaptureError(
            f"{where}: the lens model {model} can't be followed to the corners of the image; {advice}"
        )

    def lens_of(values: np.ndarray) -> Lens:
        fx, fy, cx, cy, p1, p2, k1, k2, k3, k4 = values.tolist()
        return Lens(start.width, start.height, (fx, fy), (cx, cy), (k1, k2, p1, p2), (k3, k4))

    def errors(values: np.ndarray) -> np.ndarray:
        return (lens_of(values).pixels_of(ideal) - pixels).ravel()

    first = np.array([*start.focal_px, *start.center_px, *start.tangential, *start.radial])
    scales = np.array([*start.focal_px, *start.focal_px, 0.01, 0.01, 0.1, 0.1, 0.1, 0.1])
    found = least_squares(errors, first, x_scale=scales).x
    worst = float(np.linalg.norm(errors(found).reshape(-1, 2), axis=1).max())
    if worst > limit_px:
        raise CaptureError(
            f"{where}: the lens model {model} differs from the nearest OPENCV lens by up to "
            f"{worst:.3g} px; expected at most {limit_px:g} px: {advice}"
        )
    return lens_of(
        found
    ), f"lens model {model} replaced by the nearest OPENCV lens; off by at most {worst:.2g} px"


def require_unfolded(lens: Lens, where: str) -> None:
    """Refuse a lens that maps two directions to one pixel of its image.

    Raises:
        CaptureError: it does.
    """
    if _folds(lens):
        raise CaptureError(
            f"{where}: the distortion {[*lens.radial, *lens.tangential]} folds the corners of the image over; "
            "calibrate the camera again, or undistort the images and export the poses with a pinhole lens"
        )


@lru_cache
def _folds(lens: Lens) -> bool:
    """Remembered, since all files of one camera have the same lens."""
    return _invert(lens.pixels_of, _pixel_grid(lens.width, lens.height), lens) is None


def _pixel_grid(width: int, height: int) -> Points:
    columns, rows = np.meshgrid(np.linspace(0, width, _GRID), np.linspace(0, height, _GRID))
    return np.column_stack([columns.ravel(), rows.ravel()])


def _invert(project: _Project, pixels: Points, start: Lens) -> Points | None:
    """Ideal points that `project` maps to the pixels, by Newton's method; None if there are none."""
    ideal = (pixels - np.array(start.center_px)) / np.array(start.focal_px)
    with np.errstate(all="ignore"):
        for _ in range(50):
            missing = pixels - project(ideal)
            if not np.isfinite(missing).all():
                return None
            steps = _STEP * np.eye(2)
            along = [(project(ideal + step) - project(ideal - step)) / (2 * _STEP) for step in steps]
            jacobian = np.stack(along, axis=-1)
            determinant = np.linalg.det(jacobian)
            if not np.isfinite(determinant).all() or (determinant <= 0).any():
                return None
            ideal = ideal + np.linalg.solve(jacobian, missing[..., None])[..., 0]
        return ideal if np.abs(pixels - project(ideal)).max() < 1e-3 else None
