"""A file of an instrument, opened but not read: what it says of itself, and its numbers by rows and bands.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Int, Shaped

from unmix_plugin.errors import CaptureError

BandIndex: TypeAlias = slice | Int[np.ndarray, " b"]
"""Some bands: a slice, or their indices in any order."""
_PARTLY_KNOWN = "only some of the files give wavelengths"
ReadPart: TypeAlias = Callable[[slice, BandIndex], Shaped[np.ndarray, "h W b"]]
"""Stored numbers of some rows and bands."""


@dataclass(frozen=True)
class BandTable:
    """What a file says of its bands; None where it says nothing."""

    wavelengths_nm: Float64[np.ndarray, " B"] | None = None
    """Band centres in nm, in the order of the file."""
    evidence: str = "the file gives no wavelengths"
    """Where the wavelengths were found and in which unit, for people: `header field 'wavelength', Micrometers`."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Full width at half maximum of each band, nm."""
    bad: Bool[np.ndarray, " B"] | None = None
    """Bands that the file itself marks as bad."""
    names: tuple[str, ...] | None = None
    """What the file calls its bands."""


@dataclass(frozen=True)
class SpectralFile:
    """One image of (H, W, B) numbers on disk."""

    path: Path
    """The file that was named: a header where there is one."""
    reader: str
    """Name of the reader: envi, tiff, exr, matlab, hdf5, netcdf, npy, torch, picture."""
    shape: tuple[int, int, int]
    """H, W, B."""
    dtype: np.dtype
    """Type of the stored numbers, in any byte order."""
    read_part: ReadPart = field(repr=False)
    """How `read` gets its numbers."""
    bands: BandTable = BandTable()
    interleave: str | None = None
    """bsq, bil or bip where the format has a choice."""
    scale: float | None = None
    """Stored number that stands for 1, if the file says so."""
    no_data: float | None = None
    """Stored number that stands for no measurement."""
    notes: tuple[str, ...] = ()
    """What is odd about the file, one sentence each."""
    metadata: dict[str, Any] = field(default_factory=dict)
    """Other facts by name, as JSON-able values: exposure_s, gain, black_level, xmp, ..."""
    sources: tuple[Path, ...] = ()
    """Files that hold the numbers, where they are not `path` alone."""

    def read(self, rows: slice = slice(None), bands: BandIndex = slice(None)) -> Shaped[np.ndarray, "h W b"]:
        """Stored numbers of some rows and bands, in the machine's byte order.

        Args:
            rows: With a step of at least 1.
            bands: A slice, or indices in any order; negative ones count from the last band.
        Raises:
            CaptureError: the file is cut short or can't be read.
            IndexError: there is no such band.
        """
        height, width, num_bands = self.shape
        rows, bands = slice(*rows.indices(height)), _plain_bands(bands, num_bands)
        if rows.step < 1:
            raise IndexError(f"rows are read from the top down; got the step {rows.step}")
        wanted = (len(range(height)[rows]), width, len(np.arange(num_bands)[bands]))
        if 0 in wanted:
            return np.zeros(wanted, self.dtype.newbyteorder("="))
        values = self._read_checked(rows, bands)
        if values.shape != wanted:
            raise CaptureError(f"{self.path}: reading gave an array of {values.shape}; expected {wanted}")
        return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("="))

    def _read_checked(self, rows: slice, bands: BandIndex) -> np.ndarray:
        """What `read_part` gives; whatever it raises becomes an error of the file."""
        try:
            return self.read_part(rows, bands)
        except CaptureError:
            raise
        except Exception as error:
            raise unreadable(self.path, error) from error

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that `read` depends on, `path` first."""
        return (self.path, *(source for source in self.sources if source != self.path))


def unreadable(path: Path, error: Exception) -> CaptureError:
    """What to say where a library fails on a file."""
    if isinstance(error, MemoryError):
        return CaptureError(
            f"{path}: too little memory to read it; close other programs, or cut the file in parts"
        )
    reason = " ".join(str(error).split())[:300] or "no reason given"
    return CaptureError(
        f"{path}: can't be read ({type(error).__name__}: {reason}); the file may be cut short or damaged, copy it again"
    )


def _plain_bands(bands: BandIndex, num_bands: int) -> BandIndex:
    """The same bands as a slice with a positive step, or as indices from 0 up."""
    if isinstance(bands, slice) and (bands.step is None or bands.step > 0):
        return slice(*bands.indices(num_bands))
    return np.arange(num_bands)[bands]


def stack_bands(parts: list[SpectralFile], path: Path) -> SpectralFile:
    """Files of one view that hold some bands each, as one file with all of them, in the order given.

    A scale, a no-data value and metadata are those that all parts share.

    Args:
        parts: At least one, all of one size.
        path: What the whole is called in messages: the folder that holds them.
    Raises:
        CaptureError: their sizes differ.
    """
    first = parts[0]
    for part in parts:
        if part.shape[:2] != first.shape[:2]:
            raise CaptureError(
                f"{part.path} has {part.shape[0]} x {part.shape[1]} pixels; expected the "
                f"{first.shape[0]} x {first.shape[1]} of {first.path}: the bands of one view have one size"
            )
    owner = np.concatenate([np.full(part.shape[2], index) for index, part in enumerate(parts)])
    within = np.concatenate([np.arange(part.shape[2]) for part in parts])

    def read_part(rows: slice, bands: BandIndex) -> np.ndarray:
        wanted = np.arange(len(owner))[bands]
        return np.concatenate([parts[owner[band]].read(rows, within[[band]]) for band in wanted], axis=-1)

    return replace(
        first,
        path=path,
        shape=(*first.shape[:2], len(owner)),
        dtype=np.result_type(*(part.dtype for part in parts)),
        read_part=read_part,
        bands=_stack_tables([(part.bands, part.shape[2]) for part in parts]),
        scale=_common([part.scale for part in parts]),
        no_data=_common([part.no_data for part in parts]),
        metadata=_stack_metadata(parts),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
        sources=tuple(source for part in parts for source in part.files),
    )


def _stack_tables(tables: list[tuple[BandTable, int]]) -> BandTable:
    """One table of several; a column that some table lacks is lacking, but bands without a mark are good."""

    def join(columns: list[np.ndarray | None]) -> np.ndarray | None:
        known = [column for column in columns if column is not None]
        return np.concatenate(known) if len(known) == len(columns) else None

    marks = [np.zeros(bands, bool) if table.bad is None else table.bad for table, bands in tables]
    centres = join([table.wavelengths_nm for table, _ in tables])
    known = [table for table, _ in tables if table.wavelengths_nm is not None]
    evidence = tables[0][0].evidence if len(known) in (0, len(tables)) else _PARTLY_KNOWN
    return BandTable(
        centres,
        evidence,
        join([table.fwhm_nm for table, _ in tables]),
        np.concatenate(marks) if any(table.bad is not None for table, _ in tables) else None,
        tuple(name for table, _ in tables for name in table.names or ()) if _all_named(tables) else None,
    )


def _common(values: list[float | None]) -> float | None:
    """The value that all share; None if they differ."""
    return values[0] if len({repr(value) for value in values}) == 1 else None


def _stack_metadata(parts: list[SpectralFile]) -> dict[str, Any]:
    """Entries that are the same in all parts; if any differ, `parts` lists what each part has of its own."""
    first = parts[0].metadata
    same = [key for key in first if all(repr(part.metadata.get(key)) == repr(first[key]) for part in parts)]
    own = [{key: value for key, value in part.metadata.items() if key not in same} for part in parts]
    return {key: first[key] for key in same} | ({"parts": own} if any(own) else {})


def _all_named(tables: list[tuple[BandTable, int]]) -> bool:
    return all(table.names is not None for table, _ in tables)
