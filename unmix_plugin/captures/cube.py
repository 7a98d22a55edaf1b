"""The cube of an instrument's file, opened but not read: its numbers, bands, meaning and exposure; and the views of a
capture, which are made of cubes.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped

from unmix_plugin.captures.names import natural_order
from unmix_plugin.captures.numbers import Axes, BandIndex, Numbers, find_zeros
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.errors import CaptureError, install_hint

MOST_WIDTH = 0.25
"""Width of a band, as a share of its wavelength, up to which one wavelength stands for it; panchromatic: 0.7."""
_MEASURES_NOTHING = 1e30
_REFLECTANCE = re.compile(r"(?<![a-z])reflectance(?![a-z])", re.IGNORECASE)
_FLOAT32_EPS = float(np.finfo(np.float32).eps)


@dataclass(frozen=True)
class ReadOptions:
    """What a user adds to files that don't say enough of themselves, or against what they say."""

    dataset: str | None = None
    """Variable or data set to take from a file that holds several."""
    bands: BandTable | None = None
    """Centres of the bands, and widths and marks where the user has them, in the order of the file."""
    axes: Axes | None = None
    """Order of the axes in formats that don't fix it: NumPy, MATLAB, HDF5, pages of a TIFF."""
    size: tuple[int, int] | None = None
    """Rows and columns of an image that is stored as a list of pixels, column after column as MATLAB writes it."""
    mosaic: tuple[int, int] | None = None
    """Rows and columns of filters in images of one band, of which each pixel of a block is a band."""
    exclude: tuple[Path, ...] = ()
    """Files in a folder that are not views, such as dark and white references."""

    @property
    def wavelengths_nm(self) -> Float64[np.ndarray, " B"] | None:
        """Band centres in nm that the user gives."""
        return None if self.bands is None else self.bands.wavelengths_nm


@dataclass(frozen=True)
class BandTable:
    """What a file says of its bands; None where it says nothing."""

    wavelengths_nm: Float64[np.ndarray, " B"] | None = None
    """Band centres in nm, in the order of the file."""
    source: str = "the file gives no wavelengths"
    """Where the wavelengths were found and in which unit, for people: `header field 'wavelength', Micrometers`."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Full width at half maximum of each band, nm."""
    bad: Bool[np.ndarray, " B"] | None = None
    """Bands that the file itself marks as bad."""
    names: tuple[str, ...] | None = None
    """What the file calls its bands."""
    is_given: bool = False
    """Whether the user gives the wavelengths, which files do not state, or state wrongly."""

    @property
    def num_known(self) -> int:
        """How many wavelengths it has."""
        return 0 if self.wavelengths_nm is None else len(self.wavelengths_nm)

    def __getitem__(self, index: slice) -> BandTable:
        """Some of the bands."""
        centres, widths, bad, names = (
            None if of_bands is None else of_bands[index]
            for of_bands in (self.wavelengths_nm, self.fwhm_nm, self.bad, self.names)
        )
        return replace(self, wavelengths_nm=centres, fwhm_nm=widths, bad=bad, names=names)

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


class Meaning(Enum):
    """What the values of a cube are once its gains and offsets are applied, as far as its file says."""

    RAW = "stored numbers"
    FRACTION = "numbers of which 1 means something, and nobody says what"
    RADIANCE = "radiance"
    REFLECTANCE = "reflectance"
    SRGB = "brightness to the eye, gamma-encoded as sRGB"


