"""NumPy's own format, written row after row."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from unmix_plugin.formats.raw_rows import RowSink, raw_rows


@contextmanager
def npy_rows(path: Path, shape: tuple[int, ...], dtype: type[np.generic]) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of an array of this shape; the file appears at its end.

    Raises:
        ValueError: the rows given don't add up to `shape`.
    """
    kind = np.dtype(dtype).newbyteorder("<")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
    )
    with raw_rows(path, header.getvalue(), shape, kind) as add:
        yield add
