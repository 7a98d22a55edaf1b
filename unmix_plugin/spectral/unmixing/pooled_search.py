"""Endmembers on which several searches agree.

Each search for endmembers has scenes on which it fails: pairs where a dark material varies more in shape than others
differ, archetypes where materials meet in sharp edges, corners where noise or a rare colour sticks out, cluster means
where nothing is pure. And each scatters with chance. So many sets of K spectra are made, by all of them, and one is
chosen by a measure that knows neither the scene nor the search: a good set explains pixels as mixtures of any number
(reconstruction), does so with two (sparsity), and lies where there are pixels (each is near one of them). Of sets that
do about as well, that is chosen whose spectra most searches found, and it is averaged with those that are nearly the
same: chance decides less. The measure only chooses among whole sets, as a free minimum does not look like real
materials.

Archetypes are convex mixtures of pixels of which convex mixtures make up all pixels (A. Cutler and L. Breiman,
Technometrics 36(4), 1994), found by entropic descent, several runs at once on few pixels each (A. Zouaoui et al.,
"Entropic Descent Archetypal Analysis for Blind Hyperspectral Unmixing", IEEE TIP 32, 2023).

Notation: `N` pixels, `d` principal directions kept, `K` endmembers, `R` runs, `n` pixels a run. All spectra have length
1, which removes shading, or a little less where noise is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.abundances import nnls
from unmix_plugin.spectral.unmixing.kmeans_normalised import normalised_kmeans
from unmix_plugin.spectral.unmixing.simplex_corners import vca
from unmix_plugin.spectral.unmixing.two_material_mixtures import (
    MOST_ENDMEMBERS,
    PairSearch,
    count_shapes,
    distances_to_pairs,
    two_material_endmembers,
)

_NUM_JUDGES = 600
"""Pixels that decide which candidates are pairs."""
_NUM_MEASURED = 1500
"""Pixels that whole sets are compared by."""
_NUM_CANDIDATES = 50
_NUM_CLUSTERED = 2500
"""Pixels of which the candidates of a draw are the cluster means."""
_PURITY_PRICES = (0.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.3, 0.3, 0.6, 0.6)
"""What a pixel's distance to the nearest endmember counts beside that to the nearest pair, in each draw of pairs.
Without it a variable material gets two endmembers that mean nothing."""
_POOLED_PRICES = (0.0, 0.1, 0.3)
_DARK = 0.3
"""Length below which a pixel counts less, by its root, as a share of that of bright pixels (95th percentile)."""
_POWER = 1.2
"""Of a distance in the search for pairs: squared, highlights would choose; by itself, the variability of a common
material would outweigh a rare one."""
_RUNS = 12
_RUN_PIXELS = 1500
_OUTER_STEPS = 60
_INNER_STEPS = 5
_STEP_SIZES = (16.0, 64.0)
"""Of entropic descent, times the largest singular value: smaller ones don't get far, larger ones end in any corner."""
_SETS_KEPT = 5
_NEARNESS = 0.2
"""What the distance to the nearest endmember counts in the measure."""
_REPEATS = 4
"""Times that all searches are run: with two, chance decides twice as much."""
_ABOUT_AS_WELL = 0.03
"""Share of the smallest misfit by which others may be larger: less than chance makes of it."""
_SIMILAR = 0.08
"""Angle in radians between spectra beyond which one hardly speaks for the other."""
_SAME_SET = 0.06
"""Mean angle in radians up to which two sets are the same materials."""


@dataclass(frozen=True)
class PooledEndmembers:
    """The chosen set, and others that did nearly as well."""

    endmembers: Float[Tensor, "K B"]
    """Spectra of length 1."""
    others: Float[Tensor, "S K B"]
    """The best sets, in the same order of materials: how they differ shows how certain it is what they agree on."""


