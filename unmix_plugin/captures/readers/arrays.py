"""Files that hold arrays by name: which of them is the image, and which describe its bands.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.band_entries import GOOD, NAMES, check_bands, counts_bands, says_bands, state_bands
from unmix_plugin.captures.cube import (
    Cube,
    Linear,
    Meaning,
    ReadOptions,
    linear_values,
)
from unmix_plugin.captures.fields import (
    OF_ALL_IMAGES,
    Format,
    is_exposure,
    listed,
    plain_names,
    state_exposure,
    state_linear,
)
from unmix_plugin.captures.names import common_length
from unmix_plugin.captures.numbers import Axes, Block, Numbers
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import MOST_BANDS, MOST_TEXT_BYTES, allow_parts

_SIDES = ("nrow", "nrows", "ncol", "ncols")
_NO_DATA = (
    *("_fillvalue", "fillvalue", "fill_value", "missing_value", "missingvalue", "data_ignore_value"),
    *("nodata", "no_data", "nodata_value", "no_data_value"),
)
_VALID = ("valid_range", "valid_min", "valid_max")
_QUALITY = re.compile(r"(^|_)(err|error|errors|flags?|mask|quality|qa|uncertainty|std|stddev)(_|$)")
"""What an array of three axes is called that measures nothing itself."""
_WINDOW = re.compile(r"band_window_\d+_nanometers", re.I)
_AXIS_NAMES = {
    "b": "band bands nbands wavelength wavelengths wavelength_nm wavelength_3d wl lambda channel spectral",
    "y": "y lat latitude row rows nrows line lines nlines downtrack northing height",
    "x": "x lon longitude col cols ncols column columns sample samples nsamples crosstrack easting width",
}
_AXES = {name: axis for axis, names in _AXIS_NAMES.items() for name in names.split()}
_NUMBERS, _TEXTS = "iuf", "OSU"
"""NumPy's kinds of types that measure, where marks of bands may also be booleans; and of those that hold texts."""
UNREAD = np.dtype("V")
"""Type of what a file holds that is neither numbers nor texts."""
UNREADABLE = object()
"""Value of an attribute that is there and can't be read."""
_WITH_BANDS_AT: tuple[Axes, Axes, Axes] = ("byx", "ybx", "yxb")
_LISTED = 12
"""How many arrays a message names."""
_WHERE = "data set or attribute"


@dataclass(frozen=True)
class FoundArray:
    """One array of a file."""

    name: str
    """With the groups that it is in, separated by `/`."""
    shape: tuple[int, ...]
    dtype: np.dtype
    numbers: Block
    """Perhaps of a smaller type."""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    inherited: Mapping[str, Any] = field(default_factory=dict)
    """Attributes of the groups that it is in and of the file, the nearest first."""
    dimensions: tuple[str, ...] | None = None
    """Names of its axes."""
    fill: float | None = None
    """Stored number where nothing was ever written, if the format has one."""

    @property
    def own_name(self) -> str:
        """Without groups, in lower case."""
        return self.name.rpartition("/")[2].lower()

    @property
    def all_attributes(self) -> dict[str, Any]:
        """Its own attributes, and those inherited that it lacks, as texts, numbers or lists."""
        inherited = {key: value for key, value in self.inherited.items() if key not in self.attributes}
        return {key: _decoded(value) for key, value in {**self.attributes, **inherited}.items()}

    @property
    def is_vector(self) -> bool:
        """Whether it is a number or a list of them, also as MATLAB's matrix of one row or column; marks of bands may be
        booleans."""
        kinds = _NUMBERS + "b" * bool(GOOD.fullmatch(self.own_name))
        is_list = sum(length != 1 for length in self.shape) <= 1 and prod(self.shape) <= MOST_BANDS
        return is_list and self.dtype.kind in kinds


