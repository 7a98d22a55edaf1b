"""What a TIFF says of its bands: GDAL's metadata, the description of the image, and names of pages.

Numbers of one page of a TIFF, by strips or tiles: only those that are asked for are read and decoded.

Notation: `H` rows, `W` columns, `S` samples (numbers of a pixel).

TIFF and GeoTIFF images: bands as pages, as planes, or beside each other in each pixel.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from unmix_plugin.captures.camera_tags import band_of, camera_tags, tag_value
from unmix_plugin.captures.spectral_file import (
    Axes,
    BandIndex,
    BandTable,
    ReadOptions,
    SpectralFile,
    choose_axes,
    image_shape,
    import_extra,
    logged_by,
    take_part,
)
from unmix_plugin.captures.wavelengths import StatedBands, check_bands, nm_per_unit
from unmix_plugin.errors import CaptureError

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage


_GDAL_METADATA, _GDAL_NODATA, _DESCRIPTION, _PAGE_NAME = 42112, 42113, 270, 285
_CENTRES = ("wavelength", "wavelengths", "center_wavelength", "central_wavelength", "centre_wavelength")
_LIST = re.compile(
    r"""["']?wavelengths?(?: ?\(?(?P<unit>[a-zµμ]+)\)?)?["']?\s*[=:]\s*[\[{(]?(?P<list>[\d.,;\s]+)""", re.I
)


@dataclass(frozen=True)
class GdalItem:
    """One entry of GDAL's metadata."""

    name: str
    """In lower case."""
    value: str
    sample: int | None
    """Band from 0; None for the whole file."""
    role: str | None


def gdal_items(page: TiffPage) -> list[GdalItem]:
    """Entries of GDAL's metadata; none if there is no such tag or it is damaged."""
    text = str(page.tags.valueof(_GDAL_METADATA) or "").strip("\0 \n")
    if not text or "<!" in text:  # entities can grow without bound, and GDAL writes none
        return []
    try:
        items = list(ElementTree.fromstring(text).iter("Item"))
    except ElementTree.ParseError:
        return []
    return [
        GdalItem(
            item.get("name", "").lower(),
            (item.text or "").strip(),
            int(sample) if (sample := item.get("sample", "")).isdecimal() and len(sample) < 9 else None,
            item.get("role"),
        )
        for item in items
    ]


def state_bands(pages: list[TiffPage], items: list[GdalItem]) -> StatedBands:
    """Wavelengths by the first of the places where they can be, and names."""
    return _from_gdal(items) or _from_description(pages[0]) or _from_pages(pages)


def scale_and_no_data(
    page: TiffPage, items: list[GdalItem]
) -> tuple[float | None, float | None, tuple[str, ...]]:
    """Stored number that stands for 1, stored number of no measurement, and notes."""
    no_data = _number(str(page.tags.valueof(_GDAL_NODATA) or ""))
    named = [_number(item.value) for item in items if item.name in ("reflectance_scale_factor",)]
    if named and named[0]:
        return named[0], no_data, ()
    factors = {_number(item.value) for item in items if item.role == "scale"} - {None}
    offsets = {_number(item.value) for item in items if item.role == "offset"} - {None, 0.0}
    if len(factors) == 1 and not offsets and (factor := factors.pop()) and factor > 0:
        return (1 / factor if factor != 1 else None), no_data, ()
    note = ("scales and offsets of GDAL differ between bands and are left out",) if factors or offsets else ()
    return None, no_data, note


def _from_gdal(items: list[GdalItem]) -> StatedBands | None:
    centres = _of_samples(items, _CENTRES)
    names = _of_roles(items, "description") or _of_samples(items, ("band_name", "bandname"))
    names = names or [item.value for item in items if re.fullmatch(r"band_\d+", item.name)]
    where, fwhm = "GDAL metadata", _of_samples(items, ("fwhm",))
    units = [item.value for item in items if item.name in ("wavelength_units", "wavelength_unit")]
    if not centres:
        centres, fwhm = _of_samples(items, ("central_wavelength_um",)), _of_samples(items, ("fwhm_um",))
        units = ["Micrometers"]
    if not centres:
        whole = [item.value for item in items if item.sample is None and item.name in _CENTRES]
        centres = re.findall(r"[^\s,{}]+", whole[0]) if whole else None
        units = [item.value for item in items if item.name in ("wavelength_units", "wavelength_unit")]
    if not centres and not names:
        return None
    return StatedBands(
        where,
        centres or None,
        units[0] if units else None,
        fwhm or None,
        _of_samples(items, ("bbl",)) or None,
        names or None,
    )


def _of_samples(items: list[GdalItem], names: tuple[str, ...]) -> list[str]:
    """Values of one entry for each band, in the order of bands."""
    found = {item.sample: item.value for item in items if item.name in names and item.sample is not None}
    return [found[sample] for sample in sorted(found)]


def _of_roles(items: list[GdalItem], role: str) -> list[str]:
    found = {item.sample: item.value for item in items if item.role == role and item.sample is not None}
    return [found[sample] for sample in sorted(found)]


