"""Numbers of one page of a TIFF, by strips or tiles: only those that are asked for are read and decoded.

Notation: `H` rows, `W` columns, `S` samples (numbers of a pixel).
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unmix_plugin.captures.spectral_file import BandIndex
from unmix_plugin.errors import CaptureError

if TYPE_CHECKING:
    from tifffile import TiffPage


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
