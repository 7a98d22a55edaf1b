"""From stored numbers to values: cropping, dark frame, white reference, exposure, binning.

    value = (stored - dark) / (white - dark) * reflectance of the panel * exposure of white / exposure of view

with what is not given left out.

Notation: `H x W` pixels and `B` bands of the file, of which `h` rows and `b` bands are read; `n x w` pixels and `c`
bands of the result.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.camera_tags import radiometric_model
from unmix_plugin.captures.exposure import exposure_of
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.spectral_file import BandIndex, SpectralFile, require_comparable
from unmix_plugin.errors import CaptureError, ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.srgb import decode_srgb
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv

_BLOCK_VALUES = 1 << 22
"""Values read together."""
_PATTERN_BLOCK_PX = 8
_MOST_PATTERN = 4.0
"""Ratio of the variance of blocks' means to that which noise alone would leave, above which rows differ."""


def is_srgb(file: SpectralFile) -> bool:
    """Whether the file is a picture for people."""
    return file.metadata.get("encoding") == "sRGB"


def stated_values(
    file: SpectralFile, stored: np.ndarray, rows: slice, bands: BandIndex = slice(None)
) -> Float32[np.ndarray, "h W b"]:
    """Values of some whole rows: pictures decoded, and the calibration applied that the file carries itself.

    Args:
        stored: Numbers (h, W, b) that were read of these rows and bands.
    """
    if is_srgb(file):
        top = np.iinfo(stored.dtype).max
        return decode_srgb(np.arange(top + 1) / top).astype(np.float32)[stored]
    model = radiometric_model(file)
    if model is not None:
        return model.apply(stored.astype(np.float32), rows)
    return stored.astype(np.float32) if file.linear is None else file.linear.apply(stored, bands)


def _measured(
    file: SpectralFile, rows: slice, bands: BandIndex = slice(None)
) -> Float32[np.ndarray, "h W b"]:
    """Values of some rows, NaN where nothing was measured."""
    stored = file.read(rows, bands)
    values = stated_values(file, stored, rows, bands)
    values[find_missing(stored, file)] = np.nan
    return values


@dataclass(frozen=True)
class Reference:
    """A measured reference, brought to the columns of the cubes."""

    file: SpectralFile
    what: str
    """dark frame or white reference, for messages."""
    mean: Float32[np.ndarray, "1 columns B"]
    """Mean over its lines; one column where it stands for all."""
    is_per_pixel: bool
    """Whether each pixel has its own value, read from the file when needed."""
    how: str
    """How it is used, for people."""
    reflectance: Float64[np.ndarray, " B"] | None = None
    """Of a white panel at every band of the file, above 0."""
    is_view: bool = False
    """Whether the file is a view that shows it."""

    @property
    def stored_mean(self) -> Float64[np.ndarray, "1 columns B"]:
        """The mean in numbers as the file stores them."""
        linear = self.file.linear
        if linear is None or is_srgb(self.file):
            return self.mean.astype(np.float64)
        return (self.mean - linear.offsets) / linear.gains

    def rows(self, rows: slice, columns: slice, bands: np.ndarray) -> Float32[np.ndarray, "h columns b"]:
        """Values at some rows and columns of the cubes; axes of length 1 where one value stands for all."""
        if self.is_per_pixel:
            return _measured(self.file, rows, bands)[:, columns]
        mean = self.mean[:, :, bands]
        return mean if mean.shape[1] == 1 else mean[:, columns]

    def signal(self, dark: Reference | None) -> Float64[np.ndarray, " B"]:
        """Mean counts above dark at each band of the file."""
        own = self.mean.astype(np.float64).mean(axis=(0, 1))
        return own if dark is None else own - dark.signal(None)


