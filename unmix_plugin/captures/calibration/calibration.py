"""From stored numbers to values: cropping, dark frame, white reference, exposure, binning; and the samples of views, as
they are stored and once calibrated, that all decisions on values are taken from.

    value = (stored - dark) / (white - dark) * reflectance of the panel * exposure of white / exposure of view

with what is not given left out. A white may have a dark frame of its own.

Notation: `H x W` pixels and `B` bands of the file, of which `h` rows and `b` bands are read; `n x w` pixels and `c`
bands of the result. Of exposures, `b` is 1, or the bands of a file. Of samples, `P` and `N` are pixels, `W` those of a
row, and `K` stored numbers that a type can hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8

from unmix_plugin.captures.calibration.references import (
    Reference,
    SensorReferences,
    refuse_outside,
    stated_values,
)
from unmix_plugin.captures.cube import BandIndex, CaptureView, Cube, find_missing
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.spoilt import ViewPixels
from unmix_plugin.errors import ConfigError

BRIGHT_PERCENTILE = 99.9
_ROWS_A_VIEW = 12
_MOST_ALIKE = 4
"""Views that are looked at for bands with one value only."""
_MOST_PIXELS = 20000
"""Of all views together."""
_BORDER_SHARE = 0.02
"""Width of the border that a background is judged by, as a share of the view's."""
_MOST_BORDER_PIXELS = 20000
_BACKDROP_ROWS = 96
"""Of a view in which a backdrop is looked for."""
_LEAST_UNNAMED, _UNNAMED_SHARE = 8, 0.001
"""Sampled pixels, and share of them, that a no-data value must have which no file names."""
_BELOW_NOISE, _OF_BRIGHT = 10.0, 0.01
"""How much further below 0 than any other number it lies, and at least, as a share of bright numbers: noise around
black has one number in every band, too, where bands are few."""


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
    """Exposure (`Cube.total_exposure`) that values are brought to, one number or one a band of the file: that of the
    white reference, otherwise of the first view; None where exposures are not compared."""

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
        values = stated_values(file, whole, rows, self.bands)[:, columns]  # a new array, free to be changed
        used = self.references.of(file)
        dark, white = used.dark, used.white
        if dark is not None:
            values -= dark.rows(rows, columns, self.bands)
        factor, wanted, found = np.ones(1, np.float32), self.exposure, file.total_exposure()
        if file.path in self.references.by_view and white is not None and wanted is not None:
            wanted = white.file.total_exposure()  # its own white reference
        if wanted is not None and found is not None:
            ratio = (wanted / found).astype(np.float32)
            factor = ratio if len(ratio) == 1 else ratio[self.bands]
        if white is not None:
            assert white.reflectance is not None
            light = white.light(rows, columns, self.bands)
            # NaN where the white is not above the dark.
            light = np.where(light > 0, light, np.float32(np.nan))
            factor = factor * (white.reflectance[self.bands].astype(np.float32) / light)
        values *= factor
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
            in_bins = (*values.shape[:-1], self.num_bands, self.bin_bands)
            values = values.reshape(in_bins).mean(axis=-1)
            saturated = np.any(saturated.reshape(in_bins), axis=-1)
        missing = self.raster.any_in_square(~sound)
        values[missing] = 0.0
        return CalibratedRows(values.astype(np.float32, copy=False), saturated, missing)


# Samples: a few rows of every view.


def sampled_rows(height: int) -> list[int]:
    """Rows spread evenly over an image."""
    count = min(height, _ROWS_A_VIEW)
    return [int((index + 0.5) * height / count) for index in range(count)]


# As stored: where does the detector end, and can values be reflectances?


@dataclass(frozen=True)
class StoredCounts:
    """How often each stored number is there in sampled rows of all views, in bands that have more than one value."""

    dtype: np.dtype
    lowest: int
    """Number of the first count."""
    counts: Int64[np.ndarray, " K"]
    num_pixels: int
    """With a measurement, in the first views."""
    num_bands: int
    """With more than one value in these."""
    are_whole: bool = True
    """Whether all numbers are whole ones that are counted; nothing was counted otherwise."""

    @property
    def is_wide(self) -> bool:
        """Whether the type holds more than a detector gives: its numbers are of one, or processed."""
        return self.dtype.kind not in "iu" or self.dtype.itemsize > 2

    @property
    def highest(self) -> int:
        """Number of the last count."""
        return self.lowest + len(self.counts) - 1


def count_stored(files: Sequence[Cube], bands: np.ndarray) -> StoredCounts:
    """Count the stored numbers of these bands; of wide types, those of 16 bits."""
    dtype = files[0].dtype
    is_wide = dtype.kind not in "iu" or dtype.itemsize > 2
    limits = np.iinfo(np.uint16 if is_wide else dtype)
    low, high = int(limits.min), int(limits.max)
    counts = np.zeros(high - low + 1, dtype=np.int64)
    rows = sampled_rows(files[0].shape[0])
    known = np.concatenate(
        [_stored_pixels(file, row, bands) for file, row in product(files[:_MOST_ALIKE], rows)]
    )
    varying = bands[np.ptp(known, axis=0) > 0] if len(known) else bands[:0]
    for file, row in product(files, rows) if len(varying) else ():
        stored = _stored_pixels(file, row, varying).ravel()
        stored = stored.astype(np.float64) if is_wide else stored  # half precision has no 65,535
        if is_wide and not ((stored >= 0) & (stored <= high) & (stored % 1 == 0)).all():
            return StoredCounts(dtype, low, counts, len(known), len(varying), are_whole=False)
        counts += np.bincount(stored.astype(np.int64) - low, minlength=len(counts))
    return StoredCounts(dtype, low, counts, len(known), len(varying))


