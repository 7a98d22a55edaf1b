"""Rendered beside measured pixels of a training batch, sensor by sensor, and what their differences cost.

What a sensor sees of the rendered scene is worked out once: its spectra follow from the composited coefficients, times
the gain of the view where gains are learnt, in the mean over the rays of a pixel. All comparisons take it from there.

Notation: `R` pixels of a sensor, `N` rays, `b` channels of a sensor, `B` bands of the scene, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.losses.abundance_guide import AbundanceGuide
from unmix_plugin.losses.terms import LossTerm
from unmix_plugin.operators.compositing import scale_gradient
from unmix_plugin.rendering.renderer import RenderedRays
from unmix_plugin.sensors.batches import MeasuredPixels
from unmix_plugin.sensors.views import BandBalance, SensorViews, ViewGains
from unmix_plugin.settings import LossConfig
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.spectral.evidence import (
    is_blown_out,
    mask_saturated,
    over_background,
    relative_weights,
    solid_evidence,
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
        """What is compared of one sensor's pixels. Spectra lie over the same background; where a saturated value is
        surpassed, nothing is wrong."""
        measured, exposure = part.measured, float(self.config.exposure)
        grey = self._background(measured, generator)
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
        if "abundances" in names and self._tells_materials(part):
            mixtures, informative = self.guide.targets(*self._guided(part))
            weight = (informative[:, None].to(mixtures),)
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
        if self.config.abundances == 0:
            return
        for part in compared:
            if self._tells_materials(part):
                self.guide.update(part.abundances, *self._guided(part))

    def _background(
        self, measured: MeasuredPixels, generator: torch.Generator | None
    ) -> Float[Tensor, "R 1"]:
        """What lies behind rendered and measured pixels: black where alpha is not to be trusted, so that only light
        counts."""
        grey = torch.zeros_like(measured.alpha)[:, None]
        if self.config.background == "random":
            device = grey.device if generator is None else generator.device
            grey = torch.rand(grey.shape, generator=generator, device=device).to(grey)
        elif self.config.background == "white":
            grey = grey + 1
        return grey if measured.alpha_confidence is None else grey * measured.alpha_confidence[:, None]

    def _tells_materials(self, part: ComparedPixels) -> bool:
        return self.seen_by.tells_materials(part.measured.sensor, len(self.guide.endmembers))

    def _guided(self, part: ComparedPixels) -> tuple[MeasuredPixels, Float[Tensor, "K b"]]:
        """A sensor's pixels and the guide's endmembers, both as they are unmixed."""
        sensor = part.measured.sensor
        endmembers = self.seen_by.project(self.guide.endmembers, sensor)
        return self.balance.pixels(part.measured), self.balance.scaled(endmembers, sensor)
