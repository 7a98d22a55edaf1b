"""Methods that unmix single pixels: what a field over many views has to beat.

Endmembers are found in the pixels of all training views, once a seed; then each true pixel of the evaluation views is
explained by them. Scored by the same code as a trained model, whose views must be predicted first. Oracles are told the
true spectra.

Notation: `N` pixels, `B` bands, `K` endmembers, `H x W` pixels of a view.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from unmix_plugin.spectral.segmentation import material_scores
from unmix_plugin.spectral.unmixing.abundance_estimation import fcls, nnls, sunsal
from unmix_plugin.spectral.unmixing.endmembers import (
    EndmemberMethod,
    drop_uninformative_pixels,
    initialise_endmembers,
)
from unmix_plugin.spectral.unmixing.mixture_guide import mixing_penalty
from unmix_plugin.spectral.unmixing.num_materials import propose_num_materials
from unmix_plugin.spectral.unmixing.sparse_unmixing import sparse_abundances
from unmix_plugin.trained.evaluation import Evaluation, SceneTruth, ViewTruth, scene_truth, view_truth
from unmix_plugin.trained.view_rendering import RenderedView
from unmix_plugin.training_losses import LossConfig

if TYPE_CHECKING:
    from unmix_plugin.scenes.scene import Scene

Explain = Callable[[Tensor, Tensor], Tensor]
"""From pixels (N, B) and endmembers (K, B) to amounts (N, K)."""

_RESTARTS = 5
_LARGEST_SAMPLE = 20_000
"""Training pixels that k-means of raw spectra sees, as many as the other methods."""


@dataclass(frozen=True)
class PixelMethod:
    """How endmembers are found and pixels explained."""

    find: EndmemberMethod | Literal["raw k-means", "truth"]
    explain: Explain | Literal["few"]
    """`few`: mixtures of few materials, as those that guide a field in training."""

    @property
    def is_oracle(self) -> bool:
        """Whether it is told what the others have to find."""
        return self.find == "truth"


def by_angle(pixels: Tensor, endmembers: Tensor) -> Tensor:
    """All of a pixel is the endmember of smallest angle, as bright as fits best."""
    return _one_each(pixels, endmembers, material_scores(pixels, endmembers).argmax(dim=1))


def by_distance(pixels: Tensor, endmembers: Tensor) -> Tensor:
    """All of a pixel is the nearest endmember."""
    nearest = torch.cdist(pixels, endmembers).argmin(dim=1)
    return torch.nn.functional.one_hot(nearest, len(endmembers)).to(pixels)


def by_few(training: Tensor, endmembers: Tensor) -> Explain:
    """A pixel is a mixture of few endmembers, as bright as fits best; how few, the training pixels say."""
    penalty = mixing_penalty(training, endmembers, LossConfig().mixing_penalty)

    def explain(pixels: Tensor, spectra: Tensor) -> Tensor:
        shares = sparse_abundances(pixels, spectra, penalty)
        return shares * _best_lengths(pixels, shares @ spectra)[:, None]

    return explain


METHODS: dict[str, PixelMethod] = {
    "k-means of raw spectra": PixelMethod("raw k-means", by_distance),
    "k-means of normalised spectra": PixelMethod("kmeans", by_angle),
    "k-means, NNLS": PixelMethod("kmeans", nnls),
    "VCA, probe": PixelMethod("vca", by_angle),
    "VCA, NNLS": PixelMethod("vca", nnls),
    "VCA, FCLS": PixelMethod("vca", fcls),
    "VCA, SUnSAL": PixelMethod("vca", sunsal),
    "N-FINDR, probe": PixelMethod("nfindr", by_angle),
    "N-FINDR, NNLS": PixelMethod("nfindr", nnls),
    "N-FINDR, FCLS": PixelMethod("nfindr", fcls),
    "N-FINDR, SUnSAL": PixelMethod("nfindr", sunsal),
    "minimum volume, NNLS": PixelMethod("minimum-volume", nnls),
    "pairs, probe": PixelMethod("pairs", by_angle),
    "pairs, NNLS": PixelMethod("pairs", nnls),
    "pairs, SUnSAL": PixelMethod("pairs", sunsal),
    "pairs, few": PixelMethod("pairs", "few"),
    "oracle, probe": PixelMethod("truth", by_angle),
    "oracle, NNLS": PixelMethod("truth", nnls),
    "oracle, few": PixelMethod("truth", "few"),
}
"""By the name of their row. The probe takes the endmember of smallest angle."""


class PixelBaselines:
    """The pixels of one scene, read once, and what methods make of them."""

    def __init__(self, scene: Scene) -> None:
        """
        Args:
            scene: Whose true materials are known.
        """
        self.truth: SceneTruth = scene_truth(scene)
        self._training = torch.cat([opaque_pixels(scene, index) for index in scene.train_indices])
        self._views = [view_truth(scene, index) for index in scene.eval_indices]
        self._found: dict[tuple[str, int], tuple[Tensor, float]] = {}

    def score(self, method: PixelMethod, seed: int) -> dict[str, float]:
        """Every figure of `trained.evaluation`, and `find_seconds`, `explain_seconds`."""
        endmembers, find_seconds = self._endmembers(method.find, seed)
        evaluation = Evaluation(self.truth, endmembers)
        started = time.perf_counter()
        explain = by_few(self._training, endmembers) if method.explain == "few" else method.explain
        for view in self._views:
            evaluation.add(view, explain_view(view, endmembers, explain))
        seconds = {"find_seconds": find_seconds, "explain_seconds": time.perf_counter() - started}
        return evaluation.figures() | seconds

    def propose(self, seed: int) -> dict[str, Any]:
        """The number of materials that is proposed, the true one, and the evidence."""
        generator = torch.Generator().manual_seed(seed)
        pixels = drop_uninformative_pixels(self._training)
        pixels = pixels[torch.randperm(len(pixels), generator=generator)[:_LARGEST_SAMPLE]]
        return asdict(propose_num_materials(pixels, generator)) | {"true": self.truth.num_materials}

    def _endmembers(self, find: str, seed: int) -> tuple[Tensor, float]:
        """And the seconds that it took to find them."""
        if (find, seed) not in self._found:
            started = time.perf_counter()
            spectra = self._find(find, torch.Generator().manual_seed(seed))
            self._found[find, seed] = (spectra, time.perf_counter() - started)
        return self._found[find, seed]

    def _find(self, find: str, generator: torch.Generator) -> Tensor:
        count = self.truth.num_materials
        if find == "truth":
            assert self.truth.endmembers is not None
            return self.truth.endmembers.float()
        if find == "raw k-means":
            return raw_kmeans(drop_uninformative_pixels(self._training), count, generator)
        return initialise_endmembers(self._training, count, find, generator)  # type: ignore[arg-type]


def explain_view(view: ViewTruth, endmembers: Tensor, explain: Explain) -> RenderedView:
    """What a method says of a view's true pixels, in the form of a model's prediction."""
    height, width, _ = view.spectra.shape
    pixels = view.spectra.flatten(0, 1)
    amounts = explain(pixels, endmembers)
    shares = amounts / amounts.sum(dim=1, keepdim=True).clamp(min=1e-12)
    return RenderedView(
        spectra=(amounts @ endmembers).unflatten(0, (height, width)),
        accumulation=view.opacity,
        abundances=shares.unflatten(0, (height, width)) * view.opacity[..., None],
        segmentation=amounts.argmax(dim=1).to(torch.uint8).unflatten(0, (height, width)),
        material_scores=material_scores(view.spectra, endmembers),
    )


def opaque_pixels(scene: Scene, index: int) -> Tensor:
    """Spectra of a view's valid pixels that show matter only, (N, B)."""
    alpha = scene.alpha(index)
    shows_matter = scene.valid_mask(index) if alpha is None else scene.valid_mask(index) & (alpha > 0.99)
    return torch.from_numpy(scene.cube(index)[shows_matter])


