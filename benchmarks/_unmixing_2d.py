"""The 2-D methods on a scene of many views: what a field over them has to beat.

Endmembers are found in the pixels of all training views, once a seed; then each true pixel of the evaluation views is
explained by them. Scored by the same code as a trained model, whose views must be predicted first. Oracles are told the
true spectra.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch
from _unmixing_methods import Explain, PixelMethod, find_endmembers
from torch import Tensor

from unmix_plugin.spectral.segmentation import material_scores
from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels
from unmix_plugin.spectral.unmixing.num_materials import propose_num_materials
from unmix_plugin.trained.evaluation import (
    Evaluation,
    PredictedView,
    SceneTruth,
    ViewTruth,
    scene_truth,
    view_truth,
)

if TYPE_CHECKING:
    from unmix_plugin.scenes.scene import Scene

_LARGEST_SAMPLE = 20_000
"""Pixels by which the number of materials is proposed."""


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
        """Every figure of `Evaluation`, and `find_seconds`, `explain_seconds`."""
        endmembers, find_seconds = self._endmembers(method.find, seed)
        evaluation = Evaluation(self.truth, endmembers)
        started = time.perf_counter()
        explain = method.explainer(self._training, endmembers)
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
        if find == "truth":
            assert self.truth.endmembers is not None
            return self.truth.endmembers.float()
        return find_endmembers(self._training, self.truth.num_materials, find, generator)


def explain_view(view: ViewTruth, endmembers: Tensor, explain: Explain) -> PredictedView:
    """What a method says of a view's true pixels, in the form of a model's prediction."""
    height, width, _ = view.spectra.shape
    pixels = view.spectra.flatten(0, 1)
    amounts = explain(pixels, endmembers)
    shares = amounts / amounts.sum(dim=1, keepdim=True).clamp(min=1e-12)
    return PredictedView(
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
