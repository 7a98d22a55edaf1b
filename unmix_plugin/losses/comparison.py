"""Rendered beside measured pixels of a training batch, sensor by sensor, and what their differences cost.

What a sensor sees of the rendered scene is worked out once: its spectra follow from the composited coefficients, times
the gain of the view where gains are learnt, in the mean over the rays of a pixel. All comparisons take it from there.

Notation: `R` pixels of a sensor, `N` rays, `b` channels of a sensor, `B` bands of the scene, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.losses.abundance_guide import AbundanceGuide
from unmix_plugin.operators.compositing import scale_gradient
from unmix_plugin.presets import AlphaPreset, choose
from unmix_plugin.rendering.renderer import RenderedRays
from unmix_plugin.sensors.batches import MeasuredPixels
from unmix_plugin.sensors.views import BandBalance, SensorViews, ViewGains
from unmix_plugin.settings import LossConfig
from unmix_plugin.spectral.evidence import (
    bounded_square,
    is_blown_out,
    mask_saturated,
    over_background,
    relative_weights,
    solid_evidence,
    srgb_error,
)
from unmix_plugin.spectral.materials import Coefficients, Materials

_FOREGROUND = 0.01
"""Opacity of pixels that show foreground."""
_OUTLIER = 1.0
"""Error of an exposed value above which it counts in proportion instead of squared. It matters in dark scenes only: a
blown-out pixel would otherwise outweigh all others. What a saturated value misses is unknown anyway, so for such pixels
the bound is divided by the exposure."""
_NO_OUTLIER = 1e6
"""The same where errors are squared however large; infinity would have no gradient."""
_SPARSITY_PART = 0.25
"""Part of the training in which sparsity is asked for: later it would thin out surfaces."""
_CERTAINTY_WEIGHT = 1e-2
"""Weight, at the start of training, of the certainty of abundances. Before surfaces stand, most of what a ray sees is
haze of the commonest materials. Where the softmax grows sure of those, it has no gradient left, and a rare material is
never learnt. Source: Pereyra et al. 2017, Regularizing Neural Networks by Penalizing Confident Output Distributions."""
_CERTAINTY_PART = 0.5
"""Part of the training in which certainty costs something: later pure materials may be pure."""
_SURFACE_PART = 0.5
"""Part of the training in which known surfaces guide it: later they would hold back what is finer."""
_NORMALS_WEIGHT = 0.01
"""Weight, at the start of training, of the disagreement of normals that shading by a moving lamp learns with those of
the densities; it fades to the end."""
_FINAL_ABUNDANCES = 0.1
"""Factor on the weight of abundances at the end of training: once materials are found, what is left of their
disagreement with single pixels holds spectra back."""


def loss_weights(
    config: LossConfig, preset: AlphaPreset, progress: float, as_published: bool = False
) -> dict[str, float]:
    """Weight of each loss that counts when that part of the training is over, by name."""
    weights = {
        "spectral": config.spectral,
        "rgb": choose(config.rgb, preset.rgb_loss_weight),
        "opacity": preset.opacity_loss_weight,
        "sparsity": preset.sparsity_loss_weight * _fading(progress, _SPARSITY_PART),
        "surface": preset.surface_loss_weight * _fading(progress, _SURFACE_PART),
        "normals": _NORMALS_WEIGHT * _fading(progress, 1.0),
        "certainty": _CERTAINTY_WEIGHT * _fading(progress, _CERTAINTY_PART),
        "abundances": config.abundances * _FINAL_ABUNDANCES**progress,
    }
    unknown_then = ("opacity", "sparsity", "surface", "certainty") if as_published else ()
    return {name: x for name, x in weights.items() if x > 0 and name not in unknown_then}


def _fading(progress: float, until: float) -> float:
    """From 1 at the start of training to 0 at `until`, slower and slower."""
    return max(1 - progress / until, 0.0) ** 2


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


@dataclass(frozen=True)
class SpectralTerm:
    """What rendered spectra cost: the mean of their squared errors, bounded and weighted."""

    prediction: Float[Tensor, "R b"]
    """Exposed, over a background."""
    target: Float[Tensor, "R b"]
    outlier: Float[Tensor, "R 1"]
    """Error from which on it counts in proportion instead of squared."""
    weight: tuple[Float[Tensor, "*"], ...]
    """Factors of the squares, by channel and by pixel."""

    def loss(self) -> Float[Tensor, ""]:
        """The mean."""
        squares = bounded_square(self.prediction - self.target, self.outlier)
        for factor in self.weight:
            squares = factor * squares
        return squares.mean()


@dataclass(frozen=True)
class BatchComparison:
    """What each sensor of a batch should have seen, and what it saw."""

    config: LossConfig
    preset: AlphaPreset
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
            rows, whole = slice(first, first + own.num_rays), own.num_rays == num_rays
            packed = rendered.coefficients.packed if whole else rendered.coefficients.packed[rows]
            mixtures = rendered.mixtures if whole else rendered.mixtures[rows]
            seen = Coefficients(packed, rendered.coefficients.num_endmembers)
            if own.sensor is None:
                spectra = materials.spectra(seen)
            else:
                spectra = materials.through(seen, self.seen_by.matrix(own.sensor).T)
            opacities = seen.accumulation
            if ray_weights is not None:
                weights = ray_weights[rows]
                opacities = scale_gradient(opacities, weights)
                spectra, mixtures = (scale_gradient(x, weights[:, None]) for x in (spectra, mixtures))
            if self.view_gains is not None:
                terms = self.seen_by.project(self.view_gains.terms, own.sensor)
                spectra = spectra * self.view_gains(views[rows], terms / terms[:1])
            means = (x.unflatten(0, (len(own), -1)).mean(dim=1) for x in (spectra, opacities, mixtures))
            firsts = slice(rows.start, rows.stop, max(own.num_rays // max(len(own), 1), 1))
            found.append(ComparedPixels(own, own.num_rays / max(num_rays, 1), firsts, *means))
            first = rows.stop
        return found

    def losses(
        self, compared: Sequence[ComparedPixels], wanted: set[str], generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """Losses of these names that compare rendered with measured pixels, not yet weighted; the generator draws
        backgrounds."""
        return _mean(compared, lambda part: self._losses_of(part, wanted, generator))

    @staticmethod
    def psnr(compared: Sequence[ComparedPixels]) -> Float[Tensor, ""]:
        """Of a batch on black, in dB."""

        def error(part: ComparedPixels) -> dict[str, Tensor]:
            return {"psnr": (part.spectra.detach().clamp(0, 1) - part.measured.spectra).square().mean()}

        return -10 * torch.log10(_mean(compared, error)["psnr"].clamp(min=1e-12))

    @staticmethod
    def pose_errors(
        compared: Sequence[ComparedPixels], knots: Int[Tensor, "N"]
    ) -> tuple[Int[Tensor, "R"], Float[Tensor, "R"], Bool[Tensor, "R"]]:
        """Of each pixel the nearest knot of its pose (given of each ray), its mean squared error on black, and whether
        it shows foreground in the picture or in the scene."""
        own = torch.cat([knots[part.rays] for part in compared])
        squares = [(x.spectra.detach() - x.measured.spectra).square().mean(dim=1) for x in compared]
        foreground = [torch.maximum(x.measured.alpha, x.opacities.detach()) > _FOREGROUND for x in compared]
        return own, torch.cat(squares), torch.cat(foreground)

    def update(self, compared: Sequence[ComparedPixels]) -> None:
        """Note how far margins of abundances are from those of measured spectra."""
        if self.config.abundances == 0:
            return
        for part in compared:
            if self._tells_materials(part):
                self.guide.update(part.abundances, *self._guided(part))

    def _losses_of(
        self, part: ComparedPixels, wanted: set[str], generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        measured, exposure = part.measured, choose(self.config.exposure, 1.0)
        spectra = self._spectral_term(part, exposure, generator)
        losses = {"spectral": spectra.loss()}
        if "rgb" in wanted:
            colours = self.seen_by.rgb_weights(measured.sensor)
            losses["rgb"] = srgb_error(spectra.prediction, spectra.target, colours, spectra.outlier)
        if "opacity" in wanted:
            evidence = solid_evidence(exposure * measured.spectra)
            losses["opacity"] = (evidence * (1 - part.opacities).square()).mean()
        if "abundances" in wanted and self._tells_materials(part):
            losses["abundances"] = self.guide.error(part.abundances, *self._guided(part))
        return losses

    def _spectral_term(
        self, part: ComparedPixels, exposure: float, generator: torch.Generator | None
    ) -> SpectralTerm:
        """Rendered and measured spectra over the same background; errors of saturated values are masked."""
        measured, grey = part.measured, self._background(part.measured, generator)
        opacity = torch.ones_like(part.opacities) if self.has_sky else part.opacities
        target = over_background(exposure * measured.spectra, measured.alpha, grey)
        prediction = over_background(exposure * part.spectra, opacity, grey)
        prediction = mask_saturated(prediction, target, measured.spectra)
        bound = _NO_OUTLIER if self.as_published else _OUTLIER
        outlier = torch.where(is_blown_out(measured.spectra), bound / exposure, bound)[:, None]
        by_channel, power = self.balance.of(measured.sensor), choose(self.config.relative, 0.0)
        weight = () if by_channel is None else (by_channel,)
        if power > 0:
            weight = (*weight, relative_weights(prediction, power)[:, None])
        return SpectralTerm(prediction, target, outlier, weight)

    def _background(
        self, measured: MeasuredPixels, generator: torch.Generator | None
    ) -> Float[Tensor, "R 1"]:
        """What lies behind rendered and measured pixels: black where alpha is not to be trusted, so that only light
        counts."""
        background = choose(self.config.background, self.preset.background)
        grey = torch.zeros_like(measured.alpha)[:, None]
        if background == "random":
            device = grey.device if generator is None else generator.device
            grey = torch.rand(grey.shape, generator=generator, device=device).to(grey)
        elif background == "white":
            grey = grey + 1
        return grey if measured.alpha_trust is None else grey * measured.alpha_trust[:, None]

    def _tells_materials(self, part: ComparedPixels) -> bool:
        return self.seen_by.tells_materials(part.measured.sensor, len(self.guide.endmembers))

    def _guided(self, part: ComparedPixels) -> tuple[MeasuredPixels, Float[Tensor, "K b"]]:
        """A sensor's pixels and the guide's endmembers, both as they are unmixed."""
        sensor = part.measured.sensor
        endmembers = self.seen_by.project(self.guide.endmembers, sensor)
        return self.balance.pixels(part.measured), self.balance.scaled(endmembers, sensor)


def _mean(
    compared: Sequence[ComparedPixels], losses: Callable[[ComparedPixels], dict[str, Tensor]]
) -> dict[str, Tensor]:
    """Mean of each loss over sensors, by their shares; a sensor without some loss adds 0 to it."""
    if len(compared) == 1:
        return losses(compared[0])
    totals: dict[str, Tensor] = {}
    for part in compared:
        for name, loss in losses(part).items():
            totals[name] = totals[name] + part.share * loss if name in totals else part.share * loss
    return totals