def bright_values(files: Sequence[Cube], bands: np.ndarray) -> list[float]:
    """Values of bright pixels of some files at some bands, as these state them, before any reference."""
    bright = []
    for index in np.unique(np.linspace(0, len(files) - 1, min(len(files), _MOST_ALIKE + 1)).astype(int)):
        file = files[index]
        parts = [
            (_stored_pixels(file, row, bands)[None], slice(row, row + 1))
            for row in sampled_rows(file.shape[0])
        ]
        values = np.concatenate([stated_values(file, *part, bands).ravel() for part in parts])
        bright += [float(np.percentile(values, BRIGHT_PERCENTILE))] if len(values) else []
    return bright


def find_unnamed_no_data(files: Sequence[Cube], bands: np.ndarray) -> float | None:
    """The negative number that many sampled pixels have in every band, as no light leaves one, and that the files don't
    name as their no-data value; None without one, or of one band."""
    if len(bands) < 2 or files[0].dtype.kind == "u":
        return None
    rows = sampled_rows(files[0].shape[0])
    stored = np.concatenate(
        [_stored_pixels(file, row, bands) for file, row in product(files[:_MOST_ALIKE], rows)]
    )
    number = float(stored.min(initial=0))
    is_number = stored == number
    others = stored[~is_number] if number < 0 else stored[:0]
    if len(others) == 0 or is_number.all(axis=1).sum() < max(_LEAST_UNNAMED, _UNNAMED_SHARE * len(stored)):
        return None
    is_below_noise = number < _BELOW_NOISE * float(others.min(initial=0))
    return (
        number if is_below_noise and -number > _OF_BRIGHT * np.percentile(others, BRIGHT_PERCENTILE) else None
    )


def _stored_pixels(file: Cube, row: int, bands: BandIndex = slice(None)) -> Shaped[np.ndarray, "P b"]:
    """Stored numbers of the pixels of a row that have a measurement."""
    stored = file.read(slice(row, row + 1), bands)
    return stored[~find_missing(stored, file, slice(row, row + 1), bands)]


@dataclass(frozen=True)
class WhiteSample:
    """Some rows of the panel of a white reference."""

    stored: Shaped[np.ndarray, "n columns B"]
    """0 in bands that are not measured."""
    is_measured: Bool[np.ndarray, "n columns"]

    @staticmethod
    def of(white: Reference) -> WhiteSample:
        """Rows of its file, or of the rectangle that shows it."""
        top, left, height, width = white.rectangle or (0, 0, *white.file.shape[:2])
        columns, read, measured = slice(left, left + width), [], []
        for row in sampled_rows(height):
            line = slice(top + row, top + row + 1)
            numbers, bands = white.file.read(line), white.measured
            measured.append(~find_missing(numbers[..., bands], white.file, line, bands)[:, columns])
            numbers[..., np.setdiff1d(np.arange(numbers.shape[-1]), bands)] = 0
            read.append(numbers[:, columns])
        return WhiteSample(np.concatenate(read), np.concatenate(measured))


# As calibrated: pixels of all views, of their borders, and of views that may show a backdrop.
def draw_pixels(views: Sequence[CaptureView], calibration: Calibration) -> list[ViewPixels]:
    """Pixels on the sampled rows of each view, evenly spaced along them, at all bands that the calibration keeps."""
    raster = calibration.raster
    rows = sampled_rows(raster.height)
    step = max(1, len(views) * len(rows) * raster.width // _MOST_PIXELS)
    drawn = []
    for view in views:
        parts = [calibration.rows(view.cube, row, row + 1) for row in rows]
        kept = np.zeros((len(rows), raster.width), bool)
        for index, row in enumerate(rows):
            kept[index, row % step :: step] = True
        kept &= ~np.concatenate([part.missing for part in parts])
        values, saturated = (
            np.concatenate([getattr(part, name) for part in parts])[kept] for name in ("values", "saturated")
        )
        drawn.append(ViewPixels(view.name, values, saturated))
    return drawn


def border_pixels(
    views: Sequence[CaptureView], calibration: Calibration, scale: float
) -> Float32[np.ndarray, "P c"]:
    """Pixels at the border of the views, in [0, 1]; saturated ones are 1, missing ones are left out."""
    raster = calibration.raster
    width = max(1, round(_BORDER_SHARE * raster.width))
    columns = np.r_[0:width, raster.width - width : raster.width]
    rows = sorted({0, raster.height - 1, *sampled_rows(raster.height)})
    step = max(1, len(views) * (2 * raster.width + 2 * width * len(rows)) // _MOST_BORDER_PIXELS)
    border = []
    for view in views:
        for row in rows:
            part = calibration.rows(view.cube, row, row + 1)
            shown = np.arange(raster.width) if row in (0, raster.height - 1) else columns
            shown = shown[row % step :: step]
            values = np.where(part.saturated[0, shown], np.float32(scale), part.values[0, shown])
            border.append(values[~part.missing[0, shown]])
    return np.clip(np.concatenate(border) / np.float32(scale), 0.0, 1.0)


def rows_behind(
    view: CaptureView, calibration: Calibration, scale: float
) -> tuple[Float32[np.ndarray, "n W c"], Bool[np.ndarray, "n W"]]:
    """Rows of a view that may show a backdrop, in [0, 1], and which of their pixels were measured."""
    height = calibration.raster.height
    rows = np.unique(np.linspace(0, height - 1, min(height, _BACKDROP_ROWS)).astype(int))
    parts = [calibration.rows(view.cube, row, row + 1) for row in rows.tolist()]
    values = np.concatenate([np.where(part.saturated, np.float32(scale), part.values) for part in parts])
    seen = np.clip(values / np.float32(scale), 0.0, 1.0)
    return seen, ~np.concatenate([part.missing for part in parts])