def raw_kmeans(pixels: Tensor, count: int, generator: torch.Generator, max_iterations: int = 100) -> Tensor:
    """Mean spectra of clusters by distance, where a shadow is as good a reason for a cluster as a material.

    The best of several restarts from pixels drawn by chance.
    """
    pixels = pixels[torch.randperm(len(pixels), generator=generator)[:_LARGEST_SAMPLE]]
    best, least = pixels[:count], float("inf")
    for _ in range(_RESTARTS):
        centres = pixels[torch.randperm(len(pixels), generator=generator)[:count]]
        ids = torch.full((len(pixels),), -1)
        for _ in range(max_iterations):
            before, ids = ids, torch.cdist(pixels, centres).argmin(dim=1)
            if torch.equal(before, ids):
                break
            sums = torch.zeros_like(centres).index_add_(0, ids, pixels)
            sizes = torch.bincount(ids, minlength=count)[:, None]
            centres = torch.where(sizes > 0, sums / sizes.clamp(min=1), centres)
        cost = float((pixels - centres[ids]).square().sum())
        if cost < least:
            best, least = centres, cost
    return best


def _one_each(pixels: Tensor, endmembers: Tensor, ids: Tensor) -> Tensor:
    one_hot = torch.nn.functional.one_hot(ids, len(endmembers)).to(pixels)
    return one_hot * _best_lengths(pixels, endmembers[ids])[:, None]


def _best_lengths(pixels: Tensor, spectra: Tensor) -> Tensor:
    """How often each pixel's own spectrum must be taken; a trace for a black pixel, as shares must sum to 1."""
    lengths = (pixels * spectra).sum(dim=1) / spectra.square().sum(dim=1).clamp(min=1e-12)
    return lengths.clamp(min=1e-9)
