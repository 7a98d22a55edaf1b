"""What the lens models of other programs do to ideal points: one function a model, each with its source.

Notation: `P` points; ideal coordinates are x/z, y/z before the camera, +x right, +y down. Results are pixels where a
function takes focal length and centre, and bent coordinates, of which 1 is one focal length, where it takes neither.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

Points = Float64[np.ndarray, "P 2"]
Project: TypeAlias = Callable[[Points], Points]
"""From ideal coordinates to pixels."""


def project_opencv(
    ideal: Points,
    focal_px: tuple[float, float],
    center_px: tuple[float, float],
    radial: tuple[float, ...],
    tangential: tuple[float, float] = (0.0, 0.0),
) -> Points:
    """Pixels of ideal points through a lens with radial terms of r^2, r^4, ... and OpenCV's p1, p2."""
    squared = (ideal**2).sum(axis=1)
    bent = ideal * _series(squared, radial)[:, None] + _tangential(ideal, tangential)
    return bent * focal_px + center_px


def project_fisheye(
    ideal: Points, focal_px: tuple[float, float], center_px: tuple[float, float], terms: tuple[float, ...]
) -> Points:
    """Pixels of ideal points through an equidistant lens with terms of theta^2, theta^4, ... (OPENCV_FISHEYE)."""
    angles = equidistant(ideal)
    return angles * _series((angles**2).sum(axis=1), terms)[:, None] * focal_px + center_px


def equidistant(ideal: Points) -> Points:
    """Ideal points moved along their radius to the angle from the axis, radians."""
    radius = np.linalg.norm(ideal, axis=1)
    return ideal * _ratio(np.arctan(radius), radius)[:, None]


def bend_brown_fisheye(ideal: Points, radial: Sequence[float], tangential: tuple[float, float]) -> Points:
    """An equidistant lens bent as OpenCV bends a perspective one: Metashape's fisheye."""
    return project_opencv(equidistant(ideal), (1.0, 1.0), (0.0, 0.0), tuple(radial), tangential)


def bend_thin_prism(ideal: Points, terms: Sequence[float]) -> Points:
    """COLMAP's THIN_PRISM_FISHEYE: k1, k2, p1, p2, k3, k4, sx1, sy1."""
    k1, k2, p1, p2, k3, k4, *prism = terms
    bent = bend_brown_fisheye(ideal, (k1, k2, k3, k4), (p1, p2))
    return bent + (equidistant(ideal) ** 2).sum(axis=1)[:, None] * np.array(prism)


def bend_fisheye_624(ideal: Points, terms: Sequence[float]) -> Points:
    """Project Aria's fisheye: six radial terms, two tangential and four of a thin prism, which act on bent points.

    FISHEYE624 of nerfstudio, RAD_TAN_THIN_PRISM_FISHEYE of COLMAP.
    """
    bent = project_fisheye(ideal, (1.0, 1.0), (0.0, 0.0), tuple(terms[:6]))
    return bent + _tangential(bent, (terms[7], terms[6])) + _prism(bent, terms[8:])


def bend_opensfm_624(ideal: Points, terms: Sequence[float]) -> Points:
    """OpenSfM's fisheye62 and fisheye624: the same terms, all of which act on the points of an equidistant lens."""
    angles = equidistant(ideal)
    return bend_brown_fisheye(ideal, terms[:6], (terms[6], terms[7])) + _prism(angles, terms[8:])


def bend_fov(ideal: Points, omega: float) -> Points:
    """Source: Devernay & Faugeras 2001, Straight lines have to be straight; COLMAP's FOV."""
    radius = np.linalg.norm(ideal, axis=1)
    if abs(omega) < 1e-9:
        return ideal
    steep = 2.0 * np.tan(omega / 2.0)
    return ideal * _ratio(np.arctan(radius * steep) / omega, radius, steep / omega)[:, None]