def open_reference(file: SpectralFile, what: str, cube: SpectralFile) -> Reference:
    """A reference for the cubes of one sensor.

    A file with as many rows and columns as the cubes is used pixel by pixel if its rows differ by more than noise (a
    camera that takes whole images), and by the mean of its lines otherwise (a line camera). Pixels without a
    measurement are left out of it, where 0 in a dark frame is one whatever its header says. Raises CaptureError: other
    bands than the cubes, other units, or a column without a measurement.
    """
    if (
        what == "dark frame" and file.no_data == 0
    ):  # software writes one no-data value into all headers of a capture
        file = replace(file, no_data=None)
    height, width, bands = file.shape
    if bands != cube.shape[2]:
        raise CaptureError(
            f"{file.path}: the {what} has {bands} bands, the cubes have {cube.shape[2]} ({cube.path}); expected as many"
        )
    require_comparable(file, cube)
    mean, pattern = _column_means(file)
    if not np.isfinite(mean).all():
        raise CaptureError(
            f"{file.path}: the {what} has columns without a measurement (NaN, infinite or no-data); take it again"
        )
    if (height, width) == cube.shape[:2] and height > 1 and pattern > _MOST_PATTERN:
        how = f"pixel by pixel, as its rows differ ({pattern:.1f} times what noise explains)"
        return Reference(file, what, mean, True, how)
    lines = f"mean of {height} line{'s' if height > 1 else ''}"
    if width == cube.shape[1]:
        return Reference(file, what, mean, False, f"{lines}, column by column")
    ratio = max(width, cube.shape[1]) / min(width, cube.shape[1])
    wider = f"it is {width} columns wide and the cubes {cube.shape[1]}"
    if ratio == int(ratio) and width > 1:
        how = f"{lines}, interpolated along the line: {wider}, as with another binning"
        return Reference(file, what, _stretched(mean, cube.shape[1]), False, how)
    how = f"{lines} and of all columns: {wider}, so its columns can't be those of the cubes"
    return Reference(file, what, mean.mean(axis=1, keepdims=True), False, how)


def panel_reference(cube: SpectralFile, rectangle: tuple[int, int, int, int], view: str) -> Reference:
    """The mean of a rectangle of a view as the white reference of all.

    Args:
        rectangle: First row and column, height and width.
    Raises:
        CaptureError: nothing was measured there.
        ConfigError: it leaves the image.
    """
    top, left, height, width = rectangle
    _refuse_outside(f"--white-rectangle {view}", rectangle, cube.shape[:2])
    lines = slice(top, top + height)
    values = _measured(cube, lines)[:, left : left + width].astype(np.float64)
    if np.isnan(values[..., 0]).all():
        raise CaptureError(f"{cube.path}: no pixel of --white-rectangle holds a measurement; name another")
    mean = np.nanmean(values, axis=(0, 1), keepdims=True).astype(np.float32)
    how = f"mean of {height} x {width} pixels from row {top} and column {left} of view {view}"
    return Reference(cube, "white reference", mean, False, how, is_view=True)


def _refuse_outside(what: str, rectangle: tuple[int, int, int, int], size: tuple[int, int]) -> None:
    top, left, height, width = rectangle
    is_empty = min(top, left) < 0 or min(height, width) < 1
    if is_empty or top + height > size[0] or left + width > size[1]:
        where = f"{what} {top} {left} {height} {width} (row, column, height, width)"
        raise ConfigError(f"{where} leaves the image of {size[0]} rows and {size[1]} columns")


