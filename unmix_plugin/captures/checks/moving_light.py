"""Whether the light moves with the camera, as on a turntable, measured on sparse points in pairs of near views.

Under fixed lamps a matt point keeps its brightness from view to view. Lamps that move along with the camera make a
pattern that stands still in the picture, bright in the middle or towards a lamp: points that cross it get brighter on
one side and darker on the other. So the logarithm of the ratio of brightness has a slope along the direction of
movement, the same in all pairs. On a ball lit from the camera the slope, per radius and radian of movement, is about 1;
lamps on both sides make it negative. Strong vignetting that nothing corrects has a slope too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.checks.seen_view import SeenView, angles_between, log_ratio

ANGLES_DEG = (4.0, 25.0)
"""Between the views of a pair."""
LEAST_POINTS, LEAST_PAIRS = 60, 6
MOST_PAIRS = 200
MOST_CHANGE = 0.7
"""Logarithm of a ratio beyond which a pixel shows another surface."""
LEAST_SLOPE = 0.15
"""Slopes below, up or down, count as none."""
CERTAINTY = 4.0
"""Standard errors of the slope that are beyond doubt."""


@dataclass(frozen=True)
class MovingLight:
    """What was measured."""

    slope: float
    """0 under fixed lamps."""
    error: float
    """Standard error of the slope."""
    pairs: int

    @property
    def moves(self) -> bool:
        """Whether the light moves with the camera, beyond doubt."""
        return abs(self.slope) > max(LEAST_SLOPE, CERTAINTY * self.error)


def measure(views: Sequence[SeenView], points: Float64[np.ndarray, "P 3"] | None) -> MovingLight | None:
    """The slope over all pairs of near views; None where there are too few points or pairs."""
    if points is None or len(points) < LEAST_POINTS:
        return None
    slopes = []
    for first, second in _pairs(views):
        slope = _slope(views[first], views[second], points)
        if slope is not None:
            slopes.append(slope)
    if len(slopes) < LEAST_PAIRS:
        return None
    values = np.array(slopes)
    middle = float(np.median(values))
    deviation = 1.4826 * float(np.median(np.abs(values - middle)))
    return MovingLight(middle, 1.2533 * deviation / float(np.sqrt(len(values))), len(values))


def moving_light(
    views: Sequence[SeenView], points: Float64[np.ndarray, "P 3"] | None
) -> tuple[list[str], str]:
    """What to tell of it."""
    found = measure(views, points)
    if found is None:
        return (
            [],
            "whether light moves with the camera is not measured: it takes sparse points and near views",
        )
    said = (
        f"the brightness of sparse points has a slope of {found.slope:.2f} +- {found.error:.2f} along the movement of "
        f"the camera ({found.pairs} pairs of views; 0 is fixed light)"
    )
    if not found.moves:
        return [], said
    finding = (
        f"light moves with the camera, as when an object is turned before fixed lamps: {said}. Shading of a point then "
        "changes from view to view"
    )
    return [finding], said


def _pairs(views: Sequence[SeenView]) -> list[tuple[int, int]]:
    angles = angles_between(views)
    low, high = ANGLES_DEG
    first, second = np.nonzero((angles >= low) & (angles <= high))
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    return pairs[:: max(1, len(pairs) // MOST_PAIRS)]


def _slope(first: SeenView, second: SeenView, points: Float64[np.ndarray, "P 3"]) -> float | None:
    """Slope of log brightness along the direction in which the camera moves, per radius and radian."""
    points = points[first.has_before_it(points) & second.has_before_it(points)]
    before, ratio = first.pixels_of(points), log_ratio(first, second, points)
    rotation = first.camera.camera_to_world[:, :3]
    turned = (second.position - first.position) @ rotation
    direction = np.array([turned[0], -turned[1]])
    length = float(np.linalg.norm(direction))
    good = np.isfinite(ratio) & (np.abs(ratio) < MOST_CHANGE)
    if good.sum() < LEAST_POINTS or length == 0.0:
        return None
    along = before[good] @ (direction / length)
    middle = np.median(along)
    radius = float(np.percentile(np.abs(along - middle), 95))
    if radius == 0.0:
        return None
    angle = float(np.arccos(np.clip(first.axis @ second.axis, -1.0, 1.0)))
    slope = np.polyfit((along - middle) / radius, ratio[good], 1)[0]
    return float(slope / angle)
