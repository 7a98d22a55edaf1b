"""Files that hold arrays by name: which of them is the image, and which describe its bands.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from unmix_plugin.captures.header_values import StatedBands, check_bands, exposure_facts, is_exposure
from unmix_plugin.captures.spectral_file import (
    Axes,
    BandIndex,
    Linear,
    ReadOptions,
    SpectralFile,
    choose_axes,
    image_shape,
    linear_values,
    take_part,
)
from unmix_plugin.errors import CaptureError, name_some
from unmix_plugin.spectral.bands import are_band_numbers, nm_per_unit

_TakePart: TypeAlias = Callable[[Axes, slice, BandIndex], np.ndarray]
"""(h, W, b) numbers of a stored array whose axes are these."""

_CENTRES = re.compile(
    r"(list_cw_[^_]*)|(bands)|((band_?|cent(er|re|ral)_?|sensor_?)*(wavelengths?|wavelen|wvls?|wls?|lambdas?|waves?))(_?(nm|um))?"
)
_WIDTHS = re.compile(r"(fwhms?|band_?widths?|list_fwhm_[^_]*)(_?(nm|um))?")
_SIDES = re.compile("n(row|col)s?")
_GOOD = re.compile(r"bbl|good_(wavelengths?|bands?)|list_cw_.*_flags")
_NO_DATA = (
    *("_fillvalue", "fillvalue", "fill_value", "missing_value", "missingvalue", "data_ignore_value"),
    *("nodata", "no_data", "nodata_value", "no_data_value"),
)
_GAINS, _OFFSETS = ("scale_factor", "reflectance_scale_factor"), ("add_offset",)
_OWN_GAINS = ("scalefactor", "scale", "gain", "gains", "slope")
_OWN_OFFSETS = ("offset", "offsets", "bias", "intercept")
"""Names that mean this only beside the numbers themselves; those above hold for all images of a file."""
_DIVISORS = ("reflectance_scale_factor",)
_MAY_DIVIDE = ("scale_factor", "scalefactor", "scale")
"""Names in any case of factors that divide where they are above 1, as NEON's `Scale_Factor` does; CF's `scale_factor`
never does."""
_QUALITY = re.compile(r"(^|_)(err|error|errors|flags?|mask|quality|qa|uncertainty|std|stddev)(_|$)")
"""What an array of three axes is called that measures nothing itself."""
_AXIS_NAMES = {
    "b": "band bands wavelength wavelengths wl lambda channel spectral",
    "y": "y lat latitude row rows line lines downtrack northing height",
    "x": "x lon longitude col cols column columns sample samples crosstrack easting width",
}
_AXES = {name: axis for axis, names in _AXIS_NAMES.items() for name in names.split()}
_NUMBERS = "iuf"
"""NumPy's kinds of types that measure; marks of bands may also be booleans."""
_LISTED = 12
"""How many arrays a message names."""


@dataclass(frozen=True)
class FoundArray:
    """One array of a file."""

    name: str
    """With the groups that it is in, separated by `/`."""
    shape: tuple[int, ...]
    dtype: np.dtype
    whole: Callable[[], np.ndarray]
    """All its numbers, mapped or loaded, perhaps of a smaller type."""
    take: _TakePart | None = None
    """A faster way to some rows and bands than through `whole`."""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    inherited: Mapping[str, Any] = field(default_factory=dict)
    """Attributes of the groups that it is in and of the file, the nearest first."""
    dimensions: tuple[str, ...] | None = None
    """Names of its axes."""
    fill: float | None = None
    """Stored number where nothing was ever written, if the format has one."""

    @property
    def _own_name(self) -> str:
        """Without groups, in lower case."""
        return self.name.rpartition("/")[2].lower()

    @property
    def _all_attributes(self) -> dict[str, Any]:
        """Its own attributes, and those inherited that it lacks."""
        return {**self.inherited, **self.attributes}

    def is_vector(self, kinds: str = _NUMBERS) -> bool:
        """Whether it is a number or a list of them, also as MATLAB's matrix of one row or column, of a type of some
        kinds."""
        return sum(length != 1 for length in self.shape) <= 1 and self.dtype.kind in kinds


