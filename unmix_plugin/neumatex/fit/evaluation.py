"""Figures of one picture of an object: how far predicted light and materials are from true ones.

Only pixels that show the object alone count (alpha of at least 0.99): background is easy, and edges depend on how a
picture was sampled. A pixel is the mean over its area, so rays pass through several places of each.

Notation: `M` pixels that count, `C` colours, `B` bands, `T` true materials, `P` parameters, `H x W` pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from unmix_plugin.engine import Cameras
from unmix_plugin.figures.pictures import Canvas, CanvasLayout
from unmix_plugin.neumatex.fit.tone import TONE_MAPPINGS, SpectralDisplay, ToneMapping, psnr_db
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import MaterialFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import pixel_hits
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA
from unmix_plugin.spectral.metrics import abundance_rmse, endmember_angle, match_endmembers, spectral_angle

Compare: TypeAlias = Callable[
    [Float[Tensor, "M C"], Float[Tensor, "M C"], ToneMapping],
    tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]],
]
"""From predicted light and a picture's numbers, which a tone mapping made of light, to what is compared."""
SUBPIXELS = 2
"""Places of a pixel along each edge through which rays pass."""
_PICTURE_PX = 512
"""Longer side of a picture, at least."""
_COLOUR_TRUTHS = ("base_colour_psnr", "base_colour_psnr_scaled")
_SPECTRAL_TRUTHS = ("base_colour_psnr", "reflectance_angle", "abundance_rmse", "endmember_angle")


def evaluation_outputs(
    traced: TracedObject, camera: Cameras, batch: dict[str, Tensor], *, samples: int, bounces: int
) -> dict[str, Float[Tensor, "H W C"]]:
    """`light` and `base_colour`, both linear, and `parameters` of the material where pixels count, 0 elsewhere; in the
    light that the batch may hold, by so many paths per pixel."""
    if "environment" in batch:
        light = Environment(batch["environment"], *batch["environment_placement"].tolist())
        traced = replace(traced, environment=light)
    hits = pixel_hits(traced.ray_mesh, camera, 0, SUBPIXELS)
    hits = hits.select((batch["alpha"] >= OPAQUE_ALPHA).flatten()[hits.pixels])
    generator = torch.Generator(traced.ray_mesh.device).manual_seed(0)
    light = traced.light_of_rays(hits, samples, bounces, generator)
    parameters = traced.surface.parameters(hits.points.positions)
    base_colour = traced.surface.family.base_colour(parameters)
    values = {"light": light, "base_colour": base_colour, "parameters": parameters}
    return {name: hits.image(value) for name, value in values.items()}


def evaluate_object_image(
    outputs: dict[str, Tensor],
    batch: dict[str, Tensor],
    *,
    family: MaterialFamily,
    display: nn.Module,
    compare: Compare,
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Metrics and pictures, truth left and prediction right.

    `psnr` is of light as AgX shows it, or of spectral pictures of radiance in all bands, clamped to [0, 1] on both
    sides; those have `sam` too (spectral angle of radiance, radians). `psnr_image` counts the background, black on both
    sides. A batch with a light of its own has these alone, named `relit_...`.

    Otherwise `base_colour_psnr` (linear, as it is) and `base_colour_psnr_scaled` (after the best factor for each
    colour); of spectral pictures `base_colour_psnr` (reflectance in every band), `reflectance_angle`,
    `abundance_rmse` and `endmember_angle` (mean over the true endmembers, each with its match). Where the truth is not
    known they are nan.
    """
    shown = batch["alpha"] >= OPAQUE_ALPHA
    light, numbers = outputs["light"][shown], batch["numbers"][shown]
    prefix = "relit_" if "environment" in batch else ""
    spectral: dict[str, float] = {}
    if isinstance(display, SpectralDisplay):
        predicted, true = light.clamp(0, 1), numbers.clamp(0, 1)
        colours = display(true), display(predicted)
        spectral[f"{prefix}sam"] = float(spectral_angle(predicted.double(), true.double()).mean())
    else:
        predicted, true = compare(light, numbers, TONE_MAPPINGS[int(batch["tone"])])
        colours = true, predicted
    error = (predicted - true).square()
    metrics: dict[str, float] = {
        f"{prefix}psnr": float(psnr_db(error)),
        f"{prefix}psnr_image": float(psnr_db(error.sum() / (shown.numel() * error.shape[-1]))),
        **spectral,
        "lights": float(batch["lights"]),
    }
    pictures = {f"{prefix}rgb": _side_by_side(shown, *colours)}
    if prefix:
        return metrics, pictures
    metrics["relit_psnr"] = float("nan")  # of images under other lights, where there are any
    base = outputs["base_colour"][shown]
    if isinstance(display, SpectralDisplay):
        if "true_abundances" not in batch:
            return metrics | dict.fromkeys(_SPECTRAL_TRUTHS, float("nan")), pictures
        shares, endmembers = batch["true_abundances"][shown], batch["true_endmembers"]
        reflectance = shares @ endmembers
        colours = [display.rgb(values) for values in (reflectance, base)]
        found = _material_metrics(family, outputs["parameters"][shown], base, shares, endmembers)
    else:
        if "base_colour" not in batch:
            return metrics | dict.fromkeys(_COLOUR_TRUTHS, float("nan")), pictures
        colours = batch["base_colour"][shown], base
        factor = (base * colours[0]).sum(dim=0) / base.square().sum(dim=0).clamp(min=1e-12)
        errors = ((scale * base - colours[0]).square() for scale in (1.0, factor))
        found = {name: float(psnr_db(one)) for name, one in zip(_COLOUR_TRUTHS, errors, strict=True)}
    pictures["base_colour"] = _side_by_side(shown, *map(linear_to_srgb, colours))
    return {**metrics, **found}, pictures


def _material_metrics(
    family: MaterialFamily,
    parameters: Float[Tensor, "M P"],
    base: Float[Tensor, "M B"],
    true_shares: Float[Tensor, "M T"],
    true_endmembers: Float[Tensor, "T B"],
) -> dict[str, float]:
    assert isinstance(family, SpectralFamily)
    reflectance = true_shares @ true_endmembers
    shares, endmembers = family.abundances(parameters), family.endmembers.detach()
    matching = match_endmembers(endmembers, true_endmembers)
    found = (
        float(psnr_db((base - reflectance).square())),
        float(spectral_angle(base.double(), reflectance.double()).mean()),
        abundance_rmse(shares[:, None], true_shares[:, None], matching),
        endmember_angle(endmembers, true_endmembers),
    )
    return dict(zip(_SPECTRAL_TRUTHS, found, strict=True))


def _side_by_side(
    shown: Bool[Tensor, "H W"], true: Float[Tensor, "M 3"], predicted: Float[Tensor, "M 3"]
) -> Float[Tensor, "H2 W2 3"]:
    """Two pictures, black where nothing counts, below their titles and so large that they can be looked at."""
    pictures = torch.zeros(2, *shown.shape, 3, dtype=true.dtype)
    pictures[:, shown.cpu()] = torch.stack([true, predicted]).clamp(0, 1).cpu()
    times = max(1, -(-_PICTURE_PX // max(shown.shape)))
    tiles = (pictures * 255 + 0.5).byte().repeat_interleave(times, dim=1).repeat_interleave(times, dim=2)
    titles = ("true", "predicted")
    canvas = Canvas(CanvasLayout.of((tiles.shape[2], tiles.shape[1]), titles), 3, titles)
    canvas.put(0, tiles.permute(1, 2, 0, 3).numpy())
    return torch.from_numpy(canvas.pixels).to(true) / 255