def bend_division(ideal: Points, term: float) -> Points:
    """Source: Fitzgibbon 2001, Simultaneous linear estimation of multiple view geometry and lens distortion; NaN
    beyond the edge of the model."""
    squared = (ideal**2).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return ideal * (2.0 / (1.0 + np.sqrt(1.0 - 4.0 * term * squared)))[:, None]


def bend_eucm(ideal: Points, alpha: float, beta: float) -> Points:
    """Source: Khomutenko et al. 2016, An enhanced unified camera model."""
    lengths = np.sqrt(beta * (ideal**2).sum(axis=1) + 1.0)
    return ideal / (alpha * lengths + 1.0 - alpha)[:, None]


def bend_dual(ideal: Points, transition: float, radial: tuple[float, ...]) -> Points:
    """OpenSfM's dual: between a perspective lens (1) and an equidistant one (0)."""
    mixed = transition * ideal + (1.0 - transition) * equidistant(ideal)
    return project_opencv(mixed, (1.0, 1.0), (0.0, 0.0), radial)


def project_ftheta(
    ideal: Points, center_px: tuple[float, float], terms: Sequence[float], reach_px: float
) -> Points:
    """instant-ngp's ftheta: the angle from the axis is a polynomial of the distance from the centre in pixels.

    Args:
        terms: p0, p1, ...: radians over pixels to the power of their number.
        reach_px: The greatest distance that is looked for; beyond, and where the polynomial falls, NaN.
    """
    distances = np.linspace(0.0, reach_px, 4096)
    angles = np.polynomial.polynomial.polyval(distances, terms)
    rising = int(np.argmax(np.append(np.diff(angles) <= 0.0, True))) + 1
    distances, angles = distances[:rising], angles[:rising]
    radius = np.linalg.norm(ideal, axis=1)
    wanted = np.arctan(radius)
    found = np.interp(wanted, angles, distances, right=np.nan)
    slopes = np.polynomial.polynomial.polyder(terms)
    for _ in range(3):  # from the table to rounding
        missing = wanted - np.polynomial.polynomial.polyval(found, terms)
        found = found + missing / np.polynomial.polynomial.polyval(found, slopes)
    return ideal * _ratio(found, radius, 1.0 / terms[1])[:, None] + center_px


def project_equirectangular(ideal: Points, width: float, height: float) -> Points:
    """A picture of all directions, the axis in its middle: longitude across, latitude down."""
    x, y = ideal.T
    longitude, latitude = np.arctan(x), np.arctan2(y, np.hypot(x, 1.0))
    return np.column_stack([width * (0.5 + longitude / (2 * np.pi)), height * (0.5 + latitude / np.pi)])


def _series(squared: Float64[np.ndarray, " P"], terms: Sequence[float]) -> Float64[np.ndarray, " P"]:
    """1 + k1 s + k2 s^2 + ..."""
    return np.polynomial.polynomial.polyval(squared, (1.0, *terms))


def _tangential(points: Points, terms: tuple[float, float]) -> Points:
    """What OpenCV's p1, p2 add."""
    (x, y), (p1, p2) = points.T, terms
    squared = x**2 + y**2
    across = 2 * p1 * x * y + p2 * (squared + 2 * x**2)
    return np.column_stack([across, 2 * p2 * x * y + p1 * (squared + 2 * y**2)])


def _prism(points: Points, terms: Sequence[float]) -> Points:
    """A thin prism's s0 r^2 + s1 r^4 across and s2 r^2 + s3 r^4 down."""
    s0, s1, s2, s3 = terms
    squared = (points**2).sum(axis=1)
    return np.column_stack([s0 * squared + s1 * squared**2, s2 * squared + s3 * squared**2])


def _ratio(
    values: Float64[np.ndarray, " P"], radius: Float64[np.ndarray, " P"], at_axis: float = 1.0
) -> Float64[np.ndarray, " P"]:
    """Values over radius, with the limit on the axis."""
    return np.divide(values, radius, out=np.full_like(radius, at_axis), where=radius > 1e-12)
