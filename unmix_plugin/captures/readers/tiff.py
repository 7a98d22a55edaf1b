"""TIFF and GeoTIFF images: bands as pages, as planes, or beside each other in each pixel.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unmix_plugin.captures.camera_tags import band_of, camera_tags, tag_value
from unmix_plugin.captures.readers.array_axes import choose_axes, image_shape, take_part
from unmix_plugin.captures.readers.extras import import_extra
from unmix_plugin.captures.readers.library_log import logged_by
from unmix_plugin.captures.readers.read_options import Axes, ReadOptions
from unmix_plugin.captures.readers.stated_bands import check_bands
from unmix_plugin.captures.readers.tiff_bands import gdal_items, scale_and_no_data, state_bands
from unmix_plugin.captures.readers.tiff_pages import check_page, read_page
from unmix_plugin.captures.spectral_file import BandIndex, BandTable, SpectralFile
from unmix_plugin.errors import CaptureError

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage


_OPACITY = (1, 2)
"""Kinds of extra numbers of a pixel. Programs give it to fourth bands that are none, so that nothing is dropped."""


@dataclass(frozen=True)
class _Stack:
    """The pages of a file that make its image."""

    pages: list[TiffPage]
    shape: tuple[int, ...]
    """(H, W, B) of a single page, (pages, rows, columns) of more."""
    dtype: np.dtype
    """In the byte order of the file."""
    unlisted_from: int | None = None
    """Where the numbers of all pages lie, if only the first has an entry."""
    notes: tuple[str, ...] = ()


def open_tiff(path: Path, options: ReadOptions) -> SpectralFile:
    """Open an image whose bands are pages, planes or samples.

    Raises:
        CaptureError: pages contradict each other, or the file is cut short.
    """
    with logged_by("tifffile") as messages, import_extra("tifffile").TiffFile(path) as file:
        stack = _find_stack(path, file)
        if any("page offset" in message for message in messages):
            raise CaptureError(
                f"{path}: cut short: only {len(file.pages)} pages are there; copy the file again"
            )
        first = stack.pages[0]
        tags = camera_tags(first.tags)
        items = gdal_items(first)
    stated = state_bands(stack.pages, items)
    given = options.wavelengths_nm if options.wavelengths_nm is not None else stated.centres
    is_stack = len(stack.pages) > 1 or stack.unlisted_from is not None
    axes, axis_notes = (
        ("yxb", ())
        if not is_stack
        else choose_axes(stack.shape, options.axes, None if given is None else len(given), "byx")
    )
    shape = image_shape(stack.shape, axes)
    bands, band_notes = check_bands(stated, shape[2])
    scale, no_data, scale_notes = scale_and_no_data(first, items)
    return SpectralFile(
        path=path,
        reader="tiff",
        shape=shape,
        dtype=stack.dtype,
        read_part=lambda rows, wanted: _read_part(path, stack, axes, rows, wanted),
        bands=_with_camera_tags(bands, tags["xmp"], shape[2]),
        interleave=_interleave(first, axes, is_stack),
        scale=scale,
        no_data=no_data,
        notes=stack.notes + axis_notes + band_notes + scale_notes + tuple(messages[:3]),
        metadata={name: value for name, value in tags.items() if value} | _exposure(tags),
    )


def _find_stack(path: Path, file: TiffFile) -> _Stack:
    """The first page and all that are like it; previews and masks are passed over."""
    in_file: Any = file.pages
    pages = [page for page in in_file if not (page.is_reduced or page.is_mask)]
    if not pages:
        raise CaptureError(f"{path}: no image in this TIFF; expected at least one page")
    first, size = pages[0], path.stat().st_size
    like = [page for page in pages if (page.shape, page.dtype) == (first.shape, first.dtype)]
    for page in like:
        check_page(path, page, size)
        _ = page.decode, page.jpegtables  # read now, as the file is closed afterwards
    left_out = len(file.pages) - len(like)
    notes = (f"{left_out} pages of other sizes, previews or masks are left out",) if left_out else ()
    planes, _, height, width, samples = first.shaped
    dtype = np.dtype(first.dtype).newbyteorder(file.byteorder)
    num_listed, unlisted = len(like), _unlisted(file)
    if unlisted is not None:
        num_pages = unlisted.size // (height * width)
        end = unlisted.dataoffset + unlisted.size * dtype.itemsize
        if end > size:
            raise CaptureError(f"{path}: cut short: {num_pages} pages reach to byte {end} of {size}")
        return _Stack(like[:1], (num_pages, height, width), dtype, unlisted.dataoffset, notes)
    if any(extra in _OPACITY for extra in first.extrasamples):
        notes = (*notes, "a number of each pixel is marked as opacity; it is kept as a band")
    if num_listed == 1:
        return _Stack(like, (height, width, planes * samples), dtype, None, notes)
    if planes * samples > 1:
        raise CaptureError(
            f"{path}: {num_listed} pages of {planes * samples} numbers a pixel; expected one page with all "
            "bands, or one band a page. Split the file into one image each"
        )
    return _Stack(like, (num_listed, height, width), dtype, None, notes)


def _unlisted(file: TiffFile) -> Any:
    """The series of a file that describes one page of one band and holds many, as ImageJ writes it."""
    series, first = file.series[0], file.pages.first
    is_many = series.dataoffset is not None and series.size > first.size * len(file.pages)
    return series if is_many and first.samplesperpixel == 1 else None


def _read_part(path: Path, stack: _Stack, axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
    if stack.unlisted_from is not None:
        stored = np.memmap(path, stack.dtype, "r", stack.unlisted_from, stack.shape)
        return take_part(stored, axes, rows, bands)
    if len(stack.pages) == 1:
        return read_page(path, stack.pages[0], stack.dtype, rows, bands)
    wanted = {"y": rows, "x": slice(None), "b": bands}
    of_page = rows if axes[1] == "y" else slice(0, stack.shape[1], 1)
    indices = np.arange(stack.shape[0])[wanted[axes[0]]]
    one = slice(0, 1, 1)
    planes = np.stack([read_page(path, stack.pages[i], stack.dtype, of_page, one)[..., 0] for i in indices])
    left = {axis: slice(None) if axis == axes[0] or axes[1] == axis == "y" else wanted[axis] for axis in "yb"}
    return take_part(planes, axes, left["y"], left["b"])


def _with_camera_tags(table: BandTable, xmp: dict[str, Any], num_bands: int) -> BandTable:
    """The table with what a multispectral camera's XMP says, if nothing else says it."""
    names = tag_value(xmp, "BandName")
    named = (names,) if isinstance(names, str) else tuple(names or ())
    if table.names is None and len(named) == num_bands:
        table = replace(table, names=named)
    found = band_of(xmp) or BandTable()
    if table.wavelengths_nm is not None or found.wavelengths_nm is None:
        return table
    return (
        replace(found, names=table.names, bad=table.bad) if len(found.wavelengths_nm) == num_bands else table
    )


def _exposure(tags: dict[str, Any]) -> dict[str, float]:
    """Time and gain out of EXIF, unless XMP may hold a calibration that has them in it already."""
    time_s, iso = (
        tags["exif"].get("ExposureTime"),
        tags["exif"].get("ISOSpeedRatings", tags["exif"].get("ISOSpeed")),
    )
    if tags["xmp"] or not isinstance(time_s, int | float):
        return {}
    return {"exposure_s": float(time_s), **({"gain": iso / 100} if isinstance(iso, int | float) else {})}


def _interleave(page: TiffPage, axes: Axes, is_stack: bool) -> str | None:
    if is_stack:
        return {"b": "bsq", "y": "bip" if axes[2] == "b" else "bil"}.get(axes[0])
    if page.samplesperpixel == 1:
        return None
    return "bsq" if page.planarconfig == 2 else "bip"
