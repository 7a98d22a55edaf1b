"""Figures of one spectral picture of an object: radiance in every band, and materials where the truth is known.

Which pixels count, and how they are rendered, is as in `image_evaluation`. Radiance is compared as it is, clamped to
[0, 1] on both sides.

Notation: `M` pixels that count, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine import Cameras
from unmix_plugin.neumatex.image_evaluation import SUBPIXELS, render_pixels, side_by_side
from unmix_plugin.neumatex.materials.spectral import SpectralFamily
from unmix_plugin.neumatex.scene.pixel_list import OPAQUE
from unmix_plugin.neumatex.tone.curves import psnr_db
from unmix_plugin.neumatex.tone.spectral import SpectralDisplay
from unmix_plugin.neumatex.traced_object import TracedObject
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.neumatex.tracing.primary_hits import pixel_hits
from unmix_plugin.spectral.metrics import abundance_rmse, endmember_angle, match_endmembers, spectral_angle

if TYPE_CHECKING:
    from unmix_plugin.neumatex.model import NeumatexModel

_TRUTHS = ("base_colour_psnr", "reflectance_angle", "abundance_rmse", "endmember_angle")


def evaluate_spectral_image(
    model: NeumatexModel, traced: TracedObject, camera: Cameras, batch: dict[str, Tensor]
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Metrics and pictures, truth left and prediction right.

    Without a light of its own in the batch: `psnr` over all bands, `sam` (spectral angle of radiance, radians), and
    where the truth is known `base_colour_psnr` (reflectance in every band), `reflectance_angle`, `abundance_rmse`,
    `endmember_angle` (mean over the true endmembers, each with its match). With one: `relit_psnr`, `relit_sam`.
    """
    assert isinstance(model.curve, SpectralDisplay)
    shown = batch["alpha"] >= OPAQUE
    light, base = render_pixels(model, traced, camera, shown)
    predicted, true = light.clamp(0, 1), batch["numbers"][shown].clamp(0, 1)
    error = (predicted - true).square()
    prefix = "relit_" if "environment" in batch else ""
    metrics = {
        f"{prefix}psnr": float(psnr_db(error)),
        f"{prefix}psnr_image": float(psnr_db(error.sum() / (shown.numel() * error.shape[-1]))),
        f"{prefix}sam": float(spectral_angle(predicted.double(), true.double()).mean()),
        "lights": float(batch["lights"]),
    }
    pictures = {f"{prefix}rgb": side_by_side(shown, model.curve(true), model.curve(predicted))}
    if prefix:
        return metrics, pictures
    metrics["relit_psnr"] = float("nan")  # of images under other lights, where there are any
    if "true_abundances" not in batch:
        return {**metrics, **dict.fromkeys(_TRUTHS, float("nan"))}, pictures
    true_shares, endmembers = batch["true_abundances"][shown], batch["true_endmembers"]
    reflectance = true_shares @ endmembers
    colours = [linear_to_srgb(model.curve.rgb(values)) for values in (reflectance, base)]
    pictures["base_colour"] = side_by_side(shown, *colours)
    metrics["base_colour_psnr"] = float(psnr_db((base - reflectance).square()))
    metrics["reflectance_angle"] = float(spectral_angle(base.double(), reflectance.double()).mean())
    shares = _abundances(traced, camera, shown)
    return {**metrics, **_material_metrics(traced, shares, true_shares, endmembers)}, pictures


def _abundances(
    traced: TracedObject, camera: Cameras, shown: Bool[Tensor, "H W"]
) -> Float[Tensor, "M K"]:
    """Means over the pixels that count."""
    family = traced.surface.family
    assert isinstance(family, SpectralFamily)
    hits = pixel_hits(traced.ray_mesh, camera, 0, SUBPIXELS)
    hits = hits.select(shown.flatten()[hits.pixels])
    return hits.image(family.abundances(traced.surface.parameters(hits.points.positions)))[shown]


def _material_metrics(
    traced: TracedObject,
    shares: Float[Tensor, "M K"],
    true_shares: Float[Tensor, "M T"],
    true_endmembers: Float[Tensor, "T B"],
) -> dict[str, float]:
    family = traced.surface.family
    assert isinstance(family, SpectralFamily)
    matching = match_endmembers(family.endmembers.detach(), true_endmembers)
    flat = torch.ones_like(true_endmembers[0])  # both are reflectances
    return {
        "abundance_rmse": abundance_rmse(shares[:, None], true_shares[:, None], matching),
        "endmember_angle": endmember_angle(family.endmembers.detach(), true_endmembers, flat),
    }
