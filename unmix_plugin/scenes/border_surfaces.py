"""Smooth surfaces at the border of a view, such as a wall and a floor, and which pixels show them.

A surface is a quadratic or cubic function of the place in the picture, fitted to what reaches the border. A pixel shows
it if it is as near to it as its own pixels are, and hangs together with the border or is part of a large hole. Edges
are soft: a pixel beside the surfaces is a mixture of them and of the matter farther in.

Notation: `H x W` pixels, `k` features of a spectrum, `t` terms of a surface, `P` pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32

Features = Float32[np.ndarray, "H W k"]
Mask = Bool[np.ndarray, "H W"]
Distances = Float32[np.ndarray, "H W"]
BORDER_SHARE = 0.02
"""Width of the border, as a share of the view's."""
_MOST_SURFACES = 3
"""In one view: a floor and the two walls of a corner."""
_NUM_TERMS = 10
TURNS = 5
"""In which surfaces grow from the border inwards."""
_SEGMENTS = 12
"""Parts of the border that a surface is sought from."""
FIRST_TOLERANCE = 0.04
"""Distance from a surface that still belongs to it while it is fitted, as a share of the brightest pixels."""
_LEAST_TOLERANCE, _OF_LEVEL = 0.004, 0.02
"""Of a fitted surface, in the same unit, and as a share of its own brightness: JPEG and dust vary it by this."""
_DEVIATIONS = 4.0
"""Median distances of a surface's pixels up to which one belongs to it."""
_SMALLEST_SURFACE = 0.06
"""Share of the border that a second surface explains at least."""
_MOST_FITTED = 20_000
"""Pixels that a surface is fitted to."""
HOLE_SHARE = 5e-4
"""Share of the picture from which a part that looks like the backdrop is a hole in the matter."""
_OF_A_HOLE = 0.5
"""Most of a tolerance that such a part is away, in the median."""
_AROUND_SHARE, _LEAST_AROUND = 0.06, 0.02
"""Edge of the window in which what surfaces leave unexplained is averaged, as a share of the longer side, and the share
of it that must show the backdrop."""
_RIM_PX = 2
"""Width of the edge in which pixels may be mixtures."""
_INSIDE_PX = 7
"""Edge of the window in which matter behind the rim is averaged."""


@dataclass
class _Surface:
    """A smooth surface in one view."""

    coefficients: Float32[np.ndarray, "t k"]
    tolerance: float
    """Distance up to which a pixel belongs to it."""
    level: Float32[np.ndarray, " k"]
    """Median features of its pixels."""


@dataclass(frozen=True)
class FittedView:
    """A view and the surfaces at its border."""

    features: Features
    surfaces: list[_Surface]
    farthest: float
    """Distance beyond which no pixel belongs to any."""
    known: Mask

    def have_corners(self) -> list[bool]:
        """Which of the surfaces show in most of a corner of the picture."""
        shape, found = self.known.shape, np.zeros(len(self.surfaces), bool)
        terms = _terms(shape).reshape(*shape, -1)
        rows, columns = (max(1, round(BORDER_SHARE * side)) for side in shape)
        for corner in (np.s_[y, x] for y in np.s_[:rows, -rows:] for x in np.s_[:columns, -columns:]):
            seen, own = self.features[corner], terms[corner]
            away = [norm(seen - own @ each.coefficients) / each.tolerance for each in self.surfaces]
            nearest = np.min(away, axis=0, initial=1.0)
            found |= np.array([(one <= nearest).mean() > 0.5 for one in away], bool)
        return found.tolist()

    def look(self) -> LookedAt:
        """Which pixels show the surfaces, and what they look like at each.

        What the surfaces leave unexplained is smooth too: it is taken from the backdrop around, over and over again.
        """
        terms = _terms(self.known.shape)
        values = [(terms @ each.coefficients).reshape(self.features.shape) for each in self.surfaces]
        tolerances = np.array([each.tolerance for each in self.surfaces], np.float32)
        owners = (norm(self.features - np.stack(values)) / tolerances[:, None, None]).argmin(axis=0)
        behind = np.take_along_axis(np.stack(values), owners[None, ..., None], axis=0)[0]
        rest, tolerance = self.features - behind, tolerances[owners]
        window = max(3, round(_AROUND_SHARE * max(rest.shape[:2])))
        shown, around = self._hangs_together(norm(rest) / tolerance, values), np.zeros_like(rest)
        for _ in range(TURNS):
            around, weight = _means_around(rest, shown, window)
            around *= np.minimum(1.0, self.farthest / np.maximum(norm(around), 1e-9))[..., None]
            distance = norm(rest - around) / tolerance
            shown = self._hangs_together(np.where(weight > _LEAST_AROUND, distance, np.inf), values)
        return LookedAt(self.features, behind + around, shown, self.known)

    def _hangs_together(self, distance: Distances, values: list[Features]) -> Mask:
        """Of pixels that are alike (distances up to 1), those that hang together with the border, and large holes.

        Args:
            values: Of the surfaces; what is a mixture of two is alike, too.
        """
        alike = (distance <= 1) & self.known
        for first, second in combinations(range(len(values)), 2):
            alike |= self._seam(first, second, values)
        parts = parts_of(alike)
        kept = np.bincount(parts.ravel()) >= max(4.0, HOLE_SHARE * alike.size)
        for part in np.flatnonzero(kept).tolist():
            kept[part] = np.median(distance[parts == part]) <= _OF_A_HOLE
        kept[parts[border_of(alike.shape)]] = True
        kept[0] = False
        return kept[parts]

    def _seam(self, first: int, second: int, values: list[Features]) -> Mask:
        """Pixels between two surfaces that are mixtures of both."""
        from scipy import ndimage

        near = [
            ndimage.binary_dilation(
                norm(self.features - values[each]) <= self.surfaces[each].tolerance, iterations=_RIM_PX
            )
            for each in (first, second)
        ]
        across, most = values[second] - values[first], max(each.tolerance for each in self.surfaces)
        from_first = self.features - values[first]
        share = (from_first * across).sum(-1) / np.maximum((across**2).sum(-1), 1e-12)
        away = norm(from_first - np.clip(share, 0, 1)[..., None] * across)
        return np.logical_and(near[0], near[1]) & self.known & (away <= most)


