"""Files that hold arrays by name: which is the image, which describe its bands, and how NumPy, torch and NetCDF-3
store them.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import pickle
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from unmix_plugin.captures.spectral_file import (
    Axes,
    BandIndex,
    ReadOptions,
    SpectralFile,
    choose_axes,
    image_shape,
    loaded,
    take_part,
)
from unmix_plugin.captures.wavelengths import StatedBands, check_bands
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import allow_decoded, allow_parts, open_zip
from unmix_plugin.scenes.reading.cubes import (
    READ_HEADER,
    UnreadableArrayError,
    map_array,
    parse_header,
    read_array_header,
)

_TakePart: TypeAlias = Callable[[Axes, slice, BandIndex], np.ndarray]
"""(h, W, b) numbers of a stored array whose axes are these."""

_CENTRES = re.compile(
    r"(list_cw_.*)|((band_?|cent(er|re|ral)_?|sensor_?)*(wavelengths?|wavelen|wvls?|wls?|lambdas?|waves?))(_?(nm|um))?"
)
_WIDTHS = re.compile(r"(fwhms?|band_?widths?|list_fwhm_.*)(_?(nm|um))?")
_GOOD = re.compile(r"bbl|good_(wavelengths?|bands?)")
_NO_DATA = ("_fillvalue", "missing_value", "data_ignore_value", "nodata", "no_data")
_SCALES = ("scale_factor", "reflectance_scale_factor")
_AXIS_NAMES = {
    "b": "band bands wavelength wavelengths wl lambda channel spectral",
    "y": "y lat latitude row rows line lines downtrack northing height",
    "x": "x lon longitude col cols column columns sample samples crosstrack easting width",
}
_AXES = {name: axis for axis, names in _AXIS_NAMES.items() for name in names.split()}
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
    """All its numbers, mapped or loaded."""
    take: _TakePart | None = None
    """A faster way to some rows and bands than through `whole`."""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    dimensions: tuple[str, ...] | None = None
    """Names of its axes."""

    @property
    def own_name(self) -> str:
        """Without groups, in lower case."""
        return self.name.rpartition("/")[2].lower()

    @property
    def is_vector(self) -> bool:
        """Whether it is a list of numbers, also as MATLAB's matrix of one row or column."""
        is_list = bool(self.shape) and sum(length != 1 for length in self.shape) <= 1
        return is_list and self.dtype.kind in "iuf"


def image_of_arrays(
    path: Path, reader: str, arrays: Sequence[FoundArray], options: ReadOptions
) -> SpectralFile:
    """The image of a file: the array that is named, otherwise the only one of three axes."""
    image = _find_image(path, arrays, options)
    what = image.name or "the array"
    size = _pixel_list_size(image, arrays, options)
    fixed, notes = options.axes, ()
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
    axes, notes = choose_axes(shape, fixed, None if given is None else len(given))
    of_image = image_shape(shape, axes)
    bands, band_notes = check_bands(stated, of_image[2])
    scale, scale_notes = _scale(image.attributes)

    def read_part(rows: slice, wanted: BandIndex) -> np.ndarray:
        if take is not None:
            return take(axes, rows, wanted)
        return take_part(image.whole().reshape(shape), axes, rows, wanted)

    return SpectralFile(
        path=path,
        reader=reader,
        shape=of_image,
        dtype=image.dtype,
        read_part=read_part,
        bands=bands,
        scale=scale,
        no_data=_first_number(image.attributes, _NO_DATA),
        notes=notes + band_notes + scale_notes,
        metadata={"dataset": image.name, "axes": axes} if len(arrays) > 1 else {"axes": axes},
    )


