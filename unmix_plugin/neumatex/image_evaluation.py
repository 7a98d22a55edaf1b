"""Figures of one picture of an object: how far predicted light and base colour are from true ones.

Only pixels that show the object alone count (alpha of at least 0.99): background is easy, and edges depend on how a
picture was sampled. A pixel is the mean over its area, so rays pass through several places of each.

Notation: `M` pixels that count, `C` colours, `H x W` pixels of the picture.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine import Cameras
from unmix_plugin.neumatex.scene.pixel_list import OPAQUE
from unmix_plugin.neumatex.tone.curves import TONE_MAPPINGS, psnr_db, tone_curve
from unmix_plugin.neumatex.traced_object import TracedObject
from unmix_plugin.neumatex.tracing.primary_hits import pixel_hits
from unmix_plugin.neumatex.tracing.render_view import rays_radiance
from unmix_plugin.spectral.colour.conversion import linear_to_srgb

if TYPE_CHECKING:
    from unmix_plugin.neumatex.model import NeumatexModel

SUBPIXELS = 2
"""Places of a pixel along each edge through which rays pass."""


def evaluate_object_image(
    model: NeumatexModel, outputs: dict[str, Tensor], batch: dict[str, Tensor]
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Metrics and pictures, truth left and prediction right; pictures of light are compared as AgX shows them.

    Without a light of its own in the batch: `psnr`, `base_colour_psnr` (linear, as it is), `base_colour_psnr_scaled`
    (after the best factor for each colour). With one: `relit_psnr`. `psnr_image` and `relit_psnr_image` count the
    background too, black on both sides.

    Args:
        outputs: Of `evaluation_outputs`.
    """
    shown = batch["alpha"] >= OPAQUE
    light, base = outputs["light"][shown], outputs["base_colour"][shown]
    tone = TONE_MAPPINGS[int(batch["tone"])]
    predicted, true = model.compared(light, batch["numbers"][shown], tone, tone_curve("agx"))
    error = (predicted - true).square()
    prefix = "relit_" if "environment" in batch else ""
    metrics = {
        f"{prefix}psnr": float(psnr_db(error)),
        f"{prefix}psnr_image": float(psnr_db(error.sum() / (shown.numel() * error.shape[-1]))),
        "lights": float(batch["lights"]),
    }
    pictures = {f"{prefix}rgb": side_by_side(shown, true, predicted)}
    if prefix:
        return metrics, pictures
    metrics["relit_psnr"] = float("nan")  # of images under other lights, where there are any
    if "base_colour" not in batch:
        unknown = dict.fromkeys(("base_colour_psnr", "base_colour_psnr_scaled"), float("nan"))
        return {**metrics, **unknown}, pictures
    colour = batch["base_colour"][shown]
    pictures["base_colour"] = side_by_side(shown, linear_to_srgb(colour), linear_to_srgb(base))
    return {**metrics, **_base_colour_metrics(base, colour)}, pictures


def evaluation_outputs(
    model: NeumatexModel, traced: TracedObject, camera: Cameras, batch: dict[str, Tensor]
) -> dict[str, Float[Tensor, "H W C"]]:
    """`light` and `base_colour`, both linear, and `parameters` of the material, where pixels count; 0 elsewhere."""
    shown = batch["alpha"] >= OPAQUE
    hits = pixel_hits(traced.ray_mesh, camera, 0, SUBPIXELS)
    hits = hits.select(shown.flatten()[hits.pixels])
    light = rays_radiance(
        traced.surface,
        traced.ray_mesh,
        traced.environment,
        hits,
        samples=model.config.eval_samples,
        bounces=model.config.bounces,
        generator=torch.Generator(model.device).manual_seed(0),
    )
    parameters = traced.surface.parameters(hits.points.positions)
    base = model.family.base_colour(parameters)
    return {
        "light": hits.image(light),
        "base_colour": hits.image(base),
        "parameters": hits.image(parameters),
    }


def _base_colour_metrics(base: Float[Tensor, "M C"], true: Float[Tensor, "M C"]) -> dict[str, float]:
    factor = (base * true).sum(dim=0) / base.square().sum(dim=0).clamp(min=1e-12)
    return {
        "base_colour_psnr": float(psnr_db((base - true).square())),
        "base_colour_psnr_scaled": float(psnr_db((factor * base - true).square())),
    }


def side_by_side(
    shown: Bool[Tensor, "H W"], true: Float[Tensor, "M 3"], predicted: Float[Tensor, "M 3"]
) -> Float[Tensor, "H W2 3"]:
    """Two pictures, black where nothing counts."""
    pictures = []
    for values in (true, predicted):
        picture = values.new_zeros((*shown.shape, 3))
        picture[shown] = values.clamp(0, 1)
        pictures.append(picture)
    return torch.cat(pictures, dim=1)
