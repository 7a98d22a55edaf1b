"""From stored numbers to values: cropping, dark frame, white reference, exposure, binning.

    value = (stored - dark) / (white - dark) * reflectance of the panel * exposure of white / exposure of view

with what is not given left out. A white may have a dark frame of its own.

Notation: `H x W` pixels and `B` bands of the file, of which `h` rows and `b` bands are read; `n x w` pixels and `c`
bands of the result. Of exposures, `b` is 1, or the bands of a file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from unmix_plugin.captures.calibration.exposures import exposure_of
from unmix_plugin.captures.calibration.references import (
    SensorReferences,
    find_missing,
    refuse_outside,
    stated_values,
)
from unmix_plugin.captures.cube import Cube
from unmix_plugin.captures.poses.lens import Lens
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
        """The raster of images of this size, cropped (first row and column, height and width) and binned. Raises
        ConfigError: the rectangle leaves the image, or nothing is left."""
        top, left, rows, columns = crop or (0, 0, height, width)
        refuse_outside("--crop", (top, left, rows, columns), (height, width))
        if binning < 1 or min(rows, columns) // binning < 2:
            too_few = f"leaves fewer than 2 x 2 of {rows} x {columns} pixels"
            raise ConfigError(f"--bin-pixels {binning} {too_few}; give a smaller number")
        return Raster(top, left, rows // binning, columns // binning, binning)

    @property
    def columns(self) -> slice:
        """Columns of the file."""
        return slice(self.left, self.left + self.width * self.binning)

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of the file."""
        return self.file_rows(0, self.height), self.columns

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
        return values if self.binning == 1 else self._squares(values).mean(axis=(1, 3), dtype=values.dtype)

    def any_in_square(self, marks: np.ndarray) -> np.ndarray:
        """Whether a mark is in each square, (h * n, w * n, ...) to (h, w, ...)."""
        return marks if self.binning == 1 else np.any(self._squares(marks), axis=(1, 3))

    def mostly_in_square(self, marks: np.ndarray) -> np.ndarray:
        """Whether marks fill half of each square or more, (h * n, w * n, ...) to (h, w, ...)."""
        return marks if self.binning == 1 else 2 * self._squares(marks).sum(axis=(1, 3)) >= self.binning**2

    def _squares(self, values: np.ndarray) -> np.ndarray:
        n = self.binning
        return values.reshape(len(values) // n, n, values.shape[1] // n, n, *values.shape[2:])

    def lens(self, lens: Lens) -> Lens:
        """The intrinsics of the result from those of the whole image in the file."""
        scale = 1.0 / self.binning
        return lens.seen_as(self.width, self.height, (float(self.left), float(self.top)), (scale, scale))

    def lens_of_file(self, lens: Lens, height: int, width: int) -> Lens:
        """The inverse of `lens`: intrinsics of the whole image, of this size, from those of the result."""
        n = self.binning
        return lens.seen_as(width, height, (-self.left / n, -self.top / n), (float(n), float(n)))


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
    """Neighbouring kept bands that become one, of which there are whole multiples."""
    references: SensorReferences = SensorReferences()
    saturation: float | None = None
    """Stored number of a saturated pixel; None where none is known."""
    exposure: Float64[np.ndarray, " b"] | None = None
    """Exposure (see `exposure_of`) that values are brought to, one number or one a band of the file: that of the white
    reference, otherwise of the first view; None where exposures are not compared."""

    @property
    def num_bands(self) -> int:
        """Bands of the result."""
        return len(self.bands) // self.bin_bands

    def rows(
        self,
        file: Cube,
        first: int,
        last: int,
        opacity: UInt8[np.ndarray, "h w"] | None = None,
    ) -> CalibratedRows:
        """Rows of the result from a view's file.

        Args:
            file: Of the view.
            first, last: The first row, and that behind the last.
            opacity: Of all pixels of the raster before they are averaged, 255 where opaque, if the file's values are
                not multiplied by it (straight alpha) and should be.
        Raises:
            CaptureError: the file can't be read.
        """
        rows, columns = self.raster.file_rows(first, last), self.raster.columns
        whole = file.read(rows, self.bands)
        stored = whole[:, columns]
        missing = find_missing(whole, file, rows, self.bands)[:, columns]
        saturated = np.zeros(stored.shape, bool) if self.saturation is None else stored >= self.saturation
        values = self._values(file, whole, rows)
        sound = np.isfinite(values.sum(axis=-1)) & ~missing  # one number that is not finite makes the sum so
        if not sound.all():
            values[~sound] = 0.0
            saturated[~sound] = False
        if opacity is not None:
            part = opacity[first * self.raster.binning : last * self.raster.binning, :, None]
            values *= part / np.float32(255.0)
            saturated &= part == 255
        values, saturated = self.raster.averaged(values), self.raster.mostly_in_square(saturated)
        if self.bin_bands > 1:
            values = self._in_bins(values).mean(axis=-1)
            saturated = np.any(self._in_bins(saturated), axis=-1)
        missing = self.raster.any_in_square(~sound)
        values[missing] = 0.0
        return CalibratedRows(values.astype(np.float32, copy=False), saturated, missing)

    def _values(self, file: Cube, whole: np.ndarray, rows: slice) -> Float32[np.ndarray, "h W b"]:
        columns, bands = self.raster.columns, self.bands
        values = stated_values(file, whole, rows, bands)[:, columns]  # a new array, free to be changed
        used = self.references.of(file)
        dark, white = used.dark, used.white
        if dark is not None:
            values -= dark.rows(rows, columns, bands)
        factor, wanted, found = np.ones(1, np.float32), self.exposure, exposure_of(file)
        if file.path in self.references.by_view and white is not None and wanted is not None:
            wanted = exposure_of(white.file)  # its own white reference
        if wanted is not None and found is not None:
            ratio = (wanted / found).astype(np.float32)
            factor = ratio if len(ratio) == 1 else ratio[bands]
        if white is not None:
            assert white.reflectance is not None
            light = white.light(rows, columns, bands)
            # NaN where the white is not above the dark.
            light = np.where(light > 0, light, np.float32(np.nan))
            factor = factor * (white.reflectance[bands].astype(np.float32) / light)
        values *= factor
        return values

    def _in_bins(self, values: np.ndarray) -> np.ndarray:
        """Kept bands by bins, (n, w, b) to (n, w, c, bands of a bin)."""
        return values.reshape(*values.shape[:-1], self.num_bands, self.bin_bands)