def _find_image(path: Path, arrays: Sequence[FoundArray], options: ReadOptions) -> FoundArray:
    numeric = [array for array in arrays if array.dtype.kind in "iuf" and 0 not in array.shape]
    if [(array.name, len(array.shape)) for array in arrays] == [("", 2)] and options.dataset is None:
        return arrays[0]  # the file is one matrix: one band
    listed = ", ".join(f"{array.name or 'one array'} {array.shape}" for array in numeric[:_LISTED])
    listed = listed or "no arrays of numbers"
    if options.dataset is not None:
        wanted = options.dataset.strip("/")
        named = [array for array in numeric if array.name.strip("/") == wanted]
        named = named or [array for array in numeric if array.name.rpartition("/")[2] == wanted]
        if len(named) != 1:
            raise CaptureError(
                f"{path}: {len(named) or 'no'} data sets '{options.dataset}'; the file holds {listed}"
            )
        return named[0]
    images = [array for array in numeric if len(array.shape) == 3]
    if not images:
        images = [array for array in numeric if _pixel_list_size(array, arrays, options) is not None]
    if len(images) > 1:
        images = [image for image in images if _find_vector(arrays, image, _CENTRES) is not None] or images
    if not images:
        raise CaptureError(
            f"{path}: no data set has three axes; name one (--dataset), and give rows and columns if it is a list of "
            f"pixels. The file holds {listed}"
        )
    if len(images) > 1:
        raise CaptureError(
            f"{path}: {len(images)} data sets could be the image; name one (--dataset). The file holds {listed}"
        )
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
        if array.is_vector and prod(array.shape) in image.shape and names.fullmatch(array.own_name)
    ]
    return max(found, key=lambda array: common_groups(array.name), default=None)


def _state_bands(arrays: Sequence[FoundArray], image: FoundArray) -> StatedBands:
    """What arrays or attributes say of the bands."""

    def numbers(vector: FoundArray | None) -> list[object] | None:
        return None if vector is None else vector.whole().reshape(-1).tolist()

    centres, widths, good = (_find_vector(arrays, image, names) for names in (_CENTRES, _WIDTHS, _GOOD))
    if centres is not None:
        where, listed = f"data set '{centres.name}'", numbers(centres)
        name, attributes = centres.own_name, centres.attributes
    else:
        attribute = next((key for key in image.attributes if _CENTRES.fullmatch(key.lower())), None)
        values = np.atleast_1d(image.attributes[attribute]) if attribute is not None else np.zeros(0)
        listed = values.tolist() if values.ndim == 1 and len(values) in image.shape else None
        where, name, attributes = f"attribute '{attribute}'", attribute or "", {}
    unit = next((value for key, value in attributes.items() if key.lower() in ("unit", "units")), None)
    if unit is None:
        suffix = name.lower()[-2:]
        unit = suffix if suffix in ("nm", "um") else None
    else:
        unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    return StatedBands(where, listed, unit, numbers(widths), numbers(good))


def _scale(attributes: Mapping[str, Any]) -> tuple[float | None, tuple[str, ...]]:
    """Stored number that stands for 1: factors above 1 divide, those below multiply, as climate files have it."""
    factor = _first_number(attributes, _SCALES)
    offset = _first_number(attributes, ("add_offset",))
    note = f"an offset of {offset:g} is to be added to scaled values, which is left to you" if offset else ""
    notes = (note,) if note else ()
    if factor is None or not np.isfinite(factor) or factor <= 0 or factor == 1:
        return None, notes
    return (factor if factor > 1 else 1 / factor), notes


def _first_number(attributes: Mapping[str, Any], names: Sequence[str]) -> float | None:
    for key, value in attributes.items():
        if key.lower() in names:
            try:
                return float(np.asarray(value).reshape(-1)[0])
            except (ValueError, TypeError, IndexError):
                continue
    return None


# NumPy: .npy is mapped, of .npz the member that is an image is loaded. No pickle is ever read.


def open_npy(path: Path, options: ReadOptions) -> SpectralFile:
    """Open an array of three axes, or of two for one band, by its header.

    Raises:
        CaptureError: it is cut short, holds objects or no numbers, or has another number of axes.
    """
    try:
        header = read_array_header(path)
    except UnreadableArrayError as error:
        raise CaptureError(f"{path}: {error}") from error
    image = FoundArray("", header.shape, header.dtype, lambda: map_array(path))
    return image_of_arrays(path, "npy", [image], options)


