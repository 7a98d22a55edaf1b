"""An image out of a file of named arrays: its axes, bands, scale and no-data value.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.readers.array_axes import choose_axes, image_shape, take_part
from unmix_plugin.captures.readers.found_arrays import (
    FoundArray,
    TakePart,
    describing_vectors,
    find_image,
    names_wavelengths,
    pixel_list_size,
)
from unmix_plugin.captures.readers.read_options import Axes, ReadOptions
from unmix_plugin.captures.readers.stated_bands import StatedBands, check_bands
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

_NO_DATA = ("_fillvalue", "missing_value", "data_ignore_value", "nodata", "no_data")
_SCALES = ("scale_factor", "reflectance_scale_factor")
_ROLES = {
    **dict.fromkeys(
        ("band", "bands", "wavelength", "wavelengths", "wl", "lambda", "channel", "spectral"), "b"
    ),
    **dict.fromkeys(
        ("y", "lat", "latitude", "row", "rows", "line", "lines", "downtrack", "northing", "height"), "y"
    ),
    **dict.fromkeys(("x", "lon", "longitude", "col", "cols", "column", "columns", "sample", "samples"), "x"),
    **dict.fromkeys(("crosstrack", "easting", "width"), "x"),
}


def image_of_arrays(
    path: Path, reader: str, arrays: Sequence[FoundArray], options: ReadOptions
) -> SpectralFile:
    """The image of a file.

    Raises:
        CaptureError: no array, or more than one, can be the image.
    """
    image = find_image(path, arrays, options)
    shape, take = _as_cube(path, image, arrays, options)
    stated = _state_bands(arrays, image)
    given = options.wavelengths_nm if options.wavelengths_nm is not None else stated.centres
    default = _named_axes(image) if shape == image.shape else None
    if len(image.shape) == 2 and shape != image.shape:
        axes, axis_notes = _pixel_list_axes(image, shape), ()
    else:
        fixed = options.axes or default
        axes, axis_notes = choose_axes(shape, fixed, None if given is None else len(given))
    size = image_shape(shape, axes)
    bands, band_notes = check_bands(stated, size[2])
    scale, scale_notes = _scale(image.attributes)
    return SpectralFile(
        path=path,
        reader=reader,
        shape=size,
        dtype=image.dtype,
        read_part=lambda rows, wanted: take(axes, rows, wanted),
        bands=bands,
        scale=scale,
        no_data=_first_number(image.attributes, _NO_DATA),
        notes=axis_notes + band_notes + scale_notes,
        metadata={"dataset": image.name, "axes": axes} if len(arrays) > 1 else {"axes": axes},
    )


def _as_cube(
    path: Path, image: FoundArray, arrays: Sequence[FoundArray], options: ReadOptions
) -> tuple[tuple[int, ...], TakePart]:
    """Shape of three axes and how parts of it are read; a matrix is a list of pixels or an image of one band."""
    if len(image.shape) == 3:
        whole = image.whole
        return image.shape, image.take or (lambda axes, rows, bands: take_part(whole(), axes, rows, bands))
    if len(image.shape) != 2:
        raise CaptureError(
            f"{path}: {image.name or 'the array'} has the shape {image.shape}; expected three axes"
        )
    size = pixel_list_size(image, arrays, options)
    if options.size is not None and size is None:
        pixels = options.size[0] * options.size[1]
        raise CaptureError(
            f"{path}: {image.name or 'the array'} {image.shape} is not a list of {pixels} pixels"
        )
    rows, columns = size or (0, 0)
    shape = (
        (*image.shape, 1)
        if size is None
        else (
            (image.shape[0], columns, rows)
            if image.shape[1] == rows * columns
            else (columns, rows, image.shape[1])
        )
    )
    return shape, lambda axes, wanted, bands: take_part(image.whole().reshape(shape), axes, wanted, bands)


def _pixel_list_axes(image: FoundArray, shape: tuple[int, ...]) -> Axes:
    """Pixels are listed column after column."""
    if shape[:2] == image.shape:
        return "yxb"
    return "bxy" if shape[0] == image.shape[0] else "xyb"


def _named_axes(image: FoundArray) -> Axes | None:
    roles = "".join(_ROLES.get(name.lower().rpartition("/")[2], "?") for name in image.dimensions or ())
    found: Any = roles
    return found if sorted(roles) == ["b", "x", "y"] else None


def _state_bands(arrays: Sequence[FoundArray], image: FoundArray) -> StatedBands:
    """What arrays or attributes say of the bands."""
    centres, widths, good = describing_vectors(arrays, image)

    def numbers(vector: FoundArray | None) -> list[object] | None:
        return None if vector is None else vector.whole().reshape(-1).tolist()

    if centres is None:
        attribute = next((key for key in image.attributes if names_wavelengths(key)), None)
        values = np.atleast_1d(image.attributes[attribute]) if attribute is not None else np.zeros(0)
        listed = values.tolist() if values.ndim == 1 and len(values) in image.shape else None
        unit = _unit(attribute or "", {})
        return StatedBands(f"attribute '{attribute}'", listed, unit, numbers(widths), numbers(good))
    unit = _unit(centres.own_name, centres.attributes)
    return StatedBands(f"data set '{centres.name}'", numbers(centres), unit, numbers(widths), numbers(good))


def _unit(name: str, attributes: Mapping[str, Any]) -> str | None:
    for key, value in attributes.items():
        if key.lower() in ("unit", "units"):
            return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    suffix = name.lower()[-2:]
    return suffix if suffix in ("nm", "um") else None


def _scale(attributes: Mapping[str, Any]) -> tuple[float | None, tuple[str, ...]]:
    """Stored number that stands for 1: factors above 1 divide, those below multiply, as climate files have it."""
    factor = _first_number(attributes, _SCALES)
    offset = _first_number(attributes, ("add_offset",))
    notes = (
        (f"an offset of {offset:g} is to be added to scaled values, which is left to you",) if offset else ()
    )
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