def pooled_search(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator, repeats: int = _REPEATS
) -> PooledEndmembers:
    """The best of the sets that several searches find, averaged with what is the same in others, among pixels neither
    dark nor saturated; errors are those of `two_material_endmembers`."""
    enough = max(_NUM_CANDIDATES, num_endmembers)
    if not 2 <= num_endmembers <= MOST_ENDMEMBERS or count_shapes(pixels, enough) < enough:
        few = two_material_endmembers(pixels, num_endmembers, generator)
        return PooledEndmembers(few, few[None])
    shapes = normalize(pixels, dim=1)
    # Principal directions hold most of the pixels; the others hold noise.
    directions = torch.linalg.eigh((shapes.T @ shapes).double()).eigenvectors.flip(1)
    axes = directions[:, : 3 * num_endmembers + 10].to(shapes)
    shapes = shapes @ axes
    lengths = pixels.norm(dim=1).double()
    weights = (lengths / (_DARK * lengths.quantile(0.95))).clamp(max=1).sqrt()

    def drawn(count: int) -> tuple[Tensor, Tensor]:
        """Some unit spectra and what they weigh."""
        rows = torch.randperm(len(pixels), generator=generator)[:count].to(pixels.device)
        return normalize(shapes[rows].double(), dim=1), weights[rows]

    measured = drawn(_NUM_MEASURED)
    sets: list[Tensor] = []
    for _ in range(repeats):  # with judges of their own: errors of the same few pixels would not cancel
        sets += _pair_sets(shapes, *drawn(_NUM_JUDGES), num_endmembers, generator)
        sets += _archetypes(shapes, num_endmembers, generator)
        sets += _corners_and_clusters(shapes, num_endmembers, generator)
    sets = _ranked([normalize(found.double(), dim=1) for found in sets], *measured)
    is_same = _angles(sets, sets[0]).mean(dim=-1) < _SAME_SET
    is_same[0] = True  # by rounding, a set has a small angle to itself
    mean = normalize(torch.stack(sets)[is_same].mean(dim=0), dim=1)
    spectra = torch.stack([mean, *sets[:_SETS_KEPT]]) @ axes.T.double()
    spectra = normalize(spectra.clamp(min=0), dim=-1).to(pixels.dtype)
    return PooledEndmembers(spectra[0], spectra[1:])


def _pair_sets(
    shapes: Float[Tensor, "N d"],
    seen: Float[Tensor, "judges d"],
    weights: Float[Tensor, "judges"],
    num_endmembers: int,
    generator: torch.Generator,
) -> list[Float[Tensor, "K d"]]:
    """Sets whose pairs pass near the pixels: of several draws of cluster means, and of the winners together."""

    def searched(candidates: Tensor, *prices: float) -> list[Tensor]:
        distances = distances_to_pairs(seen, candidates).pow_(_POWER).mul_(weights)
        return [candidates[PairSearch(distances, price).best_sets(num_endmembers)[-1]] for price in prices]

    draws = []
    for price in _PURITY_PRICES:
        few = shapes[torch.randperm(len(shapes), generator=generator)[:_NUM_CLUSTERED].to(shapes.device)]
        count = count_shapes(few, max(_NUM_CANDIDATES, num_endmembers))
        few = few if count >= num_endmembers else shapes
        count = max(count, num_endmembers)
        means = normalised_kmeans(few, count, generator, restarts=1, max_iterations=10)[0]
        draws += searched(normalize(means.double(), dim=1), price)
    return draws + searched(torch.cat(draws), *_POOLED_PRICES)


def _corners_and_clusters(
    shapes: Float[Tensor, "N d"], num_endmembers: int, generator: torch.Generator
) -> list[Float[Tensor, "K d"]]:
    clusters = normalised_kmeans(shapes, num_endmembers, generator, restarts=3)[0]
    try:
        return [clusters, vca(shapes, num_endmembers, generator)[0]]
    except SpectrumError:  # the pixels span too few dimensions for corners
        return [clusters]