def image_of_arrays(path: Path, reader: str, arrays: Sequence[FoundArray], options: ReadOptions) -> Cube:
    """The image of a file: the array that is named, otherwise the only one of three axes."""
    image = _find_image(path, arrays, options)
    what = image.name or "the array"
    size = _pixel_list_size(image, arrays, options)
    fixed = options.axes
    shape = image.shape
    if len(image.shape) == 2:  # a list of pixels, column after column, or one band
        if size is None and options.size is not None:
            raise CaptureError(f"{path}: {what} {shape} is not a list of {prod(options.size)} pixels")
        if size is None:
            shape, fixed = (*image.shape, 1), "yxb"
        elif image.shape[1] == prod(size):
            shape, fixed = (image.shape[0], size[1], size[0]), "bxy"
        else:
            shape, fixed = (size[1], size[0], image.shape[1]), "xyb"
    elif len(image.shape) != 3:
        raise CaptureError(f"{path}: {what} has the shape {image.shape}; expected three axes")
    elif fixed is None:
        names = (name.lower().rpartition("/")[2] for name in image.dimensions or ())
        named: Any = "".join(_AXES.get(name, "?") for name in names)
        fixed = named if sorted(named) == ["b", "x", "y"] else None
    remarks: list[Remark] = []
    entries = _entries(arrays, image)
    stated = state_bands(entries, _WHERE)
    given = options.wavelengths_nm if options.wavelengths_nm is not None else stated.centres
    axes = choose_axes(shape, fixed, None if given is None else len(given), remarks)
    of_image = image_shape(shape, axes)
    allow_parts(path, of_image[2], "bands", CaptureError, MOST_BANDS)
    bands = check_bands(stated, of_image[2], remarks)
    # NEON's `Band_Window_1_Nanometers`, in which the air lets no light through.
    nm, windows = (
        bands.wavelengths_nm,
        [_numbers(v) for k, v in image.all_attributes.items() if _WINDOW.fullmatch(k)],
    )
    if nm is not None:
        bands = bands.marking(*((nm >= min(ends)) & (nm <= max(ends)) for ends in windows if ends))
    linear = _linear(path, image, of_image[2], remarks)
    remarks += _unread(path, image)
    applied = () if linear is None else linear.entries
    exposure = state_exposure({key: entries[key] for key in entries if key not in applied}, _WHERE, remarks)
    dtype, no_data, valid = _measured_numbers(image, linear)

    others = [
        one.name
        for one in arrays
        if one.dtype == UNREAD
        or not (one.own_name in (*_AXES, *_SIDES) or is_exposure(one.own_name) or _lists_bands(one))
        if one is not image
    ]
    if others:
        remarks.append(Remark.of(Code.ARRAYS_UNUSED, names=others))
    return Cube(
        path=path,
        reader=reader,
        shape=of_image,
        dtype=dtype,
        numbers=Numbers((image.numbers,), shape, axes, dtype),
        bands=bands,
        linear=linear,
        no_data=no_data,
        valid_range=valid,
        remarks=tuple(remarks),
        exposure=exposure,
        dataset=image.name if len(arrays) > 1 else "",
        others={"axes": axes},
    )


def choose_axes(
    shape: tuple[int, ...],
    given: Axes | None,
    num_wavelengths: int | None,
    remarks: list[Remark],
    default: Axes = "yxb",
) -> Axes:
    """Axes of a 3-D array.

    Args:
        given: What the user says, which overrides everything.
        num_wavelengths: Length that the axis of bands has, if it is known.
        default: Where no length tells.

    >>> choose_axes((31, 64, 48), None, 31, [])
    'byx'
    """
    if given is not None:
        return given
    fitting = [axis for axis in (2, 0, 1) if shape[axis] == num_wavelengths]
    if _WITH_BANDS_AT.index(default) in fitting:
        fitting.insert(0, _WITH_BANDS_AT.index(default))
    if fitting:
        if len(set(fitting)) > 1:
            facts = {"number": num_wavelengths, "shape": str(shape), "axis": fitting[0]}
            remarks.append(Remark.of(Code.AXES_AMBIGUOUS, **facts))
        return _WITH_BANDS_AT[fitting[0]]
    bands = _WITH_BANDS_AT.index(default)
    shortest = int(np.argmin(shape))
    if shape[shortest] < shape[bands]:
        other = "byx" if default == "yxb" else "yxb"
        facts = {"axis": bands, "shape": str(shape), "shortest": shortest, "other": other}
        remarks.append(Remark.of(Code.AXES_UNLIKELY, **facts))
    return default


def image_shape(shape: tuple[int, ...], axes: Axes) -> tuple[int, int, int]:
    """Rows, columns and bands of a stored array.

    >>> image_shape((31, 64, 48), "byx")
    (64, 48, 31)
    """
    return shape[axes.index("y")], shape[axes.index("x")], shape[axes.index("b")]


