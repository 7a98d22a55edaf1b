"""Dark frames and white references: what a pixel and band of the detector reads without light, and with all of it.

Notation: `H x W` pixels, `B` bands of the file; `h` some rows, `b` some bands.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from unmix_plugin.captures.radiometry import radiometric_model
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError, ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv

BLOCK_VALUES = 1 << 22
"""Values read together."""
_PATTERN_BLOCK_PX = 8
_MOST_PATTERN = 4.0
"""Ratio of the variance of blocks' means to that which noise alone would leave, above which rows differ."""


def is_srgb(file: SpectralFile) -> bool:
    """Whether the file is a picture for people."""
    return file.metadata.get("encoding") == "sRGB"


def linear(file: SpectralFile, stored: np.ndarray, rows: slice) -> Float32[np.ndarray, "h W b"]:
    """Numbers of some whole rows: pictures decoded, and the calibration applied that the file carries itself.

    Args:
        file: Where they are from.
        stored: As read.
        rows: Which rows of the file they are.
    Raises:
        CaptureError: the calibration in the file is damaged.
    """
    if is_srgb(file):  # IEC 61966-2-1:1999
        top = np.iinfo(stored.dtype).max
        levels = np.arange(top + 1) / top
        light = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
        return light.astype(np.float32)[stored]
    model = radiometric_model(file)
    return stored.astype(np.float32) if model is None else model.apply(stored.astype(np.float32), rows)


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

    def rows(self, rows: slice, columns: slice, bands: np.ndarray) -> Float32[np.ndarray, "h columns b"]:
        """Values at some rows and columns of the cubes; axes of length 1 where one value stands for all."""
        if self.is_per_pixel:
            return linear(self.file, self.file.read(rows, bands), rows)[:, columns]
        mean = self.mean[:, :, bands]
        return mean if mean.shape[1] == 1 else mean[:, columns]


@dataclass(frozen=True)
class WhiteReference:
    """A white panel and what is known of it."""

    reference: Reference
    reflectance: Float64[np.ndarray, " B"]
    """Of the panel at every band of the file, above 0."""


def open_reference(file: SpectralFile, what: str, cube: SpectralFile) -> Reference:
    """A reference for the cubes of one sensor.

    A file with as many rows and columns as the cubes is used pixel by pixel if its rows differ by more than noise (a
    camera that takes whole images), and by the mean of its lines otherwise (a line camera).

    Raises:
        CaptureError: another number of bands than the cubes, or a value that is not finite.
    """
    height, width, bands = file.shape
    if bands != cube.shape[2]:
        raise CaptureError(
            f"{file.path}: the {what} has {bands} bands, the cubes have {cube.shape[2]} ({cube.path}); expected one "
            "taken by the same camera with the same settings"
        )
    mean, pattern = _column_means(file)
    if not np.isfinite(mean).all():
        raise CaptureError(f"{file.path}: the {what} holds NaN or infinite values; take it again")
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
        ConfigError: it leaves the image.
    """
    top, left, height, width = rectangle
    rows, columns, _ = cube.shape
    if min(top, left) < 0 or min(height, width) < 1 or top + height > rows or left + width > columns:
        raise ConfigError(
            f"--white-rectangle {view} {top} {left} {height} {width} (row, column, height, width) leaves the view of "
            f"{rows} rows and {columns} columns"
        )
    lines = slice(top, top + height)
    values = linear(cube, cube.read(lines), lines)[:, left : left + width].astype(np.float64)
    mean = values.mean(axis=(0, 1), keepdims=True).astype(np.float32)
    how = f"mean of {height} x {width} pixels from row {top} and column {left} of view {view}"
    return Reference(cube, "white reference", mean, False, how)


def _column_means(file: SpectralFile) -> tuple[Float32[np.ndarray, "1 W B"], float]:
    """Mean over lines, and how much more than noise the rows differ, judged on a few bands."""
    height, width, bands = file.shape
    total = np.zeros((width, bands))
    step = max(1, BLOCK_VALUES // (width * bands))
    for first in range(0, height, step):
        rows = slice(first, min(first + step, height))
        total += linear(file, file.read(rows), rows).sum(axis=0, dtype=np.float64)
    mean = total / height
    judged = np.unique(np.linspace(0, bands - 1, 5).astype(int))
    whole = slice(0, height)
    patterns = [
        _pattern(linear(file, file.read(whole, judged[[index]]), whole)[..., 0] - mean[:, band])
        for index, band in enumerate(judged)
    ]
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
    reference: Reference,
    dark: Reference | None,
    reflectance: str,
    wavelengths_nm: Float64[np.ndarray, " B"],
) -> WhiteReference:
    """A white panel that is brighter than the dark.

    Args:
        reflectance: Of the panel: a number, or a CSV file (wavelength,reflectance).
        wavelengths_nm: Of all bands of the file.
    Raises:
        CaptureError: it is not brighter.
        ConfigError: the reflectance is neither, or not above 0 and at most 1.5.
        SpectrumError: the CSV file is damaged or does not reach all bands.
    """
    light = panel_signal(reference, dark)
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
    return WhiteReference(reference, values)


def _read_reflectance(path: str, wavelengths_nm: Float64[np.ndarray, " B"]) -> Float64[np.ndarray, " B"]:
    if not Path(path).is_file():
        raise ConfigError(
            f"--white-reflectance {path}: neither a number nor a file; expected 0.99 or a CSV file"
        )
    table = read_spectra_csv(Path(path))
    if len(table.names) != 1:
        raise SpectrumError(f"{path}: expected one column beside 'wavelength'; found {len(table.names)}")
    distinct, back = np.unique(wavelengths_nm, return_inverse=True)
    return table.resampled(Bands(distinct)).spectra[0][back]


def panel_signal(reference: Reference, dark: Reference | None) -> Float64[np.ndarray, " B"]:
    """Mean counts of the white above dark at each band of the file."""
    signal = reference.mean.astype(np.float64).mean(axis=(0, 1))
    return signal if dark is None else signal - dark.mean.astype(np.float64).mean(axis=(0, 1))
