"""Views that are judged against the others, before anything is decided from them: black, overexposed, exposed otherwise
than their files say, blurred.

A view is compared with the views nearest to it, by the directions of their cameras where these are known, otherwise
in the order in which they were taken. Spoilt is what differs from all of them but one by far more than views of this
capture usually do: what several neighbours share is the scene's own. If more than a quarter of the views differ so,
they are the capture, and none is called spoilt.

Notation: `N` views, `P` sampled pixels of a view, `B` bands, `Q` percentiles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.poses.pose_set import PosedCamera, angles_between_axes
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.engine.sampling import robust_deviation
from unmix_plugin.errors import CaptureError

LEAST_JUDGED = 5
"""Views among which some can be told to be spoilt."""
_LEAST_WITH_UNREADABLE = 8
"""Views of which one may be unreadable; of fewer, each counts."""
_NEIGHBOURS = 6
_MOST_SPOILT, _MOST_BLACK_VIEWS = 0.25, 0.5
"""Share of the views that can be spoilt, and that can be black, which are of no use however many they are."""
_BLACK = 0.05
"""Brightness of a view over the usual one, below which it shows nothing."""
_LIT = 0.05
"""Of the brightness of its view, from which a pixel is judged."""
_LEAST_LIT = 50
_PERCENTILES = (10, 25, 50, 75, 90)
_DARKER_HALF = slice(0, 3)
"""Percentiles that saturation leaves alone."""
_STEP, _LEAST_STEP, _UNLIKE, _TIMES_USUAL = float(np.log(1.5)), float(np.log(1.35)), 0.25, 3.0
"""Logarithm of a factor between exposures that counts, and that all neighbours but one show; how much it may vary over
bands and percentiles, as a share of itself; and how many times the usual step between neighbours it must be."""
_MORE_SATURATED = 0.1
"""Share of a view's values at the detector's end over that of its neighbours."""
_BLURRED = 0.45
"""Fine contrast against coarse contrast, over that of the neighbours."""


class UnreadableViews:
    """Views whose files can't be read, gathered while views are gone through; the first reason is raised where they are
    too many to be an exception."""

    def __init__(self, num_views: int) -> None:
        self._most = int(_MOST_SPOILT * num_views) if num_views >= _LEAST_WITH_UNREADABLE else 0
        self.remarks: dict[str, Remark] = {}
        """Why views can't be read, by their names."""

    @contextmanager
    def noted(self, name: str) -> Iterator[None]:
        """Take note if this view can't be read in the block. Raises CaptureError: too many can't be."""
        try:
            yield
        except CaptureError as error:
            if len(self.remarks) >= self._most:
                raise
            self.remarks[name] = Remark.of(Code.VIEW_UNREADABLE, [name], why=str(error))


@dataclass(frozen=True)
class ViewPixels:
    """Calibrated pixels of one view."""

    name: str
    values: Float32[np.ndarray, "P B"]
    saturated: Bool[np.ndarray, "P B"]


def distances_between(
    names: Sequence[str], cameras: Mapping[str, PosedCamera] | None
) -> Float64[np.ndarray, "N N"]:
    """How far views are from each other, by the axes and places of their cameras where all are known, otherwise in the
    order in which they were taken."""
    if cameras is None or any(name not in cameras for name in names):
        return np.abs(np.subtract.outer(np.arange(len(names)), np.arange(len(names)))).astype(float)
    places = np.stack([cameras[name].camera_to_world[:, 3] for name in names])
    turned = angles_between_axes([cameras[name] for name in names])
    moved = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return turned + moved / max(float(np.median(moved)), 1e-12)


def neighbours(distances: Float64[np.ndarray, "N N"]) -> list[list[int]]:
    """The nearest views of each, which it is compared with."""
    apart, count = distances.copy(), len(distances)
    np.fill_diagonal(apart, np.inf)
    return [np.argsort(row, kind="stable")[: min(_NEIGHBOURS, count - 1)].tolist() for row in apart]


def judge_values(
    views: Sequence[ViewPixels], cameras: Mapping[str, PosedCamera] | None = None
) -> dict[str, Remark]:
    """Views whose values are spoilt, with the reason.

    Args:
        views: Of one sensor, in the order in which they were taken.
        cameras: By view, if they are known.
    """
    if len(views) < LEAST_JUDGED:
        return {}
    found: dict[str, Remark] = {}
    grey = [view.values.mean(axis=1) for view in views]
    brightness = np.array([np.percentile(one, 99) if len(one) else 0.0 for one in grey])
    usual = float(np.median(brightness))
    if usual <= 0:
        return {}
    is_black = brightness < _BLACK * usual
    if 0 < is_black.sum() <= _MOST_BLACK_VIEWS * len(views):
        for index in np.flatnonzero(is_black).tolist():
            share = f"{max(0.0, brightness[index] / usual):.1%}"
            found[views[index].name] = Remark.of(Code.VIEW_BLACK, [views[index].name], share=share)
    lit = [one > _LIT * level for one, level in zip(grey, brightness, strict=True)]
    judged = [index for index in range(len(views)) if not is_black[index] and lit[index].sum() >= _LEAST_LIT]
    if len(judged) >= LEAST_JUDGED:
        chosen = [views[index] for index in judged]
        near = neighbours(distances_between([view.name for view in chosen], cameras))
        spoilt = _judge_exposure(chosen, [lit[index] for index in judged], near)
        found |= spoilt if len(spoilt) <= _MOST_SPOILT * len(views) else {}
    return found


