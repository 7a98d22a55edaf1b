"""Endmembers as `two_material_mixtures` finds them, with less left to chance: for images on their own.

Five sets of candidates are searched one by one, and their winners once more together; members that several searches
agree on are averaged. The shape of a dark pixel is mostly noise, so its distance counts by the root of its length.
Trainings start from the plain search: in a room whose walls colour the light this one costs them 1 to 3 dB (docs/
unmixing.md).

Notation: `N` pixels, `B` bands, `K` endmembers, `M` candidates.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.spectral.unmixing.kmeans_normalised import normalised_kmeans
from unmix_plugin.spectral.unmixing.two_material_mixtures import (
    NUM_CANDIDATES,
    PairSearch,
    count_shapes,
    distances_to_pairs,
    two_material_endmembers,
)

_DRAWS = 5
_NUM_SEEDS = 10_000
"""Pixels of which the candidates of a draw are the cluster means."""
_ITERATIONS = 10
_NUM_JUDGES = 1500
_DARK = 0.3
"""Length below which a distance counts less, as a share of that of bright pixels (95th percentile)."""
_POWER = 1.2
"""Of a distance in the cost: squared, highlights would choose; by itself, the variability of a common material would
outweigh a rare one."""
_SAME_MATERIAL = 0.995
"""Cosine above which members of two sets are one material: an angle of 0.1 rad."""


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
    num_candidates = count_shapes(pixels, NUM_CANDIDATES)
    if num_candidates < NUM_CANDIDATES or num_endmembers > NUM_CANDIDATES:
        return two_material_endmembers(pixels, num_endmembers, generator)
    judges = _some(pixels, _NUM_JUDGES, generator).double()
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
    few = few if count_shapes(few, count) == count else pixels
    means = normalised_kmeans(few, count, generator, restarts=1, max_iterations=_ITERATIONS).endmembers
    return normalize(means.double(), dim=1)


def _grown_sets(judges: Float[Tensor, "N B"], candidates: Float[Tensor, "M B"], most: int) -> list[list[int]]:
    """The best sets found of 1, 2, ... candidates."""
    lengths = judges.norm(dim=1)
    weights = (lengths / (_DARK * lengths.quantile(0.95))).clamp(max=1).sqrt()
    search = PairSearch(distances_to_pairs(normalize(judges, dim=1), candidates).pow_(_POWER).mul_(weights))
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