def _means_around(values: Features, chosen: Mask, window: int) -> tuple[Features, Distances]:
    """Means over the chosen pixels in a window around each pixel, and the share of it that is chosen."""
    from scipy import ndimage

    weight = ndimage.uniform_filter(chosen.astype(np.float32), window)
    sizes: Any = (window, window, 1)
    total = ndimage.uniform_filter(np.where(chosen[..., None], values, 0.0), sizes)
    return total / np.maximum(weight, 1e-6)[..., None], weight


@dataclass(frozen=True)
class LookedAt:
    """The backdrop of one view, pixel by pixel."""

    features: Features
    """Of what is seen."""
    behind: Features
    """Of the backdrop, also where matter hides it."""
    shown: Mask
    """Pixels that show the backdrop."""
    known: Mask
    """Pixels with a measurement."""

    def opacity(self, matter: Mask) -> Distances:
        """How much of each pixel matter covers, [0, 1]: less than 1 only in the rim of `matter`."""
        from scipy import ndimage

        inside = np.array(ndimage.binary_erosion(matter, iterations=_RIM_PX, border_value=1), bool)
        rim = matter & ~inside & self.known
        before, weight = _means_around(self.features, inside, _INSIDE_PX)
        across = before[rim] - self.behind[rim]
        seen = self.features[rim] - self.behind[rim]
        share = (seen * across).sum(-1) / np.maximum((across**2).sum(-1), 1e-12)
        opacity = matter.astype(np.float32)
        opacity[rim] = np.where(weight[rim] > 1e-3, np.clip(share, 0.0, 1.0), 1.0)
        return opacity


