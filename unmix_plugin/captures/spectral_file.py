"""A file of an instrument, opened but not read: what it says of itself, and its numbers by rows and bands; and the
views of a capture, which are made of such files.

Notation: `H` rows, `W` columns, `B` bands. Axes of stored arrays are letters, the slowest first: `y` rows, `x`
columns, `b` bands.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Shaped

from unmix_plugin.captures.names import natural_order
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.errors import CaptureError, install_hint

Axes: TypeAlias = Literal["yxb", "byx", "ybx", "xyb", "bxy", "xby"]
"""What the axes of an array are, the slowest first: y rows, x columns, b bands."""
BandIndex: TypeAlias = slice | Int[np.ndarray, " b"]
"""Some bands: a slice, or their indices in any order."""
_ReadPart: TypeAlias = Callable[[slice, BandIndex], Shaped[np.ndarray, "h W b"]]
"""Stored numbers of some rows, and of bands in rising order; slices have both ends and no step."""
_MissingPart: TypeAlias = Callable[[slice, BandIndex], Bool[np.ndarray, "h W"]]
"""Pixels of some rows without a measurement in one of some bands."""

COLOURS_AS_STORED = (
    "red, green and blue are taken as light, as stored; if they are a picture's for people (sRGB), save it as PNG of "
    "8 bits"
)
"""Warning of colours that no header says to be linear."""
MOST_WIDTH = 0.25
"""Width of a band, as a share of its wavelength, up to which one wavelength stands for it; panchromatic: 0.7."""
GIVEN = "given by the user"
"""Evidence of wavelengths that files do not state, or state wrongly."""
_MEASURES_NOTHING = 1e30
_FLOAT32_EPS = float(np.finfo(np.float32).eps)
_KEPT_BYTES = 2**28
_kept: OrderedDict[tuple[Hashable, ...], np.ndarray] = OrderedDict()
_lock = threading.Lock()


@dataclass(frozen=True)
class ReadOptions:
    """What a user adds to files that don't say enough of themselves, or against what they say."""

    dataset: str | None = None
    """Variable or data set to take from a file that holds several."""
    wavelengths_nm: Float64[np.ndarray, " B"] | None = None
    """Band centres in nm, in the order of the file."""
    axes: Axes | None = None
    """Order of the axes in formats that don't fix it: NumPy, MATLAB, HDF5, torch, pages of a TIFF."""
    size: tuple[int, int] | None = None
    """Rows and columns of an image that is stored as a list of pixels, column after column as MATLAB writes it."""
    exclude: tuple[Path, ...] = ()
    """Files in a folder that are not views, such as dark and white references."""


@dataclass(frozen=True)
class BandTable:
    """What a file says of its bands; None where it says nothing."""

    wavelengths_nm: Float64[np.ndarray, " B"] | None = None
    """Band centres in nm, in the order of the file."""
    evidence: str = "the file gives no wavelengths"
    """Where the wavelengths were found and in which unit, for people: `header field 'wavelength', Micrometers`."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Full width at half maximum of each band, nm."""
    bad: Bool[np.ndarray, " B"] | None = None
    """Bands that the file itself marks as bad."""
    names: tuple[str, ...] | None = None
    """What the file calls its bands."""

    def marking(self, *bad: Bool[np.ndarray, " B"] | None) -> BandTable:
        """The table in which these bands are bad too, where there are such marks."""
        marks = [one for one in (self.bad, *bad) if one is not None]
        return replace(self, bad=np.any(marks, axis=0)) if marks else self

    @property
    def is_broad(self) -> Bool[np.ndarray, " B"]:
        """Which bands are too broad to have one wavelength; none where wavelengths or widths are unknown."""
        if self.wavelengths_nm is None or self.fwhm_nm is None:
            return np.zeros(0, bool)
        return self.fwhm_nm > MOST_WIDTH * self.wavelengths_nm