def _archetypes(
    shapes: Float[Tensor, "N d"], num_endmembers: int, generator: torch.Generator
) -> Float[Tensor, "R K d"]:
    """Archetypes of several runs: alternately the pixels' shares of archetypes and the archetypes' of pixels take steps
    against the gradient of the squared error, multiplied in, which keeps shares positive; then they are summed to 1."""
    num_pixels = min(_RUN_PIXELS, len(shapes))
    drawn = [torch.randperm(len(shapes), generator=generator)[:num_pixels] for _ in range(_RUNS)]
    pixels = shapes[torch.stack(drawn).to(shapes.device)]
    low, high = _STEP_SIZES
    steps = low * (high / low) ** torch.rand(_RUNS, 1, 1, generator=generator)
    steps = steps.to(pixels) / pixels.square().sum(dim=(1, 2), keepdim=True).sqrt()
    start = torch.rand(_RUNS, num_endmembers, num_pixels, generator=generator).to(pixels)
    of_pixels = torch.softmax(0.1 * start, dim=-1)
    shares = torch.full((_RUNS, num_pixels, num_endmembers), 1 / num_endmembers).to(pixels)
    archetypes = of_pixels @ pixels
    for _ in range(_OUTER_STEPS):
        gram, loads = archetypes @ archetypes.mT, pixels @ archetypes.mT
        for _ in range(_INNER_STEPS):
            shares = _entropic_step(shares, steps * (shares @ gram - loads))
        gram, loads = shares.mT @ shares, shares.mT @ pixels
        for _ in range(_INNER_STEPS):
            slopes = (gram @ archetypes - loads) @ pixels.mT
            of_pixels = _entropic_step(of_pixels, steps * (num_endmembers / num_pixels) ** 0.5 * slopes)
            archetypes = of_pixels @ pixels
    return archetypes


def _entropic_step(shares: Float[Tensor, "*a b"], slopes: Float[Tensor, "*a b"]) -> Float[Tensor, "*a b"]:
    moved = shares * torch.exp(slopes.amin(dim=-1, keepdim=True) - slopes)
    return moved / moved.sum(dim=-1, keepdim=True).clamp(min=1e-30)


def _misfit(
    seen: Float[Tensor, "measured d"], found: Float[Tensor, "K d"], weights: Float[Tensor, "measured"]
) -> float:
    """The measure: mean distance of pixels to mixtures of all and to mixtures of two, and a little of that to one."""
    to_all = (seen - nnls(seen, found) @ found).norm(dim=1)
    pairs = distances_to_pairs(seen, found)
    to_two, to_one = pairs.flatten(0, 1).amin(dim=0), pairs.diagonal().amin(dim=1)
    return float((weights * (to_all + to_two + _NEARNESS * to_one)).mean())


def _ranked(
    sets: list[Float[Tensor, "K d"]], seen: Float[Tensor, "measured d"], weights: Float[Tensor, "measured"]
) -> list[Float[Tensor, "K d"]]:
    """The chosen set first, then the others by the measure, all in its order of materials."""
    misfits = [_misfit(seen, found, weights) for found in sets]
    order = sorted(range(len(sets)), key=misfits.__getitem__)
    good = [index for index in order if misfits[index] <= (1 + _ABOUT_AS_WELL) * misfits[order[0]]]
    matched = {index: [_matched(sets[index], other) for other in sets] for index in good}
    # How many spectra of the sets speak for one of a set's, those that are not quite alike in part.
    support = {
        index: torch.exp(-((_angles(matched[index], sets[index]) / _SIMILAR) ** 2)).sum() for index in good
    }
    chosen = max(good, key=lambda index: float(support[index]))
    return [matched[chosen][index] for index in (chosen, *(index for index in order if index != chosen))]


def _matched(best: Float[Tensor, "K d"], other: Float[Tensor, "K d"]) -> Float[Tensor, "K d"]:
    """Another set in the order of the best."""
    from scipy.optimize import linear_sum_assignment

    return other[linear_sum_assignment(-(best @ other.T).cpu().numpy())[1]]


def _angles(sets: list[Float[Tensor, "K d"]], to: Float[Tensor, "K d"]) -> Float[Tensor, "S K"]:
    """Of the spectra of each set to those of another."""
    return (torch.stack(sets) * to).sum(dim=-1).clamp(-1, 1).arccos()