def _judge_exposure(
    views: Sequence[ViewPixels], lit: Sequence[Bool[np.ndarray, " P"]], near: Sequence[Sequence[int]]
) -> dict[str, Remark]:
    """Views that are brighter or darker than those around them by one factor, in all bands, or where the detector ends
    in those percentiles that are below it."""
    levels: Float64[np.ndarray, "N Q B"] = np.log(
        np.stack(
            [
                np.maximum(np.percentile(view.values[some], _PERCENTILES, axis=0), 1e-6)
                for view, some in zip(views, lit, strict=True)
            ]
        )
    )
    saturated = np.array([view.saturated[some].mean() for view, some in zip(views, lit, strict=True)])
    usual = np.median([abs(np.median(levels[i] - levels[j])) for i in range(len(views)) for j in near[i]])
    least = max(_STEP, _TIMES_USUAL * float(usual))
    found: dict[str, Remark] = {}
    for index, (view, others) in enumerate(zip(views, near, strict=True)):
        steps = levels[index] - levels[others]
        is_over = saturated[index] > np.median(saturated[others]) + _MORE_SATURATED
        kept = steps[:, _DARKER_HALF] if is_over else steps
        factors = np.median(kept, axis=(1, 2))
        spreads = robust_deviation(kept, axis=(1, 2))
        middle = float(np.median(factors))
        agree = (np.sign(factors) == np.sign(middle)) & (np.abs(factors) > _LEAST_STEP)
        is_one_factor = is_over or np.median(spreads / np.maximum(np.abs(factors), 1e-9)) < _UNLIKE
        if abs(middle) < least or agree.sum() < len(others) - 1 or not is_one_factor:
            continue
        times = f"{np.exp(middle):.2g}"
        if is_over and middle > 0:
            share = f"{saturated[index]:.0%}"
            remark = Remark.of(Code.VIEW_OVEREXPOSED, [view.name], times=times, share=share)
        else:
            remark = Remark.of(Code.VIEW_EXPOSED_OTHERWISE, [view.name], times=times)
        found[view.name] = remark
    return found


def judge_sharpness(
    sharpness: Mapping[str, Sequence[float]], cameras: Mapping[str, PosedCamera] | None = None
) -> dict[str, Remark]:
    """Views that are far less sharp than those around them.

    Args:
        sharpness: Of each view along its rows and columns (see `sharpness_of`), in the order in which they were taken;
            empty where it is not known.
        cameras: By view, if they are known.
    """
    names = [name for name, known in sharpness.items() if known]
    if len(names) < LEAST_JUDGED:
        return {}
    values = np.array([sharpness[name] for name in names])
    found: dict[str, Remark] = {}
    for index, others in enumerate(neighbours(distances_between(names, cameras))):
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = values[index] / values[others]
        if not np.isfinite(ratios).all():
            continue
        worst = int(np.argmin(np.median(ratios, axis=0)))
        if (ratios[:, worst] < _BLURRED).sum() >= len(others) - 1:
            share = f"{np.median(ratios[:, worst]):.0%}"
            found[names[index]] = Remark.of(Code.VIEW_BLURRED, [names[index]], share=share)
    return found if len(found) <= _MOST_SPOILT * len(names) else {}


_FINE_PX, _COARSE_PX = 2, 16
"""Between the pixels of a second difference."""
_LEAST_DIFFERENCES = 200


def sharpness_of(brightness: Float32[np.ndarray, "H W"], seen: Bool[np.ndarray, "H W"]) -> list[float]:
    """Contrast of fine structures over that of coarse ones, along rows and along columns; nothing in small views.

    What views are left out by: of structures wider than the noise of single pixels, by direction, and against the views
    around, before poses are known. `detail_of` warns of less, by single pixels, against all views.

    Both are root mean squares of second differences between three pixels in a line, where all are seen. A blur takes
    the fine ones, in its direction alone if the camera moved.
    """
    found = []
    for picture, known in ((brightness, seen), (brightness.T, seen.T)):
        contrasts = []
        for lag in (_FINE_PX, _COARSE_PX):
            first, middle, last = (slice(0, -2 * lag), slice(lag, -lag), slice(2 * lag, None))
            used = known[:, first] & known[:, middle] & known[:, last]
            if used.sum() < _LEAST_DIFFERENCES:
                return []
            differences = (picture[:, first] - 2 * picture[:, middle] + picture[:, last])[used]
            contrasts.append(float(np.sqrt(np.mean(np.square(differences, dtype=np.float64)))))
        fine, coarse = contrasts
        if coarse <= 0:
            return []
        found.append(fine / coarse)
    return found
