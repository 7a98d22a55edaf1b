"""How far a scene is off at each place of it, by what its training views measured there.

The surface is divided into cells, small ones within large ones. Of each cell the mean squared difference of what is
rendered and what was measured is known: of spectra, of their shape and brightness, and of abundances, which are
compared with all that the measured spectra may be mixtures of. Where a small cell has few pixels, the large one around
it speaks for it, and the whole scene for that. Within a cell, mixtures are further off than what is nearly pure or
absent, and bright spectra than dark ones. How wide intervals have to be follows from leaving views out: the errors of
each view are put beside what the cells say without that view.

docs/background/uncertainty.md says what intervals cover and what they do not.

Notation: `N` measured pixels, `P` places, `B` bands, `K` endmembers, `Q = K + 3` quantities (abundances, spectra as a
whole, their shape, their brightness), `C` cells, `D` directions of errors, `L` coverages, `G` sizes of regions, `W`
mixtures that a spectrum may be, `A` and `S` groups of abundances and of spectra by how large they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from unmix_plugin.spectral.intervals import is_determined, propagated_deviation, width_factor, width_factors

CELL_SIZES_PX = (12.0, 3.0)
"""Edges of cells, in pixels as large as they are in the middle of the scene."""
_REGION_SIZES_PX = (3.0, 12.0, 48.0, 192.0)
"""Edges of regions over which it is known how much of the errors is left in their mean."""
_PRIOR_PIXELS = 4.0
"""Pixels of a cell that say as much as the larger one around it."""
_FEWEST_VIEWS = 2
"""That have to have measured in a large cell."""
_DIRECTIONS = 8
"""Of the errors of spectra, that are kept: those of the largest deviations."""
_LEAST_SQUARE = 1e-7
"""Added to mean squares: rounding of what was measured."""
_INDEX_BITS = 20
_HALF = 1 << (_INDEX_BITS - 1)
_PRESENT = 0.05
"""Abundance from which a material is there. Intervals of what is absent and of what is there have widths of their own:
an absent material is found to be absent, which says nothing of those that are there."""
_ABUNDANCE_EDGES = (0.01, 0.03, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)
"""Between groups of abundances."""
_BRIGHTNESS_GROUPS = 10
_CONTRAST_PIXELS, _CONTRASTS = 4000, 40
"""By which it is found how wide intervals of numbers made of spectra have to be: so many contrasts of two bands."""


@dataclass(frozen=True)
class ComparedPixels:
    """What is rendered of measured pixels beside what was measured."""

    positions: Float[Tensor, "N 3"]
    """Where the pixels' rays end, model space."""
    views: Int64[Tensor, "N"]
    """Which view measured."""
    rendered: Float[Tensor, "N B"]
    """Radiance, as if what is seen were opaque."""
    measured: Float[Tensor, "N B"]
    abundances: Float[Tensor, "N K"]
    """Of what is rendered."""
    possible: Float[Tensor, "W N K"]
    """Abundances of the measured spectra: each way to unmix them, with each set of endmembers that they don't rule
    out."""


@dataclass(frozen=True)
class CellGrid:
    """Cubes that divide space. The key of a cell is one number; those of its neighbours differ from it by
    `NEIGHBOURS`."""

    origin: Float[Tensor, "3"]
    """A corner of the cell (0, 0, 0)."""
    edge: float | Tensor

    def indices(self, positions: Float[Tensor, "*places 3"]) -> Int64[Tensor, "*places 3"]:
        """Of the cells in which positions lie; far away ones share the outermost."""
        steps = ((positions.double() - self.origin.double()) / self.edge).floor()
        return steps.clamp(-_HALF, _HALF - 1).nan_to_num().long()

    def keys(self, positions: Float[Tensor, "*places 3"]) -> Int64[Tensor, "*places"]:
        """Of the cells in which positions lie."""
        return self.keys_of(self.indices(positions))

    @staticmethod
    def keys_of(indices: Int64[Tensor, "*cells 3"]) -> Int64[Tensor, "*cells"]:
        """Of cells by their indices."""
        x, y, z = (indices + _HALF).unbind(dim=-1)
        return (x << 2 * _INDEX_BITS) | (y << _INDEX_BITS) | z


NEIGHBOURS = tuple(
    (x << 2 * _INDEX_BITS) + (y << _INDEX_BITS) + z for x, y, z in product((-1, 0, 1), repeat=3)
)
"""From the key of a cell to those around it, itself in the middle."""


