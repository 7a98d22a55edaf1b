"""From stored numbers to values: cropping, dark frame, white reference, exposure, binning.

    value = (stored - dark) / (white - dark) * reflectance of the panel * exposure of white / exposure of view

with what is not given left out.

Notation: `H x W` pixels and `B` bands of the file, of which `h` rows and `b` bands are read; `n x w` pixels and `c`
bands of the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.captures.calibration.references import Reference, WhiteReference, linear
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class Raster:
    """A rectangle of the file's pixels, averaged in squares; what does not fill a square at its end is left out."""

    top: int
    left: int
    height: int
    """Rows of the result."""
    width: int
    """Columns of the result."""
    binning: int
    """Side of a square in pixels of the file."""

    @staticmethod
    def of(height: int, width: int, crop: tuple[int, int, int, int] | None, binning: int) -> Raster:
        """The raster of images of this size.

        Args:
            height, width: Of the file.
            crop: First row and column, height and width; None keeps all.
            binning: At least 1.
        Raises:
            ConfigError: the rectangle leaves the image, or nothing is left.
        """
        top, left, rows, columns = (0, 0, height, width) if crop is None else crop
        if min(top, left) < 0 or min(rows, columns) < 1 or top + rows > height or left + columns > width:
            raise ConfigError(
                f"--crop {top} {left} {rows} {columns} (row, column, height, width) leaves the image of {height} rows "
                f"and {width} columns"
            )
        if binning < 1 or min(rows, columns) // binning < 2:
            raise ConfigError(
                f"--bin-pixels {binning} leaves fewer than 2 x 2 of {rows} x {columns} pixels; give a smaller number"
            )
        return Raster(top, left, rows // binning, columns // binning, binning)

    @property
    def columns(self) -> slice:
        """Columns of the file."""
        return slice(self.left, self.left + self.width * self.binning)

    def file_rows(self, first: int, last: int) -> slice:
        """Rows of the file that rows `first` to `last` (excluded) of the result are made of."""
        return slice(self.top + first * self.binning, self.top + last * self.binning)

    def blocks(self, bands: int, most_values: int) -> Iterator[tuple[int, int]]:
        """First and last row (excluded) of parts of the result that are read from at most `most_values` values."""
        step = max(1, most_values // (self.width * self.binning * self.binning * bands))
        for first in range(0, self.height, step):
            yield first, min(first + step, self.height)

    def averaged(self, values: np.ndarray) -> np.ndarray:
        """Means over squares, (h * n, w * n, ...) to (h, w, ...)."""
        if self.binning == 1:
            return values
        n = self.binning
        squares = values.reshape(len(values) // n, n, values.shape[1] // n, n, *values.shape[2:])
        return squares.mean(axis=(1, 3), dtype=values.dtype)

    def any_in_square(self, marks: np.ndarray) -> np.ndarray:
        """Whether a mark is in each square, (h * n, w * n, ...) to (h, w, ...)."""
        if self.binning == 1:
            return marks
        n = self.binning
        return np.any(
            marks.reshape(len(marks) // n, n, marks.shape[1] // n, n, *marks.shape[2:]), axis=(1, 3)
        )

    def lens(self, lens: Lens) -> Lens:
        """The intrinsics of the result from those of the whole image in the file."""
        n = self.binning
        return replace(
            lens,
            width=self.width,
            height=self.height,
            focal_px=(lens.focal_px[0] / n, lens.focal_px[1] / n),
            center_px=((lens.center_px[0] - self.left) / n, (lens.center_px[1] - self.top) / n),
        )

    def lens_of_file(self, lens: Lens, height: int, width: int) -> Lens:
        """The inverse of `lens`: intrinsics of the whole image, of this size, from those of the result."""
        n = self.binning
        return replace(
            lens,
            width=width,
            height=height,
            focal_px=(lens.focal_px[0] * n, lens.focal_px[1] * n),
            center_px=(lens.center_px[0] * n + self.left, lens.center_px[1] * n + self.top),
        )


@dataclass(frozen=True)
class CalibratedRows:
    """Some rows of a view."""

    values: Float32[np.ndarray, "n w c"]
    """Reflectance or radiance, finite; 0 where pixels are missing."""
    saturated: Bool[np.ndarray, "n w c"]
    """At the detector's top before calibration."""
    missing: Bool[np.ndarray, "n w"]
    """Pixels without a measurement."""


@dataclass(frozen=True)
class Calibration:
    """How the files of one sensor are calibrated."""

    raster: Raster
    bands: np.ndarray
    """Indices of the kept bands in the file, in the order of the result."""
    bin_bands: int = 1
    """Neighbouring kept bands that become one; what does not fill one at the end is left out."""
    dark: Reference | None = None
    white: WhiteReference | None = None
    saturation: float | None = None
    """Stored number of a saturated pixel; None where none is known."""
    gain: float = 1.0
    """Factor on all values, such as one over the scale factor of the files."""
    exposure: float | None = None
    """Exposure time times gain that values are brought to: that of the white reference, otherwise of the first view;
    None where the files do not say."""

    @property
    def num_bands(self) -> int:
        """Bands of the result."""
        return len(self.bands) // self.bin_bands

    def rows(self, file: SpectralFile, first: int, last: int) -> CalibratedRows:
        """Rows `first` to `last` (excluded) of the result from a view's file.

        Raises:
            CaptureError: the file can't be read.
        """
        rows, columns = self.raster.file_rows(first, last), self.raster.columns
        whole = file.read(rows, self.bands)
        stored = whole[:, columns]
        missing = find_missing(stored, file.no_data)
        saturated = np.zeros(stored.shape, bool) if self.saturation is None else stored >= self.saturation
        values = self._values(file, whole, rows)
        sound = np.isfinite(values.sum(axis=-1)) & ~missing  # one number that is not finite makes the sum so
        if not sound.all():
            values[~sound] = 0.0
            saturated[~sound] = False
        values, saturated = self.raster.averaged(values), self.raster.any_in_square(saturated)
        if self.bin_bands > 1:
            values = self._in_bins(values).mean(axis=-1)
            saturated = np.any(self._in_bins(saturated), axis=-1)
        return CalibratedRows(
            values.astype(np.float32, copy=False), saturated, self.raster.any_in_square(~sound)
        )

    def _values(self, file: SpectralFile, whole: np.ndarray, rows: slice) -> Float32[np.ndarray, "h W b"]:
        columns, bands = self.raster.columns, self.bands
        values = linear(file, whole, rows)[:, columns]  # a new array, free to be changed
        exposure = exposure_of(file)
        if exposure is None or self.exposure is None:
            factor = np.float32(self.gain)
        else:
            factor = np.float32(self.gain * (self.exposure / exposure))
        dark = None if self.dark is None else self.dark.rows(rows, columns, bands)
        if dark is not None:
            values -= dark
        if self.white is not None:
            light = self.white.reference.rows(rows, columns, bands)
            if dark is not None:
                light = light - dark
            # NaN where the white is not above the dark.
            light = np.where(light > 0, light, np.float32(np.nan))
            factor = factor * (self.white.reflectance[bands].astype(np.float32) / light)
        values *= factor
        return values

    def _in_bins(self, values: np.ndarray) -> np.ndarray:
        """Kept bands by bins, (n, w, b) to (n, w, c, bands of a bin)."""
        used = values[..., : self.num_bands * self.bin_bands]
        return used.reshape(*values.shape[:-1], self.num_bands, self.bin_bands)


def find_missing(stored: np.ndarray, no_data: float | None) -> Bool[np.ndarray, "h W"]:
    """Pixels without a measurement: no number in some band, or the file's no-data value.

    A no-data value of 0 is also what a dark pixel may read in a band, so that all bands must have it.
    """
    missing = np.zeros(stored.shape[:2], bool)
    if stored.dtype.kind == "f":
        missing |= ~np.isfinite(stored).all(axis=-1)
    if no_data is not None and np.isfinite(no_data):
        limits = None if stored.dtype.kind == "f" else np.iinfo(stored.dtype)
        if limits is None or (limits.min <= no_data <= limits.max and no_data == int(no_data)):
            same = stored == stored.dtype.type(no_data)
            missing |= same.all(axis=-1) if no_data == 0 else same.any(axis=-1)
    return missing


def exposure_of(file: SpectralFile) -> float | None:
    """Exposure time times gain, where the file has the time."""
    exposure, gain = file.metadata.get("exposure_s"), file.metadata.get("gain", 1.0)
    if not isinstance(exposure, int | float) or not isinstance(gain, int | float):
        return None
    return float(exposure * gain) if exposure > 0 and gain > 0 else None