@dataclass(frozen=True)
class Linear:
    """What the stored numbers of a file stand for: value = gain * stored + offset, band by band."""

    gains: Float64[np.ndarray, " B"]
    """Above 0."""
    offsets: Float64[np.ndarray, " B"]
    source: str
    """Where the file says so, for people: `header field 'data gain values'`."""
    meaning: Meaning = Meaning.FRACTION
    """What values are."""
    entries: tuple[str, ...] = ()
    """Names of the entries that say so."""

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
    path: Path,
    num_bands: int,
    *,
    gains: Sequence[float] = (),
    offsets: Sequence[float] = (),
    source: str,
    meaning: Meaning = Meaning.FRACTION,
    entries: tuple[str, ...] = (),
) -> Linear | None:
    """The calibration that a file states; None where it changes nothing.

    Args:
        gains, offsets: One a band, one for all, or none.
        source, meaning, entries: As in `Linear`.
    Raises:
        CaptureError: another number of them, or gains that are not above 0: without them spectra would be false.
    """
    columns = []
    for name, numbers, usual in (("gains", gains, 1.0), ("offsets", offsets, 0.0)):
        values = np.array(list(numbers) or [usual], dtype=np.float64)
        if len(values) not in (1, num_bands):
            raise CaptureError(
                f"{path}: {source} gives {len(values)} {name} for {num_bands} bands; expected one a band, or one for "
                "all: correct them or take them out"
            )
        if not np.isfinite(values).all() or (name == "gains" and values.min() <= 0):
            raise CaptureError(
                f"{path}: {source} gives {name} from {values.min():g} to {values.max():g}; expected finite numbers"
                f"{' above 0' if name == 'gains' else ''}: correct them or take them out"
            )
        columns.append(np.broadcast_to(values, num_bands))
    changes = (columns[0] != 1).any() or columns[1].any()
    return Linear(columns[0], columns[1], source, meaning, entries) if changes else None


@dataclass(frozen=True)
class Factor:
    """One factor of an exposure."""

    numbers: tuple[float, ...]
    """One, or one a band."""
    source: str = ""
    """Where the file says it, for people: `header field 'tint'`."""
    assumed: str = ""
    """Unit that numbers without one were taken to be in; empty where the file says it."""

    @property
    def number(self) -> float | list[float]:
        """The only one, or the list."""
        return self.numbers[0] if len(self.numbers) == 1 else list(self.numbers)

    @property
    def description(self) -> str:
        """Source and unit, for people."""
        return f"{self.source}, no unit: taken as {self.assumed}" if self.assumed else self.source


@dataclass(frozen=True)
class Exposure:
    """How long a file was exposed, as far as it says."""

    time: Factor | None = None
    """Seconds."""
    gain: Factor | None = None
    f_number: float | None = None
    """Of the lens."""

    def to_json(self) -> dict[str, Any]:
        """For people."""
        facts: dict[str, Any] = {}
        for name, factor in (("exposure_s", self.time), ("gain", self.gain)):
            if factor is not None:
                facts[name] = factor.number
                facts |= {f"{name.partition('_')[0]}_evidence": factor.description} if factor.source else {}
        return facts if self.f_number is None else facts | {"f_number": self.f_number}


XmpTags: TypeAlias = Mapping[str, str | list[str]]
"""Text of each tag, or the texts of a list."""


@dataclass(frozen=True)
class CameraTags:
    """What a camera writes beside its pixels."""

    xmp: XmpTags = field(default_factory=dict)
    """By full names, such as `Camera:BandName`."""
    exif: Mapping[str, Any] = field(default_factory=dict)
    """By tifffile's names; numbers, texts or lists of numbers."""