@dataclass(frozen=True)
class Linear:
    """What the stored numbers of a file stand for: value = gain * stored + offset, band by band."""

    gains: Float64[np.ndarray, " B"]
    """Above 0."""
    offsets: Float64[np.ndarray, " B"]
    evidence: str
    """Where the file says so, for people: `header field 'data gain values'`."""

    def apply(self, stored: np.ndarray, bands: BandIndex) -> Float32[np.ndarray, "h W b"]:
        """Values of some bands."""
        gains, offsets = (numbers[bands].astype(np.float32) for numbers in (self.gains, self.offsets))
        return stored.astype(np.float32) * gains + offsets

    @property
    def scale(self) -> float | None:
        """Stored number that stands for 1, where one number says all."""
        is_one = not self.offsets.any() and np.ptp(self.gains) == 0
        return float(f"{1.0 / self.gains[0]:.12g}") if is_one else None


def linear_values(
    path: Path, num_bands: int, gains: Sequence[float], offsets: Sequence[float], evidence: str
) -> Linear | None:
    """The calibration that a file states; None where it changes nothing.

    Args:
        gains, offsets: One a band, one for all, or none.
    Raises:
        CaptureError: another number of them, or gains that are not above 0: without them spectra would be false.
    """
    columns = []
    for name, numbers, usual in (("gains", gains, 1.0), ("offsets", offsets, 0.0)):
        values = np.array(numbers or [usual], dtype=np.float64)
        if len(values) not in (1, num_bands):
            raise CaptureError(
                f"{path}: {evidence} gives {len(values)} {name} for {num_bands} bands; expected one a band, or one for "
                "all: correct them or take them out"
            )
        if not np.isfinite(values).all() or (name == "gains" and values.min() <= 0):
            raise CaptureError(
                f"{path}: {evidence} gives {name} from {values.min():g} to {values.max():g}; expected finite numbers"
                f"{' above 0' if name == 'gains' else ''}: correct them or take them out"
            )
        columns.append(np.broadcast_to(values, num_bands))
    changes = (columns[0] != 1).any() or columns[1].any()
    return Linear(columns[0], columns[1], evidence) if changes else None


