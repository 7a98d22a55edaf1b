"""TIFF and GeoTIFF images: bands as pages, as planes, or beside each other in each pixel.

Uncompressed pages are mapped; of compressed ones each strip or tile is decoded once. What the file says of its bands
stands in GDAL's metadata, in the description of the image, in the names of pages, or in a camera's tags.

Notation: `H` rows, `W` columns, `B` bands, `S` samples (numbers of a pixel).
"""

from __future__ import annotations

import json
import logging
import math
import re
import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unmix_plugin.captures.band_entries import StatedBands, check_bands, state_bands
from unmix_plugin.captures.camera_tags import camera_tags, with_camera_tags
from unmix_plugin.captures.cube import (
    Cube,
    ReadOptions,
    import_extra,
    with_mask,
)
from unmix_plugin.captures.fields import state_exposure
from unmix_plugin.captures.numbers import Axes, Block, Decoded, Mapped, Numbers
from unmix_plugin.captures.readers.arrays import choose_axes, image_shape
from unmix_plugin.captures.readers.gdal import gdal_entries, gdal_items, gdal_linear, gdal_number
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import MOST_BANDS, allow_decoded, allow_parts, refuse
from unmix_plugin.spectral.bands import nm_per_unit

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

_GEO_TAGS = (33922, 34264)
"""ModelTiepoint and ModelTransformation."""
_COLOURS = (2, 6)
"""RGB and YCbCr."""
_NO_NUMBERS = {
    0: "whose numbers grow with darkness (MinIsWhite)",
    3: "whose numbers are places in a table of colours (palette)",
    4: "which is a mask",
    **dict.fromkeys((8, 9, 10), "in a colour space of the eye (Lab)"),
    32803: "in which neighbouring pixels see different colours (CFA)",
}
"""Kinds of pages (PhotometricInterpretation) whose numbers are not light."""
_OPACITY = (1, 2)
"""Kinds of extra numbers of a pixel. Programs give it to fourth bands that are none, so that nothing is dropped."""
_GDAL_METADATA, _GDAL_NODATA, _DESCRIPTION, _PAGE_NAME = 42112, 42113, 270, 285
_MOST_TAGS = 4096
"""What TIFF libraries take."""
_UNIT = r"(?:nm|nanomet(?:er|re)s?|[uµμ]m|micromet(?:er|re)s?|microns?)(?![a-z])"
_LIST = re.compile(
    rf"""["']?wave ?lengths?[ _]?[(\[]?(?:in )?(?P<unit>[a-zµμ]{{1,20}})?[)\]]?["']?"""
    rf"""\s{{0,9}}[=:]\s{{0,9}}[\[{{(]?\s{{0,9}}(?:(?P<before>{_UNIT})[:\s]{{0,9}})?(?P<list>\d(?:[\d.,;\s]|(?<=[\d\s]){_UNIT})*)""",
    re.I,
)
"""`wavelengths = 450, 460`, with a unit behind the name (`wavelength (nm): ...`), before the numbers or behind each."""
_ITEM = re.compile(rf"(\d+(?:\.\d+)?)\s?({_UNIT})?", re.I)
_UNIT_BESIDE = re.compile(rf"""wave ?length[ _]?units?["']?\s{{0,9}}[=:]\s{{0,9}}["']?({_UNIT})""", re.I)


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
    fill: float = 0.0
    """What strips and tiles read as that are not in the file."""
    no_data: tuple[float, ...] = ()
    """Stored numbers that stand for no measurement."""

    def numbers(self, path: Path, axes: Axes) -> Numbers:
        """Pages as they lie in the file, or all decoded where one of them is compressed."""
        planes, _, height, width, samples = self.pages[0].shaped
        shape, of_page = self.shape, self.shape[1:]
        if len(self.pages) == 1 and self.unlisted_from is None:
            shape, axes = (
                ((planes, height, width), "byx") if planes > 1 else ((height, width, samples), "yxb")
            )
            of_page = shape
        blocks: tuple[Block, ...]
        if self.unlisted_from is not None:
            blocks = (Mapped(path, self.dtype, shape, self.unlisted_from),)
        elif all(map(_is_mappable, self.pages)):
            blocks = tuple(Mapped(path, self.dtype, of_page, page.dataoffsets[0]) for page in self.pages)
        else:
            offsets = tuple(page.offset for page in self.pages)
            native = self.dtype.newbyteorder("=")
            rows = math.gcd(*(page.chunks[0] for page in self.pages if page.chunks))
            units = (1, rows, width) if len(self.pages) > 1 else (planes, rows, width)
            units = units if len(self.pages) > 1 or planes > 1 else (rows, width, samples)
            given = offsets, repr(self.fill)
            blocks = (Decoded(path, native, shape, _decode_pages, given, units=units),)
        return Numbers(blocks, shape, axes, self.dtype)


