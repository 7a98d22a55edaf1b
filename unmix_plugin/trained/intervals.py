"""Intervals of what is seen: of abundances, spectra, and numbers made of reflectance.

Notation: `B` bands, `K` endmembers, `*places` pixels or points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.intervals import (
    COVERAGE,
    UNDETERMINED,
    Interval,
    propagated_deviation,
    width_factor,
)
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Materials
from unmix_plugin.trained.place_errors import LocalErrors

TOO_FEW_VIEWS = "fewer than two training views measured anything around"
UNDEFINED = "the number is undefined for some spectra that it may be"
Number = Callable[[Float[Tensor, "*places B"]], Tensor]
"""From spectra of what is seen, as if it were opaque, to numbers of them, one or several a place."""


@dataclass(frozen=True)
class SeenPlaces:
    """What a scene shows at some places, and how far it is expected to be off."""

    spectra: Float[Tensor, "*places B"]
    """Radiance of what is seen, as if it were opaque."""
    abundances: Float[Tensor, "*places K"]
    """Summing to 1."""
    opacity: Float[Tensor, "*places"]
    errors: LocalErrors

    def of_abundances(self, coverage: float = COVERAGE) -> tuple[Tensor, Tensor]:
        """Low and high end of abundances; NaN where nothing is, or too few views measured."""
        errors = self.errors
        half = self._where_seen(errors.scene.half_widths(self.abundances, errors.abundances, coverage))
        return (self.abundances - half).clamp(0, 1), (self.abundances + half).clamp(0, 1)

    def of_spectra(self, coverage: float = COVERAGE) -> tuple[Tensor, Tensor]:
        """The same of radiance in each band."""
        common = self.errors.scene
        factor = width_factor(common.spectrum_factors, coverage)
        half = self._where_seen(factor * self.errors.spectra[..., None] * common.band_deviations)
        return (self.spectra - half).clamp(min=0), self.spectra + half

    def of_number(self, number: Number, coverage: float = COVERAGE) -> tuple[Tensor, Tensor]:
        """The same of a number made of the spectrum; NaN also where it is undefined for spectra that are likely."""
        common, spectra = self.errors.scene, self.spectra
        of_shape = propagated_deviation(number, spectra, common.directions, self.errors.shape)
        brighter = 1 + self.errors.brightness[..., None]
        of_brightness = (number(spectra * brighter) - number(spectra * (2 - brighter))) / 2
        half = (
            (width_factor(common.shape_factors, coverage) * of_shape).square()
            + (width_factor(common.brightness_factors, coverage) * of_brightness).square()
        ).sqrt()
        values = number(spectra)
        half = (
            self._where_seen(half)
            if half.dim() > self.opacity.dim()
            else half.where(self._is_seen, torch.nan)
        )
        return values - half, values + half

    @property
    def _is_seen(self) -> Tensor:
        return self.opacity >= OCCUPIED_ACCUMULATION

    def _where_seen(self, half: Float[Tensor, "*places n"]) -> Float[Tensor, "*places n"]:
        return half.where(self._is_seen[..., None], torch.nan)


def reflectance_number(materials: Materials, score: Callable[[Tensor], Tensor] | None = None) -> Number:
    """Reflectance of spectra that are opaque, or a number made of it."""

    def number(spectra: Float[Tensor, "*places B"]) -> Tensor:
        reflectance = materials.reflectance_of(spectra, torch.ones_like(spectra[..., 0]))
        return reflectance if score is None else score(reflectance)

    return number


def as_interval(name: str, ends: tuple[Tensor, Tensor], errors: LocalErrors, coverage: float) -> Interval:
    """Ends of an output at one place as an interval, which says why where it is not determined."""
    low, high = (one.detach().double().cpu().numpy() for one in ends)
    reason = ""
    if not bool(errors.spectra.isfinite().all()):
        reason = TOO_FEW_VIEWS
    elif name.startswith("abundance") and not bool(ends[0].isfinite().all()):
        reason = UNDETERMINED
    elif not bool(ends[0].isfinite().any()):
        reason = UNDEFINED
    return Interval(low, high, coverage, reason)


def no_interval(name: str) -> ConfigError:
    """The error that nothing has an interval of this name."""
    return ConfigError(
        f"there is no interval of {name!r}; there are those of abundances, abundance:NAME, spectral, band:650nm, "
        "reflectance, index: and absorption:"
    )
