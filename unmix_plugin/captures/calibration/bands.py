"""Which bands of a file make the scene, and where the detector ends: a cheap look at some rows of every view.

Notation: `N` sampled pixels, `B` bands of the file, `c` bands of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.calibration.calibration import Calibration
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

_ROWS_A_VIEW = 12
_MOST_ALIKE = 4
"""Views that are looked at for bands with one value only."""
_MOST_PIXELS = 20000
"""Of all views together."""
_DETECTOR_BITS = (8, 10, 12, 14, 16)
_LEAST_AT_TOP = 10
"""Values that must equal the greatest one before it counts as the detector's end."""
_CROWDING = 20.0
"""Values at the greatest one, against the mean number at each value a little below it."""
_MOST_SATURATED = 0.2
"""Share of sampled values by which a band may be saturated more than bands usually are."""
_MOST_NOISY = 0.5
"""Share of bands that may be left out for their noise."""


@dataclass(frozen=True)
class Sample:
    """Calibrated pixels of all views of a sensor, at all bands of its files."""

    values: Float32[np.ndarray, "N B"]
    saturated: Bool[np.ndarray, "N B"]


@dataclass(frozen=True)
class BandChoice:
    """The bands of one sensor: in order of wavelength, without bad ones."""

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

    def without_repeated(self) -> BandChoice:
        """The choice without bands whose wavelength an earlier band has."""
        repeated = np.ones(len(self.wavelengths_nm), bool)
        repeated[np.unique(self.wavelengths_nm, return_index=True)[1]] = False
        return self.without(repeated, "an earlier band has the same wavelength")

    def require(self, binning: int, where: str) -> None:
        """Refuse to go on without bands.

        Raises:
            CaptureError: fewer bands are left than are averaged into one.
        """
        if len(self.kept) >= binning:
            return
        reasons = "; ".join(sorted(set(self.dropped.values())))
        advice = (
            f"; left out: {reasons}. Check dark and white, or change --drop-bands, --max-noise or --bin-bands"
        )
        raise CaptureError(
            f"{where}: {len(self.kept)} of {len(self.wavelengths_nm)} bands are left, {binning} or more are needed"
            + (advice if reasons else ": lower --bin-bands")
        )


def sampled_rows(height: int) -> list[int]:
    """Rows spread evenly over an image.

    >>> sampled_rows(4), len(sampled_rows(1000))
    ([0, 1, 2, 3], 12)
    """
    count = min(height, _ROWS_A_VIEW)
    return [int((index + 0.5) * height / count) for index in range(count)]


def _places(files: Sequence[SpectralFile], rows: list[int]) -> Iterator[tuple[SpectralFile, int]]:
    for file in files:
        for row in rows:
            yield file, row


