"""From stored numbers to values: cropping, dark frame, white reference, exposure, binning.

    value = (stored - dark) / (white - dark) * reflectance of the panel * exposure of white / exposure of view

with what is not given left out. A white may have a dark frame of its own.

Notation: `H x W` pixels and `B` bands of the file, of which `h` rows and `b` bands are read; `n x w` pixels and `c`
bands of the result. Of exposures, `b` is 1, or the bands of a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from unmix_plugin.captures.calibration.references import (
    Reference,
    References,
    find_missing,
    finished_by,
    refuse_outside,
    stated_values,
)
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import ConfigError, counted, name_some


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
            left = f"leaves fewer than 2 x 2 of {rows} x {columns} pixels"
            raise ConfigError(f"--bin-pixels {binning} {left}; give a smaller number")
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
    dark: Reference | None = None
    white: Reference | None = None
    saturation: float | None = None
    """Stored number of a saturated pixel; None where none is known."""
    exposure: Float64[np.ndarray, " b"] | None = None
    """Exposure (see `exposure_of`) that values are brought to, one number or one a band of the file: that of the white
    reference, otherwise of the first view; None where exposures are not compared."""
    own: Mapping[Path, References] = field(default_factory=dict)
    """Dark and white of single views, by the path of their cube; they go before the common ones."""

    @property
    def num_bands(self) -> int:
        """Bands of the result."""
        return len(self.bands) // self.bin_bands

    def rows(
        self,
        file: SpectralFile,
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

    def _values(self, file: SpectralFile, whole: np.ndarray, rows: slice) -> Float32[np.ndarray, "h W b"]:
        columns, bands = self.raster.columns, self.bands
        values = stated_values(file, whole, rows, bands)[:, columns]  # a new array, free to be changed
        dark, white = self.own.get(file.path, (self.dark, self.white))
        if dark is not None:
            values -= dark.rows(rows, columns, bands)
        factor, wanted, found = np.ones(1, np.float32), self.exposure, exposure_of(file)
        if file.path in self.own and white is not None and wanted is not None:
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


# How long views and their references were exposed, and what becomes of it.


def exposure_of(file: SpectralFile, to_light: bool = True) -> Float64[np.ndarray, " b"] | None:
    """Exposure time times gain, and over the square of the f-number if that is known, one number or one a band; None
    where the file does not say the time.

    Args:
        to_light: Whether the aperture counts, which lets in light but no dark current.
    """
    time, gain = file.metadata.get("exposure_s"), file.metadata.get("gain", 1.0)
    f_number = file.metadata.get("f_number", 1.0) if to_light else 1.0
    try:
        exposure = np.asarray(time, dtype=np.float64) * np.asarray(gain, dtype=np.float64)
        exposure = np.atleast_1d(exposure / f_number**2)
    except (TypeError, ValueError):
        return None
    is_usable = len(exposure) in (1, file.shape[2]) and np.isfinite(exposure).all() and (exposure > 0).all()
    return exposure if is_usable else None


def compare_exposures(
    views: Sequence[SpectralFile],
    whites: Sequence[SpectralFile],
    darks: Sequence[tuple[SpectralFile, SpectralFile]],
    is_bent: bool,
    may_be_finished: bool,
    notes: list[str],
    warnings: list[str],
) -> Float64[np.ndarray, " b"] | None:
    """What all views are brought to (see `exposure_of`): the exposure of the white reference, otherwise of the first
    view; None where exposures are not compared.

    Args:
        views: At least one.
        whites: References of all views, or one a view.
        darks: Each dark frame with a view or a white that it is subtracted from.
        is_bent: Whether the files are pictures for people, in which twice the exposure is not twice the number.
        may_be_finished: Whether values look like reflectances, which nothing is divided by but a reference.
        notes, warnings: What was done, and what may be wrong, is appended.
    """
    files = (*views, *whites)
    known, of_whites = (
        [e for file in some if (e := exposure_of(file)) is not None] for some in (views, whites)
    )
    differs = len({tuple(exposure) for exposure in known}) > 1 or any(len(exposure) > 1 for exposure in known)
    apertures = {"f_number" in file.metadata for file in files if exposure_of(file) is not None}
    unit = "s times gain over the square of the f-number" if True in apertures else "s times gain"
    taken = f"were exposed {_in_words(known)} {unit}" if known else ""
    finished = [finished_by(file, by_name=not whites) for file in views]
    if None not in finished and not is_bent:
        kept = f"values are not divided by that, as {finished[0]} says that they are reflectance or radiance already"
        notes += [f"views {taken}: {kept}"] if differs else []
        return None
    misfits, why = _misfits(views, whites), None
    warnings += [*_missing_units(files), *misfits]
    if len(known) < len(views):
        missing = counted(len(views) - len(known), "view")
        is_partial = bool(known or of_whites) and not misfits
        why = f"{missing} without exposure time: exposures are not compared" * is_partial
    elif len(apertures) > 1:
        lacking = name_some([file.path.name for file in files if "f_number" not in file.metadata])
        unknown = f"the f-number of the lens is known of some files and not of {lacking}"
        why = f"{unknown}: exposures are not compared; write it into all, or none"
    elif is_bent:
        bent = "which can't be undone as cameras bend the brightness of pictures: fix the exposure"
        why = f"pictures {taken}, {bent}" * differs
    elif may_be_finished and differs and not (whites or darks):
        why = (
            f"views {taken}: values are not divided by that, as they are at most about 1 and taken for reflectances. "
            "If they grow with the exposure, as raw numbers do, give a white reference, or divide them by it yourself"
        )
    if why is not None:
        warnings += filter(None, [why])
        return None
    if len(of_whites) < len(whites) and differs and not misfits:
        warnings.append(
            f"views {taken}, the white reference does not say how long: reflectances may be off by a factor"
        )
    warnings += _unlike_darks(darks)
    common, of_whom = np.median(known[0], keepdims=True), "the first view"
    if of_whites:
        common, of_whom = of_whites[0], f"{'the' if len(whites) == 1 else 'its'} white reference"
    if len({tuple(exposure) for exposure in [*known, *of_whites, common]}) > 1:
        notes.append(
            f"views {taken}: each is brought to that of {of_whom}, {_in_words(of_whites or [common])}"
        )
    return common


def _unlike_darks(darks: Sequence[tuple[SpectralFile, SpectralFile]]) -> list[str]:
    """A warning of dark frames that were exposed otherwise than what they are subtracted from."""
    pairs = [(exposure_of(dark, False), exposure_of(other, False)) for dark, other in darks]
    unlike = [(a, b) for a, b in pairs if a is not None and b is not None and not np.array_equal(a, b)]
    if not unlike:
        return []
    of_darks, of_others = (_in_words(exposures) for exposures in zip(*unlike, strict=True))
    said = f"the dark frame was exposed {of_darks} s times gain, what it is subtracted from {of_others}"
    return [f"{said}: dark current grows with exposure, so take a dark frame at each"]


def _in_words(exposures: Iterable[Float64[np.ndarray, " _"]]) -> str:
    """The range of exposures.

    >>> _in_words([np.array([0.01]), np.array([0.02])])
    '0.01 to 0.02'
    """
    every = np.concatenate(list(exposures))
    low, high = every.min(), every.max()
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _misfits(views: Sequence[SpectralFile], whites: Sequence[SpectralFile]) -> list[str]:
    """A warning where exposures are neither one number nor one a band, unless a white has the same ones."""
    files = (*views, *whites)
    stated = {repr((file.metadata.get("exposure_s"), file.metadata.get("gain"))) for file in files}
    if whites and len(stated) == 1:
        return []
    found: dict[str, tuple[int, int]] = {}
    for file in files:
        sizes = {np.size(file.metadata.get(name, 1.0)) for name in ("exposure_s", "gain")}
        if (odd := sizes - {1, file.shape[2]}) and "exposure_s" in file.metadata:
            found[file.path.name] = max(odd), file.shape[2]
    if not found:
        return []
    numbers = " or ".join(str(size) for size in sorted({size for size, _ in found.values()}))
    bands = counted(next(iter(found.values()))[1], "band")
    said = f"{name_some([*found])}: {numbers} exposure times or gains for {bands}"
    advice = "Give one number, or one a band, with points as decimal marks"
    return [f"{said}: exposures may differ and were not compared. {advice}"]


def _missing_units(files: Iterable[SpectralFile]) -> list[str]:
    """Warnings where units are missing and matter."""
    metadata = [file.metadata for file in files if "exposure_s" in file.metadata]
    warnings = []
    for what, kind in (("exposure", "exposure times"), ("gain", "gains")):
        evidence = sorted({str(own.get(f"{what}_evidence", "")) for own in metadata} - {""})
        guessed = [text for text in evidence if "no unit" in text]
        gains = {repr(own.get("gain", 1.0)) for own in metadata}
        if guessed and (len(guessed) < len(evidence) if what == "exposure" else len(gains) > 1):
            warnings.append(
                f"{kind} have no unit in some files ({'; '.join(evidence)}): values may be off by a factor"
            )
    return warnings
