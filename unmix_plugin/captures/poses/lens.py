"""The lens of a camera, and what the models of other programs do to ideal points. Lenses of models that we do not have
are replaced by one of ours: by the nearest, where that is as good as the same, otherwise by one that pictures are
resampled into while they are written.

Notation: `P` points; ideal coordinates are x/z, y/z before the camera, +x right, +y down. Models distort them; 1 is
one focal length; focal length and centre bring distorted points to pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import GREATEST_PX

Points = Float64[np.ndarray, "P 2"]
Project: TypeAlias = Callable[[Points], Points]
"""From ideal coordinates to pixels."""
Distortion: TypeAlias = Callable[..., Points]
"""From ideal coordinates, and the numbers of a model, to distorted ones."""


@dataclass(frozen=True)
class _Cut:
    """A model seen in a part of its picture, scaled; equal for equal parts, so that what follows is remembered."""

    project: Project
    corner: tuple[float, float]
    scale: tuple[float, float]

    def __call__(self, ideal: Points) -> Points:
        return (self.project(ideal) - self.corner) * self.scale


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
    resampled_from: Project | None = None
    """Where the pixels of the file were taken through a model that scenes do not have, and are to be brought into this
    lens: from ideal coordinates to the file's pixels."""
    note: str = field(default="", compare=False)
    """What stands for what, where the file has a lens of another model."""

    @property
    def radial(self) -> tuple[float, float, float, float]:
        """k1 to k4."""
        return (*self.distortion[:2], *self.higher_radial)

    @property
    def is_possible(self) -> bool:
        """Whether its numbers are finite and such as some lens has."""
        numbers = (*self.focal_px, *self.center_px, *self.distortion, *self.higher_radial)
        return min(self.focal_px) >= 1 / GREATEST_PX and bool((np.abs(numbers) <= GREATEST_PX).all())

    def pixels_of(self, ideal: Points) -> Points:
        """Where ideal points are seen."""
        return distort_brown(ideal, self.radial, self.distortion[2:]) * self.focal_px + self.center_px

    def ideal_of(self, pixels: Points) -> Points | None:
        """The inverse of `pixels_of`; None where the distortion folds."""
        return _invert(self.pixels_of, pixels, self)

    def from_file(self, pixels: Points) -> Points | None:
        """Pixels of the file in the picture that this lens has; None where the file's lens folds."""
        if self.resampled_from is None:
            return pixels
        ideal = _invert(self.resampled_from, pixels, self)
        return None if ideal is None else self.pixels_of(ideal)

    def file_pixels(self) -> Float64[np.ndarray, "H W 2"]:
        """Where the middle of each pixel lies in the file; NaN where the file's lens does not see it."""
        columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        pixels = np.column_stack([columns.ravel(), rows.ravel()])
        if self.resampled_from is not None:
            ideal = self.ideal_of(pixels)
            assert ideal is not None  # it was chosen so
            pixels = self.resampled_from(ideal)
        return pixels.reshape(self.height, self.width, 2)

    def seen_as(
        self, width: int, height: int, corner: tuple[float, float], scale: tuple[float, float]
    ) -> Lens:
        """The lens of a picture cut out of this one and scaled.

        Args:
            width, height: Of the result.
            corner: Where its upper left corner lies in this picture, x and y.
            scale: Its pixels over those of this picture, along x and y.
        """
        in_file = None if self.resampled_from is None else _Cut(self.resampled_from, corner, scale)
        (fx, fy), (cx, cy), (across, down) = self.focal_px, self.center_px, scale
        focal, center = (fx * across, fy * down), ((cx - corner[0]) * across, (cy - corner[1]) * down)
        return replace(
            self, width=width, height=height, focal_px=focal, center_px=center, resampled_from=in_file
        )


_LARGEST_ERROR_PX = 0.1
"""Of a lens anywhere in the image that stands for another one as it is. Beyond, pixels are moved."""
_WIDEST_DEG = 75.0
"""From the axis: where the nearest OPENCV lens is looked for. Beyond, pixels grow without end."""
_WIDEST_PINHOLE_DEG = 60.0
"""From the axis to the corners of the pinhole that a wider lens is cut down to."""
_LEAST_INSIDE = 0.97
"""Share of such a pinhole's picture that the file must show."""
_MOST_OUTSIDE = 0.95
"""Share of the file's picture that a pinhole may leave out; one of all directions loses 86 %."""
_GRID = 21
_STEP = 1e-6
_CALIBRATE = "calibrate the camera again, or undistort the images and give poses with a pinhole lens"


