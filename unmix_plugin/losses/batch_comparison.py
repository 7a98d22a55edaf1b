"""Rendered beside measured pixels of a training batch, sensor by sensor.

Notation: `R` pixels of a part of a batch, `B` bands of the scene, `b` channels of a sensor, `K` endmembers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.light.view_gains import ViewGains
from unmix_plugin.losses.abundance_guide import AbundanceGuide
from unmix_plugin.losses.training_losses import LossConfig, compare_pixels, pixel_mean, spectral_losses
from unmix_plugin.presets import AlphaPreset, choose
from unmix_plugin.sensors.band_balance import BandBalance
from unmix_plugin.sensors.batches import SensorPart, mean_over_parts, split_parts
from unmix_plugin.sensors.views import SensorViews
from unmix_plugin.spectral.materials import Coefficients, Materials

_MATTER = 0.01
"""Opacity of pixels that show matter."""


@dataclass(frozen=True)
class BatchComparison:
    """What each sensor of a batch should have seen, and what it saw."""

    config: LossConfig
    preset: AlphaPreset
    seen_by: SensorViews
    balance: BandBalance
    guide: AbundanceGuide
    view_gains: ViewGains | None

    @property
    def num_endmembers(self) -> int:
        """K."""
        return len(self.guide.endmembers)

    def parts(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor], materials: Materials
    ) -> list[SensorPart]:
        """A batch by sensor, each part with the `spectral` (R, b) that its sensor sees."""
        parts = split_parts(outputs, batch, self.seen_by.num_channels)
        for part in parts:
            if part.sensor is not None:
                seen = Coefficients(part.outputs["coefficients"], self.num_endmembers)
                part.outputs["spectral"] = materials.through(seen, self.seen_by.matrix(part.sensor).T)
        if self.view_gains is None:
            return parts
        return [self._with_gain(part, self.view_gains) for part in parts]

    def losses(
        self, parts: list[SensorPart], wanted: set[str], generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """Losses that compare rendered with measured pixels, not yet weighted.

        Args:
            parts: As `parts` gives them.
            wanted: Names of the losses that count.
            generator: Source of random backgrounds.
        """
        return mean_over_parts(parts, lambda part: self._part_losses(part, wanted, generator))

    @staticmethod
    def psnr(parts: list[SensorPart]) -> Float[Tensor, ""]:
        """Of a batch on black, in dB."""

        def error(part: SensorPart) -> dict[str, Tensor]:
            measured = part.batch["spectra"]
            spectra = pixel_mean(part.outputs["spectral"], len(measured))
            return {"psnr": (spectra.detach().clamp(0, 1) - measured).square().mean()}

        return -10 * torch.log10(mean_over_parts(parts, error)["psnr"].clamp(min=1e-12))

    @staticmethod
    def errors_of_poses(
        parts: list[SensorPart],
    ) -> tuple[Int[Tensor, " R"], Float[Tensor, " R"], Bool[Tensor, " R"]]:
        """Of each pixel the nearest knot of its pose, its mean squared error on black, and whether it shows matter in
        the picture or in the scene."""
        found: list[tuple[Tensor, ...]] = []
        for part in parts:
            measured, alpha = part.batch["spectra"], part.batch["alpha"]
            seen, opacities = (
                pixel_mean(part.outputs[name].detach(), len(measured))
                for name in ("spectral", "accumulation")
            )
            knots = part.outputs["knots"].view(len(measured), -1)[:, 0]
            found.append(
                (knots, (seen - measured).square().mean(dim=1), torch.maximum(alpha, opacities) > _MATTER)
            )
        knots, squares, shows_matter = map(torch.cat, zip(*found, strict=True))
        return knots, squares, shows_matter

    def observe(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> None:
        """Note how far margins of abundances are from those of measured spectra."""
        if self.config.abundances == 0:
            return
        for part in split_parts(outputs, batch, self.seen_by.num_channels):
            if self.seen_by.tells_materials(part.sensor, self.num_endmembers):
                abundances = pixel_mean(part.outputs["abundances"], len(part.batch["spectra"]))
                self.guide.observe(abundances, *self._guided(part))

    def _part_losses(
        self, part: SensorPart, wanted: set[str], generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        config, outputs, batch = self.config, part.outputs, part.batch
        measured, exposure = batch["spectra"], choose(config.exposure, 1.0)
        pixels = compare_pixels(
            outputs["spectral"],
            outputs["accumulation"],
            batch,
            choose(config.background, self.preset.background),
            generator,
            exposure,
            config.outlier,
        )
        colours, weights = self.seen_by.rgb_weights(part.sensor), self.balance.of(part.sensor)
        relative = choose(config.relative, 0.0)
        losses = spectral_losses(pixels, exposure * measured, colours, wanted, weights, relative)
        if "abundances" in wanted and self.seen_by.tells_materials(part.sensor, self.num_endmembers):
            abundances = pixel_mean(outputs["abundances"], len(measured))
            losses["abundances"] = self.guide.error(abundances, *self._guided(part))
        return losses

    def _guided(self, part: SensorPart) -> tuple[dict[str, Tensor], Tensor]:
        """A part's pixels and the guide's endmembers (K, b), both as they are unmixed."""
        endmembers = self.seen_by.project(self.guide.endmembers, part.sensor)
        return self.balance.batch(part.batch, part.sensor), self.balance.scaled(endmembers, part.sensor)

    def _with_gain(self, part: SensorPart, view_gains: ViewGains) -> SensorPart:
        terms = self.seen_by.project(view_gains.terms, part.sensor)
        gains = view_gains(part.outputs["cameras"], terms / terms[:1])
        return replace(part, outputs={**part.outputs, "spectral": part.outputs["spectral"] * gains})
