"""Images on disk as they are in memory: a header and then row after row, of which only a few are held at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import numpy as np

from unmix_plugin.engine.runs.atomic_files import whole_file, write_all, write_errors_as

RowSink: TypeAlias = Callable[[np.ndarray], None]
"""Takes the next rows of an image, (rows, W, ...), from the top down."""


@contextmanager
def raw_rows(path: Path, header: bytes, shape: tuple[int, ...], dtype: np.dtype) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of an image; at its end the file is complete and has its name.

    Args:
        path: File to write.
        header: Bytes before the pixels.
        shape: Of the whole image, (H, W, ...).
        dtype: Of the numbers on disk.
    Raises:
        ValueError: the rows given don't add up to `shape`.
    """
    given = 0

    def add(rows: np.ndarray) -> None:
        nonlocal given
        if rows.shape[1:] != shape[1:]:
            raise ValueError(f"rows of {path.name} have shape {shape[1:]}; got {rows.shape[1:]}")
        given += len(rows)
        with write_errors_as(path):
            _write(descriptor, np.ascontiguousarray(rows, dtype=dtype))

    with whole_file(path) as temporary:
        with write_errors_as(path):
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            descriptor = os.open(temporary, flags, 0o666)
        try:
            with write_errors_as(path):
                _write(descriptor, np.frombuffer(header, dtype=np.uint8))
            yield add
        finally:
            os.close(descriptor)
        if given != shape[0]:
            raise ValueError(f"{path.name} has {shape[0]} rows; got {given}")


def _write(descriptor: int, values: np.ndarray) -> None:
    write_all(descriptor, values.reshape(-1).view(np.uint8).data)