def open_tiff(path: Path, options: ReadOptions) -> Cube:
    """Open an image whose bands are pages, planes or samples. Raises CaptureError: pages contradict each other, or the
    file is cut short."""
    _check_directories(path)
    with _logged() as messages, import_extra("tifffile").TiffFile(path) as file:
        remarks: list[Remark] = []
        stack = _find_stack(path, file, remarks)
        if any("page offset" in message for message in messages):
            raise CaptureError(f"{path}: cut short: only {len(file.pages)} pages are there; copy it again")
        first = stack.pages[0]
        tags = camera_tags(first.tags)
        # What holds for the whole file stands in its first page, which may be a preview.
        top: Any = file.pages.first
        texts = dict.fromkeys(_text(page, _GDAL_METADATA) for page in (first, top))
        items = next(filter(None, (gdal_items(text, remarks) for text in texts)), {})
        entries = gdal_entries(items)
        statements = [state_bands(entries, "GDAL metadata")]
        statements += [state_bands(_described(page), "image description") for page in (first, top)]
        from_pages = _from_pages(stack.pages, file.imagej_metadata or {})
        of_page = len(stack.pages) > 1  # a description of one wavelength may be that of its page alone
        statements = [one for one in statements if not (of_page and len(one.centres or ()) == 1)]
        stated = next((one for one in statements if one.centres or one.names), from_pages)
        stack = _with_fill(stack, gdal_number(_text(first, _GDAL_NODATA)), remarks)
        on_map = any(tag in first.tags for tag in _GEO_TAGS)
        masks = _mask_pages(path, file, first)
    given = options.wavelengths_nm if options.wavelengths_nm is not None else stated.centres
    is_stack = len(stack.pages) > 1 or stack.unlisted_from is not None
    axes: Axes = "yxb"
    interleave = None if first.samplesperpixel == 1 else "bsq" if first.planarconfig == 2 else "bip"
    if is_stack:
        num_known = None if given is None else len(given)
        axes = choose_axes(stack.shape, options.axes, num_known, remarks, default="byx")
        interleave = {"b": "bsq", "y": "bip" if axes[2] == "b" else "bil"}.get(axes[0])
    shape = image_shape(stack.shape, axes)
    allow_parts(path, shape[2], "bands", CaptureError, MOST_BANDS)
    bands = check_bands(stated, shape[2], remarks)
    linear = gdal_linear(path, items, shape[2], where="GDAL's", remarks=remarks)
    applied = () if linear is None else linear.entries
    exposed = {f"EXIF {name}": value for name, value in tags.exif.items()}
    exposed |= {name: value for name, value in entries.items() if name not in applied}
    exposure = state_exposure(exposed, "tag or metadata", remarks)
    turned: Any = tags.exif.get("Orientation")
    # A picture is as bright as its numbers to the eye only.
    is_colour = first.photometric in _COLOURS and bands.wavelengths_nm is None
    remarks += (
        [Remark.of(Code.COLOURS_AS_STORED)] if is_colour and first.dtype in (np.uint8, np.uint16) else []
    )
    others = [text for text in messages if "GDAL_NODATA" not in text][:3]
    remarks += [Remark.of(Code.NOTE, text=text) for text in others]
    opened = Cube(
        path=path,
        reader="tiff",
        shape=shape,
        dtype=stack.dtype,
        numbers=stack.numbers(path, axes),
        bands=with_camera_tags(bands, tags.xmp, shape[2]),
        interleave=interleave,
        linear=linear,
        no_data=stack.no_data,
        remarks=tuple(remarks),
        exposure=exposure,
        camera=tags,
        orientation=int(turned) if turned in range(1, 9) else 1,
        is_geotiff=on_map,
    )
    for page in masks if shape[:2] == first.shaped[2:4] else ():  # otherwise rows or columns are pages
        kind = np.dtype(page.dtype).newbyteorder(page.parent.byteorder)
        mask = _Stack([page], (*shape[:2], 1), kind).numbers(path, "yxb")
        opened = with_mask(opened, f"the mask in page {page.index}", mask)
    return opened