def open_npz(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the image among the arrays of an archive; a list of wavelengths beside it is found by its name.

    Raises:
        CaptureError: a member is damaged or holds objects, or none can be the image.
    """
    with open_zip(path, CaptureError) as archive:
        arrays = [_npz_member(path, archive, info) for info in archive.infolist()]
    return image_of_arrays(path, "npy", arrays, options)


def _npz_member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> FoundArray:
    """A member by its header."""
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        if version not in READ_HEADER:
            raise CaptureError(
                f"{path}: {info.filename} is a .npy file of version {version}; write it with numpy.savez"
            )
        shape, _, dtype = parse_header(file, version)
    needed = int(np.prod(shape, dtype=object)) * dtype.itemsize
    if not dtype.hasobject and info.file_size < needed:
        raise CaptureError(
            f"{path}: {info.filename} holds {info.file_size} bytes; its header promises {needed}"
        )
    allow_decoded(path, info.file_size, CaptureError, info.compress_size)
    name = info.filename.removesuffix(".npy")
    return FoundArray(name, shape, dtype, lambda: loaded(_load_npz_member, path, info.filename))


def _load_npz_member(path: Path, name: str) -> np.ndarray:
    with zipfile.ZipFile(path) as archive, archive.open(name) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


# Tensors that torch.save wrote: read with weights_only, which loads no code.


def open_torch(path: Path, options: ReadOptions) -> SpectralFile:
    """Open a tensor, or the image among the tensors of a dictionary.

    Raises:
        CaptureError: the file is damaged, holds other objects than tensors, or none can be the image.
    """
    import torch

    def tensors() -> dict[str, Any]:
        """By name, mapped where the file allows it."""
        with path.open("rb") as file:
            is_mappable = file.read(2) == b"PK"
        try:
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=is_mappable)
        except pickle.UnpicklingError as error:
            raise CaptureError(
                f"{path}: holds other objects than tensors, which are never loaded because they can run code; "
                "save a plain tensor with torch.save"
            ) from error
        named = content if isinstance(content, dict) else {"": content}
        return {str(name): value for name, value in named.items() if isinstance(value, torch.Tensor)}

    def numbers(tensor: torch.Tensor) -> np.ndarray:
        """What NumPy has no type for becomes float32."""
        tensor = tensor.detach()
        return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor.resolve_neg()).numpy()

    found = tensors()
    allow_parts(path, len(found), "tensors", CaptureError)
    for tensor in found.values():  # of which many numbers can be one in the file
        allow_decoded(path, tensor.numel() * tensor.element_size(), CaptureError)
    arrays = [
        FoundArray(
            name,
            tuple(tensor.shape),
            numbers(tensor[:0] if tensor.ndim else tensor).dtype,
            lambda name=name: numbers(tensors()[name]),
        )
        for name, tensor in found.items()
    ]
    return image_of_arrays(path, "torch", arrays, options)


# NetCDF of the classic kind, mapped by SciPy.


def open_netcdf3(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the variable that is the image.

    Raises:
        CaptureError: the file is damaged, or no variable, or more than one, can be the image.
    """
    from scipy.io import netcdf_file

    def found(name: str, variable: Any) -> FoundArray:
        """A variable, without holding on to the map of its file."""

        def whole() -> np.ndarray:
            with netcdf_file(str(path), "r", mmap=True) as file:
                return np.array(file.variables[name].data)

        def take(axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
            with netcdf_file(str(path), "r", mmap=True) as file:
                return take_part(file.variables[name].data, axes, rows, bands)

        attributes = dict(variable._attributes)
        kind = variable.data.dtype
        return FoundArray(name, variable.shape, kind, whole, take, attributes, variable.dimensions)

    with netcdf_file(str(path), "r", mmap=True) as file:
        allow_parts(path, len(file.variables), "variables", CaptureError)
        arrays = [found(name, variable) for name, variable in file.variables.items()]
    return image_of_arrays(path, "netcdf", arrays, options)