@np.errstate(all="ignore")  # whatever comes of it is judged by where pixels fall
def fit_lens(project: Project, start: Lens, model: str, where: str) -> Lens:
    """The OPENCV lens that stands for one of another model, and says so: the nearest; if it is not near enough, pixels
    are to be resampled into it; and of a lens too wide for it, a pinhole that shows its middle.

    Args:
        start: Size of the image and a first guess of focal length and centre.
        model: What the other model is called.
        where: The file, for messages.
    Raises:
        CaptureError: the model is not to be followed even in the middle of the image, or its numbers are impossible.
    """
    require_possible(start, where)
    pixels = _pixel_grid(start.width, start.height)
    ideal = _invert(project, pixels, start)
    if ideal is not None and np.linalg.norm(ideal, axis=1).max() < np.tan(np.radians(_WIDEST_DEG)):
        lens, worst = _nearest_opencv(pixels, ideal, start)
        if worst <= _LARGEST_ERROR_PX:
            note = f"lens model {model} replaced by the nearest OPENCV lens; off by at most {worst:.2g} px"
            return replace(lens, note=note)
        if not _folds(lens):
            nearest = f"no OPENCV lens comes nearer than {worst:.2g} px"
            note = f"lens model {model}: {nearest}, so pixels are interpolated into that one"
            return replace(lens, resampled_from=project, note=note)
    found = _widest_pinhole(project, start)
    if found is None:
        raise CaptureError(
            f"{where}: the lens model {model} can't be followed even in the middle of the image; {_CALIBRATE}"
        )
    pinhole, outside = found
    corner = np.hypot(pinhole.width, pinhole.height) / 2 / pinhole.focal_px[0]
    note = (
        f"lens model {model} sees too much for an OPENCV lens, so pixels are interpolated into a pinhole that reaches "
        f"{np.degrees(np.arctan(corner)):.0f} degrees from the axis to its corners; {outside:.0%} of the picture lies "
        "outside and is left out"
    )
    return replace(pinhole, resampled_from=project, note=note)


def distorted_lens(distort: Distortion, terms: Sequence[float], start: Lens, model: str, where: str) -> Lens:
    """The same as `fit_lens` of a model that distorts ideal points, with focal length and centre of the start."""
    return fit_lens(
        lambda ideal: distort(ideal, *terms) * start.focal_px + start.center_px, start, model, where
    )


def _nearest_opencv(pixels: Points, ideal: Points, start: Lens) -> tuple[Lens, float]:
    """The lens that maps the ideal points best to the pixels, and by how many of these it is off at most."""
    from scipy.optimize import least_squares

    def lens_of(values: np.ndarray) -> Lens:
        fx, fy, cx, cy, p1, p2, k1, k2, k3, k4 = values.tolist()
        return Lens(start.width, start.height, (fx, fy), (cx, cy), (k1, k2, p1, p2), (k3, k4))

    def errors(values: np.ndarray) -> np.ndarray:
        return (lens_of(values).pixels_of(ideal) - pixels).ravel()

    first = np.array([*start.focal_px, *start.center_px, *start.distortion[2:], *start.radial])
    scales = np.array([*start.focal_px, *start.focal_px, 0.01, 0.01, 0.1, 0.1, 0.1, 0.1])
    found = least_squares(errors, first, x_scale=scales).x
    return lens_of(found), float(np.linalg.norm(errors(found).reshape(-1, 2), axis=1).max())


def _widest_pinhole(project: Project, start: Lens) -> tuple[Lens, float] | None:
    """The widest pinhole whose picture the model fills, and the share of the model's picture outside of it."""
    corner = np.hypot(start.width, start.height) / 2
    middle = (start.width / 2, start.height / 2)
    for degrees in np.arange(_WIDEST_PINHOLE_DEG, 4.0, -2.0):
        focal = corner / np.tan(np.radians(degrees))
        pinhole = Lens(start.width, start.height, (focal, focal), middle)
        ideal = (_pixel_grid(start.width, start.height) - middle) / focal
        # The way from the axis to each point must not fold, or two directions would share a pixel.
        parts = np.linspace(0.1, 1.0, 10)
        if not all(_is_upright(_jacobian(project, ideal * part)).all() for part in parts):
            continue
        seen = project(ideal)
        inside = ((seen >= 0) & (seen <= (start.width, start.height))).all(axis=1)
        if inside.mean() >= _LEAST_INSIDE:
            seen = np.clip(seen, 0, (start.width, start.height)).reshape(_GRID, _GRID, 2)
            rim = np.concatenate([seen[0], seen[1:, -1], seen[-1, -2::-1], seen[-2:0:-1, 0]])
            x, y = rim.T
            area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
            outside = max(0.0, 1.0 - area / (start.width * start.height))
            return None if outside > _MOST_OUTSIDE else (pinhole, outside)
    return None


