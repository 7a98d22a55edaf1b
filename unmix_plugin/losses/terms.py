"""What training makes smaller: rendered beside measured pixels of a batch, sensor by sensor, and the terms by name.

| term | made by | what it asks for |
|---|---|---|
| `spectral`, `rgb` | `BatchComparison.terms` | the spectra, and the colours, that were measured |
| `opacity` | the same | something solid where a pixel sends light |
| `abundances` | the same | the mixtures that the measured spectra show |
| `sparsity`, `certainty` | `VolumeRenderer.render` | surfaces in place of haze; abundances that stay open at first |
| `surface` | `stray_light` | light from the surface that views agree on |
| `near` | `light_near_cameras` | no clouds between cameras |
| `normals` | `normals_error` | normals of shading that agree with those of the density |
| `poses` | `PoseRefinement.penalty` | small and smooth corrections |

`loss_weights` says how much each counts at which part of the training.

What a sensor sees of the rendered scene is worked out once: its spectra follow from the composited coefficients, times
the gain of the view where gains are learnt, in the mean over the rays of a pixel. All comparisons take it from there.

Where the views agree clearly on the surface that a pixel shows, light of its rays should come from there (Deng et al.
2022, Depth-supervised NeRF, with a plane sweep's distances in place of sparse points, and with a bound on what a wrong
one costs). Normals that a lamp's light teaches are guided by those of the densities: from afar the light alone goes
astray. Densities know roughly where a surface faces, light in the end knows better: so this fades out.

Notation: `R` pixels of a sensor (or rays), `N` rays, `S` visible samples, `b` channels of a sensor, `B` bands of the
scene, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.engine.geometry.space import RayBundle, UnitSpace
from unmix_plugin.light.shading import LampShading
from unmix_plugin.losses.abundance_guide import AbundanceGuide
from unmix_plugin.operators.compositing import scale_gradient
from unmix_plugin.presets import AlphaPreset
from unmix_plugin.rendering.renderer import RenderedRays
from unmix_plugin.sensors.views import BandBalance, MeasuredPixels, SensorViews, ViewGains
from unmix_plugin.settings import LossConfig
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.spectral.evidence import (
    OPAQUE_ALPHA,
    bounded_square,
    has_spectral_shape,
    is_blown_out,
    mask_saturated,
    over_background,
    relative_weights,
    solid_evidence,
)
from unmix_plugin.spectral.materials import Coefficients, Materials

_CERTAINTY_WEIGHT = 1e-2
"""Weight, at the start of training, of the certainty of abundances. Before surfaces stand, most of what a ray sees is
haze of the commonest materials. Where the softmax grows sure of those, it has no gradient left, and a rare material is
never learnt. Source: Pereyra et al. 2017, Regularizing Neural Networks by Penalizing Confident Output Distributions."""
_NORMALS_WEIGHT = 0.01
"""Weight, at the start of training, of the disagreement of normals that shading by a moving lamp learns with those of
the densities."""
_FINAL_ABUNDANCES = 0.1
"""Factor on the weight of abundances at the end of training: once materials are found, what is left of their
disagreement with single pixels holds spectra back."""
_FADES_UNTIL = {"sparsity": 0.25, "surface": 0.5, "near": 0.5, "certainty": 0.5, "normals": 1.0}
"""Part of the training at which a weight has fallen to 0, slower and slower: later, sparsity would thin out surfaces,
known surfaces would hold back what is finer, and pure materials may be pure."""
_NOT_PUBLISHED = {"opacity", "sparsity", "surface", "near", "certainty"}
"""Terms that the method as published does without."""


def loss_weights(
    config: LossConfig, preset: AlphaPreset, progress: float, as_published: bool = False
) -> dict[str, float]:
    """Weight of each term that counts when that part of the training is over, by name."""
    weights = {
        "spectral": config.spectral,
        "rgb": float(config.rgb),
        "opacity": preset.opacity_loss_weight,
        "sparsity": preset.sparsity_loss_weight,
        "surface": preset.surface_loss_weight,
        "near": preset.near_loss_weight,
        "normals": _NORMALS_WEIGHT,
        "certainty": _CERTAINTY_WEIGHT,
        "abundances": config.abundances * _FINAL_ABUNDANCES**progress,
    }
    for name, until in _FADES_UNTIL.items():
        weights[name] *= max(1 - progress / until, 0.0) ** 2
    return {name: x for name, x in weights.items() if x > 0 and not (as_published and name in _NOT_PUBLISHED)}


@dataclass(frozen=True)
class LossTerm:
    """How far what is rendered of pixels is from what they should be: squared errors, bounded and weighted."""

    prediction: Float[Tensor, "R *channels"]
    target: Float[Tensor, "R *channels"]
    weight: tuple[Float[Tensor, "*"], ...] = ()
    """Factors of the squares, by channel or by pixel."""
    outlier: Float[Tensor, "R 1"] | None = None
    """Error from which on it counts in proportion instead of squared; None: squared however large."""
    of_pixel: Literal["mean", "sum"] = "mean"
    """Over the channels of a pixel."""

    def loss(self) -> Float[Tensor, ""]:
        """Mean over pixels."""
        errors = self.prediction - self.target
        squares = errors.square() if self.outlier is None else bounded_square(errors, self.outlier)
        for factor in self.weight:
            squares = factor * squares
        return squares.mean() if self.of_pixel == "mean" else squares.sum(dim=1).mean()


_FOREGROUND = 0.01
"""Opacity of pixels that show foreground."""
_OUTLIER = 1.0
"""Error of an exposed value above which it counts in proportion instead of squared. It matters in dark scenes only: a
blown-out pixel would otherwise outweigh all others. What a saturated value misses is unknown anyway, so for such pixels
the bound is divided by the exposure."""
_NO_OUTLIER = 1e6
"""The same where errors are squared however large; infinity would have no gradient."""


@dataclass(frozen=True)
class ComparedPixels:
    """Pixels of one sensor: what it measured, and what it sees of the rendered scene, in the mean over a pixel's
    rays."""

    measured: MeasuredPixels
    share: float
    """Of the batch's rays."""
    rays: slice
    """The first ray of each pixel."""
    spectra: Float[Tensor, "R b"]
    """On black."""
    opacities: Float[Tensor, "R"]
    abundances: Float[Tensor, "R K"]
    mixtures: Float[Tensor, "R K"] | None = None
    """What the guide says that the pixels are made of, summing to 1; None where it isn't asked, or the sensor has too
    few channels to tell."""
    is_mixture_known: Bool[Tensor, "R"] | None = None
    """Pixels of which that counts."""