def _from_description(page: TiffPage) -> StatedBands | None:
    """Wavelengths in JSON, or in text as `wavelengths = 450, 460`."""
    text = str(page.tags.valueof(_DESCRIPTION) or "")[: 2**20]
    if "wavelength" not in text.lower():
        return None
    if listed := re.findall(r'<Channel\b[^>]*?\bEmissionWavelength="([^"]+)"', text):
        unit = re.search(r'EmissionWavelengthUnit="([^"]+)"', text)
        return StatedBands("OME-XML, EmissionWavelength", listed, unit[1] if unit else "nm")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        content = None
    if isinstance(content, dict):
        entries: dict[str, Any] = {str(key).lower().rstrip("s"): value for key, value in content.items()}
        centres = entries.get("wavelength", entries.get("wavelengths_nm", entries.get("wavelength_nm")))
        unit = entries.get("wavelength_unit", "nm" if "wavelengths_nm" in map(str.lower, content) else None)
        if isinstance(centres, list):
            fwhm = entries.get("fwhm")
            return StatedBands(
                "image description",
                centres,
                unit if isinstance(unit, str) else None,
                fwhm if isinstance(fwhm, list) else None,
            )
    match = _LIST.search(text)
    centres = re.findall(r"\d+(?:\.\d+)?", match["list"]) if match else []
    if match is None or not centres:
        return None
    return StatedBands(
        "image description", centres, match["unit"] if nm_per_unit(match["unit"] or "") else None
    )


def _from_pages(pages: list[TiffPage]) -> StatedBands:
    """Names of pages, where each has its own."""
    for tag, what in ((_PAGE_NAME, "names of pages"), (_DESCRIPTION, "descriptions of pages")):
        names = [" ".join(str(page.tags.valueof(tag) or "").split()) for page in pages]
        if all(names) and all(len(name) < 200 for name in names) and (len(set(names)) == len(names)):
            return StatedBands(what, names=names)
    return StatedBands("the file")


def _number(text: str) -> float | None:
    """A number, not a NaN where none is allowed; None for other text."""
    try:
        number = float(text.strip("\0 "))
    except ValueError:
        return None
    return number if not math.isinf(number) else None


def check_page(path: Path, page: TiffPage, file_size: int) -> None:
    """Refuse a page whose numbers can't be there.

    Raises:
        CaptureError: it is empty, deep, of an unknown type, or promises more than the file holds.
    """
    where = f"{path}: page {page.index}"
    if 0 in page.shaped or page.dtype is None:
        raise CaptureError(f"{where}: has the shape {page.shape} of {page.dtype or 'an unknown type'}")
    if page.imagedepth > 1:
        raise CaptureError(f"{where}: is {page.imagedepth} images deep; expected one image a page")
    segments, needed = min(len(page.dataoffsets), len(page.databytecounts)), prod(page.chunked)
    if segments < needed:
        raise CaptureError(f"{where}: {segments} strips or tiles; its size of {page.shape} needs {needed}")
    ends = zip(page.dataoffsets, page.databytecounts, strict=False)
    end = max(offset + count for offset, count in ends)
    if is_mappable(page):
        end = max(end, page.dataoffsets[0] + page.nbytes)
    if end > file_size:
        raise CaptureError(
            f"{where}: cut short: its numbers reach to byte {end} of {file_size}; copy the file again"
        )


def is_mappable(page: TiffPage) -> bool:
    """Whether its numbers lie uncompressed, one after the other."""
    return page.is_contiguous and page.dtype is not None and page.bitspersample == page.dtype.itemsize * 8


def read_page(path: Path, page: TiffPage, dtype: np.dtype, rows: slice, bands: BandIndex) -> np.ndarray:
    """Numbers (h, W, s) of some rows and samples.

    Args:
        path: Its file, which is opened and closed again.
        page: As tifffile describes it.
        dtype: Of the numbers in the file.
        rows: Normal form, see `SpectralFile.read`.
        bands: Samples, likewise.
    """
    planes, _, height, width, samples = page.shaped
    if is_mappable(page):
        stored = np.memmap(path, dtype, "r", page.dataoffsets[0], (planes, height, width, samples))
        image = stored[:, rows]
        chosen = image[0][..., bands] if planes == 1 else np.moveaxis(image[..., 0][bands], 0, -1)
        return np.array(chosen, order="C")
    indices = np.arange(planes * samples)[bands]
    wanted_planes = sorted(set(indices.tolist())) if planes > 1 else [0]
    block = _decode(path, page, rows, wanted_planes)
    image = np.moveaxis(block[..., 0], 0, -1) if planes > 1 else block[0]
    return image[:: rows.step][..., np.searchsorted(wanted_planes, indices) if planes > 1 else indices]


def _decode(path: Path, page: TiffPage, rows: slice, planes: list[int]) -> np.ndarray:
    """Numbers (p, h, W, S) of the rows from the first to the last of `rows`, in some planes."""
    _, _, height, width, samples = page.shaped
    down = page.chunks[0]
    across = -(-width // page.chunks[1])
    per_plane = -(-height // down) * across
    block = np.zeros((len(planes), rows.stop - rows.start, width, samples), page.dtype)
    touched = range(rows.start // down * across, -(-rows.stop // down) * across)
    with path.open("rb") as file:
        for at, plane in enumerate(planes):
            for within in touched:
                _put_segment(block[at], rows.start, _segment(file, page, plane * per_plane + within))
    return block


def _segment(file: Any, page: TiffPage, index: int) -> tuple[np.ndarray | None, tuple, tuple]:
    """A decoded strip or tile, None if it is left out in the file; its place and shape."""
    file.seek(page.dataoffsets[index])
    data = file.read(page.databytecounts[index])
    if len(data) < page.databytecounts[index]:
        raise CaptureError(f"{file.name}: cut short in strip or tile {index}; copy the file again")
    return page.decode(data or None, index, jpegtables=page.jpegtables)


def _put_segment(block: np.ndarray, first_row: int, segment: tuple[np.ndarray | None, tuple, tuple]) -> None:
    """Copy what of a segment lies in the block, whose first row is `first_row` of the image."""
    values, (_, _, top, left, _), _ = segment
    if values is None:
        return
    values = values[0]
    skip = max(0, first_row - top)
    to = top + skip - first_row
    part = values[skip : skip + len(block) - to, : block.shape[1] - left]
    block[to : to + len(part), left : left + part.shape[1]] = part


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