def require_possible(lens: Lens, where: str) -> None:
    """Refuse a lens whose numbers no lens has, or that maps two directions to one pixel of its image by terms that few
    files have. Raises CaptureError: it does."""
    terms = [*lens.radial, *lens.distortion[2:]]
    if not lens.is_possible:
        raise CaptureError(
            f"{where}: a lens has the focal length {lens.focal_px}, the centre {lens.center_px} and the distortion "
            f"{terms}; expected pixels from {1 / GREATEST_PX:g} to {GREATEST_PX:g}: {_CALIBRATE}"
        )
    if any(lens.higher_radial) and _folds(lens):
        raise CaptureError(f"{where}: the distortion {terms} folds the image's corners over; {_CALIBRATE}")


@lru_cache
def _folds(lens: Lens) -> bool:
    """Remembered, since all files of one camera have the same lens."""
    return _invert(lens.pixels_of, _pixel_grid(lens.width, lens.height), lens) is None


def _pixel_grid(width: int, height: int) -> Points:
    columns, rows = np.meshgrid(np.linspace(0, width, _GRID), np.linspace(0, height, _GRID))
    return np.column_stack([columns.ravel(), rows.ravel()])


def _invert(project: Project, pixels: Points, start: Lens) -> Points | None:
    """Ideal points that `project` maps to the pixels, by Newton's method; None if there are none."""
    with np.errstate(all="ignore"):
        ideal = (pixels - np.array(start.center_px)) / np.array(start.focal_px)
        for _ in range(50):
            missing = pixels - project(ideal)
            if not np.isfinite(missing).all():
                return None
            if np.abs(missing).max() < 1e-9:
                break
            jacobian = _jacobian(project, ideal)
            if not _is_upright(jacobian).all():
                return None
            ideal = ideal + np.linalg.solve(jacobian, missing[..., None])[..., 0]
        return ideal if np.abs(pixels - project(ideal)).max() < 1e-3 else None


def _jacobian(project: Project, ideal: Points) -> Float64[np.ndarray, "P 2 2"]:
    """Of pixels by ideal points, by differences."""
    steps = _STEP * np.eye(2)
    slopes = [(project(ideal + step) - project(ideal - step)) / (2 * _STEP) for step in steps]
    return np.stack(slopes, axis=-1)


def _is_upright(jacobian: Float64[np.ndarray, "P 2 2"]) -> Bool[np.ndarray, " P"]:
    """Where a model is finite and keeps what is around a point the right way round."""
    determinant = np.linalg.det(jacobian)
    return np.isfinite(determinant) & (determinant > 0)


# Models of other programs: what each does to ideal points.


def distort_brown(
    points: Points, radial: Sequence[float], tangential: Sequence[float] = (0.0, 0.0)
) -> Points:
    """Radial terms of r^2, r^4, ... and OpenCV's p1, p2."""
    return points * _series((points**2).sum(axis=1), radial)[:, None] + _tangential(points, tangential)


def distort_opencv(
    ideal: Points, k1: float, k2: float, p1: float, p2: float, k3: float = 0.0, *below: float
) -> Points:
    """OpenCV's lens with three radial terms, and three more in the denominator (COLMAP's FULL_OPENCV)."""
    squared = (ideal**2).sum(axis=1)
    ratio = _series(squared, (k1, k2, k3)) / _series(squared, below)
    return ideal * ratio[:, None] + _tangential(ideal, (p1, p2))


def _equidistant(ideal: Points) -> Points:
    """Ideal points moved along their radius to the angle from the axis, radians."""
    radius = np.linalg.norm(ideal, axis=1)
    return ideal * _ratio(np.arctan(radius), radius)[:, None]


def distort_fisheye(ideal: Points, *radial: float, tangential: Sequence[float] = (0.0, 0.0)) -> Points:
    """An equidistant lens, distorted as OpenCV distorts a perspective one: with terms of theta^2, theta^4, ...
    (OPENCV_FISHEYE), and with tangential ones."""
    return distort_brown(_equidistant(ideal), radial, tangential)


def distort_agisoft(
    ideal: Points,
    radial: Sequence[float],
    tangential: Sequence[float],
    growth: Sequence[float],
    is_fisheye: bool,
) -> Points:
    """Metashape's frame and fisheye cameras, p1 and p2 in OpenCV's order; up to version 1.5 the tangential terms grow
    with 1 + p3 r^2 + p4 r^4."""
    points = _equidistant(ideal) if is_fisheye else ideal
    grown = _series((points**2).sum(axis=1), growth)[:, None]
    return distort_brown(points, radial) + _tangential(points, tangential) * grown