def pose_errors(
    compared: Sequence[ComparedPixels], knots: Int[Tensor, "N"]
) -> tuple[Int[Tensor, "R"], Float[Tensor, "R"], Bool[Tensor, "R"]]:
    """Of each pixel the nearest knot of its pose (given of each ray), its mean squared error on black, and whether it
    shows foreground in the picture or in the scene."""
    nearest = torch.cat([knots[part.rays] for part in compared])
    squares = [(x.spectra.detach() - x.measured.spectra).square().mean(dim=1) for x in compared]
    foreground = [torch.maximum(x.measured.alpha, x.opacities.detach()) > _FOREGROUND for x in compared]
    return nearest, torch.cat(squares), torch.cat(foreground)


@dataclass(frozen=True)
class BatchComparison:
    """What each sensor of a batch should have seen, and what it saw."""

    config: LossConfig
    """Without `auto`."""
    seen_by: SensorViews
    balance: BandBalance
    guide: AbundanceGuide
    view_gains: ViewGains | None
    as_published: bool = False
    has_sky: bool = False
    """Whether something is behind all that is rendered: no background shines through."""

    def compare(
        self,
        measured: Sequence[MeasuredPixels],
        rendered: RenderedRays,
        views: Int[Tensor, "N"],
        materials: Materials,
        ray_weights: Float[Tensor, "N"] | None = None,
    ) -> list[ComparedPixels]:
        """The pixels of a batch with what is seen of them by the rays through them, each of a training view;
        `ray_weights` are those by which rays shape the scene, None: alike."""
        found, first, num_rays = [], 0, len(views)
        for own in measured:
            sensor, rows, whole = own.sensor, slice(first, first + own.num_rays), own.num_rays == num_rays
            packed = rendered.coefficients.packed if whole else rendered.coefficients.packed[rows]
            abundances = rendered.mixtures if whole else rendered.mixtures[rows]
            seen = Coefficients(packed, rendered.coefficients.num_endmembers)
            if sensor is None:
                spectra = materials.spectra(seen)
            else:
                spectra = materials.through(seen, self.seen_by.matrix(sensor).T)
            opacities = seen.accumulation
            if ray_weights is not None:
                weights = ray_weights[rows]
                opacities = scale_gradient(opacities, weights)
                spectra, abundances = (scale_gradient(x, weights[:, None]) for x in (spectra, abundances))
            if self.view_gains is not None:
                terms = self.seen_by.project(self.view_gains.terms, sensor)
                spectra = spectra * self.view_gains(views[rows], terms / terms[:1])
            spectra, opacities, abundances = (
                x.unflatten(0, (len(own), -1)).mean(dim=1) for x in (spectra, opacities, abundances)
            )

            firsts = slice(rows.start, rows.stop, max(own.num_rays // max(len(own), 1), 1))
            share = own.num_rays / max(num_rays, 1)
            found.append(ComparedPixels(own, share, firsts, spectra, opacities, abundances, *self.unmix(own)))
            first = rows.stop
        return found

    def unmix(
        self, measured: MeasuredPixels
    ) -> tuple[Float[Tensor, "R K"], Bool[Tensor, "R"]] | tuple[None, None]:
        """What the guide says that measured pixels are made of, and which of them tell; as `ComparedPixels` has it."""
        sensor, endmembers = measured.sensor, self.guide.endmembers
        if self.config.abundances == 0 or not self.seen_by.tells_materials(sensor, len(endmembers)):
            return None, None
        spectra = self.balance.scaled(measured.spectra, sensor)
        seen = self.balance.scaled(self.seen_by.project(endmembers, sensor), sensor)
        is_known = has_spectral_shape(spectra)
        if measured.alpha_confidence is not None:
            is_known = is_known & (measured.alpha_confidence > 0)
        return self.guide.unmix(measured.pixels, spectra, seen), is_known

    def losses(
        self, compared: Sequence[ComparedPixels], names: Collection[str], generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """Those of these losses that compare rendered with measured pixels, not yet weighted: their means over sensors,
        by the rays of each. The generator draws backgrounds."""
        losses: dict[str, Tensor] = {}
        for part in compared:
            for name, term in self.terms(part, names, generator).items():
                loss = part.share * term.loss()
                losses[name] = losses[name] + loss if name in losses else loss
        return losses

    def terms(
        self, part: ComparedPixels, names: Collection[str], generator: torch.Generator | None
    ) -> dict[str, LossTerm]:
        """What is compared of one sensor's pixels. Spectra lie over the same background, black where alpha is not to be
        trusted, so that only light counts; where a saturated value is surpassed, nothing is wrong."""
        measured, exposure = part.measured, float(self.config.exposure)
        grey = torch.zeros_like(measured.alpha)[:, None]
        if self.config.background == "random":
            device = grey.device if generator is None else generator.device
            grey = torch.rand(grey.shape, generator=generator, device=device).to(grey)
        elif self.config.background == "white":
            grey = grey + 1
        if measured.alpha_confidence is not None:
            grey = grey * measured.alpha_confidence[:, None]
        opacity = torch.ones_like(part.opacities) if self.has_sky else part.opacities
        target = over_background(exposure * measured.spectra, measured.alpha, grey)
        prediction = over_background(exposure * part.spectra, opacity, grey)
        prediction = mask_saturated(prediction, target, measured.spectra)
        bound = _NO_OUTLIER if self.as_published else _OUTLIER
        outlier = torch.where(is_blown_out(measured.spectra), bound / exposure, bound)[:, None]

        terms: dict[str, LossTerm] = {}
        if "spectral" in names:
            by_channel, power = self.balance.of(measured.sensor), float(self.config.relative)
            weight = () if by_channel is None else (by_channel,)
            if power > 0:
                weight = (*weight, relative_weights(prediction, power)[:, None])
            terms["spectral"] = LossTerm(prediction, target, weight, outlier)
        if "rgb" in names:
            # Against the colours of the measured spectra, not of a picture file: another colour pipeline than ours
            # there would contradict the spectra.
            linear = torch.stack([prediction, target]) @ self.seen_by.rgb_weights(measured.sensor)
            colours = linear_to_srgb(linear)
            terms["rgb"] = LossTerm(colours[0], colours[1], outlier=outlier)
        if "opacity" in names:
            evidence = solid_evidence(exposure * measured.spectra)
            terms["opacity"] = LossTerm(part.opacities, torch.ones_like(part.opacities), (evidence,))
        if "abundances" in names and part.mixtures is not None and part.is_mixture_known is not None:
            # Composited abundances sum to the opacity, so those of a measured pixel to its alpha.
            mixtures = measured.alpha[:, None] * part.mixtures
            weight = (part.is_mixture_known[:, None].to(mixtures),)
            terms["abundances"] = LossTerm(part.abundances, mixtures, weight, of_pixel="sum")
        return terms

    @staticmethod
    def psnr(compared: Sequence[ComparedPixels]) -> Float[Tensor, ""]:
        """Of a batch on black, in dB."""
        squares = [(part.spectra.detach().clamp(0, 1) - part.measured.spectra).square() for part in compared]
        errors = [part.share * each.mean() for part, each in zip(compared, squares, strict=True)]
        return -10 * torch.log10(torch.stack(errors).sum().clamp(min=1e-12))

    def update(self, compared: Sequence[ComparedPixels]) -> None:
        """Note how far margins of abundances are from those of measured spectra."""
        for part in compared:
            if part.mixtures is not None and part.is_mixture_known is not None:
                counts = part.is_mixture_known & (part.measured.alpha > OPAQUE_ALPHA)
                self.guide.update(part.abundances, part.mixtures, counts)


_SURFACE_CELLS = 64.0
"""Along an edge of contracted space: the unit of the two bounds below."""
_AT_SURFACE, _OFF_SURFACE = 1.0, 3.0
"""Distance from the known place up to which all light counts, and beyond which none does."""


def stray_light(
    weights: Float[Tensor, "S"],
    positions: Float[Tensor, "S 3"],
    ray_indices: Int[Tensor, "S"],
    surfaces: Float[Tensor, "R 3"],
    space: UnitSpace,
) -> Float[Tensor, ""]:
    """Mean over all rays of the share of light from elsewhere than their surfaces (model space, NaN where unknown); 0
    for rays whose surface isn't known. Each sample, at a position of the unit cube, sends a weight of its ray's light.
    """
    is_known = ~surfaces.isnan().any(dim=-1)
    places = space.to_unit(surfaces.nan_to_num(0.0)).index_select(0, ray_indices)
    away = _SURFACE_CELLS * (positions - places).norm(dim=-1)
    counted = ((_OFF_SURFACE - away) / (_OFF_SURFACE - _AT_SURFACE)).clamp(0.0, 1.0)
    light = torch.zeros_like(surfaces[:, 0]).index_add(0, ray_indices, weights * counted)
    return torch.where(is_known, 1.0 - light, 0.0).mean()


_NEAR_REACH = 1.2
"""Distance from a camera within which light counts as from near it, in distances of cameras from the middle of the box,
median over them."""
_MOST_CAMERAS = 64


def light_near_cameras(
    weights: Float[Tensor, "S"], positions: Float[Tensor, "S 3"], rays: RayBundle, space: UnitSpace
) -> Float[Tensor, ""]:
    """Mean over rays of the light that samples at positions of the unit cube send, by how near they are to any of the
    rays' cameras: (1 - d / r)^2 within r of the nearest.

    What is as well explained by something farther away, as a plain sky is, does not hang in the air between cameras.
    """
    views, order = rays.camera_indices.sort(stable=True)
    is_first = views.diff(prepend=views[:1] - 1) != 0
    cameras = rays.origins.detach()[order[is_first]]
    cameras = cameras[:: -(-len(cameras) // _MOST_CAMERAS)]
    reach = _NEAR_REACH * (cameras - space.box.aabb.mean(dim=0)).norm(dim=-1).median()
    nearest = torch.cdist(space.from_unit(positions), cameras).amin(dim=1)
    return (weights * (1 - nearest / reach).clamp(min=0).square()).sum() / max(len(rays), 1)


_ONE_OF = 8
"""Samples, of which one is evaluated in a step."""


def normals_error(
    get_density: Callable[[Tensor], tuple[Tensor, Tensor]],
    shading: LampShading,
    positions: Float[Tensor, "S 3"],
    weights: Float[Tensor, "S"],
    generator: torch.Generator | None,
) -> Float[Tensor, ""]:
    """Mean of 1 - n . m over some samples in model space, by weight: n the learnt normals, m against the slope of the
    log density.

    Source: Verbin et al. 2022, Ref-NeRF, on predicted normals; there as a squared distance, which is twice as much.
    """
    device = positions.device if generator is None else generator.device
    chosen = torch.randperm(len(positions), generator=generator, device=device)
    chosen = chosen[: -(-len(positions) // _ONE_OF)].to(positions.device)
    at, shares = positions[chosen].requires_grad_(), weights.detach()[chosen]
    densities, features = get_density(at)
    logs = densities.clamp(min=1e-20).log().sum()
    (slope,) = torch.autograd.grad(logs, at, retain_graph=True)
    agreement = (shading.surface(features)[0] * normalize(-slope, dim=1)).sum(dim=1)
    return (shares * (1 - agreement)).sum() / shares.sum().clamp(min=1e-6)