def _find_image(path: Path, arrays: Sequence[FoundArray], options: ReadOptions) -> FoundArray:
    numeric = [array for array in arrays if array.dtype.kind in _NUMBERS and 0 not in array.shape]
    if [(array.name, len(array.shape)) for array in arrays] == [("", 2)] and options.dataset is None:
        return arrays[0]  # the file is one matrix: one band
    listed = ", ".join(f"{array.name or 'one array'} {array.shape}" for array in numeric[:_LISTED])
    listed = listed or "no arrays of numbers"
    if options.dataset is not None:
        wanted = options.dataset.strip("/")
        named = [array for array in numeric if array.name.strip("/") == wanted]
        named = named or [array for array in numeric if array.name.rpartition("/")[2] == wanted]
        if len(named) != 1:
            found = f"{len(named) or 'no'} data sets '{options.dataset}'"
            raise CaptureError(f"{path}: {found}; the file holds {listed}")
        return named[0]
    images = [array for array in numeric if len(array.shape) == 3]
    if not images:
        images = [array for array in numeric if _pixel_list_size(array, arrays, options) is not None]
    if len(images) > 1:
        images = [image for image in images if not _QUALITY.search(image.own_name)] or images
    if len(images) > 1:
        described = [image for image in images if state_bands(_entries(arrays, image), _WHERE).centres]
        images = described or images
    if not images:
        raise CaptureError(
            f"{path}: no data set has three axes; name one (--dataset) and, in unmix-image, give the size "
            f"of an image that is stored as a matrix (--size ROWS COLUMNS). The file holds {listed}"
        )
    if len(images) > 1:
        several = f"{len(images)} data sets could be the image"
        raise CaptureError(f"{path}: {several}; name one (--dataset). The file holds {listed}")
    return images[0]


def _pixel_list_size(
    array: FoundArray, arrays: Sequence[FoundArray], options: ReadOptions
) -> tuple[int, int] | None:
    """Rows and columns of an image that is stored as a matrix of bands and pixels; None if it is not such a matrix.

    Files of unmixing scenes give them as numbers `nRow` and `nCol`.
    """
    size = options.size
    numbers = {one.own_name.rstrip("s"): one for one in arrays if one.is_vector and prod(one.shape) == 1}
    if size is None and "nrow" in numbers and "ncol" in numbers:
        rows, columns = (float(numbers[name].numbers.array().reshape(-1)[0]) for name in ("nrow", "ncol"))
        size = (int(rows), int(columns)) if 1 <= rows < 2**31 and 1 <= columns < 2**31 else None
    if len(array.shape) != 2 or size is None or prod(size) not in array.shape:
        return None
    return size


def _entries(arrays: Sequence[FoundArray], image: FoundArray) -> dict[str, Any]:
    """What attributes say, and lists beside the image; of bands, lists go before attributes, of which those count that
    fit an axis, first the one whose name has a word of the image's."""

    def words_apart(key: str) -> int:
        return -len(words & set(re.split(r"[\W_]+", key.lower())))

    attributes = {key: value for key, value in image.all_attributes.items() if value is not UNREADABLE}
    words = set(re.split(r"[\W_]+", image.own_name))
    entries = {key: value for key, value in attributes.items() if not says_bands(key.lower())}
    entries |= _lists_beside(arrays, image)
    for key in sorted(attributes, key=words_apart):
        is_of_bands = says_bands(key.lower())
        values = np.atleast_1d(_numbers_in_text(attributes[key]) if is_of_bands else attributes[key])
        kinds = _NUMBERS + "b" * bool(GOOD.fullmatch(key.lower()))
        if is_of_bands and values.dtype.kind in _TEXTS and len(values) in image.shape:
            entries.setdefault("band names", values)
        if values.ndim == 1 and values.dtype.kind in kinds and len(values) in image.shape:
            entries.setdefault(key, values)
    return entries