def image_of_arrays(
    path: Path, reader: str, arrays: Sequence[FoundArray], options: ReadOptions
) -> SpectralFile:
    """The image of a file: the array that is named, otherwise the only one of three axes."""
    image = _find_image(path, arrays, options)
    what = image.name or "the array"
    size = _pixel_list_size(image, arrays, options)
    fixed = options.axes
    shape, take = image.shape, image.take
    if len(image.shape) == 2:  # a list of pixels, column after column, or one band
        if size is None and options.size is not None:
            raise CaptureError(f"{path}: {what} {shape} is not a list of {prod(options.size)} pixels")
        if size is None:
            shape, fixed = (*image.shape, 1), "yxb"
        elif image.shape[1] == prod(size):
            shape, fixed = (image.shape[0], size[1], size[0]), "bxy"
        else:
            shape, fixed = (size[1], size[0], image.shape[1]), "xyb"
        take = None
    elif len(image.shape) != 3:
        raise CaptureError(f"{path}: {what} has the shape {image.shape}; expected three axes")
    elif fixed is None:
        names = (name.lower().rpartition("/")[2] for name in image.dimensions or ())
        named: Any = "".join(_AXES.get(name, "?") for name in names)
        fixed = named if sorted(named) == ["b", "x", "y"] else None
    stated = _state_bands(arrays, image)
    given = options.wavelengths_nm if options.wavelengths_nm is not None else stated.centres
    axes, axis_warnings = choose_axes(shape, fixed, None if given is None else len(given))
    of_image = image_shape(shape, axes)
    bands, band_warnings = check_bands(stated, of_image[2])
    linear = _linear(path, image, of_image[2])
    exposure, exposure_warnings = _exposure(arrays, image, linear)

    dtype, no_data, valid = _measured_numbers(image, linear)

    def read_part(rows: slice, wanted: BandIndex) -> np.ndarray:
        if take is not None:
            return take(axes, rows, wanted).astype(dtype, copy=False)
        return take_part(image.whole().reshape(shape), axes, rows, wanted).astype(dtype, copy=False)

    known = (_CENTRES, _WIDTHS, _GOOD, _SIDES)
    others = [
        one.name
        for one in arrays
        if one is not image
        and not is_exposure(one._own_name)
        and one._own_name not in _AXES
        and not any(names.fullmatch(one._own_name) for names in known)
    ]
    return SpectralFile(
        path=path,
        reader=reader,
        shape=of_image,
        dtype=dtype,
        read_part=read_part,
        bands=bands,
        linear=linear,
        no_data=no_data,
        valid_range=valid,
        notes=(f"also in the file, and not used: {name_some(others)}",) if others else (),
        warnings=axis_warnings + band_warnings + exposure_warnings,
        metadata={**({"dataset": image.name} if len(arrays) > 1 else {}), "axes": axes, **exposure},
    )


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _unit_of(attributes: Mapping[str, Any]) -> str | None:
    key = _first_key(attributes, ("units", "unit"))
    return None if key is None else _text(attributes[key])


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
        images = [image for image in images if not _QUALITY.search(image._own_name)] or images
    if len(images) > 1:
        images = [image for image in images if _find_vector(arrays, image, _CENTRES) is not None] or images
    if not images:
        raise CaptureError(
            f"{path}: no data set has three axes; name one (--dataset), and give rows and columns if it is a list of "
            f"pixels. The file holds {listed}"
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
    numbers = {one._own_name.rstrip("s"): one for one in arrays if one.is_vector() and prod(one.shape) == 1}
    if size is None and "nrow" in numbers and "ncol" in numbers:
        rows, columns = (float(numbers[name].whole().reshape(-1)[0]) for name in ("nrow", "ncol"))
        size = (int(rows), int(columns)) if 1 <= rows < 2**31 and 1 <= columns < 2**31 else None
    if len(array.shape) != 2 or size is None or prod(size) not in array.shape:
        return None
    return size


def _find_vector(
    arrays: Sequence[FoundArray], image: FoundArray, names: re.Pattern[str]
) -> FoundArray | None:
    """The list of one number a band with such a name; of several the one in the nearest group."""

    def common_groups(name: str) -> int:
        pairs = zip(name.strip("/").split("/")[:-1], image.name.strip("/").split("/")[:-1], strict=False)
        least = min(name.count("/"), image.name.count("/"))
        return next((count for count, (a, b) in enumerate(pairs) if a != b), least)

    found = [
        array
        for array in arrays
        if array.is_vector(_kinds_of(names))
        and prod(array.shape) in image.shape
        and names.fullmatch(array._own_name)
        and not _counts(array._own_name, array.whole(), _unit_of(array.attributes))
    ]
    return max(found, key=lambda array: common_groups(array.name), default=None)


def _kinds_of(names: re.Pattern[str]) -> str:
    """Kinds of types that a list with one of these names may have."""
    return _NUMBERS + "b" if names is _GOOD else _NUMBERS


def _counts(name: str, numbers: np.ndarray, unit: str | None = None) -> bool:
    """Whether a list called `bands` has the numbers of bands, perhaps of some of them, and not their wavelengths."""
    has_unit = unit is not None and nm_per_unit(unit) is not None
    return name.lower() == "bands" and not has_unit and are_band_numbers(numbers, may_have_gaps=True)


def _state_bands(arrays: Sequence[FoundArray], image: FoundArray) -> StatedBands:
    """What arrays or attributes say of the bands."""

    def numbers(vector: FoundArray | None) -> list[object] | None:
        if vector is None:
            return None
        stored: Any = vector.whole().reshape(-1)
        gain, offset = (_first_number(vector.attributes, (name,)) for name in ("scale_factor", "add_offset"))
        stored = stored if gain is None else stored * gain  # as CF packs any variable
        return (stored if offset is None else stored + offset).tolist()

    centres, widths, good = (_find_vector(arrays, image, names) for names in (_CENTRES, _WIDTHS, _GOOD))
    of_image = [_find_attribute(image, names) for names in (_CENTRES, _WIDTHS, _GOOD)]
    if centres is not None:
        where, listed = f"data set '{centres.name}'", numbers(centres)
        name, attributes = centres._own_name, centres.attributes
    else:
        name, listed = of_image[0]
        where, attributes = f"attribute '{name}'", {}
    unit = _unit_of(attributes)
    if unit is None:
        suffix = name.lower()[-2:]
        unit = suffix if suffix in ("nm", "um") else None
    fwhm, marks = numbers(widths) or of_image[1][1], numbers(good) or of_image[2][1]
    if marks is not None:
        marks = [int(mark) if isinstance(mark, bool) else mark for mark in marks]
    return StatedBands(where, listed, unit, fwhm, marks)


def _find_attribute(image: FoundArray, names: re.Pattern[str]) -> tuple[str, list[object] | None]:
    """The attribute with such a name that fits an axis; of several the one whose name has a word of the image's."""
    words = set(re.split(r"[\W_]+", image._own_name))
    found = {
        key: values.tolist()
        for key, value in image._all_attributes.items()
        if names.fullmatch(key.lower())
        and (values := np.atleast_1d(value)).ndim == 1
        and values.dtype.kind in _kinds_of(names)
        and len(values) in image.shape
        and not _counts(key, values)
    }
    best = max(found, key=lambda key: len(words & set(re.split(r"[\W_]+", key.lower()))), default="")
    return best, found.get(best)


def _linear(path: Path, image: FoundArray, num_bands: int) -> Linear | None:
    """Gains and offsets among the attributes: value = factor * stored + offset, as climate files have it.

    Source: CF conventions, 8.1. A single factor above 1 without an offset divides under a name that is not CF's, as
    NEON's 10000 does. PRISMA's are those of its level.
    """
    columns, evidence = [], []
    for names, own_names in ((_GAINS, _OWN_GAINS), (_OFFSETS, _OWN_OFFSETS)):
        key = _first_key(image._all_attributes, names) or _first_key(image.attributes, own_names)
        numbers = [] if key is None else _numbers(image._all_attributes[key])
        columns.append(numbers)
        evidence += [f"'{key}'"] if numbers else []
    gains, offsets = columns
    if len(gains) == 1 and not offsets and evidence[0].lower() == "'gain'":  # that of a camera
        gains, evidence = [], []
    name = evidence[0].strip("'") if gains else ""
    # An offset, 0 too, is CF's, whose factors multiply whatever they are.
    is_divisor = len(gains) == 1 and gains[0] > 1 and not offsets and name != "scale_factor"
    if (is_divisor and name.lower() in _MAY_DIVIDE) or name.lower() in _DIVISORS:
        gains = [1.0 / gain if gain else np.nan for gain in gains]
    if not evidence and (prisma := _prisma(image)) is not None:
        gains, offsets, evidence = [prisma[0]], [prisma[1]], [prisma[2]]
    return linear_values(path, num_bands, gains, offsets, f"attribute {' and '.join(evidence)}")


def _prisma(image: FoundArray) -> tuple[float, float, str] | None:
    """Gain, offset and where they stand in a PRISMA file: radiances of levels 1 and 2B, reflectances of 2C and 2D.

    Source: ASI, PRISMA Products Specification, chapters 5 and 7 (`ScaleFactor_Vnir`, `L2ScaleVnirMin`); Busetto and
    Ranghetti, prismaread (of level 2B).
    """
    for part in ("Vnir", "Swir"):
        if part.lower() not in image._own_name:
            continue
        ends = [f"l2scale{part.lower()}{end}" for end in ("min", "max")]
        low, high = (_first_number(image._all_attributes, (end,)) for end in ends)
        if low is not None and high is not None and high > low:
            what = "radiance" if "prs_l2b_" in image.name.lower() else "reflectance"
            return (high - low) / 65535.0, low, f"'L2Scale{part}Min' and 'L2Scale{part}Max' of {what}"
        names = [f"{name}_{part.lower()}" for name in ("scalefactor", "offset")]
        factor, offset = (_first_number(image._all_attributes, (name,)) for name in names)
        if factor:
            return 1.0 / factor, -(offset or 0.0), f"'ScaleFactor_{part}' and 'Offset_{part}' of radiance"
    return None


def _numbers(value: Any) -> list[float]:
    """Numbers of an attribute; none where it is something else."""
    try:
        return np.asarray(value, dtype=np.float64).reshape(-1).tolist()
    except (TypeError, ValueError):
        return []


def _measured_numbers(
    image: FoundArray, linear: Linear | None
) -> tuple[np.dtype, tuple[float, ...], tuple[float, float] | None]:
    """Type of the stored numbers, every one that stands for no measurement, and the range of those that do.

    Source: CF conventions, 2.5.1: `_FillValue` and `missing_value` both mark missing numbers.
    """
    attributes, dtype, valid = image._all_attributes, image.dtype, _valid_range(image, linear)
    keys = (_first_key(attributes, (name,)) for name in _NO_DATA)
    no_data = [number for key in keys if key is not None for number in _numbers(attributes[key])]
    if dtype.kind == "i" and _text(image.attributes.get("_Unsigned", "")).lower() == "true":
        dtype, more = np.dtype(dtype.str.replace("i", "u")), 256.0**dtype.itemsize  # attributes are signed
        no_data = [number + more * (number < 0) for number in no_data]
        low, high = valid or (0.0, 0.0)
        valid = valid and (low + more * (low < 0), high + more * (high < 0))
    elif image.fill is not None and image.fill != 0 and (dtype.kind == "f" or image.fill < 0):
        no_data.append(image.fill)  # other numbers may be light
    return dtype, tuple(dict.fromkeys(no_data)), valid


def _valid_range(image: FoundArray, linear: Linear | None) -> tuple[float, float] | None:
    """Least and greatest stored number that was measured, by NetCDF's attributes.

    A range of floating-point numbers beside packed whole ones is one of values. Source: netCDF-Java,
    EnhanceScaleMissingUnsigned.
    """
    keys = {key.lower(): key for key in image._all_attributes}
    named = [keys[name] for name in ("valid_range", "valid_min", "valid_max") if name in keys]
    numbers = {key.lower(): _numbers(image._all_attributes[key]) for key in named}
    low, high = numbers.get("valid_min", [-np.inf]), numbers.get("valid_max", [np.inf])
    both = numbers["valid_range"] if len(numbers.get("valid_range", [])) == 2 else [*low, *high]
    if not named or len(both) != 2:
        return None
    is_float = any(np.asarray(image._all_attributes[key]).dtype.kind == "f" for key in named)
    if is_float and image.dtype.kind != "f" and linear is not None:
        ends = np.subtract.outer(both, linear.offsets) / linear.gains
        both = [ends[0].min() - 0.5, ends[1].max() + 0.5]  # between whole numbers, as dividing rounds
    return float(both[0]), float(both[1])


def _exposure(
    arrays: Sequence[FoundArray], image: FoundArray, linear: Linear | None
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Exposure among attributes that values are not multiplied by, and single numbers or lists of one a band beside the
    image."""
    applied = "" if linear is None else linear.evidence
    entries = {key: value for key, value in image._all_attributes.items() if f"'{key}'" not in applied}
    for array in arrays:
        if array.is_vector() and prod(array.shape) in (1, *image.shape) and is_exposure(array._own_name):
            unit, numbers = _unit_of(array.attributes) or "", array.whole().reshape(-1).tolist()
            entries[array._own_name] = ",".join(f"{number} {unit}" for number in numbers)
    return exposure_facts(entries, "data set or attribute")


def _first_key(attributes: Mapping[str, Any], names: Sequence[str]) -> str | None:
    """The attribute with the first of some names that is there, in any case."""
    named = {key.lower(): key for key in attributes}
    return next((named[name] for name in names if name in named), None)


def _first_number(attributes: Mapping[str, Any], names: Sequence[str]) -> float | None:
    key = _first_key(attributes, names)
    numbers = [] if key is None else _numbers(attributes[key])
    return numbers[0] if numbers else None
