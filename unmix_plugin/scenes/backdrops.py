"""A backdrop that is much alike within and over views: whether there is one, and which pixels of a view show it.

In each view a backdrop is one or two smooth surfaces, such as a wall and a floor: quadratic functions of the place in
the picture, fitted to what reaches the border. Stripes of the sensor, the same in all views, are taken off first. A
pixel shows the backdrop if it is as near to a surface as the backdrop's own pixels are, and hangs together with the
border or is part of a large hole. Edges are soft: a pixel beside the backdrop is a mixture of it and of the matter
farther in.

Rooms and landscapes have borders too. So a backdrop counts only if it is plain, reaches most of the border of nearly
all views, and looks alike in all of them: a mask that is wrong is worse than none.

Notation: `H x W` pixels, `B` bands, `k` features of a spectrum, `n` surfaces, `P` pixels; values in [0, 1] as they are
written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32

_NUM_FEATURES = 4
"""Coordinates of spectra along which those of the capture differ most."""
_BRIGHT_PERCENTILE = 99.0
LOOKED_AT = 12
"""Views that a backdrop is looked for in."""
_LONGEST_SIDE_PX, _MOST_BANDS = 200, 12
"""Of views of a scene, in which it is looked for: larger ones are thinned out."""
_BORDER_SHARE = 0.02
"""Width of the border, as a share of the view's."""
_STRIPE_WINDOW = 25
"""Columns that stripes of the sensor are narrower than."""
_MOST_SURFACES = 2
_NUM_TERMS = 10
_TURNS = 5
"""In which surfaces grow from the border inwards."""
_SEGMENTS = 12
"""Parts of the border that a surface is sought from."""
_FIRST_TOLERANCE = 0.04
"""Distance from a surface that still belongs to it while it is fitted, as a share of the brightest pixels."""
_LEAST_TOLERANCE, _OF_LEVEL = 0.004, 0.02
"""Of a fitted surface, in the same unit, and as a share of its own brightness: JPEG and dust vary it by this."""
_DEVIATIONS = 4.0
"""Median distances of a surface's pixels up to which one belongs to it."""
_SMALLEST_SURFACE = 0.06
"""Share of the border that a second surface explains at least."""
_MOST_FITTED = 20_000
"""Pixels that a surface is fitted to."""
_HOLE_SHARE = 5e-4
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