def _decoded(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _numbers_in_text(value: Any) -> Any:
    """Items of a text, or texts, as numbers where all are; anything else as it is."""
    if isinstance(value, str) or np.asarray(value).dtype.kind in _TEXTS:
        with suppress(TypeError, ValueError):
            return [float(text) for text in listed(value)]
        return [str(_decoded(text)) for text in listed(value, ",")]
    return value


def describes_image(name: str) -> bool:
    """Whether an array of this name, with its groups, may say something of an image beside it."""
    last = name.rpartition("/")[2].lower()
    return (
        last in _AXES
        or last in _SIDES
        or is_exposure(last)
        or says_bands(last)
        or bool(NAMES.fullmatch(last))
    )


def _lists_bands(array: FoundArray) -> bool:
    """Whether it is called as a list of bands is, or a text as names of bands are."""
    is_named = NAMES.fullmatch(array.own_name) or _AXES.get(array.own_name) == "b"
    return says_bands(array.own_name) or bool(is_named and array.dtype.kind in _TEXTS)


def _lists_beside(arrays: Sequence[FoundArray], image: FoundArray) -> dict[str, Any]:
    """Numbers and names of bands, and exposures with their units, by name; of one name those in the nearest group."""

    def groups_apart(array: FoundArray) -> int:
        return -common_length([one.name.strip("/").split("/")[:-1] for one in (image, array)])

    beside: dict[str, Any] = {}
    for array in sorted(arrays, key=groups_apart):
        name, is_text = array.own_name, array.dtype.kind in _TEXTS
        lengths = (1, *image.shape) if is_exposure(name) else image.shape if _lists_bands(array) else ()
        known = [key.rpartition("/")[2].lower() for key in beside]
        is_list = (*array.shape, 1)[0] in (1, *image.shape) if is_text else array.is_vector
        is_list &= prod(array.shape) * max(1, array.dtype.itemsize) <= MOST_TEXT_BYTES
        if array is image or name in known or not (lengths and is_list):
            continue
        stored: Any = np.asarray(array.numbers.array())
        if is_text:  # of letters, a row is a text
            letters = stored.ndim == 2 and stored.dtype == "S1"
            texts = [b"".join(row) for row in stored] if letters else stored.reshape(-1).tolist()
            numbers = _numbers_in_text(_decoded(texts[0]) if len(texts) == 1 else texts)
        else:  # as CF packs any variable
            gain, offset = (_first_number(array.attributes, name) for name in ("scale_factor", "add_offset"))
            stored = stored.reshape(-1) if gain is None else stored.reshape(-1) * gain
            numbers = (stored if offset is None else stored + offset).tolist()
        if len(numbers) not in lengths:
            continue
        plain = plain_names(array.attributes)
        unit = next((array.all_attributes[plain[key]] for key in ("units", "unit") if key in plain), None)
        if is_exposure(name):
            beside[name] = numbers if unit is None else [f"{number} {unit}" for number in numbers]
        elif isinstance(numbers[0], str):
            beside.setdefault("band names", numbers)
        elif name != "bands" or not counts_bands(numbers, unit):
            beside |= {array.name: numbers} | ({} if unit is None else {f"{name} units": unit})
    return beside


def _linear(path: Path, image: FoundArray, num_bands: int, remarks: list[Remark]) -> Linear | None:
    """Gains and offsets among the attributes of an image, or those of its level of PRISMA: radiances of levels 1 and
    2B, reflectances of 2C and 2D.

    Source: ASI, PRISMA Products Specification, chapters 5 and 7 (`ScaleFactor_Vnir`, `L2ScaleVnirMin`); Busetto and
    Ranghetti, prismaread (of level 2B).
    """
    found = {key: _numbers(value) for key, value in image.all_attributes.items()}
    plain = plain_names({key: numbers for key, numbers in found.items() if numbers})
    found = {
        key: found[key] for name, key in plain.items() if key in image.attributes or name in OF_ALL_IMAGES
    }
    named = plain_names(found)
    if "scale_factor" in named:  # before the factor of reflectances
        found.pop(named.get("reflectance_scale_factor", ""), None)
    linear = state_linear(path, num_bands, found, where="attribute", format_of=Format.ARRAYS, remarks=remarks)
    if linear is not None:
        return linear
    part = next((part for part in ("Vnir", "Swir") if part.lower() in image.own_name), "")
    names = (f"L2Scale{part}Min", f"L2Scale{part}Max", f"ScaleFactor_{part}", f"Offset_{part}")
    low, high, factor, offset = (_first_number(image.all_attributes, name.lower()) for name in names)
    if low is not None and high is not None and high > low:
        meaning = Meaning.RADIANCE if "prs_l2b_" in image.name.lower() else Meaning.REFLECTANCE
        gains, offsets, used = [(high - low) / 65535.0], [low], names[:2]
    elif factor:
        meaning, gains, offsets, used = Meaning.RADIANCE, [1.0 / factor], [-(offset or 0.0)], names[2:]
    else:
        return None
    source = f"attribute '{used[0]}' and '{used[1]}' of {meaning.value}"
    return linear_values(
        path, num_bands, gains=gains, offsets=offsets, source=source, meaning=meaning, entries=used
    )


def _unread(path: Path, image: FoundArray) -> list[Remark]:
    """Remarks on attributes that say what stands for no measurement, or of bands, and that are no numbers or can't be
    read at all. Raises CaptureError: what numbers are to be multiplied by can't be read."""
    attributes, remarks = image.all_attributes, []
    for name, key in plain_names(attributes).items():
        value = attributes[key]
        is_read = value is not UNREADABLE
        is_own = (
            key in image.attributes
            and name in (*Format.ARRAYS.gains, *Format.ARRAYS.offsets)
            and name != "gain"
        )
        if name in OF_ALL_IMAGES and not _numbers(value):
            found = f"is {str(value)[:40]!r}, no number" if is_read else "is of a type that can't be read"
            raise CaptureError(
                f"{path}: attribute '{key}' {found}: without it all numbers would be false; write it as a number, or "
                "take it out"
            )
        is_number = is_own or name in (*_NO_DATA, *_VALID)
        if (is_number and not _numbers(value)) or (says_bands(name) and not is_read):
            entry, shown = f"attribute '{key}'", repr(str(value)[:40])
            remarks.append(
                Remark.of(Code.ENTRY_NO_NUMBER, entry=entry, value=shown)
                if is_read
                else Remark.of(Code.ENTRY_UNREADABLE, entry=entry)
            )
    return remarks


def _numbers(value: Any) -> list[float]:
    """Numbers of an attribute; none where it is something else."""
    if value is UNREADABLE:
        return []
    try:
        return np.asarray(value, dtype=np.float64).reshape(-1).tolist()
    except (TypeError, ValueError):
        return []


def _first_number(attributes: Mapping[str, Any], name: str) -> float | None:
    """The first number of an attribute of this plain name; None without one."""
    key = plain_names(attributes).get(name)
    return None if key is None else next(iter(_numbers(attributes[key])), None)


def _measured_numbers(
    image: FoundArray, linear: Linear | None
) -> tuple[np.dtype, tuple[float, ...], tuple[float, float] | None]:
    """Type of the stored numbers, every one that stands for no measurement, and the range of those that do.

    Source: CF conventions, 2.5.1: `_FillValue` and `missing_value` both mark missing numbers; of ranges netCDF-Java,
    EnhanceScaleMissingUnsigned.
    """
    attributes, dtype, valid = image.all_attributes, image.dtype, None
    named = plain_names(attributes)
    stated = {name: attributes[named[name]] for name in _VALID if name in named}
    ends = {name: _numbers(value) for name, value in stated.items()}
    both = [*ends.get("valid_min", [-np.inf]), *ends.get("valid_max", [np.inf])]
    both = ends["valid_range"] if len(ends.get("valid_range", [])) == 2 else both
    if stated and len(both) == 2:
        is_float = any(np.asarray(value).dtype.kind == "f" for value in stated.values())
        if (
            is_float and dtype.kind != "f" and linear is not None
        ):  # one of values, beside packed whole numbers
            packed = np.subtract.outer(both, linear.offsets) / linear.gains
            both = [packed[0].min() - 0.5, packed[1].max() + 0.5]  # between whole numbers, as dividing rounds
        valid = float(both[0]), float(both[1])
    no_data = [number for name in _NO_DATA if name in named for number in _numbers(attributes[named[name]])]
    if dtype.kind == "i" and str(attributes.get("_Unsigned", "")).lower() == "true":
        dtype, more = np.dtype(dtype.str.replace("i", "u")), 256.0**dtype.itemsize  # attributes are signed
        no_data = [number + more * (number < 0) for number in no_data]
        valid = valid and (valid[0] + more * (valid[0] < 0), valid[1] + more * (valid[1] < 0))
    elif image.fill is not None and image.fill != 0 and (dtype.kind == "f" or image.fill < 0):
        no_data.append(image.fill)  # other numbers may be light
    no_data = [np.nan if np.isnan(number) else number for number in no_data]  # of which one is like another
    return dtype, tuple(dict.fromkeys(no_data)), valid
