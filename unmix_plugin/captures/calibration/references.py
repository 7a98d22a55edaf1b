"""What stored numbers stand for, and the measured references that they are compared with: dark frames and white panels.

Notation: `H x W` pixels and `B` bands of a file, of which `h` rows and `b` bands are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from unmix_plugin.captures.camera_tags import radiometric_model
from unmix_plugin.captures.cube import (
    BandIndex,
    CaptureView,
    Cube,
    Meaning,
    find_missing,
)
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.errors import CaptureError, ConfigError, SpectrumError, counted, name_some
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.srgb import decode_srgb
from unmix_plugin.spectral.library.spectra_csv import read_spectra

_BLOCK_VALUES = 1 << 22
"""Values read together."""
_LARGEST_DIFFERENCE_NM = 0.1
"""Between the same bands of files of one capture."""
_PATTERN_BLOCK_PX = 8
_MOST_PATTERN = 4.0
"""Ratio of the variance of blocks' means to that which noise alone would leave, above which rows differ."""


def stated_reflectance(file: Cube, by_name: bool = True) -> str | None:
    """Where a file says that its values are reflectances; None where it does not, or says what else they are.

    Args:
        by_name: Whether its name may say so.
    Source: NV5, ENVI Header Files (`reflectance scale factor`); Fichet et al. 2021, spectral OpenEXR (layer `T`).
    """
    if file.is_srgb or radiometric_model(file) is not None:
        return None
    if file.meaning is Meaning.REFLECTANCE:
        return file.meaning_source
    return f"the name {file.reflectance_name}" if by_name and file.reflectance_name else None


def finished_by(file: Cube, by_name: bool = True) -> str | None:
    """Where a file says that its values are reflectance or radiance, in which the exposure is accounted for; None where
    it does not. Software keeps the exposure time of the raw file in the header of such values.

    Args:
        by_name: Whether its name may say that they are reflectance.
    Source: NV5, ENVI Header Files (`data gain values` in W/(m2 um sr)).
    """
    return file.meaning_source if file.meaning is Meaning.RADIANCE else stated_reflectance(file, by_name)


def stated_values(
    file: Cube, stored: np.ndarray, rows: slice, bands: BandIndex = slice(None)
) -> Float32[np.ndarray, "h W b"]:
    """Values of some whole rows: pictures decoded, and the calibration applied that the file carries itself.

    Args:
        stored: Numbers (h, W, b) that were read of these rows and bands.
    """
    if file.is_srgb:
        top = np.iinfo(stored.dtype).max
        return decode_srgb(np.arange(top + 1) / top).astype(np.float32)[stored]
    model = radiometric_model(file)
    if model is not None:
        return model.apply(stored.astype(np.float32), rows)
    return stored.astype(np.float32) if file.linear is None else file.linear.apply(stored, bands)


def require_comparable(file: Cube, other: Cube) -> None:
    """Refuse a file whose bands are other ones than those of another file of the capture, or whose numbers are of
    another unit: gains, or a maker's calibration, in one alone. Raises CaptureError."""
    found, expected = file.bands.wavelengths_nm, other.bands.wavelengths_nm
    is_given = file.bands.is_given or other.bands.is_given
    if found is not None and expected is not None and not is_given:
        band = int(np.argmax(np.abs(found - expected)))
        if abs(found[band] - expected[band]) > _LARGEST_DIFFERENCE_NM:
            raise CaptureError(
                f"{file.path} has {found[band]:g} nm at band {band}; expected {expected[band]:g} nm, as "
                f"{other.path} has"
            )
    maker, other_maker = (model and model.maker for model in map(radiometric_model, (file, other)))
    for what, of_file, of_other in (
        ("gains or scale", file.linear and file.linear.source, other.linear and other.linear.source),
        ("calibration of its maker in its XMP", maker, other_maker),
    ):
        if (of_file is None) != (of_other is None):
            has, lacks = (file, other) if of_other is None else (other, file)
            raise CaptureError(
                f"{lacks.path} has no {what}, {has.path} has ({of_file or of_other}); expected both or neither, as "
                "numbers of one can't be compared with those of the other"
            )


def _measured(file: Cube, rows: slice, bands: BandIndex = slice(None)) -> Float32[np.ndarray, "h W b"]:
    """Values of some rows, NaN where nothing was measured."""
    stored = file.read(rows, bands)
    values = stated_values(file, stored, rows, bands)
    values[find_missing(stored, file, rows, bands)] = np.nan
    return values


