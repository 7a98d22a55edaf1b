"""Images made of the numbers of other images: a scan of several files one under the other, and the bands of a mosaic.

The numbers are copied once, some rows at a time, into the scratch file of what is decoded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.cube import Cube
from unmix_plugin.captures.numbers import Decoded, Numbers
from unmix_plugin.captures.report import Code, Remark, merged
from unmix_plugin.errors import CaptureError

_MOSAICS = ((2, 2), (3, 3), (4, 4), (5, 5), (2, 4), (6, 6))
"""Rows and columns of filters that cameras have (imec, XIMEA, Bayer)."""
_LEAST_SHARE = 0.5
"""Of the variance between neighbouring pixels that their places in the pattern explain, from which it is one."""
_JUDGED_PX = 240


def join_lines(parts: Sequence[Cube]) -> Cube:
    """The parts of one scan as one image, one under the other in the order given.

    Raises:
        CaptureError: they differ in more than their lines.
    """
    first = parts[0]
    for part in parts:
        same = (part.shape[1:], part.dtype, repr(part.bands), repr(part.linear), part.exposure, part.no_data)
        expected = (
            *(first.shape[1:], first.dtype, repr(first.bands), repr(first.linear), first.exposure),
            first.no_data,
        )
        if same != expected or part.numbers is None or part.masks or part.dark_lines:
            raise CaptureError(
                f"{part.path} and {first.path} are named like parts of one scan, but their width, bands, gains or "
                "exposure differ; move one of them away"
            )
    height = sum(part.shape[0] for part in parts)
    shape = (height, *first.shape[1:])
    pieces = tuple((part.path, part.first_line, part.shape[0], part.numbers) for part in parts)
    block = Decoded(
        first.path, first.dtype.newbyteorder("="), shape, _copy_lines, (pieces,), units=(1, *shape[1:])
    )
    joined = Remark.of(Code.PARTS_JOINED, parts=len(parts), names=[part.path.name for part in parts])
    return replace(
        first,
        shape=shape,
        dtype=block.dtype,
        numbers=Numbers((block,), shape, "yxb", block.dtype),
        first_line=0,
        remarks=(*merged(remark for part in parts for remark in part.remarks), joined),
        sources=tuple(source for part in parts for source in part.files),
    )


def _copy_lines(
    _: Path, into: np.ndarray, axis: int, first: int, pieces: tuple[tuple[Path, int, int, Numbers], ...]
) -> None:
    """Rows from `first` on, whichever of the pieces they stand in."""
    assert axis == 0
    last, begin = first + len(into), 0
    for _, offset, lines, numbers in pieces:
        low, high = max(first, begin), min(last, begin + lines)
        if low < high:
            stored = slice(offset + low - begin, offset + high - begin)
            into[low - first : high - first] = numbers.read(stored, slice(0, into.shape[2]))
        begin += lines


def take_apart(mosaic: Cube, filters: tuple[int, int]) -> Cube:
    """The bands of a mosaic: of each block of `filters` rows and columns the pixel (r, c) is band r * columns + c.

    Raises:
        CaptureError: the image has several bands, or fewer pixels than a block.
    """
    rows, columns = filters
    height, width, num_bands = mosaic.shape
    if num_bands != 1 or mosaic.numbers is None:
        raise CaptureError(f"{mosaic.path} has {num_bands} bands; --mosaic takes apart images of one band")
    shape = (height // rows, width // columns, rows * columns)
    if 0 in shape:
        raise CaptureError(
            f"{mosaic.path} has {height} x {width} pixels, and --mosaic {rows}x{columns} needs more"
        )
    block = Decoded(
        *(mosaic.path, mosaic.dtype.newbyteorder("="), shape, _copy_mosaic),
        (rows, columns, mosaic.first_line, mosaic.numbers),
        units=(1, *shape[1:]),
    )
    cut = (height % rows, width % columns)
    filters_named = f"{rows} x {columns}"
    remarks = [Remark.of(Code.MOSAIC_TAKEN_APART, filters=filters_named, apart=max(filters) - 1)]
    if any(cut):
        remarks.append(Remark.of(Code.MOSAIC_RIM_LEFT_OUT, rows=cut[0], columns=cut[1]))
    return replace(
        mosaic,
        shape=shape,
        dtype=block.dtype,
        numbers=Numbers((block,), shape, "yxb", block.dtype),
        first_line=0,
        bands=replace(mosaic.bands, wavelengths_nm=None, fwhm_nm=None, bad=None, names=None),
        is_srgb=False,
        masks=(),
        remarks=(*mosaic.remarks, *remarks),
    )


def _copy_mosaic(
    _: Path,
    into: np.ndarray,
    axis: int,
    first: int,
    rows: int,
    columns: int,
    offset: int,
    numbers: Numbers,
) -> None:
    assert axis == 0
    high, wide, bands = into.shape
    stored = numbers.read(slice(offset + first * rows, offset + (first + high) * rows), slice(0, 1))
    blocks = stored[:, : wide * columns, 0].reshape(high, rows, wide, columns)
    into[:] = blocks.transpose(0, 2, 1, 3).reshape(high, wide, bands)


def mosaic_of(file: Cube) -> tuple[int, int] | None:
    """Rows and columns of filters of an image of one band whose neighbouring pixels differ by their places in blocks
    that repeat; None for others. Judged in the middle of the image."""
    height, width, num_bands = file.shape
    if num_bands != 1 or min(height, width) < 12:
        return None
    top = max(0, (height - _JUDGED_PX) // 2)
    values = file.read(slice(top, top + _JUDGED_PX))[..., 0].astype(np.float64)
    left = max(0, (width - _JUDGED_PX) // 2)
    values = values[:, left : left + _JUDGED_PX]
    if not np.isfinite(values).all():
        return None
    # How much of what pixels differ from the mean of their block their place in it explains.
    shares = dict.fromkeys(_MOSAICS, 0.0)
    for rows, columns in _MOSAICS:
        high, wide = values.shape[0] // rows, values.shape[1] // columns
        if min(high, wide) >= 2:
            blocks = values[: high * rows, : wide * columns].reshape(high, rows, wide, columns)
            means = blocks.mean(axis=(1, 3), keepdims=True)
            apart = (blocks - means) / np.maximum(means, 1e-12)  # filters pass parts of the light
            total = float((apart**2).mean())
            if total > 0:
                shares[rows, columns] = float((apart.mean(axis=(0, 2)) ** 2).mean()) / total
    best = max(shares.values())
    return next((filters for filters in _MOSAICS if shares[filters] >= max(_LEAST_SHARE, 0.9 * best)), None)


def said_of_mosaic(file: Cube) -> str:
    """What to do, for a message, with an image that looks like a mosaic; empty for others."""
    filters = mosaic_of(file)
    if filters is None:
        return ""
    rows, columns = filters
    return (
        f". It looks like the raw frame of a mosaic camera, {rows} x {columns} filters: give --mosaic {rows}x{columns} "
        f"and the {rows * columns} wavelengths of its filters, row by row"
    )