def distort_thin_prism(ideal: Points, k1: float, k2: float, p1: float, p2: float, *more: float) -> Points:
    """COLMAP's THIN_PRISM_FISHEYE: k1, k2, p1, p2, k3, k4, sx1, sy1."""
    k3, k4, across, down = more
    distorted = distort_fisheye(ideal, k1, k2, k3, k4, tangential=(p1, p2))
    return distorted + _prism(_equidistant(ideal), (across, 0.0, down, 0.0))


def distort_fisheye_624(ideal: Points, *terms: float) -> Points:
    """Project Aria's fisheye (nerfstudio's FISHEYE624, COLMAP's RAD_TAN_THIN_PRISM_FISHEYE): six radial terms, two
    tangential and four of a thin prism, which act on distorted points."""
    distorted = distort_fisheye(ideal, *terms[:6])
    return distorted + _tangential(distorted, (terms[7], terms[6])) + _prism(distorted, terms[8:])


def distort_opensfm_624(ideal: Points, *terms: float) -> Points:
    """OpenSfM's fisheye62 and fisheye624: the same terms, all of which act on the points of an equidistant lens."""
    return distort_fisheye(ideal, *terms[:6], tangential=terms[6:8]) + _prism(_equidistant(ideal), terms[8:])


def distort_fov(ideal: Points, omega: float) -> Points:
    """Source: Devernay & Faugeras 2001, Straight lines have to be straight; COLMAP's FOV."""
    radius = np.linalg.norm(ideal, axis=1)
    if abs(omega) < 1e-9:
        return ideal
    steep = 2.0 * np.tan(omega / 2.0)
    return ideal * _ratio(np.arctan(radius * steep) / omega, radius, steep / omega)[:, None]


def distort_division(ideal: Points, term: float) -> Points:
    """Source: Fitzgibbon 2001, Simultaneous linear estimation of multiple view geometry and lens distortion; NaN
    beyond the edge of the model."""
    with np.errstate(invalid="ignore"):
        return ideal * (2.0 / (1.0 + np.sqrt(1.0 - 4.0 * term * (ideal**2).sum(axis=1))))[:, None]


def distort_eucm(ideal: Points, alpha: float, beta: float) -> Points:
    """Source: Khomutenko et al. 2016, An enhanced unified camera model."""
    lengths = np.sqrt(beta * (ideal**2).sum(axis=1) + 1.0)
    return ideal / (alpha * lengths + 1.0 - alpha)[:, None]


def distort_dual(ideal: Points, transition: float, *radial: float) -> Points:
    """OpenSfM's dual: between a perspective lens (1) and an equidistant one (0)."""
    return distort_brown(transition * ideal + (1.0 - transition) * _equidistant(ideal), radial)


def distort_ftheta(ideal: Points, reach_px: float, *terms: float) -> Points:
    """instant-ngp's ftheta: the angle from the axis is a polynomial of the distance from the centre in pixels, radians
    over pixels to the power of their number. The focal length is 1 / p1 pixels. Beyond `reach_px`, and where the
    polynomial falls, NaN."""
    polyval, slopes = np.polynomial.polynomial.polyval, np.polynomial.polynomial.polyder(terms)
    distances = np.linspace(0.0, reach_px, 4096)
    angles = polyval(distances, terms)
    rising = int(np.argmax(np.append(np.diff(angles) <= 0.0, True))) + 1
    radius = np.linalg.norm(ideal, axis=1)
    wanted = np.arctan(radius)
    found = np.interp(wanted, angles[:rising], distances[:rising], right=np.nan)
    for _ in range(3):  # from the table to rounding
        found = found + (wanted - polyval(found, terms)) / polyval(found, slopes)
    return ideal * _ratio(found * terms[1], radius)[:, None]


def distort_equirectangular(ideal: Points) -> Points:
    """A picture of all directions, the axis in its middle: longitude across, latitude down, radians."""
    x, y = ideal.T
    return np.column_stack([np.arctan(x), np.arctan2(y, np.hypot(x, 1.0))])


def _series(squared: Float64[np.ndarray, " P"], terms: Sequence[float]) -> Float64[np.ndarray, " P"]:
    """1 + k1 s + k2 s^2 + ..."""
    return np.polynomial.polynomial.polyval(squared, (1.0, *terms))


def _tangential(points: Points, terms: Sequence[float]) -> Points:
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