def _check_directories(path: Path) -> None:
    """Refuse pages without end before any is read: each directory says where the next one lies, perhaps at itself."""
    with path.open("rb") as file:
        begin = file.read(16)
        order = "<" if begin[:2] == b"II" else ">"
        is_big = begin[2:4] in (b"+\0", b"\0+")
        count_type, offset_type, entry_bytes = ("Q", "Q", 20) if is_big else ("H", "I", 12)
        count_bytes, offset_bytes = struct.calcsize(count_type), struct.calcsize(offset_type)
        at = begin[8 : 8 + offset_bytes] if is_big else begin[4 : 4 + offset_bytes]
        seen: set[int] = set()
        while len(at) == offset_bytes and (offset := struct.unpack(order + offset_type, at)[0]):
            if offset in seen:
                refuse(path, f"page {len(seen)} leads back to an earlier one", "each page once", CaptureError)
            seen.add(offset)
            allow_parts(path, len(seen), "pages", CaptureError)
            file.seek(offset)
            count = file.read(count_bytes)
            if len(count) < count_bytes:
                return
            tags = struct.unpack(order + count_type, count)[0]
            if tags > _MOST_TAGS:
                refuse(path, f"{tags} tags in page {len(seen)}", f"at most {_MOST_TAGS}", CaptureError)
            file.seek(tags * entry_bytes, 1)
            at = file.read(offset_bytes)


@contextmanager
def _logged() -> Iterator[list[str]]:
    """Context in which warnings and errors of tifffile's log are collected for notes, and shown nowhere."""
    messages: list[str] = []

    class _Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            messages.append(" ".join(record.getMessage().split())[:200])

    logger, collector = logging.getLogger("tifffile"), _Collector(logging.WARNING)
    propagated = logger.propagate
    logger.addHandler(collector)
    logger.propagate = False
    try:
        yield messages
    finally:
        logger.removeHandler(collector)
        logger.propagate = propagated


def _find_stack(path: Path, file: TiffFile, remarks: list[Remark]) -> _Stack:
    """The pages that hold the most bands, all alike; previews and masks are passed over."""
    in_file: Any = file.pages
    pages = list(in_file)  # before the series, which take pages for more of the first one
    if file.is_ome and len(file.series) > 1 and len({series.shape for series in file.series}) == 1:
        pages = [page for page in file.series[0].pages if page is not None]  # of several positions the first
    pages = [page for page in _with_below(pages) if not (page.is_reduced or page.is_mask)]
    if not pages:
        raise CaptureError(f"{path}: no image in this TIFF; expected at least one page")
    groups: dict[Any, list[TiffPage]] = defaultdict(list)
    for page in pages:
        groups[page.shape, page.dtype].append(page)

    def size_of(group: list[TiffPage]) -> tuple[int, int]:
        """Bands that pages hold together, and pixels of each."""
        planes, _, height, width, samples = group[0].shaped
        return len(group) * planes * samples, height * width

    like = max(groups.values(), key=size_of)
    first, size = like[0], path.stat().st_size
    for page in like:
        _check_page(path, page, size)
    compressed = [page for page in like if not _is_mappable(page)]
    of_strip = max((math.prod(page.chunks) * page.dtype.itemsize for page in compressed), default=0)  # type: ignore[union-attr]
    allow_decoded(path, max(of_strip, sum(page.nbytes for page in compressed)), CaptureError)
    others = [group for group in groups.values() if group is not like]
    shown = ", ".join(f"{len(group)} of {' x '.join(map(str, group[0].shape))}" for group in others)
    remarks += [Remark.of(Code.PAGES_LEFT_OUT, pages=shown)] if others else []
    planes, _, height, width, samples = first.shaped
    dtype = np.dtype(first.dtype).newbyteorder(file.byteorder)
    # ImageJ describes one page of one band, behind which the others lie.
    series = file.series[0]
    has_unlisted = series.dataoffset is not None and series.size > first.size * len(file.pages)
    if has_unlisted and first.samplesperpixel == 1:
        num_pages, start = series.size // (height * width), series.dataoffset
        end = start + series.size * dtype.itemsize
        if end > size:
            raise CaptureError(f"{path}: cut short: {num_pages} pages reach to byte {end} of {size}")
        return _Stack(like[:1], (num_pages, height, width), dtype, start)
    if any(extra in _OPACITY for extra in first.extrasamples):
        remarks.append(Remark.of(Code.OPACITY_IS_A_BAND))
    if len(like) == 1:
        return _Stack(like, (height, width, planes * samples), dtype)
    if planes * samples > 1:
        raise CaptureError(
            f"{path}: {len(like)} pages of {planes * samples} numbers per pixel; expected one page with all bands, or "
            "one band a page"
        )
    return _Stack(like, (len(like), height, width), dtype)


