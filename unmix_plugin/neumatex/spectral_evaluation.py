"""Figures of one spectral picture of an object: radiance in every band, and materials where the truth is known.

Which pixels count, and how they are rendered, is as in `image_evaluation`. Radiance is compared as it is, clamped to
[0, 1] on both sides.

Notation: `M` pixels that count, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.image_evaluation import side_by_side
from unmix_plugin.neumatex.materials.family import MaterialFamily
from unmix_plugin.neumatex.materials.spectral import SpectralFamily
from unmix_plugin.neumatex.scene.pixel_list import OPAQUE
from unmix_plugin.neumatex.tone.curves import psnr_db
from unmix_plugin.neumatex.tone.spectral import SpectralDisplay
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.spectral.metrics import abundance_rmse, endmember_angle, match_endmembers, spectral_angle

if TYPE_CHECKING:
    from unmix_plugin.neumatex.model import NeumatexModel

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
    shown = batch["alpha"] >= OPAQUE
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