def fit_surfaces(features: Features, known: Mask, brightest: float) -> FittedView:
    """Up to three smooth surfaces that explain most of a view's border, grown inwards from there."""
    stride = max(1, round((known.size / _MOST_FITTED) ** 0.5))
    thin = (slice(None, None, stride),) * 2
    is_known = known[thin]
    terms = _terms(known.shape).reshape(*known.shape, -1)[thin].reshape(-1, _NUM_TERMS)
    values = features[thin].reshape(-1, features.shape[-1])
    at_border, farthest = border_of(is_known.shape), FIRST_TOLERANCE * brightest
    members = unexplained = border = np.flatnonzero(at_border & is_known)
    surfaces: list[_Surface] = []
    for turn in range(TURNS):
        # Once surfaces are fitted closely, what they miss of the border can be another behind a faint seam.
        more = _border_surfaces(
            terms[unexplained], values[unexplained], farthest, _SMALLEST_SURFACE * len(border)
        )
        surfaces += [_Surface(each, farthest, np.zeros(values.shape[1], np.float32)) for each in more]
        del surfaces[_MOST_SURFACES:]
        if not surfaces:
            break
        members = np.union1d(members, unexplained)
        distances = [norm(values[members] - terms[members] @ each.coefficients) for each in surfaces]
        owners = np.argmin(distances, axis=0)
        for index, (surface, own) in enumerate(zip(surfaces, distances, strict=True)):
            chosen = members[(owners == index) & (own <= surface.tolerance)]
            if len(chosen) < _NUM_TERMS:
                continue
            num_terms = 6 if turn == 0 else _NUM_TERMS
            surface.coefficients = _least_squares(terms[chosen], values[chosen], num_terms)
            surface.level = np.median(values[chosen], axis=0)
            left = norm(values[chosen] - terms[chosen] @ surface.coefficients)
            least = max(_LEAST_TOLERANCE * brightest, _OF_LEVEL * float(norm(surface.level)))
            surface.tolerance = min(max(_DEVIATIONS * float(np.median(left)), least), farthest)
        near = [norm(values - terms @ each.coefficients) <= each.tolerance for each in surfaces]
        alike = np.any(near, axis=0).reshape(is_known.shape) & is_known
        parts = parts_of(alike)
        members = np.flatnonzero(np.isin(parts, parts[at_border]) & alike)
        unexplained = border[~alike.ravel()[border]]
    return FittedView(features, surfaces, farthest, known)


def _border_surfaces(
    terms: Float32[np.ndarray, "P t"], values: Float32[np.ndarray, "P k"], farthest: float, fewest: float
) -> list[Float32[np.ndarray, "t k"]]:
    """Quadratic surfaces near to most pixels of the border, each sought from all parts of it and near to more than
    `fewest`."""
    parts = np.floor((np.arctan2(terms[:, 2], terms[:, 1]) / (2 * np.pi) + 0.5) * _SEGMENTS)
    free, surfaces = np.ones(len(terms), bool), []
    while len(surfaces) < _MOST_SURFACES:
        best, most = free, fewest
        found = None
        for part in range(_SEGMENTS):
            near = free & (parts == part)
            if near.sum() < 3:
                continue
            surface = np.zeros((_NUM_TERMS, values.shape[1]), np.float32)
            surface[0] = np.median(values[near], axis=0)
            near = free & (norm(values - terms @ surface) < farthest)
            for num_terms in (1, 3, 3, 6, 6):
                if near.sum() < 2 * num_terms:
                    break
                surface = _least_squares(terms[near], values[near], num_terms)
                away = norm(values - terms @ surface) / farthest
                near = free & (away < 1)
                # By how near they are, not by their number: a surface can pass near to parts of two others.
                if (score := float((1 - away[near] ** 2).sum())) > most:
                    found, best, most = surface, near, score
        if found is None:
            break
        surfaces.append(found)
        free &= ~best
    return surfaces


def parts_of(mask: Mask) -> Int32[np.ndarray, "H W"]:
    """Numbers, from 1, of the parts of a mask that are connected by edges; 0 outside."""
    from scipy import ndimage

    parts = np.empty(mask.shape, np.int32)
    ndimage.label(mask, output=parts)
    return parts


def _least_squares(
    terms: Float32[np.ndarray, "P t"], values: Float32[np.ndarray, "P k"], num_terms: int
) -> Float32[np.ndarray, "t k"]:
    """The surface of so many terms nearest to values; the others are 0."""
    used = terms[:, :num_terms].astype(np.float64)
    moments = used.T @ used + 1e-6 * len(used) * np.eye(num_terms)
    surface = np.zeros((terms.shape[1], values.shape[1]), np.float32)
    surface[:num_terms] = np.linalg.solve(moments, used.T @ values)
    return surface


def _terms(shape: tuple[int, int]) -> Float32[np.ndarray, "P t"]:
    """Products of x and y up to the third degree, the lower ones first, of each pixel; both run from -1 to 1."""
    y, x = np.meshgrid(*(np.linspace(-1, 1, side, dtype=np.float32) for side in shape), indexing="ij")
    x, y = x.ravel(), y.ravel()
    cubic = (x * x * x, x * x * y, x * y * y, y * y * y)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, *cubic], axis=-1)


def border_of(shape: tuple[int, int]) -> Mask:
    border = np.ones(shape, bool)
    rows, columns = (max(1, round(BORDER_SHARE * side)) for side in shape)
    border[rows:-rows, columns:-columns] = False
    return border


def norm(values: Float32[np.ndarray, "*pixels k"]) -> Float32[np.ndarray, "*pixels"]:
    return np.asarray(np.sqrt(np.square(values).sum(axis=-1)))
