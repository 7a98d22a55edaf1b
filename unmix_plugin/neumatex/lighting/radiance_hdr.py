"""Reading Radiance's RGBE pictures (.hdr).

Source: Ward 1991, Real Pixels, Graphics Gems II; the run-length code of the Radiance file format's documentation.

Notation: `H x W` pixels.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from unmix_plugin.errors import SceneError

_NEW_RUNS = (8, 0x7FFF)
"""Widths, in pixels, that may have the newer run-length code."""


def read_hdr(path: Path) -> Float32[np.ndarray, "H W 3"]:
    """Linear radiance of a picture whose rows run from the top, each from the left.

    Raises:
        SceneError: the file is damaged, holds XYZ instead of RGB, or stores its pixels in another order.
    """
    data = path.read_bytes()
    height, width, start = _header(path, data)
    rgbe = np.empty((height, width, 4), dtype=np.uint8)
    row = 0
    try:
        for row in range(height):
            start = _read_row(data, start, rgbe[row])
    except (IndexError, ValueError) as error:
        raise SceneError(f"{path}: ends or breaks in row {row} of {height}; copy the file again") from error
    exponents = rgbe[..., 3:].astype(np.int32)
    scale = np.where(exponents > 0, np.ldexp(np.float32(1.0), exponents - 136), np.float32(0.0))
    return (rgbe[..., :3] * scale).astype(np.float32)


def _header(path: Path, data: bytes) -> tuple[int, int, int]:
    """Rows, columns and where the pixels start."""
    match = re.search(rb"\n\n(\S+) (\d+) (\S+) (\d+)\n", data[:65536])
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")) or match is None:
        raise SceneError(f"{path}: is no Radiance picture (its header is missing); convert it to .exr")
    if b"FORMAT=32-bit_rle_xyze" in data[: match.start()]:
        raise SceneError(f"{path}: holds XYZ colours; convert it to RGB")
    if (match[1], match[3]) != (b"-Y", b"+X"):
        raise SceneError(
            f"{path}: has its rows in the order {match[0].decode().strip()!r}, not -Y +X; convert it"
        )
    return int(match[2]), int(match[4]), match.end()


def _read_row(data: bytes, start: int, row: np.ndarray) -> int:
    """Fill a row's (W, 4) bytes; where the next row starts."""
    width = len(row)
    coded = _NEW_RUNS[0] <= width <= _NEW_RUNS[1] and data[start : start + 2] == b"\x02\x02"
    if not coded:
        return _read_old_row(data, start, row)
    if data[start + 2] << 8 | data[start + 3] != width:
        raise ValueError("length of the row")
    start += 4
    for channel in range(4):
        column = 0
        while column < width:
            count = data[start]
            if count > 128:
                count -= 128
                values, used = data[start + 1], 2
            else:
                values, used = np.frombuffer(data, np.uint8, count, start + 1), count + 1
            if count == 0 or column + count > width:
                raise ValueError("run")
            row[column : column + count, channel] = values
            column, start = column + count, start + used
    return start


def _read_old_row(data: bytes, start: int, row: np.ndarray) -> int:
    """A row of plain pixels, in which (1, 1, 1, n) repeats the pixel before it."""
    column, shift = 0, 0
    while column < len(row):
        pixel = np.frombuffer(data, np.uint8, 4, start)
        start += 4
        if tuple(pixel[:3]) == (1, 1, 1):
            count = int(pixel[3]) << shift
            if column == 0 or column + count > len(row):
                raise ValueError("run")
            row[column : column + count] = row[column - 1]
            column, shift = column + count, shift + 8
        else:
            row[column] = pixel
            column, shift = column + 1, 0
    return start