def _column_means(file: SpectralFile) -> tuple[Float32[np.ndarray, "1 W B"], float]:
    """Mean over lines, and how much more than noise the rows differ, judged on a few bands."""
    height, width, bands = file.shape
    total, count = np.zeros((width, bands)), np.zeros((width, bands))
    missing = np.zeros((height, width), bool)
    step = max(1, _BLOCK_VALUES // (width * bands))
    for first in range(0, height, step):
        lines = slice(first, min(first + step, height))
        stored = file.read(lines)
        missing[lines] = find_missing(stored, file)
        values = stated_values(file, stored, lines)
        values[missing[lines]] = np.nan
        total += np.nansum(values, axis=0, dtype=np.float64)
        count += np.isfinite(values).sum(axis=0)
    mean = total / np.where(count > 0, count, np.nan)
    judged = np.unique(np.linspace(0, bands - 1, 5).astype(int))
    every, patterns = slice(0, height), []
    for band in judged:
        index = np.array([band])
        values = stated_values(file, file.read(every, index), every, index)[..., 0]
        patterns.append(_pattern(np.nan_to_num(np.where(missing, 0.0, values - mean[:, band]))))
    return mean[None].astype(np.float32), float(np.median(patterns))


def _pattern(residual: Float64[np.ndarray, "H W"]) -> float:
    """Variance of the means of square blocks, as a multiple of what pixels that differ by noise alone would give."""
    side = _PATTERN_BLOCK_PX
    height, width = (length // side * side for length in residual.shape)
    variance = residual.var()
    if height == 0 or width == 0 or not variance > 0:
        return 0.0
    blocks = residual[:height, :width].reshape(height // side, side, width // side, side).mean(axis=(1, 3))
    return float(blocks.var() * side * side / variance)


def _stretched(mean: Float32[np.ndarray, "1 V B"], width: int) -> Float32[np.ndarray, "1 W B"]:
    """Linear interpolation along the line; both lines span the same field."""
    found = mean.shape[1]
    at = (np.arange(width) + 0.5) * found / width - 0.5
    if found > width:  # finer than the cubes: average what falls into each of their pixels
        return mean.reshape(1, width, found // width, -1).mean(axis=2)
    low = np.clip(np.floor(at).astype(int), 0, found - 1)
    high = np.minimum(low + 1, found - 1)
    part = np.clip(at - low, 0.0, 1.0)[None, :, None].astype(np.float32)
    return mean[:, low] * (1 - part) + mean[:, high] * part


def white_reference(
    reference: Reference, dark: Reference | None, reflectance: str, wavelengths_nm: Float64[np.ndarray, " B"]
) -> Reference:
    """A white panel that is brighter than the dark, with its reflectance.

    Args:
        reflectance: Of the panel: a number, or a CSV file (wavelength,reflectance).
        wavelengths_nm: Of all bands of the file.
    Raises:
        CaptureError: it is not brighter.
        ConfigError: the reflectance is neither, or not above 0 and at most 1.5.
        SpectrumError: the CSV file is damaged or does not reach all bands.
    """
    light = reference.signal(dark)
    if not (light > 0).mean() > 0.5:
        dark_name = "0" if dark is None else f"the dark frame {dark.file.path}"
        raise CaptureError(
            f"{reference.file.path}: the white reference is not brighter than {dark_name} in "
            f"{(light <= 0).mean():.0%} of its bands; are white and dark swapped?"
        )
    try:
        values = np.full(len(wavelengths_nm), float(reflectance))
    except ValueError:
        values = _read_reflectance(reflectance, wavelengths_nm)
    if not (np.isfinite(values).all() and values.min() > 0.0 and values.max() <= 1.5):
        raise ConfigError(
            f"--white-reflectance {reflectance} is {values.min():g} to {values.max():g}; expected a reflectance above "
            "0, such as 0.99 (per cent are divided by 100 first)"
        )
    return replace(reference, reflectance=values)


def _read_reflectance(path: str, wavelengths_nm: Float64[np.ndarray, " B"]) -> Float64[np.ndarray, " B"]:
    if not Path(path).is_file():
        raise ConfigError(f"--white-reflectance {path}: expected a number such as 0.99, or a CSV file")
    table = read_spectra_csv(Path(path))
    if len(table.names) != 1:
        raise SpectrumError(f"{path}: expected one column beside 'wavelength'; found {len(table.names)}")
    distinct, back = np.unique(wavelengths_nm, return_inverse=True)
    return table.resampled(Bands(distinct)).spectra[0][back]


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
        _refuse_outside("--crop", (top, left, rows, columns), (height, width))
        if binning < 1 or min(rows, columns) // binning < 2:
            left = f"leaves fewer than 2 x 2 of {rows} x {columns} pixels"
            raise ConfigError(f"--bin-pixels {binning} {left}; give a smaller number")
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
        return values if self.binning == 1 else self._squares(values).mean(axis=(1, 3), dtype=values.dtype)

    def any_in_square(self, marks: np.ndarray) -> np.ndarray:
        """Whether a mark is in each square, (h * n, w * n, ...) to (h, w, ...)."""
        return marks if self.binning == 1 else np.any(self._squares(marks), axis=(1, 3))

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
    """Neighbouring kept bands that become one; what does not fill one at the end is left out."""
    dark: Reference | None = None
    white: Reference | None = None
    saturation: float | None = None
    """Stored number of a saturated pixel; None where none is known."""
    exposure: Float64[np.ndarray, " b"] | None = None
    """Exposure time times gain that values are brought to, one number or one a band of the file: that of the white
    reference, otherwise of the first view; None where exposures are not compared."""
    own: Mapping[Path, tuple[Reference | None, Reference | None]] = field(default_factory=dict)
    """Dark and white of single views, by the path of their cube; they go before the common ones."""

    @property
    def num_bands(self) -> int:
        """Bands of the result."""
        return len(self.bands) // self.bin_bands

    def rows(self, file: SpectralFile, first: int, last: int) -> CalibratedRows:
        """Rows `first` to `last` (excluded) of the result from a view's file. Raises CaptureError: the file can't be
        read."""
        rows, columns = self.raster.file_rows(first, last), self.raster.columns
        whole = file.read(rows, self.bands)
        stored = whole[:, columns]
        missing = find_missing(stored, file)
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
        values = stated_values(file, whole, rows, bands)[:, columns]  # a new array, free to be changed
        own_dark, white = self.own.get(file.path, (self.dark, self.white))
        dark = None if own_dark is None else own_dark.rows(rows, columns, bands)
        factor = self._exposure_factor(file, white)
        if dark is not None:
            values -= dark
        if white is not None:
            assert white.reflectance is not None
            light = white.rows(rows, columns, bands)
            if dark is not None:
                light = light - dark
            # NaN where the white is not above the dark.
            light = np.where(light > 0, light, np.float32(np.nan))
            factor = factor * (white.reflectance[bands].astype(np.float32) / light)
        values *= factor
        return values

    def _exposure_factor(self, file: SpectralFile, white: Reference | None) -> Float32[np.ndarray, " b"]:
        """What brings the kept bands of a view to the common exposure, or to that of its own white reference."""
        wanted, found = self.exposure, exposure_of(file)
        if file.path in self.own and white is not None and wanted is not None:
            wanted = exposure_of(white.file)
        if wanted is None or found is None:
            return np.ones(1, np.float32)
        factor = wanted / found
        return (factor if len(factor) == 1 else factor[self.bands]).astype(np.float32)

    def _in_bins(self, values: np.ndarray) -> np.ndarray:
        """Kept bands by bins, (n, w, b) to (n, w, c, bands of a bin)."""
        used = values[..., : self.num_bands * self.bin_bands]
        return used.reshape(*values.shape[:-1], self.num_bands, self.bin_bands)


def find_missing(stored: np.ndarray, file: SpectralFile) -> Bool[np.ndarray, "h W"]:
    """Pixels without a measurement: no number in some band, the file's no-data value, or out of its valid range.

    A no-data value of 0 is also what a dark pixel may read in a band, so that all bands must have it.
    """
    missing = np.zeros(stored.shape[:2], bool)
    if stored.dtype.kind == "f":
        missing |= ~np.isfinite(stored).all(axis=-1)
    if file.valid_range is not None:
        low, high = file.valid_range
        missing |= ((stored < low) | (stored > high)).any(axis=-1)
    no_data = file.no_data
    if no_data is not None and np.isfinite(no_data):
        limits = None if stored.dtype.kind == "f" else np.iinfo(stored.dtype)
        if limits is None or (limits.min <= no_data <= limits.max and no_data == int(no_data)):
            same = stored == stored.dtype.type(no_data)
            missing |= same.all(axis=-1) if no_data == 0 else same.any(axis=-1)
    return missing
