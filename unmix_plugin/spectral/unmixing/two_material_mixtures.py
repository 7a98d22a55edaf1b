"""Endmembers of which two at a time explain the pixels.

In images of surfaces most pixels show one material and nearly all others two: edges, prints, thin leaves before a pot.
So of many mean spectra those K are endmembers of which the best mixture of two explains the pixels best. A spectrum
inside the cone of the others, which corner finders never choose, is one if pixels need it for a mixture of two; a
frequent mixture, which k-means takes for a material, is none.

The model is that of two-endmember MESMA (D. A. Roberts et al., Remote Sensing of Environment 65, 1998); the search
grows the set one by one and swaps members while that helps, as in partitioning around medoids (Kaufman and Rousseeuw
1990).

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

MOST_ENDMEMBERS = 64
"""More are not searched for: time and memory grow with the square of the candidates."""
_NUM_CANDIDATES, _NUM_JUDGES = 80, 3000
_DISTINCT = 4e-10
"""Squared distance above which unit spectra are distinct; k-means then finds at least as many shapes."""
_LEAST_GAIN = 1e-7
"""Least fall of the mean distance that counts: rounding errors must not swap forever."""


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
    """The best sets found of 1, 2, ..., at most 64, endmembers; fewer sets if there are fewer distinct shapes.

    Pixels are spectra of non-zero length; drop dark and saturated ones first.
    """
    if not 1 <= most_endmembers <= MOST_ENDMEMBERS:
        raise SpectrumError(
            f"mixtures of two are searched for 1 to {MOST_ENDMEMBERS} endmembers; {most_endmembers} were asked for; "
            "ask for fewer or take another method"
        )
    num_candidates = max(1, min(_NUM_CANDIDATES, count_shapes(pixels, _NUM_CANDIDATES)))
    candidates = normalised_kmeans(pixels, num_candidates, generator, restarts=1)[0]
    judges = pixels[torch.randperm(len(pixels), generator=generator)[:_NUM_JUDGES].to(pixels.device)]
    candidates = normalize(candidates.double(), dim=1)
    search = PairSearch(distances_to_pairs(normalize(judges.double(), dim=1), candidates))
    return [
        _TwoMaterialFit(candidates[chosen].to(pixels.dtype), search.cost(chosen))
        for chosen in search.best_sets(min(most_endmembers, num_candidates))
    ]


def two_material_endmembers(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator
) -> Float[Tensor, "K B"]:
    """K spectra of length 1 of which two at a time explain the pixels best; as many distinct shapes are needed."""
    fits = two_material_fits(pixels, num_endmembers, generator)
    if len(fits) < num_endmembers:
        raise SpectrumError(
            f"found only {len(fits)} distinct spectral shapes among {len(pixels)} pixels: "
            f"{num_endmembers} endmembers were asked for; ask for at most {len(fits)}"
        )
    return fits[-1].endmembers


def distances_to_pairs(
    shapes: Float[Tensor, "N B"], candidates: Float[Tensor, "M B"]
) -> Float[Tensor, "M M N"]:
    """Distance of unit spectra to the non-negative mixtures of every two candidates; on the diagonal, of one alone.

    Computed in the inputs' type, which should be float64: the square of a small distance is a difference of ones.
    """
    overlaps, cosines = candidates @ shapes.T, candidates @ candidates.T
    alone = 1 - overlaps.clamp(min=0).square()
    distances = torch.empty(len(candidates), len(candidates), len(shapes), device=shapes.device)
    for first in range(len(candidates)):
        cosine, overlap, others = cosines[first, first:, None], overlaps[first], overlaps[first:]
        volume = (1 - cosine.square()).clamp(min=1e-9)
        of_first, of_second = (overlap - cosine * others) / volume, (others - cosine * overlap) / volume
        mixed = 1 - of_first * overlap - of_second * others
        inside = (of_first > 0) & (of_second > 0)
        squared = torch.where(inside, mixed, torch.minimum(alone[first], alone[first:]))
        squared[0] = alone[first]
        distances[first, first:] = squared.clamp_(min=0).sqrt_()
        distances[first + 1 :, first] = distances[first, first + 1 :]
    return distances


def mean_pair_distance(pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"]) -> float:
    """Mean distance of pixels to the nearest mixture of two endmembers, all taken as unit spectra; 0 without pixels."""
    corners = normalize(endmembers.double(), dim=1)
    nearest = [
        distances_to_pairs(normalize(part.double(), dim=1), corners).flatten(0, 1).amin(dim=0)
        for part in pixels.split(_NUM_JUDGES)
    ]
    return float(torch.cat(nearest).mean()) if len(pixels) else 0.0


class PairSearch:
    """Sets of candidates, judged by the mean distance of pixels to the nearest pair in the set."""

    def __init__(self, pair_distances: Float[Tensor, "M M N"], purity_price: float = 0.0) -> None:
        """
        Args:
            pair_distances: As `distances_to_pairs` gives them, or a power of them, weighted.
            purity_price: What the distance to the nearest single member counts beside that to the nearest pair.
        """
        self._pairs, self._price = pair_distances, purity_price
        every = torch.arange(len(pair_distances), device=pair_distances.device)
        self._alone = pair_distances[every, every]

    def best_sets(self, most: int) -> list[list[int]]:
        """The best sets found of 1, 2, ... candidates."""
        sets: list[list[int]] = [[]]
        for _ in range(min(most, len(self._alone))):
            costs = self._costs_with_each(sets[-1])
            costs[sets[-1]] = torch.inf
            sets.append(self._improved([*sets[-1], int(costs.argmin())]))
        return sets[1:]

    def cost(self, chosen: list[int]) -> float:
        """Mean distance of the pixels, what purity costs included."""
        nearest = self._distances(chosen) + self._price * self._alone[chosen].amin(dim=0)
        return float(nearest.mean())

    def _distances(self, chosen: list[int]) -> Float[Tensor, " N"]:
        """Of each pixel to the nearest pair."""
        members = torch.tensor(chosen)
        return self._pairs[members[:, None], members].flatten(0, 1).amin(dim=0)

    def _improved(self, chosen: list[int]) -> list[int]:
        """Each member swapped for the best candidate in its place, until no swap helps."""
        cost = self.cost(chosen)
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
        """The cost if a candidate joined, for every candidate."""
        if not chosen:
            return (1 + self._price) * self._alone.mean(dim=1)
        with_one = torch.minimum(self._alone, self._pairs[chosen].amin(dim=0))  # both ways are the same
        nearest = torch.minimum(with_one, self._distances(chosen))
        single = torch.minimum(self._alone, self._alone[chosen].amin(dim=0))
        return nearest.add_(single, alpha=self._price).mean(dim=1)


def count_shapes(pixels: Float[Tensor, "N B"], enough: int) -> int:
    """Number of distinct shapes; counting stops at `enough`."""
    # Where each of a few pixels has a shape of its own there is no need to compare all.
    for some in (pixels[: 2 * enough], pixels):
        remaining, count = normalize(some, dim=1), 0
        while count < enough and len(remaining) > 0:
            remaining = remaining[(remaining - remaining[0]).square().sum(dim=1) > _DISTINCT]
            count += 1
        if count == enough:
            break
    return count