_LEAST_EXPLAINED, _LEAST_IN_A_VIEW = 0.8, 0.5
"""Share of the border that a backdrop reaches: in the median, and in most views."""
_MOST_VIEWS = 0.8
"""Share of the views that this holds for."""
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

    def find(self, features: Float32[np.ndarray, "H W k"], known: Bool[np.ndarray, "H W"]) -> LookedAt | None:
        """The backdrop in a view; None where it shows none.

        Args:
            features: Of all its pixels.
            known: Pixels with a measurement.
        """
        found = _fit(features, known, self.brightest)
        kept = [index for index, level in enumerate(found.levels) if self.is_like(level)]
        return found.of(kept).look() if kept else None

    def spectra(self, features: Float32[np.ndarray, "P k"]) -> Float32[np.ndarray, "P B"]:
        """Spectra of these features."""
        return features @ self.basis.T

    def is_like(self, level: Float32[np.ndarray, " k"]) -> bool:
        """Whether features are near those of a surface that was looked at, or of it in more or in less light."""
        share = (self.levels @ level) / np.maximum(np.square(self.levels).sum(-1), 1e-12)
        lit = np.clip(share, 1 / _MOST_SHADED, _MOST_SHADED)[:, None] * self.levels
        near = _norm(self.levels - level) < _MOST_UNLIKE * self.brightest
        return bool((near | (_norm(lit - level) < _FIRST_TOLERANCE * self.brightest)).any())

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
class ViewBackdrop:
    """Smooth surfaces in one view, and the pixels on them."""

    features: Float32[np.ndarray, "H W k"]
    surfaces: tuple[Float32[np.ndarray, "t k"], ...]
    levels: tuple[Float32[np.ndarray, " k"], ...]
    """Median features of the pixels of each."""
    tolerances: tuple[float, ...]
    """Distance up to which a pixel belongs to each."""
    farthest: float
    """Distance beyond which no pixel belongs to any."""
    known: Bool[np.ndarray, "H W"]

    def of(self, kept: Sequence[int]) -> ViewBackdrop:
        """With some of the surfaces."""
        return replace(
            self,
            surfaces=tuple(self.surfaces[index] for index in kept),
            levels=tuple(self.levels[index] for index in kept),
            tolerances=tuple(self.tolerances[index] for index in kept),
        )

    def look(self) -> LookedAt:
        """Which pixels show the backdrop, and what it looks like at each.

        What the surfaces leave unexplained is smooth too: it is taken from the backdrop around, over and over again.
        """
        from scipy import ndimage

        behind, tolerance = self._nearest()
        rest = self.features - behind
        window = max(3, round(_AROUND_SHARE * max(rest.shape[:2])))
        shown, around = self._hangs_together(_norm(rest) / tolerance), np.zeros_like(rest)
        for _ in range(_TURNS):
            weight = ndimage.uniform_filter(shown.astype(np.float32), window)
            around = (
                np.stack(
                    [
                        ndimage.uniform_filter(np.where(shown, rest[..., i], 0.0), window)
                        for i in range(rest.shape[-1])
                    ],
                    axis=-1,
                )
                / np.maximum(weight, 1e-6)[..., None]
            )
            around *= np.minimum(1.0, self.farthest / np.maximum(_norm(around), 1e-9))[..., None]
            distance = _norm(rest - around) / tolerance
            shown = self._hangs_together(np.where(weight > _LEAST_AROUND, distance, np.inf))
        return LookedAt(self.features, behind + around, shown, self.known)

    def _nearest(self) -> tuple[Float32[np.ndarray, "H W k"], Float32[np.ndarray, "H W"]]:
        """Of each pixel the surface that it is nearest to, in tolerances, and that surface's tolerance."""
        terms = _terms(self.known.shape)
        values = np.stack([(terms @ surface).reshape(self.features.shape) for surface in self.surfaces])
        tolerances = np.array(self.tolerances, np.float32)
        owners = (_norm(self.features - values) / tolerances[:, None, None]).argmin(axis=0)
        return np.take_along_axis(values, owners[None, ..., None], axis=0)[0], tolerances[owners]

    def _hangs_together(self, distance: Float32[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """Of pixels that are alike (distances up to 1), those that hang together with the border, and large holes."""
        alike = (distance <= 1) & self.known
        alike |= self._seams(alike)
        parts = _parts(alike)
        sizes = np.bincount(parts.ravel())
        kept = sizes >= max(4.0, _HOLE_SHARE * alike.size)
        for part in np.flatnonzero(kept).tolist():
            kept[part] = np.median(distance[parts == part]) <= _OF_A_HOLE
        kept[parts[_border(alike.shape)]] = True
        kept[0] = False
        return kept[parts]

    def _seams(self, alike: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """Pixels between two surfaces that are mixtures of both."""
        from scipy import ndimage

        if len(self.surfaces) < 2:
            return np.zeros_like(alike)
        terms = _terms(alike.shape)
        first, second = ((terms @ surface).reshape(self.features.shape) for surface in self.surfaces)
        near = [
            ndimage.binary_dilation(_norm(self.features - values) <= tolerance, iterations=_RIM_PX)
            for values, tolerance in zip((first, second), self.tolerances, strict=True)
        ]
        across = second - first
        share = ((self.features - first) * across).sum(-1) / np.maximum((across**2).sum(-1), 1e-12)
        away = _norm(self.features - first - np.clip(share, 0, 1)[..., None] * across)
        return np.logical_and(near[0], near[1]) & self.known & (away <= max(self.tolerances))


@dataclass(frozen=True)
class LookedAt:
    """The backdrop of one view, pixel by pixel."""

    features: Float32[np.ndarray, "H W k"]
    """Of what is seen."""
    behind: Float32[np.ndarray, "H W k"]
    """Of the backdrop, also where matter hides it."""
    shown: Bool[np.ndarray, "H W"]
    """Pixels that show the backdrop."""
    known: Bool[np.ndarray, "H W"]
    """Pixels with a measurement."""

    def opacity(self, matter: Bool[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """How much of each pixel matter covers, [0, 1]: less than 1 only in the rim of `matter`."""
        from scipy import ndimage

        inside = np.array(ndimage.binary_erosion(matter, iterations=_RIM_PX, border_value=1), bool)
        rim = matter & ~inside & self.known
        weight = ndimage.uniform_filter(inside.astype(np.float32), _INSIDE_PX)[rim]
        before = np.stack(
            [
                ndimage.uniform_filter(np.where(inside, self.features[..., i], 0.0), _INSIDE_PX)[rim]
                for i in range(self.features.shape[-1])
            ],
            axis=-1,
        )
        across = before / np.maximum(weight, 1e-6)[:, None] - self.behind[rim]
        seen = self.features[rim] - self.behind[rim]
        share = (seen * across).sum(-1) / np.maximum((across**2).sum(-1), 1e-12)
        opacity = matter.astype(np.float32)
        opacity[rim] = np.where(weight > 1e-3, np.clip(share, 0.0, 1.0), 1.0)
        return opacity


@dataclass(frozen=True)
class BeforeBackdrop:
    """Of each training view, where something may stand before a backdrop that all share."""

    thinned: tuple[Bool[np.ndarray, "_ _"], ...]
    """Of every `stride`-th row and column."""
    stride: int
    sizes: tuple[tuple[int, int], ...]
    """Width and height of each view."""

    @property
    def shows_matter(self) -> bool:
        """Whether there is anything but the backdrop."""
        return bool(np.mean([mask.mean() for mask in self.thinned]) > 1 - _ALL)

    def masks(self) -> list[Bool[np.ndarray, "_ _"]]:
        """Of whole views, which are much larger than what is kept."""
        return [
            mask.repeat(self.stride, axis=0).repeat(self.stride, axis=1)[:height, :width]
            for mask, (width, height) in zip(self.thinned, self.sizes, strict=True)
        ]


def find_before_backdrop(
    sizes: Sequence[tuple[int, int]],
    read_view: Callable[[int, tuple[slice, ...]], np.ndarray],
    unknown: Sequence[Bool[np.ndarray, "_ _"] | None],
) -> BeforeBackdrop | None:
    """Where something may stand before a backdrop that all views share; None if there is none.

    Args:
        sizes: Width and height of each view.
        read_view: From a view, and the rows, columns and bands wanted, to its picture.
        unknown: Of each view, pixels that are not valid or masked out, before which anything may stand; None without.
    """
    stride = -(-max(max(size) for size in sizes) // _LONGEST_SIDE_PX)
    bands = read_view(0, (slice(1), slice(1))).shape[2]
    part = (slice(None, None, stride), slice(None, None, stride), slice(None, None, -(-bands // _MOST_BANDS)))
    chosen = np.unique(
        np.linspace(0, len(sizes) - 1, min(len(sizes), LOOKED_AT)).round().astype(int)
    ).tolist()

    def known(view: int, image: np.ndarray) -> np.ndarray:
        missing = unknown[view]
        return np.ones(image.shape[:2], bool) if missing is None else ~missing[part[:2]]

    images = [read_view(view, part) for view in chosen]
    is_known = [known(view, image) for view, image in zip(chosen, images, strict=True)]
    sample = np.concatenate(
        [image[::4, ::4][mask[::4, ::4]] for image, mask in zip(images, is_known, strict=True)]
    )
    backdrop = judge_backdrop(images, is_known, sample)
    if backdrop is None:
        return None
    masks = []
    for view in range(len(sizes)):
        image = read_view(view, part)
        seen, mask = backdrop.find(backdrop.features(image), known(view, image)), known(view, image)
        masks.append(np.ones_like(mask) if seen is None else _without_specks(~seen.shown) | ~mask)
    return BeforeBackdrop(tuple(masks), stride, tuple(sizes))


def _without_specks(matter: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Matter without parts that are smaller than a hole may be, wider by a pixel."""
    from scipy import ndimage

    parts = _parts(matter)
    kept = np.bincount(parts.ravel()) >= max(4.0, _HOLE_SHARE * matter.size)
    kept[0] = False
    return np.array(ndimage.binary_dilation(kept[parts]), bool)


def judge_backdrop(
    images: Sequence[Float32[np.ndarray, "h W B"]],
    known: Sequence[Bool[np.ndarray, "h W"]],
    sample: Float32[np.ndarray, "N B"],
) -> Backdrop | None:
    """The backdrop of some views.

    Args:
        images: Their pixels, or some of their rows.
        known: Pixels with a measurement.
        sample: Pixels of all views.
    """
    if min(images[0].shape[:2]) < 3 or len(sample) < _NUM_FEATURES:
        return None
    basis = _basis(np.clip(sample, 0.0, 1.0))
    brightest = float(np.percentile(_norm(np.clip(sample, 0.0, 1.0)), _BRIGHT_PERCENTILE))
    if brightest <= 0:
        return None
    features = [image @ basis for image in images]
    stripes = _stripes(features)
    fitted = [_fit(image - stripes, mask, brightest) for image, mask in zip(features, known, strict=True)]
    levels = np.array([level for view in fitted for level in view.levels], np.float32)
    if not len(levels):
        return None
    # Alike are surfaces that most views have one like.
    owners = np.array([index for index, view in enumerate(fitted) for _ in view.levels])
    near = _norm(levels[:, None] - levels[None]) < _MOST_UNLIKE * brightest
    supported = [len(set(owners[row])) >= _MOST_VIEWS * len(images) for row in near]
    found = Backdrop(basis, stripes, brightest, levels[supported], np.zeros(basis.shape[0], np.float32))
    explained, shares, distances, spectra = [], [], [], []
    for image, view, mask in zip(images, fitted, known, strict=True):
        own = view.of([index for index, level in enumerate(view.levels) if found.is_like(level)])
        seen = own.look() if own.surfaces else None
        shown = np.zeros_like(mask) if seen is None else seen.shown
        at_border = _border(mask.shape) & mask
        explained.append(shown[at_border].mean() if at_border.any() else 0.0)
        shares.append(shown[mask].mean() if mask.any() else 0.0)
        if seen is not None and shown.any():
            distances.append(np.median(_norm(seen.features - seen.behind)[shown]) / brightest)
            spectra.append(np.median(image[shown], axis=0))
    if (
        not distances
        or np.median(explained) < _LEAST_EXPLAINED
        or np.mean(np.array(explained) >= _LEAST_IN_A_VIEW) < _MOST_VIEWS
        or np.median(shares) < _LEAST_SHARE
        or _MOST_SHARE < np.median(shares) < _ALL
        or np.median(distances) > _MOST_DISTANCE
    ):
        return None
    spectrum = np.median(spectra, axis=0).astype(np.float32)
    return Backdrop(basis, stripes, brightest, found.levels, spectrum)


def _basis(sample: Float32[np.ndarray, "N B"]) -> Float32[np.ndarray, "B k"]:
    """Directions in which spectra reach farthest from 0."""
    moments = sample.T.astype(np.float64) @ sample
    _, vectors = np.linalg.eigh(moments)
    return np.ascontiguousarray(vectors[:, ::-1][:, :_NUM_FEATURES], np.float32)


def _stripes(features: Sequence[Float32[np.ndarray, "h W k"]]) -> Float32[np.ndarray, "W k"]:
    """What the columns of a sensor add: median over the views' first and last rows of what is narrow in them."""
    from scipy import ndimage

    width = max(1, round(_BORDER_SHARE * len(features[0])))
    lines = [side.mean(axis=0) for image in features for side in (image[:width], image[-width:])]
    # Less what is smooth: mirrored at the ends of a line, a slope would look like stripes there.
    rests = [line - _smooth_part(line) for line in lines]
    narrow = [rest - ndimage.median_filter(rest, (_STRIPE_WINDOW, 1), mode="mirror") for rest in rests]
    return np.median(narrow, axis=0).astype(np.float32)


def _smooth_part(line: Float32[np.ndarray, "W k"]) -> Float32[np.ndarray, "W k"]:
    """A cubic through most of a line, whatever the rest is."""
    terms = np.vander(np.linspace(-1, 1, len(line)), 4).astype(np.float32)
    smooth = np.broadcast_to(np.median(line, axis=0), line.shape)
    for _ in range(_TURNS):
        away = _norm(line - smooth)
        near = away <= 2 * np.median(away)
        smooth = terms @ np.linalg.lstsq(terms[near], line[near], rcond=None)[0]
    return smooth


def _fit(
    features: Float32[np.ndarray, "H W k"], known: Bool[np.ndarray, "H W"], brightest: float
) -> ViewBackdrop:
    """Up to two smooth surfaces that explain most of a view's border, grown inwards from there."""
    stride = max(1, round((known.size / _MOST_FITTED) ** 0.5))
    thin = (slice(None, None, stride),) * 2
    shape = known[thin].shape
    terms = _terms(known.shape).reshape(*known.shape, -1)[thin].reshape(-1, _NUM_TERMS)
    values = features[thin].reshape(-1, features.shape[-1])
    at_border, farthest = _border(shape), _FIRST_TOLERANCE * brightest
    border = np.flatnonzero(at_border & known[thin])
    surfaces: list[Float32[np.ndarray, "t k"]] = []
    tolerances: list[float] = []
    levels: list[Float32[np.ndarray, " k"]] = []
    members = unexplained = border
    for turn in range(_TURNS):
        # Once surfaces are fitted closely, what they miss of the border can be another behind a faint seam.
        most = _SMALLEST_SURFACE * len(border)
        more = _border_surfaces(terms[unexplained], values[unexplained], farthest, most)
        more = more[: _MOST_SURFACES - len(surfaces)]
        surfaces += more
        tolerances += [farthest] * len(more)
        levels += [np.zeros(values.shape[1], np.float32)] * len(more)
        if not surfaces:
            break
        members = np.union1d(members, unexplained)
        distances = np.stack([_norm(values[members] - terms[members] @ surface) for surface in surfaces])
        owners = distances.argmin(axis=0)
        for index, own in enumerate(distances):
            mine = (owners == index) & (own <= tolerances[index])
            if mine.sum() < _NUM_TERMS:
                continue
            chosen = members[mine]
            surfaces[index] = _least_squares(terms[chosen], values[chosen], 6 if turn == 0 else _NUM_TERMS)
            levels[index] = np.median(values[chosen], axis=0)
            left = _norm(values[chosen] - terms[chosen] @ surfaces[index])
            least = max(_LEAST_TOLERANCE * brightest, _OF_LEVEL * float(_norm(levels[index])))
            tolerances[index] = min(max(_DEVIATIONS * float(np.median(left)), least), farthest)
        near = [
            _norm(values - terms @ each) <= limit for each, limit in zip(surfaces, tolerances, strict=True)
        ]
        alike = np.any(near, axis=0).reshape(shape) & known[thin]
        members = np.flatnonzero(_reaching(alike, at_border))
        unexplained = border[~alike.ravel()[border]]
    return ViewBackdrop(features, tuple(surfaces), tuple(levels), tuple(tolerances), farthest, known)


def _border_surfaces(
    terms: Float32[np.ndarray, "P t"],
    values: Float32[np.ndarray, "P k"],
    farthest: float,
    fewest: float,
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
            near = free & (_norm(values - terms @ surface) < farthest)
            for num_terms in (1, 3, 3, 6, 6):
                if near.sum() < 2 * num_terms:
                    break
                surface = _least_squares(terms[near], values[near], num_terms)
                away = _norm(values - terms @ surface) / farthest
                near = free & (away < 1)
                # By how near they are, not by their number: a surface can pass near to parts of two others.
                if (score := float((1 - away[near] ** 2).sum())) > most:
                    found, best, most = surface, near, score
        if found is None:
            break
        surfaces.append(found)
        free &= ~best
    return surfaces


def _reaching(alike: Bool[np.ndarray, "H W"], at_border: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Parts of a mask that reach the border."""
    parts = _parts(alike)
    reaches = np.zeros(parts.max() + 1, bool)
    reaches[parts[at_border]] = True
    reaches[0] = False
    return reaches[parts]


def _parts(mask: Bool[np.ndarray, "H W"]) -> Int32[np.ndarray, "H W"]:
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


def _border(shape: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    border = np.ones(shape, bool)
    rows, columns = (max(1, round(_BORDER_SHARE * side)) for side in shape)
    border[rows:-rows, columns:-columns] = False
    return border


def _norm(values: Float32[np.ndarray, "*pixels k"]) -> Float32[np.ndarray, "*pixels"]:
    return np.asarray(np.sqrt(np.square(values).sum(axis=-1)))