class ReferenceKind(Enum):
    """What is measured beside the views."""

    DARK = "dark frame"
    WHITE = "white reference"

    @property
    def flag(self) -> str:
        """Names one for all views."""
        return f"--{self.name.lower()}"


@dataclass(frozen=True)
class Reference:
    """A measured reference, brought to the columns of the cubes."""

    file: Cube
    mean: Float32[np.ndarray, "1 columns B"]
    """Mean over its lines; one column where it stands for all. 0 in bands that are not measured."""
    measured: Int[np.ndarray, " b"]
    """Bands of the file that it can serve in, as `measured_bands` has them."""
    is_per_pixel: bool
    """Whether each pixel has its own value, read from the file when needed."""
    how: str
    """How it is used, for people."""
    reflectance: Float64[np.ndarray, " B"] | None = None
    """Of a white panel at every band of the file, above 0."""
    dark: Reference | None = None
    """Of a white panel: the dark frame that was taken for it alone, otherwise that of the views."""
    rectangle: tuple[int, int, int, int] | None = None
    """First row and column, height and width of the part of a view that shows it; None for a file of its own."""

    def rows(self, rows: slice, columns: slice, bands: np.ndarray) -> Float32[np.ndarray, "h columns b"]:
        """Values at some rows and columns of the cubes; axes of length 1 where one value stands for all."""
        if self.is_per_pixel:
            return _measured(self.file, rows, bands)[:, columns]
        mean = self.mean[:, :, bands]
        return mean if mean.shape[1] == 1 else mean[:, columns]

    def light(self, rows: slice, columns: slice, bands: np.ndarray) -> Float32[np.ndarray, "h columns b"]:
        """The same of a white panel, above its dark: a mean over columns less the mean of the dark over these."""
        if not self.is_per_pixel and self.mean.shape[1] == 1:
            return self.signal[None, None, bands].astype(np.float32)
        light = self.rows(rows, columns, bands)
        return light if self.dark is None else light - self.dark.rows(rows, columns, bands)

    @cached_property
    def signal(self) -> Float64[np.ndarray, " B"]:
        """Mean counts above its dark at each band of the file."""
        counts = self.mean.astype(np.float64).mean(axis=(0, 1))
        if self.dark is None or self.rectangle is None:
            return counts if self.dark is None else counts - self.dark.signal
        top, left, height, width = self.rectangle
        lines, columns = slice(top, top + height), slice(left, left + width)
        bands = self.dark.measured
        counts[bands] -= np.nanmean(self.dark.rows(lines, columns, bands), axis=(0, 1), dtype=np.float64)
        return counts


