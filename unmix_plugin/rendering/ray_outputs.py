"""What a training step needs to know of rendered rays besides their spectra, by the names of the model's outputs."""

from __future__ import annotations

import torch
from torch import Tensor

from unmix_plugin.engine.geometry.space import RayBundle, UnitSpace
from unmix_plugin.rendering.renderer import RenderedRays


def ray_outputs(rendered: RenderedRays, ray_bundle: RayBundle) -> dict[str, Tensor]:
    """Of R rays `accumulation` (R), `abundances` (R, K) with those of the sky, `spread` and `num_samples`, one number
    each, and of the S samples that carry weight `positions` in the unit cube, `weights`, `rays` and `views`."""
    return {
        "accumulation": rendered.coefficients.accumulation,
        "abundances": rendered.mixtures,
        "spread": rendered.spread,
        "num_samples": torch.tensor(rendered.num_samples),
        "positions": rendered.positions,
        "weights": rendered.weights,
        "rays": rendered.ray_indices,
        "views": ray_bundle.camera_indices.index_select(0, rendered.ray_indices),
    }


def observed_by_rays(rendered: RenderedRays, space: UnitSpace) -> dict[str, Tensor]:
    """Of all N samples looked at, without gradients, `observed_positions` in the unit cube and `observed_densities`."""
    positions = torch.cat(list(rendered.looked_at.all_positions)).detach()
    return {
        "observed_positions": space.to_unit(positions),
        "observed_densities": torch.cat(list(rendered.looked_at.all_densities)),
    }
