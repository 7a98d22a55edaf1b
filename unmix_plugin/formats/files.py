"""Files that are whole or not there: nothing overwritten by accident, images row after row, arrays and PNG as bytes.

Notation: `H x W` pixels, `N` colours.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8

from unmix_plugin.engine.runs.atomic_files import (  # noqa: F401 - some of them for others, who take them from here
    NOT_PLAIN,
    NOT_PORTABLE,
    make_folder,
    safe_name,
    whole_file,
    write_all,
    write_errors_as,
    write_file,
)
from unmix_plugin.engine.runs.replacing import hash_of, refuse_foreign  # noqa: F401 - one of them for others, too
from unmix_plugin.engine.tables import csv_bytes  # noqa: F401 - for others, who take it from here
from unmix_plugin.errors import ConfigError

if TYPE_CHECKING:
    from PIL.Image import Image


RowSink: TypeAlias = Callable[[np.ndarray], None]
"""Takes the next rows of an image, (rows, W, ...), from the top down."""


def refuse_to_overwrite(paths: Collection[Path], overwrite: bool) -> None:
    """Look before anything is computed whether files would be lost.

    Raises:
        ConfigError: one of `paths` exists, and overwriting was not asked for.
        RunError: one of them is not ours (`engine.runs.replacing`), be overwriting asked for or not.
    """
    existing = [path for path in paths if os.path.lexists(path)]
    if existing and not overwrite:
        others = f" and {len(existing) - 1} more of its files exist" if len(existing) > 1 else " exists"
        raise ConfigError(f"{existing[0]}{others} already; give --overwrite or another folder")
    refuse_foreign(paths)


def numbered_apart(names: Iterable[str]) -> list[str]:
    """Names that differ in more than capitals: one that is taken gets the least number that makes it free.

    >>> numbered_apart(["red_clay", "leaf", "red_clay_1", "Leaf", "red_clay"])
    ['red_clay', 'leaf', 'red_clay_1', 'Leaf_1', 'red_clay_2']
    """
    taken: dict[str, str] = {}
    for name in names:
        free, number = name, 0
        while free.casefold() in taken:
            number += 1
            free = f"{name}_{number}"
        taken[free.casefold()] = free
    return list(taken.values())


def eight_bits(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1] as 8-bit numbers; others are cut."""
    return np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)


def array_bytes(array: np.ndarray) -> bytes:
    """An array as the bytes of an .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


@contextmanager
def raw_rows(path: Path, header: bytes, shape: tuple[int, ...], dtype: np.dtype) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of an image; at its end the file is complete and has its name.

    The file has `header` before an image of this shape, (H, W, ...), and type.

    Raises:
        ValueError: the rows given don't add up to `shape`.
    """
    given = 0

    def write(values: np.ndarray) -> None:
        with write_errors_as(path):
            write_all(descriptor, values.reshape(-1).view(np.uint8).data)

    def add(rows: np.ndarray) -> None:
        nonlocal given
        if rows.shape[1:] != shape[1:]:
            raise ValueError(f"rows of {path.name} have shape {shape[1:]}; got {rows.shape[1:]}")
        given += len(rows)
        write(np.ascontiguousarray(rows, dtype=dtype))

    with whole_file(path) as temporary:
        with write_errors_as(path):
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            descriptor = os.open(temporary, flags, 0o666)
        try:
            write(np.frombuffer(header, dtype=np.uint8))
            yield add
        finally:
            os.close(descriptor)
        if given != shape[0]:
            raise ValueError(f"{path.name} has {shape[0]} rows; got {given}")


@contextmanager
def npy_rows(path: Path, shape: tuple[int, ...], dtype: type[np.generic]) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of an array of this shape, as `raw_rows` does."""
    kind = np.dtype(dtype).newbyteorder("<")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
    )
    with raw_rows(path, header.getvalue(), shape, kind) as add:
        yield add


def rgba_png_bytes(pixels: UInt8[np.ndarray, "H W *C"], description: str = "") -> bytes:
    """sRGB colours of three or four channels, of which the fourth is opacity, by which they are not multiplied; or
    numbers as shades of grey.

    `description` says what is shown; it is written into the file as its `Description`.
    """
    from PIL import Image

    return _encoded(Image.fromarray(pixels), description)


def indexed_png_bytes(
    ids: UInt8[np.ndarray, "H W"],
    palette: Float[np.ndarray, "N 3"],
    transparent: int | None = None,
    description: str = "",
) -> bytes:
    """Ids whose colours are in the palette, sRGB in [0, 1]: readers get either, as they ask.

    The id `transparent` is not painted; `description` is as `rgba_png_bytes` takes it.
    """
    from PIL import Image

    picture = Image.fromarray(ids, mode=None).copy()
    picture.putpalette(np.round(np.asarray(palette) * 255).astype(np.uint8).tobytes())
    return _encoded(picture, description, transparent)


def _encoded(picture: Image, description: str, transparent: int | None = None) -> bytes:
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    if description:
        text.add_itxt("Description", description)
    buffer = io.BytesIO()
    options = {} if transparent is None else {"transparency": transparent}
    picture.save(buffer, format="PNG", pnginfo=text, **options)
    return buffer.getvalue()
