"""Which bands of a file make the scene: in order of wavelength, without bad ones.

Notation: `B` bands of the file, `c` bands of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.captures.calibration.sampling import Sample, noise_shares
from unmix_plugin.errors import CaptureError

MOST_SATURATED = 0.2
"""Share of sampled values by which a band may be saturated more than bands usually are."""
MOST_NOISY = 0.5
"""Share of bands that may be left out for their noise."""
LEAST_WHITE = 0.01
"""Signal of the white reference in a band, as a share of the greatest, below which the band is too dark."""


@dataclass(frozen=True)
class BandChoice:
    """The bands of one sensor."""

    wavelengths_nm: Float64[np.ndarray, " B"]
    """Of all bands of the file."""
    dropped: dict[int, str]
    """Why bands are left out, by index."""

    @property
    def kept(self) -> np.ndarray:
        """Indices of the others, by rising wavelength."""
        order = np.argsort(self.wavelengths_nm, kind="stable")
        return order[[index not in self.dropped for index in order.tolist()]]

    def centers_nm(self, binning: int) -> Float64[np.ndarray, " c"]:
        """Wavelengths of the scene: means over binned bands."""
        kept = self.wavelengths_nm[self.kept]
        count = len(kept) // binning
        return kept[: count * binning].reshape(count, binning).mean(axis=1)

    def without(self, marks: Bool[np.ndarray, " B"], reason: str) -> BandChoice:
        """The choice without some more bands."""
        added = {int(index): reason for index in np.flatnonzero(marks)}
        return BandChoice(self.wavelengths_nm, {**added, **self.dropped})


def repeated_wavelengths(wavelengths_nm: Float64[np.ndarray, " B"]) -> Bool[np.ndarray, " B"]:
    """Bands whose wavelength an earlier band has."""
    _, first = np.unique(wavelengths_nm, return_index=True)
    repeated = np.ones(len(wavelengths_nm), bool)
    repeated[first] = False
    return repeated


def drop_found(choice: BandChoice, sample: Sample, max_noise: float) -> tuple[BandChoice, tuple[str, ...]]:
    """Leave out bands that are dead, saturated or noisy in the sample.

    Where most bands are noisy none is left out for it: bands have little in common then, or the whole capture is noisy.

    Args:
        choice: Bands that were kept so far; the sample has these, in their order.
        max_noise: Greatest noise as a share of a band's signal.
    Returns:
        The choice, and what a user should know.
    """
    kept, bands = choice.kept, len(choice.wavelengths_nm)

    def marks(found: Bool[np.ndarray, " kept"]) -> Bool[np.ndarray, " B"]:
        all_bands = np.zeros(bands, bool)
        all_bands[kept[found]] = True
        return all_bands

    shares = sample.saturated.mean(axis=0)
    is_saturated = shares > MOST_SATURATED + np.median(shares)
    is_dead = np.ptp(sample.values, axis=0) == 0
    is_alive = ~is_dead
    noise = np.zeros(len(kept))
    usable = ~sample.saturated[:, is_alive].any(axis=1)
    noise[is_alive] = noise_shares(sample.values[usable][:, is_alive])
    is_noisy, notes = noise > max_noise, ()  # false for NaN
    if is_noisy.mean() > MOST_NOISY:
        notes = (
            f"{is_noisy.sum()} of {len(kept)} bands have noise above {max_noise:.0%} of their signal; all are kept",
        )
        is_noisy[:] = False
    choice = choice.without(marks(is_dead), "dead: the same value in every sampled pixel")
    choice = choice.without(
        marks(is_saturated), f"saturated in more than {MOST_SATURATED:.0%} of sampled pixels"
    )
    for band in np.flatnonzero(is_noisy):
        one = np.zeros(len(kept), bool)
        one[band] = True
        choice = choice.without(marks(one), f"noise is {noise[band]:.0%} of the signal")
    return choice, notes


def require_bands(choice: BandChoice, binning: int, where: str) -> None:
    """Refuse to go on without bands.

    Raises:
        CaptureError: fewer bands are left than are averaged into one.
    """
    if len(choice.kept) >= binning:
        return
    reasons = "; ".join(sorted(set(choice.dropped.values())))
    advice = (
        f"; left out: {reasons}. Check dark and white, or change --drop-bands, --max-noise or --bin-bands"
    )
    raise CaptureError(
        f"{where}: {len(choice.kept)} of {len(choice.wavelengths_nm)} bands are left, {binning} or more are needed"
        + (advice if reasons else ": lower --bin-bands")
    )
