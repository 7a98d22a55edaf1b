"""A look ahead at all views, small: what their pictures must have in common, so that a video does not flicker."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.figures.picture_grid import ColourScale
from unmix_plugin.spectral.coefficients import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.maps.reflectance_maps import (
    Score,
    is_reflectance_map,
    parse_reflectance_map,
)
from unmix_plugin.spectral.pca import PcaColours
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import TrainedScene

SURVEYED_OUTPUTS = {
    "depth": "depth along the viewing axis (world units)",
    "ray_distance": "distance along the ray (world units)",
}
"""Outputs whose range is not known beforehand, and what they are."""

_MOST_VIEWS = 12
_PIXELS = 32 * 32
"""Of a view looked at."""

_RANGE = (0.01, 0.99)
"""Quantiles of what is seen that the colours of a map go through."""


@dataclass(frozen=True)
class Survey:
    """What all pictures of a render share."""

    scales: dict[str, ColourScale] = field(default_factory=dict)
    """Colours of `SURVEYED_OUTPUTS` and of indices and targets, as far as asked for."""
    pca: PcaColours | None = None
    """Colours of the output `pca`, if asked for."""
    scores: dict[str, Score] = field(default_factory=dict)
    """From reflectance to each index and target that is asked for."""


def needs_survey(outputs: Collection[str]) -> bool:
    """Whether pictures of `outputs` share anything that has to be found out first."""
    return "pca" in outputs or any(name in SURVEYED_OUTPUTS or is_reflectance_map(name) for name in outputs)


def take_survey(scene: TrainedScene, views: Sequence[RunView], outputs: Collection[str]) -> Survey:
    """Look at up to twelve views, evenly spread over all, and find what `outputs` of all views share."""
    ranged = [name for name in SURVEYED_OUTPUTS if name in outputs]
    seen = _seen(scene, views, [*ranged, "spectral"])
    scores, scales = _scores(scene, seen, [name for name in outputs if is_reflectance_map(name)])
    return Survey(
        {**{name: _scale(seen[name], SURVEYED_OUTPUTS[name]) for name in ranged}, **scales},
        PcaColours.fit(seen["spectral"]) if "pca" in outputs else None,
        scores,
    )


def _scores(
    scene: TrainedScene, seen: dict[str, Tensor], names: Sequence[str]
) -> tuple[dict[str, Score], dict[str, ColourScale]]:
    """How indices and targets are computed, judged against what is seen of the scene, and their colours."""
    materials = scene.materials
    found = materials.reflectance_of(seen["spectral"], seen["accumulation"])
    scores: dict[str, Score] = {}
    scales: dict[str, ColourScale] = {}
    for name in names:
        asked = parse_reflectance_map(name, materials.bands)
        scores[name] = asked.fit(found)
        if asked.usual_range is None:
            values = scores[name](found)
            scales[name] = _scale(values[values.isfinite()], asked.what)
        else:
            scales[name] = ColourScale("viridis", *asked.usual_range, asked.what)
    return scores, scales


def _seen(scene: TrainedScene, views: Sequence[RunView], outputs: Sequence[str]) -> dict[str, Tensor]:
    """Outputs of the pixels in which something is, of all views looked at, on the CPU."""
    every = -(-len(views) // _MOST_VIEWS)
    outputs = [*outputs, "accumulation"]
    found: dict[str, list[Tensor]] = {name: [] for name in outputs}
    for view in views[::every]:
        rendered = scene.render(view.camera.shrunk(_PIXELS), outputs)
        occupied = rendered["accumulation"] > OCCUPIED_ACCUMULATION
        for name in outputs:
            found[name].append(rendered[name][occupied].cpu())
    return {name: torch.cat(parts) for name, parts in found.items()}


def _scale(values: Float[Tensor, " N"], label: str) -> ColourScale:
    low, high = (
        torch.quantile(values.double(), torch.tensor(_RANGE, dtype=torch.float64)).tolist()
        if len(values)
        else (0.0, 1.0)
    )
    return ColourScale("viridis", low, max(high, low + 1e-6), label)
