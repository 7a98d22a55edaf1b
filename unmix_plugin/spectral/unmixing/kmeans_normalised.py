"""K-means on spectra of equal length: materials by the shape of their spectra, whatever the light on them.

Source: spherical k-means (I. S. Dhillon and D. S. Modha, Machine Learning 42, 2001), seeded by k-means++ (D. Arthur and
S. Vassilvitskii, SODA 2007).

Notation: `N` pixels, `B` bands, `K` clusters; a `shape` is a spectrum divided by its length.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.errors import SpectrumError

_SAME_SHAPE = 1e-10
"""Squared distance of unit spectra below which they are the same shape (an angle of 1e-5 rad, above float32 noise)."""
_WELL_LIT = 0.95
"""Quantile of the lengths of a spectrum's pixels that becomes its own."""
_SAMPLES_PER_PRODUCT = 65_536
"""Pixels compared with the centres at a time, so that memory stays small."""


def normalised_kmeans(
    pixels: Float[Tensor, "N B"],
    num_clusters: int,
    generator: torch.Generator,
    restarts: int = 5,
    max_iterations: int = 100,
) -> tuple[Float[Tensor, "K B"], Int[Tensor, " N"]]:
    """Cluster spectra by shape; the best of several restarts. Drop dark ones first: noise is all the shape they have.

    Returns:
        The mean shape of each cluster at the brightness of its well-lit pixels, the largest cluster first, and the
        cluster of each pixel.
    Raises:
        SpectrumError: no pixels, a zero spectrum, or fewer distinct shapes than clusters.
    """
    lengths = pixels.norm(dim=1)
    if len(pixels) == 0 or not bool((lengths > 0).all()):
        found = f"{int((lengths == 0).sum())} that are zero" if len(pixels) else "no pixels"
        raise SpectrumError(f"k-means needs spectra of non-zero length; found {found}")
    shapes = pixels / lengths[:, None]
    runs = [_cluster(shapes, num_clusters, generator, max_iterations) for _ in range(restarts)]
    _, centres, ids = min(runs, key=lambda run: run[0])
    order = torch.bincount(ids, minlength=num_clusters).argsort(descending=True, stable=True)
    ids = order.argsort()[ids]
    return scale_to_lit_pixels(centres[order], pixels, ids), ids


def scale_to_lit_pixels(
    spectra: Float[Tensor, "K B"], pixels: Float[Tensor, "N B"], ids: Int[Tensor, " N"]
) -> Float[Tensor, "K B"]:
    """Spectra of the same shape, each as long as the well-lit ones of the pixels that belong to it by their `ids`.

    A shading factor below 1 can only darken an endmember, so one as dark as its pixels' mean could not explain their
    bright half. Where a band would come above 1 the whole spectrum is scaled down, so that its shape stays. A spectrum
    without pixels keeps its length.
    """
    brightness = spectra.norm(dim=1)
    lengths = pixels.norm(dim=1)
    for k in range(len(spectra)):
        own = lengths[ids == k]
        if len(own) > 0:
            brightness[k] = own.quantile(_WELL_LIT)
    lit = torch.nn.functional.normalize(spectra, dim=1) * brightness[:, None]
    return lit / lit.amax(dim=1, keepdim=True).clamp(min=1)


def _cluster(
    shapes: Tensor, num_clusters: int, generator: torch.Generator, max_iterations: int
) -> tuple[float, Float[Tensor, "K B"], Int[Tensor, " N"]]:
    """One restart of Lloyd's iteration: inertia, unit centres, cluster of each shape."""
    centres = _seed(shapes, num_clusters, generator)
    ids, distances = _assign(shapes, centres)
    for _ in range(max_iterations):
        # An empty cluster takes the shape that fits worst.
        filled = _fill_empty(ids, distances, num_clusters)
        sums = torch.zeros_like(centres).index_add_(0, filled, shapes)
        centres = torch.nn.functional.normalize(sums, dim=1)
        new_ids, distances = _assign(shapes, centres)
        if torch.equal(new_ids, ids):
            break
        ids = new_ids
    return float(distances.double().mean()), centres, _fill_empty(ids, distances, num_clusters)


def _seed(shapes: Tensor, num_clusters: int, generator: torch.Generator) -> Float[Tensor, "K B"]:
    """K-means++: each next centre is a pixel drawn with probability proportional to its squared distance."""
    index = int(torch.randint(len(shapes), (1,), generator=generator))
    centres = shapes[index : index + 1]
    nearest = (shapes - centres).square().sum(dim=1)
    while len(centres) < num_clusters:
        weights = torch.where(nearest > _SAME_SHAPE, nearest, 0.0).double().cumsum(0)
        if not weights[-1] > 0:
            raise SpectrumError(
                f"found only {len(centres)} distinct spectral shapes among {len(shapes)} pixels: "
                f"{num_clusters} endmembers were asked for; ask for at most {len(centres)}"
            )
        draw = torch.rand(1, generator=generator, dtype=torch.float64).to(weights.device) * weights[-1]
        index = min(int(torch.searchsorted(weights, draw, right=True)), len(shapes) - 1)
        centres = torch.cat([centres, shapes[index : index + 1]])
        nearest = torch.minimum(nearest, (shapes - centres[-1]).square().sum(dim=1))
    return centres


def _assign(shapes: Tensor, centres: Tensor) -> tuple[Int[Tensor, " N"], Float[Tensor, " N"]]:
    """Nearest centre of each shape and the squared distance 2 - 2 cos to it."""
    best = [(part @ centres.T).max(dim=1) for part in shapes.split(_SAMPLES_PER_PRODUCT)]
    cosines = torch.cat([b.values for b in best])
    return torch.cat([b.indices for b in best]), (2 - 2 * cosines).clamp(min=0)


def _fill_empty(ids: Tensor, distances: Tensor, num_clusters: int) -> Int[Tensor, " N"]:
    """Give each empty cluster the worst-fitting pixel of a cluster that can spare one."""
    counts = torch.bincount(ids, minlength=num_clusters)
    if bool((counts > 0).all()):
        return ids
    ids = ids.clone()
    for index in distances.argsort(descending=True).tolist():
        empty = torch.nonzero(counts == 0)
        if len(empty) == 0:
            break
        donor = int(ids[index])
        if counts[donor] > 1:
            ids[index] = empty[0, 0]
            counts[donor] -= 1
            counts[empty[0, 0]] += 1
    return ids