def measured_bands(
    file: Cube, bad: Bool[np.ndarray, " B"] | None = None, rows: slice = slice(None)
) -> Int[np.ndarray, " b"]:
    """Bands that are not marked as bad and in which a pixel was measured; of those, all where nothing was.

    Args:
        bad: Marks beside those of the file.
        rows: Where to look.
    """
    marks = file.bands.marking(bad).bad
    first, last, _ = rows.indices(file.shape[0])
    kept = np.arange(file.shape[2]) if marks is None or marks.all() else np.flatnonzero(~marks)
    is_seen = np.zeros(len(kept), bool)
    step = max(1, _BLOCK_VALUES // (file.shape[1] * len(kept)))
    for begin in range(first, last, step):
        part = slice(begin, min(begin + step, last))
        stored = file.read(part, kept)
        for index in np.flatnonzero(~is_seen).tolist():
            band = slice(index, index + 1)
            is_seen[index] = not find_missing(stored[..., band], file, part, kept[band]).all()
        if is_seen.all():
            break
    return kept[is_seen] if is_seen.any() else kept


def open_reference(file: Cube, kind: ReferenceKind, cube: Cube) -> Reference:
    """A reference for the cubes of one sensor.

    A file with as many rows and columns as the cubes is used pixel by pixel if its rows differ by more than noise (a
    camera that takes whole images), and by the mean of its lines otherwise (a line camera). Pixels without a
    measurement are left out of it, where 0 in a dark frame is one whatever its header says. Bands that it or the cube
    marks as bad, or that it measured nothing in, don't count. Raises CaptureError: other bands than the cubes, other
    units, or a column without a measurement.
    """
    if kind is ReferenceKind.DARK:  # software writes one no-data value into all headers of a capture
        file = replace(file, no_data=tuple(number for number in file.no_data if number != 0))
    height, width, bands = file.shape
    if bands != cube.shape[2]:
        raise CaptureError(
            f"{file.path}: the {kind.value} has {bands} bands, the cubes have {cube.shape[2]} ({cube.path}); expected "
            "as many"
        )
    require_comparable(file, cube)
    # Mean over lines, NaN where nothing was measured.
    measured = measured_bands(file, cube.bands.bad)
    total, count = np.zeros((width, len(measured))), np.zeros((width, len(measured)))
    missing = np.zeros((height, width), bool)
    step = max(1, _BLOCK_VALUES // (width * bands))
    for first in range(0, height, step):
        part = slice(first, min(first + step, height))
        stored = file.read(part, measured)
        missing[part] = find_missing(stored, file, part, measured)
        values = stated_values(file, stored, part, measured)
        values[missing[part]] = np.nan
        total += np.nansum(values, axis=0, dtype=np.float64)
        count += np.isfinite(values).sum(axis=0)
    precise = total / np.where(count > 0, count, np.nan)
    mean = np.zeros((1, width, bands), np.float32)
    mean[..., measured] = precise
    if not np.isfinite(mean).all():
        raise CaptureError(
            f"{file.path}: the {kind.value} has columns without a measurement (NaN, infinite or no-data); take it again"
        )
    pattern = 0.0
    if (height, width) == cube.shape[:2] and height > 1:
        pattern = _pattern_of_rows(file, measured, precise, missing)
    if pattern > _MOST_PATTERN:
        how = f"pixel by pixel, as its rows differ ({pattern:.1f} times what noise explains)"
        return Reference(file, mean, measured, True, how)
    lines = f"mean of {height} line{'s' if height > 1 else ''}"
    if width == cube.shape[1]:
        return Reference(file, mean, measured, False, f"{lines}, column by column")
    ratio = max(width, cube.shape[1]) / min(width, cube.shape[1])
    wider = f"it is {width} columns wide and the cubes {cube.shape[1]}"
    if ratio == int(ratio) and width > 1:  # both lines span the same field
        how = f"{lines}, interpolated along the line: {wider}, as with another binning"
        if width > cube.shape[1]:  # finer than the cubes: average what falls into each of their pixels
            mean = mean.reshape(1, cube.shape[1], width // cube.shape[1], -1).mean(axis=2)
        else:
            at = (np.arange(cube.shape[1]) + 0.5) * width / cube.shape[1] - 0.5
            low = np.clip(np.floor(at).astype(int), 0, width - 1)
            high = np.minimum(low + 1, width - 1)
            part_way = np.clip(at - low, 0.0, 1.0)[None, :, None].astype(np.float32)
            mean = mean[:, low] * (1 - part_way) + mean[:, high] * part_way
        return Reference(file, mean, measured, False, how)
    how = f"{lines} and of all columns: {wider}, so its columns can't be those of the cubes"
    return Reference(file, mean.mean(axis=1, keepdims=True), measured, False, how)


def _open_white(file: Cube, own_dark: Cube | None, cube: Cube) -> Reference:
    """A white reference with the dark frame that was taken for it alone, if there is one."""
    white = open_reference(file, ReferenceKind.WHITE, cube)
    if own_dark is None:
        return white
    dark = open_reference(own_dark, ReferenceKind.DARK, cube)
    return replace(white, dark=dark, how=f"{white.how}; less a dark frame of its own ({dark.how})")


def panel_reference(cube: Cube, rectangle: tuple[int, int, int, int], view: str) -> Reference:
    """The mean of a rectangle of a view as the white reference of all.

    Args:
        rectangle: First row and column, height and width.
    Raises:
        CaptureError: nothing was measured there.
        ConfigError: it leaves the image.
    """
    top, left, height, width = rectangle
    refuse_outside(f"--white-rectangle {view}", rectangle, cube.shape[:2])
    lines = slice(top, top + height)
    measured = measured_bands(cube, rows=lines)
    values = _measured(cube, lines, measured)[:, left : left + width].astype(np.float64)
    if np.isnan(values[..., 0]).all():
        raise CaptureError(f"{cube.path}: no pixel of --white-rectangle holds a measurement; name another")
    mean = np.zeros((1, 1, cube.shape[2]), np.float32)
    mean[..., measured] = np.nanmean(values, axis=(0, 1))
    how = f"mean of {height} x {width} pixels from row {top} and column {left} of view {view}"
    return Reference(cube, mean, measured, False, how, rectangle=rectangle)


def refuse_outside(what: str, rectangle: tuple[int, int, int, int], size: tuple[int, int]) -> None:
    """Refuse a rectangle (first row and column, height and width) that leaves an image. Raises ConfigError: it does."""
    top, left, height, width = rectangle
    is_empty = min(top, left) < 0 or min(height, width) < 1
    if is_empty or top + height > size[0] or left + width > size[1]:
        where = f"{what} {top} {left} {height} {width} (row, column, height, width)"
        raise ConfigError(f"{where} leaves the image of {size[0]} rows and {size[1]} columns")


def _pattern_of_rows(
    file: Cube,
    measured: Int[np.ndarray, " b"],
    mean: Float64[np.ndarray, "W b"],
    missing: Bool[np.ndarray, "H W"],
) -> float:
    """How much more than noise the rows differ from their mean, judged on a few bands: the variance of the means of
    square blocks, as a multiple of what pixels that differ by noise alone would give."""
    height, width, _ = file.shape
    every, side, patterns = slice(0, height), _PATTERN_BLOCK_PX, []
    down, across = height // side, width // side
    for band in np.unique(np.linspace(0, len(measured) - 1, 5).astype(int)):
        index = measured[[band]]
        values = stated_values(file, file.read(every, index), every, index)[..., 0]
        residual = np.nan_to_num(np.where(missing, 0.0, values - mean[:, band]))
        variance = residual.var()
        if down == 0 or across == 0 or not variance > 0:
            patterns.append(0.0)
            continue
        blocks = residual[: down * side, : across * side].reshape(down, side, across, side).mean(axis=(1, 3))
        patterns.append(float(blocks.var() * side * side / variance))
    return float(np.median(patterns))


def _as_white(
    panel: Reference, dark: Reference | None, reflectance: str, wavelengths_nm: Float64[np.ndarray, " B"]
) -> Reference:
    """A white panel that is brighter than its dark, with its reflectance: a number, or that of a table."""
    white = replace(panel, dark=panel.dark or dark)
    light = white.signal[white.measured]
    if not (light > 0).mean() > 0.5:
        dark_name = "0" if white.dark is None else f"the dark frame {white.dark.file.path}"
        raise CaptureError(
            f"{white.file.path}: the white reference is not brighter than {dark_name} in "
            f"{(light <= 0).mean():.0%} of its bands; are white and dark swapped?"
        )
    try:
        values = np.full(len(wavelengths_nm), float(reflectance))
    except ValueError:
        if not Path(reflectance).is_file():
            raise ConfigError(
                f"--white-reflectance {reflectance}: expected a number such as 0.99, or a table"
            ) from None
        table = read_spectra(Path(reflectance))
        if len(table.names) != 1:
            found = f"found {len(table.names)}"
            raise SpectrumError(f"{reflectance}: expected one column beside 'wavelength'; {found}") from None
        distinct, back = np.unique(wavelengths_nm, return_inverse=True)
        values = table.resampled(Bands(distinct)).spectra[0][back]
    if not (np.isfinite(values).all() and values.min() > 0.0 and values.max() <= 1.5):
        raise ConfigError(
            f"--white-reflectance {reflectance} is {values.min():g} to {values.max():g}; expected a reflectance above "
            "0, such as 0.99 (per cent are divided by 100 first)"
        )
    return replace(white, reflectance=values)


@dataclass(frozen=True)
class GivenReferences:
    """References that the user names; they go before those of views."""

    dark: Cube | None = None
    white: Cube | None = None

    @property
    def files(self) -> list[Cube]:
        """Those that there are."""
        return [file for file in (self.dark, self.white) if file is not None]


@dataclass(frozen=True)
class ViewReferences:
    """What the numbers of a view are compared with."""

    dark: Reference | None = None
    white: Reference | None = None


@dataclass(frozen=True)
class SensorReferences:
    """References of all views of a sensor."""

    common: ViewReferences = ViewReferences()
    by_view: Mapping[Path, ViewReferences] = field(default_factory=dict)
    """Of views that were taken with their own, by the path of their cube; they go before the common ones."""

    def of(self, file: Cube) -> ViewReferences:
        """Those of the view with this cube."""
        return self.by_view.get(file.path, self.common)

    @property
    def whites(self) -> list[Reference]:
        """All white references, one a view where views have their own."""
        used = [*self.by_view.values()] or [self.common]
        return [references.white for references in used if references.white is not None]

    @property
    def all(self) -> list[Reference]:
        """Every reference that is used, dark frames of white references too."""
        used = [*self.by_view.values()] or [self.common]
        pairs = [(one.dark, one.white, one.white and one.white.dark) for one in used]
        return [reference for pair in pairs for reference in pair if reference is not None]

    def darks_beside(self, files: Sequence[Cube]) -> list[tuple[Cube, Cube]]:
        """Each dark frame with the file that it is subtracted from: a view's, or that of a white reference."""
        pairs = []
        for file in files:
            used = self.of(file)
            pairs += [(used.dark.file, file)] if used.dark else []
            pairs += [(used.white.dark.file, used.white.file)] if used.white and used.white.dark else []
        return pairs


def find_references(
    views: Sequence[CaptureView],
    wavelengths_nm: Float64[np.ndarray, " B"],
    options: ProcessOptions,
    given: GivenReferences,
    all_views: Sequence[CaptureView],
) -> SensorReferences:
    """References of the views of a sensor.

    Args:
        wavelengths_nm: Of all bands of the files.
        all_views: With those that have no pose: one may show a panel.
    Raises:
        CaptureError: a reference does not fit the views, or some have one of their own and others have none.
        ConfigError: the rectangle of the panel, or its reflectance, is wrong.
    """
    cube = views[0].cube
    dark = None if given.dark is None else open_reference(given.dark, ReferenceKind.DARK, cube)
    panel = None
    if options.white_rectangle is not None:
        wanted, *rectangle = options.white_rectangle
        shown = next((view for view in all_views if wanted in (view.name, view.shot)), None)
        if shown is None:
            names = name_some([view.name for view in all_views], 5)
            raise ConfigError(f"--white-rectangle {wanted}: no view of this name; there are {names}")
        top, left, height, width = rectangle
        panel = panel_reference(shown.cube, (top, left, height, width), shown.name)
        own_dark = _own_dark(shown.cube, shown.dark) if dark is None else None
        if own_dark is not None:
            panel = replace(panel, dark=open_reference(own_dark, ReferenceKind.DARK, shown.cube))
    elif given.white is not None:
        panel = _open_white(given.white, _own_dark(given.white) if dark is None else None, cube)
    white = panel and _as_white(panel, dark, options.white_reflectance, wavelengths_nm)
    common = ViewReferences(dark, white)
    return SensorReferences(common, _references_by_view(views, wavelengths_nm, options, common))


def _references_by_view(
    views: Sequence[CaptureView],
    wavelengths_nm: Float64[np.ndarray, " B"],
    options: ProcessOptions,
    common: ViewReferences,
) -> dict[Path, ViewReferences]:
    """References of views that were taken with their own, by the path of their cube, with the common one of what they
    lack."""
    darks, whites, darks_of_whites = {}, {}, {}
    if common.dark is None:
        darks = _one_each({view.name: _own_dark(view.cube, view.dark) for view in views}, ReferenceKind.DARK)
        darks_of_whites = {
            view.white.path: _own_dark(view.white, view.white_dark)
            for view in views
            if view.white is not None
        }
    if common.white is None:
        whites = _one_each({view.name: view.white for view in views}, ReferenceKind.WHITE)
    opened: dict[tuple[Path | None, Path | None], ViewReferences] = {}  # files that several views share
    by_view: dict[Path, ViewReferences] = {}
    for view in views:
        dark_file, white_file = darks.get(view.name), whites.get(view.name)
        if dark_file is None and white_file is None:
            continue
        key = (dark_file and dark_file.path, white_file and white_file.path)
        if key not in opened:
            dark = common.dark
            if dark_file is not None:
                dark = open_reference(dark_file, ReferenceKind.DARK, view.cube)
            white = common.white and replace(common.white, dark=common.white.dark or dark)
            if white_file is not None:
                panel = _open_white(white_file, darks_of_whites.get(white_file.path), view.cube)
                white = _as_white(panel, dark, options.white_reflectance, wavelengths_nm)
            opened[key] = ViewReferences(dark, white)
        by_view[view.cube.path] = opened[key]
    return by_view


def _own_dark(file: Cube, beside: Cube | None = None) -> Cube | None:
    """The dark frame that lies beside a file, otherwise its own dark lines, if its numbers are raw: dark lines of what
    was brought to reflectance are near 0."""
    return beside or (None if finished_by(file) else file.dark)


def _one_each(files: Mapping[str, Cube | None], kind: ReferenceKind) -> dict[str, Cube]:
    """A reference for each view, by its name: its own, or the only one that there is. Raises CaptureError: several
    views have different ones, and others none."""
    known = {file.path: file for file in files.values() if file is not None}
    missing = [name for name, file in files.items() if file is None]
    if missing and len(known) > 1:
        raise CaptureError(
            f"{counted(len(missing), 'view')} ({name_some(missing)}) without a {kind.value} of their own, {len(known)} "
            f"others have one; expected one for each, or one for all ({kind.flag})"
        )
    return {name: file or only for name, file in files.items() for only in list(known.values())[:1]}