def _with_fill(stack: _Stack, no_data: float | None, remarks: list[Remark]) -> _Stack:
    """The stack with the no-data value of the file, and with what its absent strips and tiles read as.

    Source: GDAL, GTiff driver, "Sparse files": they hold the no-data value, or 0 where there is none. Without one,
    floating-point numbers read as NaN here, which is missing.
    """
    stated = () if no_data is None else (no_data,)
    pages = [page for page in stack.pages if not _is_mappable(page)]
    absent = sum(page.databytecounts[: math.prod(page.chunked)].count(0) for page in pages)
    if not absent:
        return replace(stack, no_data=stated)
    is_float = stack.dtype.kind == "f"
    with np.errstate(invalid="ignore"):  # numbers that the type can't hold
        is_usable = no_data is not None and (is_float or np.array(no_data).astype(stack.dtype) == no_data)
    if no_data is not None and is_usable:
        return replace(stack, fill=no_data, no_data=stated)
    taken = "they count as not measured" if is_float else "pixels of 0 in all bands count as not measured"
    remarks.append(Remark.of(Code.BLOCKS_ABSENT, blocks=absent, taken=taken))
    fill, more = (math.nan, ()) if is_float else (0.0, (0.0,))
    return replace(stack, fill=fill, no_data=(*stated, *more))


def _with_below(pages: Any) -> list[Any]:
    return [*pages, *(sub for page in pages for sub in (page.pages or ()))]


def _mask_pages(path: Path, file: TiffFile, image: TiffPage) -> list[TiffPage]:
    """Masks of the whole image: pages of its size, one number a pixel, that are marked as masks and are no previews.

    Source: TIFF 6.0, NewSubfileType 4 and PhotometricInterpretation 4; GDAL, GTiff driver, internal masks.
    """
    # Pages that tifffile takes for more of the first one (OME) have no marks of their own.
    marked = [page for page in _with_below(file.pages) if getattr(page, "is_mask", False)]
    found = [page for page in marked if not page.is_reduced]
    masks = [page for page in found if page.shaped[2:] == (*image.shaped[2:4], 1) and page.shaped[0] == 1]
    for page in masks:
        _check_page(path, page, path.stat().st_size)
    allow_decoded(path, sum(page.nbytes for page in masks), CaptureError)
    return masks


def _check_page(path: Path, page: TiffPage, file_size: int) -> None:
    """Refuse a page that is empty, deep, of an unknown type, no light, or promises more than the file holds."""
    where = f"{path}: page {page.index}"
    if 0 in page.shaped or page.dtype is None:
        raise CaptureError(f"{where}: has the shape {page.shape} of {page.dtype or 'an unknown type'}")
    if page.photometric in _NO_NUMBERS and not page.is_mask:
        raise CaptureError(
            f"{where}: a page {_NO_NUMBERS[page.photometric]}; save it as numbers that grow with light"
        )
    if page.imagedepth > 1:
        raise CaptureError(f"{where}: is {page.imagedepth} images deep; expected one image a page")
    segments, needed = min(len(page.dataoffsets), len(page.databytecounts)), math.prod(page.chunked)
    if segments < needed:
        raise CaptureError(f"{where}: {segments} strips or tiles; its size of {page.shape} needs {needed}")
    ends = zip(page.dataoffsets, page.databytecounts, strict=False)
    end = max(offset + count for offset, count in ends)
    if _is_mappable(page):
        end = max(end, page.dataoffsets[0] + page.nbytes)
    if end > file_size:
        raise CaptureError(f"{where}: cut short: its numbers reach to byte {end} of {file_size}")


def _is_mappable(page: TiffPage) -> bool:
    """Whether its numbers lie uncompressed, one after the other; at the start of the file lies nothing of an image."""
    is_plain = page.dtype is not None and page.bitspersample == page.dtype.itemsize * 8
    return is_plain and page.is_contiguous and page.dataoffsets[0] > 0