@dataclass(frozen=True, eq=False)
class Cube:
    """One image of (H, W, B) numbers on disk; equal to itself alone."""

    path: Path
    """The file that was named: a header where there is one."""
    reader: str
    """Name of the reader: envi, tiff, exr, matlab, hdf5, netcdf, npy, picture."""
    shape: tuple[int, int, int]
    """H, W, B."""
    dtype: np.dtype
    """Type of the stored numbers, in any byte order."""
    numbers: Numbers | None = field(default=None, repr=False)
    """Where the numbers lie, rows before and behind the image among them; None where they are those of `parts`."""
    parts: tuple[Cube, ...] = field(default=(), repr=False)
    """Files that hold one band each, of which each says itself what is missing in it."""
    bands: BandTable = BandTable()
    interleave: str | None = None
    """bsq, bil or bip where the format has a choice."""
    linear: Linear | None = None
    """What stored numbers stand for, if the file says so."""
    no_data: tuple[float, ...] = ()
    """Stored numbers that stand for no measurement."""
    valid_range: tuple[float, float] | None = None
    """Least and greatest stored number that was measured, if the file says so."""
    remarks: tuple[Remark, ...] = ()
    """What is odd about the file."""
    exposure: Exposure = Exposure()
    camera: CameraTags = CameraTags()
    is_srgb: bool = False
    """Whether numbers are gamma-encoded, as those of pictures for people are."""
    reflectance_source: str = ""
    """Where the file says that values are reflectances other than by gains: a layer, or a scale factor of 1."""
    dataset: str = ""
    """Name of the array in a file that holds several."""
    orientation: int = 1
    """EXIF's, 1 to 8, where 1 is not turned; it is never applied."""
    map_entries: Mapping[str, str] = field(default_factory=dict)
    """Entries of an ENVI header that place the image on a map."""
    is_geotiff: bool = False
    """Whether tags of a TIFF place it on a map."""
    others: Mapping[str, Any] = field(default_factory=dict)
    """Other entries of the file by name, JSON-able, for people alone: nothing is decided from them."""
    sources: tuple[Path, ...] = ()
    """Files that hold the numbers, where they are not `path` alone."""
    first_line: int = 0
    """Of the numbers, the line that is the first of the image."""
    dark_lines: int = 0
    """Lines after the image that were taken with the shutter closed."""
    lines_per_second: float | None = None
    """Of a line camera, if the file says so."""
    masks: tuple[Numbers, ...] = field(default=(), repr=False)
    """Of one band or as many as the file, 0 where a pixel holds no measurement."""

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
            if self.numbers is not None:
                chosen = slice(rising[0], rising[-1] + 1) if is_slice else rising
                values = self.numbers.read(slice(self.first_line + first, self.first_line + last), chosen)
            else:
                lines = slice(first, last)
                values = np.concatenate([self.parts[band].read(lines) for band in rising], axis=-1)
        except CaptureError:
            raise
        except Exception as error:
            raise unreadable(self.path, error) from error
        if values.shape != wanted:
            raise CaptureError(f"{self.path}: reading gave an array of {values.shape}; expected {wanted}")
        values = values if np.array_equal(rising, indices) else values[..., order]
        return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("="))

    def total_exposure(self, to_light: bool = True) -> Float64[np.ndarray, " b"] | None:
        """Exposure time times gain, over the square of the f-number if that is known: what the numbers of one scene
        grow with. One number, or one a band; None where the file does not say the time.

        Args:
            to_light: Whether the aperture counts, which lets in light but no dark current.
        """
        time, gain, f_number = self.exposure.time, self.exposure.gain, self.exposure.f_number
        factors = [np.array(factor.numbers) for factor in (time, gain) if factor is not None]
        if time is None or any(len(factor) not in (1, self.shape[2]) for factor in factors):
            return None
        exposure = np.multiply.reduce(np.broadcast_arrays(*factors))
        exposure = exposure if f_number is None or not to_light else exposure / f_number**2
        return exposure if np.isfinite(exposure).all() and (exposure > 0).all() else None

    def remarking(self, *remarks: Remark) -> Cube:
        """The cube with more remarks."""
        return replace(self, remarks=(*self.remarks, *remarks))

    @property
    def meaning(self) -> Meaning:
        """What values are, as far as the file says by its entries. Whether a camera's own calibration makes radiance of
        them, `radiometric_model` tells."""
        linear = Meaning.RAW if self.linear is None else self.linear.meaning
        if self.is_srgb:
            return Meaning.SRGB
        if self.reflectance_source or linear is Meaning.REFLECTANCE:
            return Meaning.REFLECTANCE
        return Meaning.FRACTION if linear is Meaning.RAW and self.dtype.kind == "f" else linear

    @property
    def meaning_source(self) -> str:
        """Where the file says so, for people; empty where it doesn't."""
        return self.reflectance_source or ("" if self.linear is None else self.linear.source)

    @property
    def reflectance_name(self) -> str:
        """The name of the file or of its array, where it has the word reflectance (REFLECTANCE_212, site/reflectance);
        empty for raw numbers, which whole ones without a gain are whatever their name (reflectance_target)."""
        if self.dtype.kind != "f" and self.linear is None:
            return ""
        return next((name for name in (self.path.stem, self.dataset) if _REFLECTANCE.search(name)), "")

    @property
    def facts(self) -> dict[str, Any]:
        """All that the file says beside its bands and numbers, JSON-able, for people."""
        facts = {**self.others, **self.exposure.to_json()}
        facts |= {
            name: value for name, value in (("xmp", self.camera.xmp), ("exif", self.camera.exif)) if value
        }
        facts |= {"encoding": "sRGB"} if self.is_srgb else {}
        facts |= {"dataset": self.dataset} if self.dataset else {}
        facts |= {"orientation": self.orientation} if self.orientation != 1 else {}
        facts |= {"map": dict(self.map_entries)} if self.map_entries else {}
        return facts | ({"geo_reference": "GeoTIFF"} if self.is_geotiff else {})

    @property
    def dark(self) -> Cube | None:
        """The lines that were taken with the shutter closed, as a dark frame; None where there are none."""
        if not self.dark_lines:
            return None
        shape = (self.dark_lines, *self.shape[1:])
        return replace(self, shape=shape, first_line=self.shape[0], dark_lines=0, masks=())

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that `read` depends on, `path` first."""
        return (self.path, *(source for source in self.sources if source != self.path))


def find_missing(
    stored: np.ndarray, file: Cube, rows: slice = slice(None), bands: BandIndex = slice(None)
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
    asked = slice(*rows.indices(file.shape[0])[:2])
    if file.masks:
        missing |= find_zeros(file.masks, asked, bands)
    for index, band in enumerate(np.arange(len(file.parts))[bands] if file.parts else ()):
        missing |= find_missing(stored[..., index : index + 1], file.parts[band], asked)
    return missing


def with_mask(file: Cube, name: str, mask: Numbers) -> Cube:
    """The file with pixels missing where a mask, called `name` in remarks, is 0 in one of the bands that are asked for.

    Source: GDAL, RFC 15: band masks: 0 is no data.
    """
    return replace(file, masks=(*file.masks, mask)).remarking(Remark.of(Code.MASK_USED, mask=name))


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
    cube: Cube
    """All bands that were taken from this place."""
    sensor: str = ""
    """Lens or camera of a rig that took it; views of one sensor share bands and size."""
    picture: Path | None = None
    """RGB or RGBA picture with the pixels of the cube."""
    mask: Path | None = None
    """Black where pixels are ignored."""
    labels: Path | None = None
    """True materials, if known."""
    dark: Cube | None = None
    white: Cube | None = None
    """References that were taken for this view alone."""
    white_dark: Cube | None = None
    """Dark frame that was taken for its white reference alone, with the exposure of that."""
    alpha: Cube | None = None
    """Opacity in [0, 1], (H, W, 1), where it is not a channel of the picture; the cube is multiplied by it."""
    lens: Lens | None = None
    """Intrinsics that the camera itself writes; poses may bring better ones."""
    shot: str = ""
    """Name of the shutter release; views of one shot were taken at one moment by the lenses of a rig."""
    split: Literal["train", "eval"] | None = None
    """What the layout says the view is for."""

    @property
    def references(self) -> list[Cube]:
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
    unreadable: Mapping[str, Remark] = field(default_factory=dict)
    """Why files of views can't be opened, by the names of these."""
    no_poses: str = ""
    """Why the layout has no poses that can be used, for people."""

    @property
    def names(self) -> list[str]:
        """Of all views, those that can't be opened too, in their order."""
        return sorted([*(view.name for view in self.views), *self.unreadable], key=natural_order)