def find_saturation(files: Sequence[SpectralFile], bands: np.ndarray) -> tuple[float | None, str]:
    """The stored number at which a detector ends, from a plateau at the greatest one, and the evidence.

    Files of floating-point numbers have none, as they were processed.

    Args:
        files: Of the views of one sensor.
        bands: Indices of bands that may be usable; those with one value in all sampled pixels are left out here.
    """
    dtype = files[0].dtype
    if dtype.kind not in "iu" or dtype.itemsize > 2:
        return None, f"none: the files hold {dtype.name}"
    low = int(np.iinfo(dtype).min)
    counts = np.zeros(np.iinfo(dtype).max - low + 1, dtype=np.int64)
    rows = sampled_rows(files[0].shape[0])
    parts = [file.read(slice(row, row + 1), bands)[0] for file, row in _places(files[:_MOST_ALIKE], rows)]
    bands = bands[np.ptp(np.concatenate(parts), axis=0) > 0]
    if not len(bands):
        return None, "none: every band has one value only"
    for file, row in _places(files, rows):
        stored = file.read(slice(row, row + 1), bands).ravel()
        if file.no_data is not None:
            stored = stored[stored != file.no_data]
        counts += np.bincount(stored.astype(np.int64) - low, minlength=len(counts))
    top = int(np.flatnonzero(counts)[-1]) if counts.any() else 0
    below = counts[max(0, top - max(1, (top + low) // 50)) : top]
    at_top, usual = int(counts[top]), float(below.mean()) if len(below) else 0.0
    number, is_end = top + low, top + low in {2**bits - 1 for bits in _DETECTOR_BITS}
    if at_top >= _LEAST_AT_TOP and (at_top > _CROWDING * usual or is_end):
        return float(number), f"{at_top} sampled values are {number}, none is greater"
    limit = float(np.iinfo(dtype).max)
    return limit, f"no plateau below the end of {dtype.name}; the greatest sampled value is {number}"


def draw_sample(files: Sequence[SpectralFile], calibration: Calibration) -> Sample:
    """Pixels on the sampled rows, evenly spaced along them.

    Args:
        files: Of the views of one sensor.
        calibration: Without band binning; all bands that it keeps are sampled.
    Raises:
        CaptureError: every sampled pixel is missing, or a file can't be read.
    """
    raster = calibration.raster
    rows = sampled_rows(raster.height)
    step = max(1, len(files) * len(rows) * raster.width // _MOST_PIXELS)
    values, saturated = [], []
    for file, row in _places(files, rows):
        part = calibration.rows(file, row, row + 1)
        keep = np.zeros(raster.width, bool)
        keep[row % step :: step] = True
        keep &= ~part.missing[0]
        values.append(part.values[0][keep])
        saturated.append(part.saturated[0][keep])
    sample = Sample(np.concatenate(values), np.concatenate(saturated))
    if not len(sample.values):
        raise CaptureError(
            f"{files[0].path}: no sampled pixel of it and of the other views has a measurement in all bands (NaN, "
            "no-data, or no light on the white panel); check these, or leave bands out with --drop-bands"
        )
    return sample


def drop_found(choice: BandChoice, sample: Sample, max_noise: float) -> tuple[BandChoice, tuple[str, ...]]:
    """Leave out bands that are dead, saturated or noisy in the sample.

    Where most bands are noisy none is left out for it: bands have little in common then, or the whole capture is noisy.

    Args:
        choice: Bands that were kept so far; the sample has these, in their order.
        max_noise: Greatest noise as a share of a band's signal.
    Returns:
        The choice, and what a user should know.
    """
    kept, notes = choice.kept, ()
    shares = sample.saturated.mean(axis=0)
    is_saturated = shares > _MOST_SATURATED + np.median(shares)
    is_dead = np.ptp(sample.values, axis=0) == 0
    noise = np.zeros(len(kept))
    usable = ~sample.saturated[:, ~is_dead].any(axis=1)
    noise[~is_dead] = noise_shares(sample.values[usable][:, ~is_dead])
    is_noisy = noise > max_noise  # false for NaN
    if is_noisy.mean() > _MOST_NOISY:
        notes = (
            f"{is_noisy.sum()} of {len(kept)} bands have noise above {max_noise:.0%} of their signal; all are kept",
        )
        is_noisy[:] = False
    # The first reason that is found counts.
    reasons = {int(kept[i]): f"noise is {noise[i]:.0%} of the signal" for i in np.flatnonzero(is_noisy)}
    many = f"saturated in more than {_MOST_SATURATED:.0%} of sampled pixels"
    reasons |= dict.fromkeys(kept[is_saturated].tolist(), many)
    reasons |= dict.fromkeys(kept[is_dead].tolist(), "dead: the same value in every sampled pixel")
    return BandChoice(choice.wavelengths_nm, reasons | choice.dropped), notes


def noise_shares(values: Float32[np.ndarray, "N B"]) -> Float64[np.ndarray, " B"]:
    """Noise of each band over its signal, from what the other bands can't explain; NaN with too few pixels.

    The residual of a band's regression on all others has variance 1 / (C^-1)_bb, with C the matrix of their second
    moments. Signal is the root mean square of the band.
    Source:
        Bioucas-Dias & Nascimento 2008, HySime, noise estimation.
    """
    count, bands = values.shape
    if count < 4 * bands or bands < 8:
        return np.full(bands, np.nan)
    pixels = values.astype(np.float64)
    size = np.sqrt((pixels**2).mean(axis=0))
    size[size == 0] = 1.0
    pixels = pixels / size
    moments = pixels.T @ pixels / count
    inverse = np.linalg.inv(moments + 1e-9 * np.eye(bands))
    return np.sqrt(1.0 / np.diag(inverse))