def _decode_pages(
    path: Path, numbers: np.ndarray, axis: int, first: int, offsets: tuple[int, ...], fill: str
) -> None:
    """Each strip or tile of some rows, or of some pages, once: into (pages, H, W), or of a single page into (H, W, S)
    or (S, H, W).

    Args:
        offsets: Where the entries of the pages lie.
        fill: What strips and tiles read as that are not in the file, a number.
    """
    tifffile = import_extra("tifffile")
    numbers[:] = float(fill) if numbers.dtype.kind == "f" else int(float(fill))
    is_of_pages = len(offsets) > 1 and axis == 0
    chosen = offsets[first : first + len(numbers)] if is_of_pages else offsets
    with tifffile.TiffFile(path) as file, path.open("rb") as data:
        for index, offset in enumerate(chosen):
            file.filehandle.seek(offset)
            page = tifffile.TiffPage(file, index=index)
            planes, _, height, width, samples = page.shaped
            image = numbers if len(offsets) == 1 else numbers[index]
            image = image.reshape(planes, -1, width, samples)
            top = 0 if is_of_pages else first
            down, across = page.chunks[0], -(-width // page.chunks[1])
            per_plane = -(-height // down) * across
            strips = range(top // down * across, -(-(top + image.shape[1]) // down) * across)
            for plane in range(planes):
                for strip in strips:
                    index_of = plane * per_plane + strip
                    data.seek(page.dataoffsets[index_of])
                    stored = data.read(page.databytecounts[index_of])
                    if len(stored) < page.databytecounts[index_of]:
                        raise CaptureError(
                            f"{path}: cut short in strip or tile {index_of}; copy the file again"
                        )
                    decoded: Any = page.decode(stored or None, index_of, jpegtables=page.jpegtables)
                    values, (part_of, _, row, left, _), _ = decoded
                    if values is not None:  # not left out in the file
                        above = max(0, top - row)
                        place = image[part_of, row + above - top :, left:]
                        part = values[0, above : above + place.shape[0], : place.shape[1]]
                        place[: part.shape[0], : part.shape[1]] = part


def _text(page: TiffPage, tag: int) -> str:
    return str(page.tags.valueof(tag) or "").strip("\0 \n")


def _described(page: TiffPage) -> dict[str, Any]:
    """Entries of a description with wavelengths: OME-XML, JSON, or text as `wavelengths = 450, 460`."""
    text = _text(page, _DESCRIPTION)[: 2**20]
    if "wavelength" not in text.lower():
        return {}
    if found := re.findall(r'<Channel\b[^<>]*?\bEmissionWavelength="([^"]+)"', text):
        unit = re.search(r'EmissionWavelengthUnit="([^"]+)"', text)
        return {"EmissionWavelength": found, "EmissionWavelength units": unit[1] if unit else "nm"}
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        content = None
    items = content.items() if isinstance(content, dict) else ()
    entries = {key: value for key, value in items if isinstance(value, list | str)}
    if state_bands(entries, "image description").centres:
        return entries
    match = _LIST.search(text)
    if match is None:
        return entries
    found = _ITEM.findall(match["list"])
    beside = _UNIT_BESIDE.search(text)
    units = [match["unit"], match["before"], beside[1] if beside else None, found[0][1]]
    known = [unit for unit in units if unit and nm_per_unit(unit)]
    of_items = {unit.lower() for _, unit in found if unit}
    if len({nm_per_unit(unit) for unit in [*known, *sorted(of_items)]}) > 1:
        units_found = ", ".join(dict.fromkeys(unit for unit in (*known, *sorted(of_items))))
        raise CaptureError(
            f"{page.parent.filename}: the description gives wavelengths in several units ({units_found}); correct it, "
            "or give them yourself (--wavelengths)"
        )
    return {"wavelength": [number for number, _ in found], "wavelength units": known[0] if known else ""}


def _from_pages(pages: list[TiffPage], imagej: dict[str, Any]) -> StatedBands:
    """Names of pages, where each is a band and has its own: ImageJ's labels, or in the pages themselves."""
    if pages[0].shaped[0] * pages[0].shaped[-1] > 1:
        return StatedBands("the file")
    if labels := imagej.get("Labels"):
        return StatedBands("labels of ImageJ", names=[str(label) for label in labels])
    for tag, what in ((_PAGE_NAME, "names of pages"), (_DESCRIPTION, "descriptions of pages")):
        names = [" ".join(_text(page, tag).split()) for page in pages]
        if all(0 < len(name) < 200 for name in names) and len(set(names)) == len(names):
            return StatedBands(what, names=names)
    return StatedBands("the file")
