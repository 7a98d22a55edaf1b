"""The lens of a camera. Lenses of models that we do not have are replaced by one of ours: by the nearest, where that is
as good as the same, otherwise by one that pictures are resampled into while they are written.

Notation: `P` points; ideal coordinates are x/z, y/z before the camera, +x right, +y down.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.captures.poses.lens_models import Points, Project, project_opencv
from unmix_plugin.errors import CaptureError


@dataclass(frozen=True)
class FileLens:
    """The lens that the pixels of a file were taken through, of a model that scenes do not have."""

    model: str
    project: Project
    """From ideal coordinates to pixels of the picture that the `Lens` beside it has."""
    said: str
    """What becomes of the picture, for people."""


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
    resampled_from: FileLens | None = None
    """Where the file has another one: its pixels are to be brought into this lens."""

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

    def ideal_of(self, pixels: Points) -> Points | None:
        """The inverse of `pixels_of`; None where the distortion folds."""
        return _invert(self.pixels_of, pixels, self)

    def from_file(self, pixels: Points) -> Points | None:
        """Pixels of the file in the picture that this lens has; None where the file's lens folds."""
        if self.resampled_from is None:
            return pixels
        ideal = _invert(self.resampled_from.project, pixels, self)
        return None if ideal is None else self.pixels_of(ideal)

    def file_pixels(self) -> Float64[np.ndarray, "H W 2"]:
        """Where the middle of each pixel lies in the file; NaN where the file's lens does not see it."""
        columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        pixels = np.column_stack([columns.ravel(), rows.ravel()])
        if self.resampled_from is not None:
            ideal = self.ideal_of(pixels)
            assert ideal is not None  # it was chosen so
            pixels = self.resampled_from.project(ideal)
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
        from_file = self.resampled_from
        if from_file is not None:
            from_file = replace(from_file, project=_Cut(from_file.project, corner, scale))
        return replace(
            self,
            width=width,
            height=height,
            focal_px=(self.focal_px[0] * scale[0], self.focal_px[1] * scale[1]),
            center_px=(
                (self.center_px[0] - corner[0]) * scale[0],
                (self.center_px[1] - corner[1]) * scale[1],
            ),
            resampled_from=from_file,
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


def fit_lens(project: Project, start: Lens, model: str, where: str) -> tuple[Lens, str]:
    """The OPENCV lens that stands for one of another model.

    Args:
        project: The other model.
        start: Size of the image and a first guess of focal length and centre.
        model: What the other model is called.
        where: The file, for messages.
    Returns:
        The nearest lens; if it is not near enough, pixels are to be resampled into it. Of a lens too wide for it, a
        pinhole that shows its middle. And a sentence that says what was done.
    Raises:
        CaptureError: the model is not to be followed even in the middle of the image.
    """
    pixels = _pixel_grid(start.width, start.height)
    ideal = _invert(project, pixels, start)
    if ideal is not None and np.linalg.norm(ideal, axis=1).max() < np.tan(np.radians(_WIDEST_DEG)):
        lens, worst = _nearest_opencv(pixels, ideal, start)
        if worst <= _LARGEST_ERROR_PX:
            note = f"lens model {model} replaced by the nearest OPENCV lens; off by at most {worst:.2g} px"
            return lens, note
        if not _folds(lens):
            nearest = f"no OPENCV lens comes nearer than {worst:.2g} px"
            note = f"lens model {model}: {nearest}, so pixels are interpolated into that one"
            return replace(lens, resampled_from=FileLens(model, project, note)), note
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
    return replace(pinhole, resampled_from=FileLens(model, project, note)), note


def _nearest_opencv(pixels: Points, ideal: Points, start: Lens) -> tuple[Lens, float]:
    """The lens that maps the ideal points best to the pixels, and by how many of these it is off at most."""
    from scipy.optimize import least_squares

    def lens_of(values: np.ndarray) -> Lens:
        fx, fy, cx, cy, p1, p2, k1, k2, k3, k4 = values.tolist()
        return Lens(start.width, start.height, (fx, fy), (cx, cy), (k1, k2, p1, p2), (k3, k4))

    def errors(values: np.ndarray) -> np.ndarray:
        return (lens_of(values).pixels_of(ideal) - pixels).ravel()

    first = np.array([*start.focal_px, *start.center_px, *start.tangential, *start.radial])
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
        if not all(_is_sound(project, ideal * part).all() for part in np.linspace(0.1, 1.0, 10)):
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


def require_unfolded(lens: Lens, where: str) -> None:
    """Refuse a lens that maps two directions to one pixel of its image. Raises CaptureError: it does."""
    if _folds(lens):
        raise CaptureError(
            f"{where}: the distortion {[*lens.radial, *lens.tangential]} folds the image's corners over; {_CALIBRATE}"
        )


@lru_cache
def _folds(lens: Lens) -> bool:
    """Remembered, since all files of one camera have the same lens."""
    return _invert(lens.pixels_of, _pixel_grid(lens.width, lens.height), lens) is None


def _pixel_grid(width: int, height: int) -> Points:
    columns, rows = np.meshgrid(np.linspace(0, width, _GRID), np.linspace(0, height, _GRID))
    return np.column_stack([columns.ravel(), rows.ravel()])


def _invert(project: Project, pixels: Points, start: Lens) -> Points | None:
    """Ideal points that `project` maps to the pixels, by Newton's method; None if there are none."""
    ideal = (pixels - np.array(start.center_px)) / np.array(start.focal_px)
    with np.errstate(all="ignore"):
        for _ in range(50):
            missing = pixels - project(ideal)
            if not np.isfinite(missing).all():
                return None
            if np.abs(missing).max() < 1e-9:
                break
            jacobian = np.stack(list(_slopes(project, ideal)), axis=-1)
            determinant = np.linalg.det(jacobian)
            if not np.isfinite(determinant).all() or (determinant <= 0).any():
                return None
            ideal = ideal + np.linalg.solve(jacobian, missing[..., None])[..., 0]
        return ideal if np.abs(pixels - project(ideal)).max() < 1e-3 else None


def _slopes(project: Project, ideal: Points) -> Iterator[Points]:
    """Pixels that a step along x and along y moves each point by, over the step."""
    for step in _STEP * np.eye(2):
        yield (project(ideal + step) - project(ideal - step)) / (2 * _STEP)


def _is_sound(project: Project, ideal: Points) -> Bool[np.ndarray, " P"]:
    """Whether the model is finite at points and keeps their surroundings the right way round."""
    with np.errstate(all="ignore"):
        determinant = np.linalg.det(np.stack(list(_slopes(project, ideal)), axis=-1))
        return np.isfinite(determinant) & (determinant > 0)
