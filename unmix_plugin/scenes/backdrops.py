"""A backdrop that is much alike within and over views: whether there is one, and which pixels of a view show it.

In each view a backdrop is up to three smooth surfaces (`border_surfaces`). Stripes of the sensor, the same in all
views, are taken off first. Rooms and landscapes have borders too. So a backdrop counts only if it is plain, reaches
most of the border of nearly all views, and looks alike in all of them: a mask that is wrong is worse than none.

Notation: `H x W` pixels, `B` bands, `k` features of a spectrum; values in [0, 1] as they are written.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.scenes.border_surfaces import (
    BORDER_SHARE,
    FIRST_TOLERANCE,
    HOLE_SHARE,
    TURNS,
    Features,
    FittedView,
    LookedAt,
    Mask,
    border_of,
    fit_surfaces,
    norm,
    parts_of,
)
from unmix_plugin.scenes.geometry.views import Views

_NUM_FEATURES = 4
"""Coordinates of spectra along which those of the capture differ most."""
_BRIGHT_PERCENTILE = 99.0
_LOOKED_AT = 12
"""Views that a backdrop is looked for in."""
_LONGEST_SIDE_PX, _MOST_BANDS = 200, 12
"""Of views of a scene, in which it is looked for: larger ones are thinned out."""
_STRIPE_WINDOW = 25
"""Columns that stripes of the sensor are narrower than."""
_LEAST_EXPLAINED, _LEAST_IN_A_VIEW = 0.8, 0.5
"""Share of the border that a backdrop reaches: in the median, and in most views."""
_MOST_VIEWS = 0.8
"""Share of the views that this holds for."""
_LEAST_CORNERS = 0.6
"""Share of its surfaces that show in a corner of their view."""
_LEAST_SHARE = 0.1
"""Of the pixels; less than that is not worth a mask."""
_MOST_SHARE, _ALL = 0.9, 0.995
"""Of the pixels: a plain field with little in it is ground seen from above, not what stands behind an object; and where
there is nothing else at all, there is no object, which is refused."""
_MOST_DISTANCE = 0.012
"""Median distance of a backdrop's pixels from its surfaces; more is a texture."""
_MOST_UNLIKE = 0.12
"""Distance of a view's backdrop from that of the others, as a share of the brightest pixels."""
_MOST_SHADED = 2.0
"""How many times brighter or darker the same backdrop may be in a view."""


@dataclass(frozen=True)
class Backdrop:
    """The backdrop of the views of one sensor."""

    basis: Float32[np.ndarray, "B k"]
    """Orthonormal; spectra times it are their features."""
    stripes: Float32[np.ndarray, "W k"]
    """What each column of the sensor adds."""
    brightest: float
    """Length of the features of the brightest pixels."""
    levels: Float32[np.ndarray, "m k"]
    """Features of its surfaces in the views that were looked at."""
    spectrum: Float32[np.ndarray, " B"]
    """Median over these."""

    def features(self, values: Float32[np.ndarray, "h W B"]) -> Float32[np.ndarray, "h W k"]:
        """Features of the pixels of some rows, without stripes."""
        return np.clip(values, 0.0, 1.0) @ self.basis - self.stripes

    def find(self, features: Features, known: Mask) -> LookedAt | None:
        """The backdrop in a view, given all its pixels and which of them have a measurement; None where it shows
        none."""
        return self._look(fit_surfaces(features, known, self.brightest))

    def _look(self, view: FittedView) -> LookedAt | None:
        """The surfaces of a view that are near one of the backdrop's, or are one in more or in less light."""
        surfaces = []
        for surface in view.surfaces:
            gains = (self.levels @ surface.level) / np.maximum(np.square(self.levels).sum(-1), 1e-12)
            lit = np.clip(gains, 1 / _MOST_SHADED, _MOST_SHADED)[:, None] * self.levels
            is_near = norm(self.levels - surface.level) < _MOST_UNLIKE * self.brightest
            if (is_near | (norm(lit - surface.level) < FIRST_TOLERANCE * self.brightest)).any():
                surfaces.append(surface)
        return replace(view, surfaces=surfaces).look() if surfaces else None

    def spectra(self, features: Float32[np.ndarray, "*P k"]) -> Float32[np.ndarray, "*P B"]:
        """Spectra of these features, of one pixel or of many."""
        return features @ self.basis.T

    @property
    def in_words(self) -> str:
        """Its colour and its brightness, as a share of full scale."""
        low, high, mean = (float(f(self.spectrum)) for f in (np.min, np.max, np.mean))
        if mean < 0.06:
            return f"black ({mean:.3f})"
        colour = "white" if low > 0.6 else "grey" if high - low < 0.5 * mean else "coloured"
        return f"{colour} ({mean:.2f})"

    @property
    def evidence(self) -> dict[str, Any]:
        """For the record."""
        return {"kind": "found", "spectrum": [round(float(value), 5) for value in self.spectrum]}