def find_keys(
    known: Int64[Tensor, "C"], keys: Int64[Tensor, "*places"]
) -> tuple[Int64[Tensor, "*places"], Bool[Tensor, "*places"]]:
    """Row of each key among increasing ones, and whether it is there."""
    rows = torch.searchsorted(known, keys).clamp(max=len(known) - 1)
    return rows, known[rows] == keys


@dataclass(frozen=True)
class Cells:
    """Sums over the cells of one size."""

    keys: Int64[Tensor, "C"]
    """Increasing."""
    counts: Float[Tensor, "C"]
    """Pixels measured."""
    views: Int64[Tensor, "C"]
    """Views that measured any of them."""
    sums: Float[Tensor, "C Q"]
    """Of squared errors."""


@dataclass(frozen=True)
class LocalErrors:
    """Expected errors at some places."""

    abundances: Float[Tensor, "*places K"]
    """Standard deviation, NaN where too few views measured."""
    spectra: Float[Tensor, "*places"]
    """The same of spectra, in multiples of the usual one; NaN as above."""
    shape: Float[Tensor, "*places"]
    """The same of what is left of errors of spectra when they are as bright as each other."""
    brightness: Float[Tensor, "*places"]
    """Relative."""
    scene: PlaceErrors
    """Whose errors they are."""

    def to(self, device: torch.device | str) -> LocalErrors:
        """The same on another device."""
        scene = self.scene.map(lambda values: values.to(device))
        spectral = (one.to(device) for one in (self.spectra, self.shape, self.brightness))
        return LocalErrors(self.abundances.to(device), *spectral, scene=scene)


