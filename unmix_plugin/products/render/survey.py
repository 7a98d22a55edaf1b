"""A look ahead at all views, small: what their pictures must have in common, so that a video does not flicker."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.registry import Output
from unmix_plugin.figures.pictures import ColourScale
from unmix_plugin.products.render.pictures import scale_of
from unmix_plugin.spectral.maps.reflectance_maps import Score, is_reflectance_map, parse_reflectance_map
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import TrainedScene

_MOST_VIEWS = 12
_PIXELS = 32 * 32
"""Of a view looked at."""

_RANGE = (0.01, 0.99)
"""Quantiles of what is seen that the colours of a map go through."""


@dataclass(frozen=True)
class Survey:
    """What all pictures of a render share."""

    scales: dict[str, ColourScale] = field(default_factory=dict)
    """Colours of outputs whose range only the views tell, by output."""
    pca: PcaColours | None = None
    """Colours of the output `pca` of a scene of materials, if asked for."""
    scores: dict[str, Score] = field(default_factory=dict)
    """From reflectance to each index and target that is asked for."""


def needs_survey(outputs: Collection[Output]) -> bool:
    """Whether pictures of `outputs` share anything that has to be found out first."""
    return any(
        output.name == "pca" or is_reflectance_map(output.name) or _is_ranged(output) for output in outputs
    )


def take_survey(scene: RenderableScene, views: Sequence[RunView], outputs: Collection[Output]) -> Survey:
    """Look at up to twelve views, evenly spread over all, and find what `outputs` of all views share."""
    maps = [output for output in outputs if is_reflectance_map(output.name)]
    ranged = [output for output in outputs if _is_ranged(output) and output not in maps]
    has_pca = any(output.name == "pca" for output in outputs)
    is_mixed = isinstance(scene, TrainedScene)
    spectra = ["spectral"] if is_mixed and (maps or has_pca) else []
    seen = _seen(scene, views, [*(output.name for output in ranged), *spectra])
    scales = {output.name: scale_of(output, *_bounds(seen[output.name])) for output in ranged}
    if not is_mixed or not spectra:
        return Survey(scales)
    reflectance = scene.materials.reflectance_of(seen["spectral"], seen["accumulation"])
    scores = {
        output.name: parse_reflectance_map(output.name, scene.bands).fit(reflectance) for output in maps
    }
    for output in maps:
        if output.value_range is None:
            scales[output.name] = scale_of(output, *_bounds(scores[output.name](reflectance)))
    return Survey(scales, PcaColours.fit(seen["spectral"]) if has_pca else None, scores)


def _is_ranged(output: Output) -> bool:
    """Whether only the views tell between which values an output's colours go."""
    return output.kind in ("map", "shares") and output.value_range is None


def _seen(scene: RenderableScene, views: Sequence[RunView], outputs: Sequence[str]) -> dict[str, Tensor]:
    """Outputs and `accumulation` of the pixels in which something is, of all views looked at, on the CPU."""
    every = -(-len(views) // _MOST_VIEWS)
    found: dict[str, list[Tensor]] = {name: [] for name in (*outputs, "accumulation")}
    for view in views[::every]:
        looked = scene.look(view.camera.shrunk(_PIXELS))
        occupied = looked.opacity > OCCUPIED_ACCUMULATION
        for name in outputs:
            found[name].append(looked[name][occupied].cpu())
        found["accumulation"].append(looked.opacity[occupied].cpu())
    return {name: torch.cat(parts) for name, parts in found.items()}


def _bounds(values: Float[Tensor, "..."]) -> tuple[float, float]:
    """Between which values nearly all of them lie."""
    known = values[values.isfinite()].double()
    if len(known) == 0:
        return 0.0, 1.0
    low, high = torch.quantile(known, torch.tensor(_RANGE, dtype=torch.float64)).tolist()
    return low, max(high, low + 1e-6)