@dataclass(frozen=True)
class BeforeBackdrop:
    """Of each training view, where something may stand before a backdrop that all share."""

    thinned: tuple[Bool[np.ndarray, "_ _"], ...]
    """Of every `stride`-th row and column."""
    stride: int
    size: tuple[int, int]
    """Width and height of a view."""
    in_words: str
    """Colour and brightness of the backdrop."""

    @property
    def shows_foreground(self) -> bool:
        """Whether there is anything but the backdrop."""
        return bool(np.mean([mask.mean() for mask in self.thinned]) > 1 - _ALL)

    def masks(self) -> list[Bool[np.ndarray, "_ _"]]:
        """Of whole views, which are much larger than what is kept."""
        repeated = (mask.repeat(self.stride, axis=0).repeat(self.stride, axis=1) for mask in self.thinned)
        return [mask[: self.size[1], : self.size[0]] for mask in repeated]


def find_before_backdrop(views: Views) -> BeforeBackdrop | None:
    """Where something may stand before a backdrop that all views share; None if there is none. Anything may stand
    before pixels that don't count."""
    from scipy import ndimage

    size, count = views.cameras.size(0), len(views.cameras)
    stride = -(-max(size) // _LONGEST_SIDE_PX)
    bands = views.read(0, (slice(1), slice(1))).shape[2]
    part = (slice(None, None, stride), slice(None, None, stride), slice(None, None, -(-bands // _MOST_BANDS)))

    def read(view: int) -> tuple[np.ndarray, np.ndarray]:
        image = views.read(view, part)
        return image, np.ones(image.shape[:2], bool) if views.valid is None else views.valid(view)[part[:2]]

    looked_at = evenly_spaced(count, _LOOKED_AT)
    sample = [image[::4, ::4][mask[::4, ::4]] for image, mask in map(read, looked_at)]
    backdrop = judge_backdrop(map(read, looked_at), np.concatenate(sample))
    if backdrop is None:
        return None
    masks = []
    for image, mask in (read(view) for view in range(count)):
        seen = backdrop.find(backdrop.features(image), mask)
        if seen is None:
            masks.append(np.ones_like(mask))
            continue
        # Without parts that are smaller than a hole may be, wider by a pixel.
        parts = parts_of(~seen.shown)
        is_large = np.bincount(parts.ravel()) >= max(4.0, HOLE_SHARE * parts.size)
        is_large[0] = False
        masks.append(np.array(ndimage.binary_dilation(is_large[parts]), bool) | ~mask)
    return BeforeBackdrop(tuple(masks), stride, size, backdrop.in_words)


def judge_backdrop(
    views: Iterable[tuple[Float32[np.ndarray, "h W B"], Bool[np.ndarray, "h W"]]],
    sample: Float32[np.ndarray, "N B"],
) -> Backdrop | None:
    """The backdrop of some views; None without one.

    Args:
        views: Pixels of each, or some of their rows, and which of these have a measurement; asked for once, one after
            the other, so that few bands of few views are in memory.
        sample: Pixels of all views.
    """
    if len(sample) < _NUM_FEATURES:
        return None
    sample = np.clip(sample, 0.0, 1.0)
    # Directions in which spectra reach farthest from 0.
    _, vectors = np.linalg.eigh(sample.T.astype(np.float64) @ sample)
    basis = np.ascontiguousarray(vectors[:, ::-1][:, :_NUM_FEATURES], np.float32)
    brightest = float(np.percentile(norm(sample), _BRIGHT_PERCENTILE))
    if brightest <= 0:
        return None
    features, known = zip(*((np.asarray(image @ basis), mask) for image, mask in views), strict=True)
    if min(features[0].shape[:2]) < 3:
        return None
    stripes = _stripes(features)
    fitted = [
        fit_surfaces(image - stripes, mask, brightest) for image, mask in zip(features, known, strict=True)
    ]
    levels = np.array([each.level for view in fitted for each in view.surfaces], np.float32)
    if not len(levels):
        return None
    # Alike are surfaces that most views have one like. A seam leaves corners on either side, in many views if not in
    # all; what an edge of the pictures cuts off between two corners, such as the foot of an object, stands before it.
    owners = np.array([index for index, view in enumerate(fitted) for _ in view.surfaces])
    near = norm(levels[:, None] - levels[None]) < _MOST_UNLIKE * brightest
    has_corner = np.array([has for view in fitted for has in view.have_corners()])
    supported = [
        len(set(owners[row])) >= _MOST_VIEWS * len(fitted) and has_corner[row].mean() >= _LEAST_CORNERS
        for row in near
    ]
    found = Backdrop(basis, stripes, brightest, levels[supported], np.zeros(basis.shape[0], np.float32))
    explained, shares, distances, levels_shown = [], [], [], []
    for view, mask in zip(fitted, known, strict=True):
        seen = found._look(view)
        shown = np.zeros_like(mask) if seen is None else seen.shown
        at_border = border_of(mask.shape) & mask
        explained.append(shown[at_border].mean() if at_border.any() else 0.0)
        shares.append(shown[mask].mean() if mask.any() else 0.0)
        if seen is not None and shown.any():
            distances.append(np.median(norm(seen.features - seen.behind)[shown]) / brightest)
            levels_shown.append(np.median(seen.features[shown], axis=0))
    if (
        not distances
        or np.median(explained) < _LEAST_EXPLAINED
        or np.mean(np.array(explained) >= _LEAST_IN_A_VIEW) < _MOST_VIEWS
        or np.median(shares) < _LEAST_SHARE
        or _MOST_SHARE < np.median(shares) < _ALL
        or np.median(distances) > _MOST_DISTANCE
    ):
        return None
    spectrum = found.spectra(np.median(levels_shown, axis=0).astype(np.float32))
    return replace(found, spectrum=spectrum.clip(min=0))


def _stripes(features: Sequence[Float32[np.ndarray, "h W k"]]) -> Float32[np.ndarray, "W k"]:
    """What the columns of a sensor add: median over the views' first and last rows of what is narrow in them."""
    from scipy import ndimage

    width = max(1, round(BORDER_SHARE * len(features[0])))
    lines = [side.mean(axis=0) for image in features for side in (image[:width], image[-width:])]
    # Less what is smooth: mirrored at the ends of a line, a slope would look like stripes there.
    rests = [line - _smooth_part(line) for line in lines]
    narrow = [rest - ndimage.median_filter(rest, (_STRIPE_WINDOW, 1), mode="mirror") for rest in rests]
    return np.median(narrow, axis=0).astype(np.float32)


def _smooth_part(line: Float32[np.ndarray, "W k"]) -> Float32[np.ndarray, "W k"]:
    """A cubic through most of a line, whatever the rest is."""
    terms = np.vander(np.linspace(-1, 1, len(line)), 4).astype(np.float32)
    smooth = np.broadcast_to(np.median(line, axis=0), line.shape)
    for _ in range(TURNS):
        away = norm(line - smooth)
        near = away <= 2 * np.median(away)
        smooth = terms @ np.linalg.lstsq(terms[near], line[near], rcond=None)[0]
    return smooth