@dataclass(frozen=True)
class SpectralFile:
    """One image of (H, W, B) numbers on disk."""

    path: Path
    """The file that was named: a header where there is one."""
    reader: str
    """Name of the reader: envi, tiff, exr, matlab, hdf5, netcdf, npy, torch, picture."""
    shape: tuple[int, int, int]
    """H, W, B."""
    dtype: np.dtype
    """Type of the stored numbers, in any byte order."""
    read_part: _ReadPart = field(repr=False)
    """How `read` gets its numbers."""
    bands: BandTable = BandTable()
    interleave: str | None = None
    """bsq, bil or bip where the format has a choice."""
    linear: Linear | None = None
    """What stored numbers stand for, if the file says so."""
    no_data: tuple[float, ...] = ()
    """Stored numbers that stand for no measurement."""
    valid_range: tuple[float, float] | None = None
    """Least and greatest stored number that was measured, if the file says so."""
    notes: tuple[str, ...] = ()
    """What is odd about the file, one sentence each."""
    warnings: tuple[str, ...] = ()
    """What may make values, wavelengths or geometry wrong, one sentence each: reports begin with it."""
    metadata: dict[str, Any] = field(default_factory=dict)
    """Other facts by name, as JSON-able values: exposure_s, gain, f_number, black_level, xmp, ..."""
    sources: tuple[Path, ...] = ()
    """Files that hold the numbers, where they are not `path` alone."""
    dark_lines: int = 0
    """Lines after the image that were taken with the shutter closed."""
    missing_part: _MissingPart | None = field(default=None, repr=False)
    """Which pixels hold no measurement beyond what `no_data` and `valid_range` say of all bands."""

    def read(self, rows: slice = slice(None), bands: BandIndex = slice(None)) -> Shaped[np.ndarray, "h W b"]:
        """Stored numbers of some rows and bands, in the machine's byte order.

        Args:
            rows: One after the other.
            bands: A slice, or indices in any order; negative ones count from the last band.
        Raises:
            CaptureError: the file is cut short or can't be read.
            IndexError: there is no such band.
        """
        height, width, num_bands = self.shape
        first, last, _ = rows.indices(height)
        indices = np.arange(num_bands)[bands]
        rising, order = np.unique(indices, return_inverse=True)
        wanted = (max(0, last - first), width, len(rising))
        if 0 in wanted:
            return np.zeros((wanted[0], width, len(indices)), self.dtype.newbyteorder("="))
        is_slice = len(rising) == len(indices) == rising[-1] - rising[0] + 1
        try:
            values = self.read_part(
                slice(first, last), slice(rising[0], rising[-1] + 1) if is_slice else rising
            )
        except CaptureError:
            raise
        except Exception as error:
            raise unreadable(self.path, error) from error
        if values.shape != wanted:
            raise CaptureError(f"{self.path}: reading gave an array of {values.shape}; expected {wanted}")
        values = values if np.array_equal(rising, indices) else values[..., order]
        return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("="))

    @property
    def dark(self) -> SpectralFile | None:
        """The lines that were taken with the shutter closed, as a dark frame; None where there are none."""
        if not self.dark_lines:
            return None
        begin = self.shape[0]
        return replace(
            self,
            shape=(self.dark_lines, *self.shape[1:]),
            read_part=lambda rows, bands: self.read_part(slice(begin + rows.start, begin + rows.stop), bands),
            dark_lines=0,
            missing_part=None,
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that `read` depends on, `path` first."""
        return (self.path, *(source for source in self.sources if source != self.path))


def find_missing(
    stored: np.ndarray, file: SpectralFile, rows: slice = slice(None), bands: BandIndex = slice(None)
) -> Bool[np.ndarray, "h W"]:
    """Pixels without a measurement: no number in some band, a no-data value of the file, out of its valid range, or
    missing by a mask of the file.

    A no-data value of 0 is also what a dark pixel may read in a band, so that all bands must have it.

    Args:
        stored: Numbers (h, W, b) that were read of these rows and bands.
    """
    missing = np.zeros(stored.shape[:2], bool)
    if stored.dtype.kind == "f":
        missing |= ~np.isfinite(stored).all(axis=-1)
    if file.valid_range is not None:
        low, high = file.valid_range
        missing |= ((stored < low) | (stored > high)).any(axis=-1)
    for no_data in filter(np.isfinite, file.no_data):
        same = _is_number(stored, no_data)
        missing |= same.all(axis=-1) if no_data == 0 else same.any(axis=-1)
    if file.missing_part is not None:
        missing |= file.missing_part(slice(*rows.indices(file.shape[0])), bands)
    return missing


def with_mask(
    file: SpectralFile, name: str, read_mask: Callable[[slice, BandIndex], Shaped[np.ndarray, "h W b"]]
) -> SpectralFile:
    """The file with pixels missing where a mask is 0 in one of the bands that are asked for.

    Source: GDAL, RFC 15: band masks: 0 is no data.

    Args:
        name: What the mask is called in notes.
        read_mask: Its numbers at some rows of the file, for some of its bands or one for all.
    """
    before = file.missing_part

    def missing_part(rows: slice, bands: BandIndex) -> np.ndarray:
        missing = (read_mask(rows, bands) == 0).any(axis=-1)
        return missing if before is None else missing | before(rows, bands)

    note = f"pixels where {name} is 0 count as not measured"
    return replace(file, missing_part=missing_part, notes=(*file.notes, note))


def _is_number(stored: np.ndarray, number: float) -> Bool[np.ndarray, "*shape"]:
    """Where stored numbers are a number that a text gives, in floating point up to the digits of that text.

    Source: GDAL, ARE_REAL_EQUAL: equal within two units of the last place. Of the greatest numbers, which measure
    nothing, six digits are enough, as `%g` writes them.
    """
    if stored.dtype.kind != "f":
        limits = np.iinfo(stored.dtype)
        is_whole = limits.min <= number <= limits.max and number == int(number)
        return stored == stored.dtype.type(number) if is_whole else np.zeros(stored.shape, bool)
    limits = np.finfo(stored.dtype)
    share = 1e-5 if abs(number) > _MEASURES_NOTHING else 4 * min(float(limits.eps), _FLOAT32_EPS)
    ends = np.clip(np.sort([number * (1 - share), number * (1 + share)]), limits.min, limits.max)
    low, high = ends.astype(stored.dtype)
    return (stored >= low) & (stored <= high)


def unreadable(path: Path, error: Exception) -> CaptureError:
    """What to say where a library fails on a file."""
    if isinstance(error, MemoryError):
        return CaptureError(f"{path}: too little memory to read it; cut the file in parts")
    reason = " ".join(str(error).split())[:300] or "no reason given"
    return CaptureError(f"{path}: can't be read ({type(error).__name__}: {reason}); copy the file again")


def take_part(stored: np.ndarray, axes: str, rows: slice, bands: BandIndex) -> np.ndarray:
    """A copy (h, W, b) of some rows and bands of a stored array."""
    return np.array(stored.transpose([axes.index(axis) for axis in "yxb"])[rows][:, :, bands], order="C")


def loaded(load: Callable[..., np.ndarray], path: Path, *arguments: Hashable) -> np.ndarray:
    """The array that `load(path, *arguments)` gives; read again only if others came between or the file changed.

    Arrays of 256 MiB together are kept, or one that is larger.
    """
    state = path.stat()
    key = (load, path.resolve(), arguments, state.st_size, state.st_mtime_ns)
    with _lock:
        if key in _kept:
            _kept.move_to_end(key)
            return _kept[key]
    array: Any = load(path, *arguments)
    array.setflags(write=False)
    with _lock:
        _kept[key] = array
        while len(_kept) > 1 and sum(kept.nbytes for kept in _kept.values()) > _KEPT_BYTES:
            _kept.popitem(last=False)
    return array


def import_extra(package: str) -> ModuleType:
    """A package of the extra `captures`. Raises CaptureError: it isn't installed."""
    try:
        return import_module(package)
    except ImportError as error:
        raise CaptureError(
            f"the package {package.partition('.')[0]} isn't installed ({error}): {install_hint('captures')}"
        ) from error


@dataclass(frozen=True)
class CaptureView:
    """One image from one place."""

    name: str
    """Unique in the capture, fit for file names; poses are found by it or by the stem of one of the files."""
    cube: SpectralFile
    """All bands that were taken from this place."""
    sensor: str = ""
    """Lens or camera of a rig that took it; views of one sensor share bands and size."""
    picture: Path | None = None
    """RGB or RGBA picture with the pixels of the cube."""
    mask: Path | None = None
    """Black where pixels are ignored."""
    labels: Path | None = None
    """True materials, if known."""
    dark: SpectralFile | None = None
    white: SpectralFile | None = None
    """References that were taken for this view alone."""
    white_dark: SpectralFile | None = None
    """Dark frame that was taken for its white reference alone, with the exposure of that."""
    alpha: SpectralFile | None = None
    """Opacity in [0, 1], (H, W, 1), where it is not a channel of the picture; the cube is multiplied by it."""
    lens: Lens | None = None
    """Intrinsics that the camera itself writes; poses may bring better ones."""
    release: str = ""
    """Name of the shutter release; views of one release were taken at one moment by the lenses of a rig."""
    split: Literal["train", "eval"] | None = None
    """What the layout says the view is for."""

    @property
    def references(self) -> list[SpectralFile]:
        """The files of all references of its own."""
        return [file for file in (self.dark, self.white, self.white_dark) if file is not None]


@dataclass(frozen=True)
class Capture:
    """What a folder of an instrument holds."""

    layout: str
    root: Path
    views: tuple[CaptureView, ...]
    """In the order of their names."""
    poses: PoseSet | None = None
    """Where the layout has poses of its own."""
    notes: tuple[str, ...] = ()
    """What is odd about the folder, one sentence each."""
    warnings: tuple[str, ...] = ()
    """What may make values, wavelengths or geometry wrong, one sentence each: reports begin with it."""
    unreadable: tuple[tuple[str, str], ...] = ()
    """Names of views whose files can't be opened, and why."""

    @property
    def names(self) -> list[str]:
        """Of all views, those that can't be opened too, in their order."""
        return sorted(
            [*(view.name for view in self.views), *(name for name, _ in self.unreadable)], key=natural_order
        )
