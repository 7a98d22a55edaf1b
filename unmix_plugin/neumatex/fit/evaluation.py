"""Figures of one picture of an object: how far predicted light and base colour are from true ones.

Only pixels that show the object alone count (alpha of at least 0.99): background is easy, and edges depend on how a
picture was sampled. A pixel is the mean over its area, so rays pass through several places of each.

Notation: `M` pixels that count, `C` colours, `H x W` pixels of the picture.

Figures of one spectral picture of an object: radiance in every band, and materials where the truth is known.

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
from unmix_plugin.neumatex.fit.tone import TONE_MAPPINGS, SpectralDisplay, psnr_db, tone_curve
from unmix_plugin.neumatex.tracing.families import MaterialFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject, rays_radiance
from unmix_plugin.neumatex.tracing.rays import pixel_hits
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA
from unmix_plugin.spectral.metrics import abundance_rmse, endmember_angle, match_endmembers, spectral_angle

if TYPE_CHECKING:
    from unmix_plugin.neumatex.fit.model import NeumatexModel


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
    shown = batch["alpha"] >= OPAQUE_ALPHA
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
    shown = batch["alpha"] >= OPAQUE_ALPHA
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


_TRUTHS = ("base_colour_psnr", "reflectance_angle", "abundance_rmse", "endmember_angle")


def evaluate_spectral_image(
    model: NeumatexModel, outputs: dict[str, Tensor], batch: dict[str, Tensor]
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Metrics and pictures, truth left and prediction right.

    Without a light of its own in the batch: `psnr` over all bands, `sam` (spectral angle of radiance, radians), and
    where the truth is known `base_colour_psnr` (reflectance in every band), `reflectance_angle`, `abundance_rmse`,
    `endmember_angle` (mean over the true endmembers, each with its match). With one: `relit_psnr`, `relit_sam`.

    Args:
        outputs: Of `image_evaluation.evaluation_outputs`.
    """
    assert isinstance(model.curve, SpectralDisplay)
    shown = batch["alpha"] >= OPAQUE_ALPHA
    light, base = outputs["light"][shown], outputs["base_colour"][shown]
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
    true_shares, true_endmembers = batch["true_abundances"][shown], batch["true_endmembers"]
    reflectance = true_shares @ true_endmembers
    colours = [linear_to_srgb(model.curve.rgb(values)) for values in (reflectance, base)]
    pictures["base_colour"] = side_by_side(shown, *colours)
    metrics["base_colour_psnr"] = float(psnr_db((base - reflectance).square()))
    metrics["reflectance_angle"] = float(spectral_angle(base.double(), reflectance.double()).mean())
    shares = outputs["parameters"][shown]
    return {**metrics, **_material_metrics(model.family, shares, true_shares, true_endmembers)}, pictures


def _material_metrics(
    family: MaterialFamily,
    parameters: Float[Tensor, "M P"],
    true_shares: Float[Tensor, "M T"],
    true_endmembers: Float[Tensor, "T B"],
) -> dict[str, float]:
    assert isinstance(family, SpectralFamily)
    shares, endmembers = family.abundances(parameters), family.endmembers.detach()
    matching = match_endmembers(endmembers, true_endmembers)
    flat = torch.ones_like(true_endmembers[0])  # both are reflectances
    return {
        "abundance_rmse": abundance_rmse(shares[:, None], true_shares[:, None], matching),
        "endmember_angle": endmember_angle(endmembers, true_endmembers, flat),
    }
