"""Endmembers of which two at a time explain the pixels.

In images of surfaces most pixels show one material and nearly all others two: edges, prints, thin leaves before a pot.
So of many mean spectra those K are endmembers of which the best mixture of two explains the pixels best. A spectrum
inside the cone of the others, which corner finders never choose, is one if pixels need it for a mixture of two; a
frequent mixture, which k-means takes for a material, is none.

The model is that of two-endmember MESMA (D. A. Roberts et al., Remote Sensing of Environment 65, 1998); the search
grows the set one by one and swaps members while that helps, as in partitioning around medoids (Kaufman and Rousseeuw
1990). `pooled_pair_endmembers` leaves less to chance, for images on their own: five sets of candidates are searched one
by one, and their winners once more together; members that several searches agree on are averaged, and the distance of
a dark pixel, whose shape is mostly noise, counts by the root of its length. Trainings start from the plain search: in a
room whose walls colour the light the other costs them 1 to 3 dB (docs/background/unmixing.md).

Notation: `N` pixels that judge, `B` bands, `M` candidates, `K` endmembers. All spectra have length 1, which removes
shading; the distance of a pixel to a cone is then the sine of the angle between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.kmeans_normalised import normalised_kmeans

_MOST_ENDMEMBERS = 64
"""More are not searched for: time and memory grow with the square of the candidates."""

_NUM_CANDIDATES = 80
_NUM_JUDGES = 3000

_DISTINCT = 4e-10
"""Squared distance above which unit spectra are distinct; k-means then finds at least as many shapes."""

_LEAST_GAIN = 1e-7
"""Least fall of the mean distance that counts: rounding errors must not swap forever."""
_DRAWS = 5
_NUM_SEEDS = 10_000
"""Pixels of which the candidates of a draw are the cluster means."""
_ITERATIONS = 10
_NUM_POOLED_JUDGES = 1500
_DARK = 0.3
"""Length below which a distance counts less, as a share of that of bright pixels (95th percentile)."""
_POWER = 1.2
"""Of a distance in the cost: squared, highlights would choose; by itself, the variability of a common material would
outweigh a rare one."""
_SAME_MATERIAL = 0.995
"""Cosine above which members of two sets are one material: an angle of 0.1 rad."""


@dataclass(frozen=True)
class _TwoMaterialFit:
    """Endmembers and how well two of them at a time explain the pixels."""

    endmembers: Float[Tensor, "K B"]
    """Spectra of length 1."""
    mean_distance: float
    """Mean distance of unit pixels to the nearest mixture of two endmembers: about an angle in radians."""


def two_material_fits(
    pixels: Float[Tensor, "N B"], most_endmembers: int, generator: torch.Generator
) -> list[_TwoMaterialFit]:
    """The best sets found of 1, 2, ... endmembers; fewer sets if there are fewer distinct shapes.

    Args:
        pixels: Spectra of non-zero length. Drop dark and saturated ones first.
        most_endmembers: Size of the largest set, at most 64.
        generator: On the CPU; the only source of randomness.
    Raises:
        SpectrumError: more than 64 endmembers, no pixels, or a zero spectrum.
    """
    if not 1 <= most_endmembers <= _MOST_ENDMEMBERS:
        raise SpectrumError(
            f"mixtures of two are searched for 1 to {_MOST_ENDMEMBERS} endmembers; {most_endmembers} were asked for; "
            "ask for fewer or take another method"
        )
    num_candidates = max(1, min(_NUM_CANDIDATES, _count_shapes(pixels, _NUM_CANDIDATES)))
    candidates = normalised_kmeans(pixels, num_candidates, generator, restarts=1).endmembers
    judges = pixels[torch.randperm(len(pixels), generator=generator)[:_NUM_JUDGES].to(pixels.device)]
    candidates = normalize(candidates.double(), dim=1)
    search = _PairSearch(_distances_to_pairs(normalize(judges.double(), dim=1), candidates))
    fits, chosen = [], []
    for _ in range(min(most_endmembers, num_candidates)):
        chosen = search.improved(search.grown(chosen))
        spectra = candidates[chosen].to(pixels.dtype)
        fits.append(_TwoMaterialFit(spectra, float(search.distances(chosen).mean())))
    return fits


def two_material_endmembers(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator
) -> Float[Tensor, "K B"]:
    """K spectra of length 1 of which two at a time explain the pixels best.

    Raises:
        SpectrumError: as `two_material_fits`; fewer distinct shapes than endmembers.
    """
    fits = two_material_fits(pixels, num_endmembers, generator)
    if len(fits) < num_endmembers:
        raise SpectrumError(
            f"found only {len(fits)} distinct spectral shapes among {len(pixels)} pixels: "
            f"{num_endmembers} endmembers were asked for; ask for at most {len(fits)}"
        )
    return fits[-1].endmembers


def _distances_to_pairs(
    shapes: Float[Tensor, "N B"], candidates: Float[Tensor, "M B"]
) -> Float[Tensor, "M M N"]:
    """Distance of unit spectra to the non-negative mixtures of every two candidates; on the diagonal, of one alone.

    Computed in the inputs' type, which should be float64: the square of a small distance is a difference of ones.
    """
    overlaps, cosines = shapes @ candidates.T, candidates @ candidates.T
    alone = 1 - overlaps.clamp(min=0).square()
    distances = torch.empty(len(candidates), len(candidates), len(shapes), device=shapes.device)
    for first in range(len(candidates)):
        cosine, overlap = cosines[first], overlaps[:, first, None]
        volume = (1 - cosine.square()).clamp(min=1e-9)
        of_first, of_second = (overlap - cosine * overlaps) / volume, (overlaps - cosine * overlap) / volume
        mixed = 1 - of_first * overlap - of_second * overlaps
        inside = (of_first > 0) & (of_second > 0)
        squared = torch.where(inside, mixed, torch.minimum(alone[:, first, None], alone))
        squared[:, first] = alone[:, first]
        distances[first] = squared.clamp(min=0).sqrt().T
    return distances


def mean_pair_distance(pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"]) -> float:
    """Mean distance of pixels to the nearest mixture of two endmembers, all taken as unit spectra; 0 without pixels."""
    corners = normalize(endmembers.double(), dim=1)
    nearest = [
        _distances_to_pairs(normalize(part.double(), dim=1), corners).flatten(0, 1).amin(dim=0)
        for part in pixels.split(_NUM_JUDGES)
    ]
    return float(torch.cat(nearest).mean()) if len(pixels) else 0.0


class _PairSearch:
    """Sets of candidates, judged by the mean distance of pixels to the nearest pair in the set."""

    def __init__(self, pair_distances: Float[Tensor, "M M N"]) -> None:
        self._pairs = pair_distances
        every = torch.arange(len(pair_distances), device=pair_distances.device)
        self._alone = pair_distances[every, every]

    def distances(self, chosen: list[int]) -> Float[Tensor, " N"]:
        """Of each pixel to the nearest pair; infinite without any."""
        if not chosen:
            return torch.full_like(self._alone[0], torch.inf)
        return self._pairs[chosen][:, chosen].flatten(0, 1).amin(dim=0)

    def grown(self, chosen: list[int]) -> list[int]:
        """With the candidate that helps most."""
        costs = self._costs_with_each(chosen)
        costs[chosen] = torch.inf
        return [*chosen, int(costs.argmin())]

    def improved(self, chosen: list[int]) -> list[int]:
        """Each member swapped for the best candidate in its place, until no swap helps."""
        cost = float(self.distances(chosen).mean())
        is_better = True
        while is_better:
            is_better = False
            for place in range(len(chosen)):
                others = chosen[:place] + chosen[place + 1 :]
                costs = self._costs_with_each(others)
                best = int(costs.argmin())
                if float(costs[best]) < cost - _LEAST_GAIN:
                    chosen = [*chosen[:place], best, *chosen[place + 1 :]]
                    cost, is_better = float(costs[best]), True
        return chosen

    def _costs_with_each(self, chosen: list[int]) -> Float[Tensor, " M"]:
        """Mean distance if a candidate joined, for every candidate."""
        nearest = self._alone
        if chosen:
            nearest = torch.minimum(nearest, self._pairs[:, chosen].amin(dim=1))
        return torch.minimum(nearest, self.distances(chosen)).mean(dim=1)


def _count_shapes(pixels: Float[Tensor, "N B"], enough: int) -> int:
    """Number of distinct shapes; counting stops at `enough`."""
    left, count = normalize(pixels, dim=1), 0
    while count < enough and len(left) > 0:
        left = left[(left - left[0]).square().sum(dim=1) > _DISTINCT]
        count += 1
    return count


def pooled_pair_endmembers(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator
) -> Float[Tensor, "K B"]:
    """Spectra of length 1 that explain the pixels best as mixtures of two.

    Args:
        pixels: Spectra of non-zero length. Drop dark and saturated ones first.
        num_endmembers: K, at most 64.
        generator: On the CPU; the only source of randomness.
    Raises:
        SpectrumError: more than 64 endmembers, or more than there are distinct shapes.
    """
    num_candidates = _count_shapes(pixels, _NUM_CANDIDATES)
    if num_candidates < _NUM_CANDIDATES or num_endmembers > _NUM_CANDIDATES:
        return two_material_endmembers(pixels, num_endmembers, generator)
    judges = _some(pixels, _NUM_POOLED_JUDGES, generator).double()
    pool, draws = [], []
    for _ in range(_DRAWS):
        candidates = _candidates(pixels, num_candidates, generator)
        sets = _grown_sets(judges, candidates, num_endmembers)
        pool.append(candidates[sorted({index for chosen in sets for index in chosen})])
        draws.append(candidates[sets[-1]])
    candidates = torch.cat(pool)
    chosen = _grown_sets(judges, candidates, num_endmembers)[-1]
    return _averaged(candidates[chosen], draws).to(pixels.dtype)


def _some(pixels: Float[Tensor, "N B"], count: int, generator: torch.Generator) -> Float[Tensor, "n B"]:
    return pixels[torch.randperm(len(pixels), generator=generator)[:count].to(pixels.device)]


def _candidates(pixels: Float[Tensor, "N B"], count: int, generator: torch.Generator) -> Float[Tensor, "M B"]:
    """Mean shapes of clusters of some of the pixels; of all if those show fewer shapes."""
    few = _some(pixels, _NUM_SEEDS, generator)
    few = few if _count_shapes(few, count) == count else pixels
    means = normalised_kmeans(few, count, generator, restarts=1, max_iterations=_ITERATIONS).endmembers
    return normalize(means.double(), dim=1)


def _grown_sets(judges: Float[Tensor, "N B"], candidates: Float[Tensor, "M B"], most: int) -> list[list[int]]:
    """The best sets found of 1, 2, ... candidates."""
    lengths = judges.norm(dim=1)
    weights = (lengths / (_DARK * lengths.quantile(0.95))).clamp(max=1).sqrt()
    search = _PairSearch(_distances_to_pairs(normalize(judges, dim=1), candidates).pow_(_POWER).mul_(weights))
    sets: list[list[int]] = [[]]
    for _ in range(min(most, len(candidates))):
        sets.append(search.improved(search.grown(sets[-1])))
    return sets[1:]


def _averaged(members: Float[Tensor, "K B"], draws: list[Float[Tensor, "K B"]]) -> Float[Tensor, "K B"]:
    """Mean shape of each member and of what is the same in other sets: chance decides less."""
    means = members.clone()
    for drawn in draws:
        nearest = (members @ drawn.T).max(dim=1)
        means += torch.where((nearest.values > _SAME_MATERIAL)[:, None], drawn[nearest.indices], 0.0)
    return normalize(means, dim=1)