@dataclass(frozen=True)
class PlaceErrors:
    """Expected errors at all places of a scene, on one device."""

    origin: Float[Tensor, "3"]
    """Corner of the cells, model space."""
    pixel_size: Float[Tensor, ""]
    """Model units."""
    large: Cells
    small: Cells
    usual: Float[Tensor, "Q"]
    """Mean squared errors of the whole scene; of spectra and their shape 1, in units of the usual one."""
    directions: Float[Tensor, "D B"]
    """Of errors of the shape of spectra: their usual covariance is directions^T directions."""
    band_deviations: Float[Tensor, "B"]
    """Usual root mean squared error of each band, radiance."""
    endmember_deviations: Float[Tensor, "K B"]
    """Expected errors of the endmembers, radiance."""
    is_determined: Bool[Tensor, "K"]
    """Whether these are small beside the endmembers."""
    abundance_levels: Float[Tensor, "A"]
    """Errors of abundances of each group in multiples of what cells say."""
    brightness_edges: Float[Tensor, "edges"]
    """Lengths of spectra between groups, radiance."""
    brightness_levels: Float[Tensor, "S 3"]
    """Errors of spectra of each group, their shape and their brightness, in multiples of what cells say."""
    absent_factors: Float[Tensor, "L"]
    """Half widths of intervals of abundances that are hardly there, in multiples of the deviation, for each of
    COVERAGES."""
    abundance_factors: Float[Tensor, "L"]
    """The same of those that are there."""
    spectrum_factors: Float[Tensor, "L"]
    shape_factors: Float[Tensor, "L"]
    brightness_factors: Float[Tensor, "L"]
    abundance_alike: Float[Tensor, "G"]
    """Share of squared errors that is left in the mean over a region, for each size."""
    spectrum_alike: Float[Tensor, "G"]

    @staticmethod
    def fit(
        pixels: ComparedPixels,
        endmembers: Float[Tensor, "K B"],
        endmember_deviations: Float[Tensor, "K B"],
        origin: Float[Tensor, "3"],
        pixel_size: float,
    ) -> PlaceErrors | None:
        """What compared pixels tell, with expected errors of the endmembers; None where fewer than three views measured
        any."""
        if len(pixels.views.unique()) <= _FEWEST_VIEWS:
            return None
        generator = torch.Generator().manual_seed(0)
        rendered, abundances = pixels.rendered.double(), pixels.abundances.double()
        spectra = rendered - pixels.measured.double()
        lengths = rendered.norm(dim=1, keepdim=True).clamp(min=1e-6)
        brightness = (spectra * rendered).sum(dim=1, keepdim=True) / lengths.square()
        shape = spectra - brightness * rendered
        band_squares, shape_squares = (one.square().mean(dim=0) + _LEAST_SQUARE for one in (spectra, shape))
        deviations = abundances - pixels.possible.double()
        squares = torch.cat(
            [
                deviations.square().mean(dim=0),
                (spectra.square() / band_squares).mean(dim=1, keepdim=True),
                (shape.square() / shape_squares).mean(dim=1, keepdim=True),
                brightness.square(),
            ],
            dim=1,
        )
        usual = squares.mean(dim=0)
        keys = [CellGrid(origin, size * pixel_size).keys(pixels.positions) for size in CELL_SIZES_PX]
        large, small = (_cells(own, pixels.views, squares) for own in keys)
        expected = _without_own_view(keys, pixels.views, squares, usual)

        edges = torch.linspace(0, 1, _BRIGHTNESS_GROUPS + 1, dtype=torch.float64)[1:-1]
        brightness_edges = torch.quantile(lengths[:, 0], edges)
        of_abundances = torch.bucketize(abundances, abundances.new_tensor(_ABUNDANCE_EDGES))
        of_spectra = torch.bucketize(lengths[:, 0], brightness_edges)
        abundance_levels = _levels(
            of_abundances, expected[:, :-3], squares[:, :-3], len(_ABUNDANCE_EDGES) + 1
        )
        brightness_levels = torch.stack(
            [_levels(of_spectra, expected[:, i], squares[:, i], _BRIGHTNESS_GROUPS) for i in (-3, -2, -1)],
            dim=1,
        )
        own = expected[:, :-3] * abundance_levels[of_abundances]
        of_spectrum, of_shape, of_brightness = (expected[:, -3:] * brightness_levels[of_spectra]).unbind(
            dim=1
        )

        ratios = deviations.abs() / own
        is_there = abundances > _PRESENT
        # What is there is measured against the mixtures that are furthest off: any may be the true ones.
        told = is_there if is_there.any() else torch.ones_like(is_there)
        of_ways = torch.stack([width_factors(one[told], generator) for one in ratios])
        eigen = torch.linalg.eigh(shape.T @ shape / len(shape))
        kept = slice(-min(_DIRECTIONS, shape.shape[1]), None)
        directions = (eigen.eigenvectors[:, kept] * eigen.eigenvalues[kept].clamp(min=0).sqrt()).T
        some = torch.randperm(len(shape), generator=generator)[:_CONTRAST_PIXELS]
        contrasts = _contrasts(rendered.shape[1], generator)
        missed = (contrasts(rendered[some]) - contrasts(pixels.measured[some].double())).abs()
        foreseen = propagated_deviation(contrasts, rendered[some], directions, of_shape[some])

        sizes = [CellGrid(origin, size * pixel_size).keys(pixels.positions) for size in _REGION_SIZES_PX]
        absent = ratios[:, ~is_there].flatten()
        every_way = deviations.transpose(0, 1).flatten(1)
        of_bands = of_spectrum[:, None] * band_squares.sqrt()
        found = PlaceErrors(
            origin=origin.double(),
            pixel_size=torch.tensor(pixel_size, dtype=torch.float64),
            large=large,
            small=small,
            usual=usual,
            directions=directions,
            band_deviations=band_squares.sqrt(),
            endmember_deviations=endmember_deviations.double(),
            is_determined=torch.from_numpy(
                is_determined(endmembers.double().numpy(), endmember_deviations.double().numpy())
            ),
            abundance_levels=abundance_levels,
            brightness_edges=brightness_edges,
            brightness_levels=brightness_levels,
            absent_factors=width_factors(absent if len(absent) else ratios.flatten(), generator),
            abundance_factors=of_ways.amax(dim=0),
            spectrum_factors=width_factors((spectra.abs() / of_bands).flatten(), generator),
            shape_factors=width_factors((missed / foreseen.clamp(min=1e-9)).flatten(), generator),
            brightness_factors=width_factors(brightness[:, 0].abs() / of_brightness, generator),
            abundance_alike=torch.stack([_alike(one, every_way) for one in sizes]),
            spectrum_alike=torch.stack([_alike(one, spectra) for one in sizes]),
        )
        return found.map(lambda values: values.float() if values.is_floating_point() else values)

    def at(
        self,
        positions: Float[Tensor, "*places 3"],
        abundances: Float[Tensor, "*places K"],
        spectra: Float[Tensor, "*places B"],
    ) -> LocalErrors:
        """At places of model space with these abundances and this radiance; unknown (NaN) where fewer than two views
        measured around, and of abundances of endmembers that are not determined."""
        flat = positions.reshape(-1, 3).to(self.origin)
        squares = self.usual.expand(len(flat), -1)
        is_known = torch.zeros(len(flat), dtype=torch.bool, device=flat.device)
        for size, cells in zip(CELL_SIZES_PX, (self.large, self.small), strict=True):
            rows, is_there = find_keys(cells.keys, CellGrid(self.origin, size * self.pixel_size).keys(flat))
            counts = torch.where(is_there, cells.counts[rows], 0.0)[:, None]
            sums = torch.where(is_there[:, None], cells.sums[rows], 0.0)
            squares = (sums + _PRIOR_PIXELS * squares) / (counts + _PRIOR_PIXELS)
            if cells is self.large:
                is_known = is_there & (cells.views[rows] >= _FEWEST_VIEWS)
        deviations = torch.where(is_known[:, None], (squares + _LEAST_SQUARE).sqrt(), torch.nan)
        deviations = deviations.reshape(*positions.shape[:-1], -1)
        edges = self.origin.new_tensor(_ABUNDANCE_EDGES)
        levels = self.abundance_levels[torch.bucketize(abundances.to(edges).contiguous(), edges)]
        levels = levels.where(self.is_determined, torch.nan)
        lengths = spectra.to(self.origin).norm(dim=-1)
        of_spectra = (
            deviations[..., -3:] * self.brightness_levels[torch.bucketize(lengths, self.brightness_edges)]
        )
        return LocalErrors(deviations[..., :-3] * levels, *of_spectra.unbind(dim=-1), scene=self)

    def over_region(self, local: LocalErrors, weights: Float64[np.ndarray, " P"], edge: float) -> LocalErrors:
        """Of means over a region of the surface, from errors at places in it, what these weigh, and the edge of a
        square of its area (model units)."""
        parts = torch.from_numpy(weights / weights.sum()).to(self.origin)
        parts = torch.where(local.spectra.isfinite(), parts, 0.0)[:, None]
        total = parts.sum()
        whole = torch.where(total >= 0.5, 1 / total.clamp(min=1e-12), torch.nan)
        of_abundances, of_spectra = self.alike(edge)
        spectral = torch.stack([local.spectra, local.shape, local.brightness], dim=1)
        means = [
            (alike * whole * torch.where(parts > 0, parts * values.square(), 0.0).sum(dim=0)).sqrt()
            for alike, values in ((of_abundances, local.abundances), (of_spectra, spectral))
        ]
        return LocalErrors(means[0], *means[1].unbind(), scene=self)

    def half_widths(
        self, abundances: Float[Tensor, "*places K"], deviations: Float[Tensor, "*places K"], coverage: float
    ) -> Float[Tensor, "*places K"]:
        """Of intervals of abundances, from their expected errors."""
        absent, there = (width_factor(one, coverage) for one in (self.absent_factors, self.abundance_factors))
        return torch.where(abundances > _PRESENT, there * deviations, absent * deviations)

    def alike(self, edge: float) -> tuple[float, float]:
        """Share of the squared errors of abundances, and of spectra, that is left in the mean over a region with this
        edge (model units)."""
        size = np.log(max(edge / float(self.pixel_size), 1e-9))
        of_abundances, of_spectra = (
            float(np.interp(size, np.log(_REGION_SIZES_PX), shares.cpu().double().numpy()))
            for shares in (self.abundance_alike, self.spectrum_alike)
        )
        return of_abundances, of_spectra

    def map(self, function: Callable[[Tensor], Tensor]) -> PlaceErrors:
        """The same after a change of device or precision."""
        return PlaceErrors.of_tensors({name: function(values) for name, values in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """By name, as they are stored."""
        found: dict[str, Tensor] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            parts = {"": value} if isinstance(value, Tensor) else vars(value)
            found |= {f"{field.name}.{name}".rstrip("."): tensor for name, tensor in parts.items()}
        return found

    @staticmethod
    def of_tensors(tensors: Mapping[str, Tensor]) -> PlaceErrors:
        """The errors that `tensors` gave; a KeyError where one is missing, a ValueError where they do not fit."""
        large, small = (
            Cells(**{one.name: tensors[f"{size}.{one.name}"] for one in fields(Cells)})
            for size in ("large", "small")
        )
        for cells in (large, small):
            lengths = {len(values) for values in vars(cells).values()}
            if len(lengths) != 1 or lengths == {0} or not bool((cells.keys.diff() > 0).all()):
                raise ValueError("cells that do not fit together")
        if not all(bool(values.isfinite().all()) for values in tensors.values()):
            raise ValueError("values that are not finite")
        plain: dict[str, Any] = {
            one.name: tensors[one.name] for one in fields(PlaceErrors) if one.name not in ("large", "small")
        }
        return PlaceErrors(large=large, small=small, **plain)


def _cells(keys: Int64[Tensor, "N"], views: Int64[Tensor, "N"], squares: Float[Tensor, "N Q"]) -> Cells:
    own, rows = keys.unique(return_inverse=True)
    pairs = torch.stack([rows, views]).unique(dim=1)
    return Cells(
        own,
        torch.bincount(rows, minlength=len(own)).to(squares),
        torch.bincount(pairs[0], minlength=len(own)),
        squares.new_zeros(len(own), squares.shape[1]).index_add_(0, rows, squares),
    )


def _without_own_view(
    keys: Sequence[Int64[Tensor, "N"]],
    views: Int64[Tensor, "N"],
    squares: Float[Tensor, "N Q"],
    usual: Float[Tensor, "Q"],
) -> Float[Tensor, "N Q"]:
    """Deviations that the cells of all other views expect of each pixel."""
    expected = usual.expand(len(views), -1)
    for own in keys:
        counts, sums = [], []
        for groups in (own, torch.stack([own, views])):
            _, rows = groups.unique(return_inverse=True, dim=-1)
            num = int(rows.max()) + 1
            counts.append(torch.bincount(rows, minlength=num).to(squares)[rows, None])
            sums.append(squares.new_zeros(num, squares.shape[1]).index_add_(0, rows, squares)[rows])
        others, of_others = counts[0] - counts[1], (sums[0] - sums[1]).clamp(min=0)
        expected = (of_others + _PRIOR_PIXELS * expected) / (others + _PRIOR_PIXELS)
    return (expected + _LEAST_SQUARE).sqrt()


def _levels(
    groups: Int64[Tensor, "*values"],
    expected: Float[Tensor, "*values"],
    squares: Float[Tensor, "*values"],
    num: int,
) -> Float[Tensor, "num"]:
    """Root mean squared errors of each group in multiples of those that were expected; 1 of an empty group."""
    found, foreseen = (
        squares.new_zeros(num).index_add_(0, groups.flatten(), values.flatten())
        for values in (squares, expected.square())
    )
    return torch.where(foreseen > 0, (found + _LEAST_SQUARE) / (foreseen + _LEAST_SQUARE), 1.0).sqrt()


def _contrasts(
    num_bands: int, generator: torch.Generator
) -> Callable[[Float[Tensor, "N B"]], Float[Tensor, "N pairs"]]:
    """Normalised differences of two bands, for pairs drawn at random."""
    pairs = torch.randint(num_bands, (2, _CONTRASTS), generator=generator)
    first, second = pairs[:, pairs[0] != pairs[1]] if num_bands > 1 else pairs

    def contrasts(spectra: Float[Tensor, "N B"]) -> Float[Tensor, "N pairs"]:
        a, b = spectra[:, first], spectra[:, second]
        return (a - b) / (a + b).clamp(min=1e-3)

    return contrasts


def _alike(keys: Int64[Tensor, "N"], errors: Float[Tensor, "N Q"]) -> Float[Tensor, ""]:
    """Mean product of the errors of two pixels of one cell, over their mean square: what of squared errors is left in
    means over cells; [0, 1]."""
    own, rows, counts = keys.unique(return_inverse=True, return_counts=True)
    sums = errors.new_zeros(len(own), errors.shape[1]).index_add_(0, rows, errors)
    squares = errors.new_zeros(len(own), errors.shape[1]).index_add_(0, rows, errors.square())
    pairs, several = (counts * (counts - 1)).sum(), counts > 1
    if not several.any():
        return errors.new_ones(())
    products = ((sums.square() - squares)[several].sum() / pairs).clamp(min=0)
    usual = squares[several].sum() / counts[several].sum()
    return (products / usual.clamp(min=1e-30)).clamp(max=1)
