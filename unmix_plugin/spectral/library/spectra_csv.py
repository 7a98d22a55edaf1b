"""Spectra as CSV: one row a wavelength, one column a spectrum.

`wavelength,name,name,...` for endmembers and libraries, `wavelength,power` for an illuminant. Wavelengths in nm,
strictly increasing; values finite and not negative, divided by 100 where a name ends in % or (%). UTF-8, with or
without a byte order mark; blank lines are skipped.
"""

from __future__ import annotations

import csv
import io
import re
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.engine.tables import csv_bytes
from unmix_plugin.errors import SpectrumError, name_some
from unmix_plugin.limits import read_bounded
from unmix_plugin.spectral.bands import Bands, require_nanometres

_MOST_BYTES = 1 << 26
"""Of a table; two thousand spectra in as many bands have 40 MB."""
TOLERANCE_NM = 1e-3
"""What tables lose of wavelengths by rounding them: centres that differ by no more are the same, and a reach beyond the
data by no more is not extrapolation."""
PERCENT = re.compile(r"(?:[\s_]*[\[(](?:%|percent|per cent)[\])]|(?<![\d\s_])[\s_]*%)\s*$", re.IGNORECASE)
"""`paint (%)`, `paint %`; `clay 20 %` is a name."""


@dataclass(frozen=True)
class SpectraTable:
    """Named spectra on one sampling."""

    bands: Bands
    names: tuple[str, ...]
    """One for each spectrum, distinct, not empty."""
    spectra: Float64[np.ndarray, "K B"]
    """One spectrum a row; finite, not negative."""

    def __post_init__(self) -> None:
        if self.spectra.shape != (len(self.names), len(self.bands)):
            raise SpectrumError(
                f"{len(self.names)} names and {len(self.bands)} bands need spectra of shape "
                f"({len(self.names)}, {len(self.bands)}); found {self.spectra.shape}"
            )
        if not self.names or not all(name.strip() for name in self.names):
            raise SpectrumError(f"each spectrum needs a name; found {name_some(self.names, 8)}")
        for name, count in Counter(self.names).items():
            if count > 1:
                raise SpectrumError(f"names of spectra must differ; found '{name}' {count} times")
        for rule, holds in (("be finite", np.isfinite(self.spectra)), ("not be negative", self.spectra >= 0)):
            if not holds.all():
                k, b = np.unravel_index(np.argmin(holds), holds.shape)
                raise SpectrumError(
                    f"spectra must {rule}; found {self.spectra[k, b]:g} in '{self.names[k]}' "
                    f"at {self.bands.centers_nm[b]:g} nm"
                )

    def resampled(self, bands: Bands) -> SpectraTable:
        """The same spectra at other wavelengths, as `resample_spectra` interpolates them."""
        return SpectraTable(bands, self.names, resample_spectra(self.spectra, self.bands, bands))


def resample_spectra(
    spectra: Float64[np.ndarray, "*batch B"], source: Bands, target: Bands
) -> Float64[np.ndarray, "*batch C"]:
    """Linear interpolation between band centres, bands last; a target centre outside the source's is refused."""
    if spectra.shape[-1] != len(source):
        raise SpectrumError(f"spectra of {spectra.shape[-1]} values do not fit {source}")
    below = source.centers_nm[0] - target.centers_nm[0]
    above = target.centers_nm[-1] - source.centers_nm[-1]
    if max(below, above) > TOLERANCE_NM:
        sides = [f"{d:g} nm {side}" for d, side in ((below, "below"), (above, "above")) if d > TOLERANCE_NM]
        raise SpectrumError(
            f"spectra at {source} do not reach {target}: {' and '.join(sides)} their range; "
            "measure them there or leave those bands out (nothing is extrapolated)"
        )
    if source == target:
        return spectra.copy()
    rows = spectra.reshape(-1, len(source))
    resampled = [np.interp(target.centers_nm, source.centers_nm, row) for row in rows]
    return np.array(resampled, dtype=np.float64).reshape(*spectra.shape[:-1], len(target))


def read_spectra_csv(path: Path) -> SpectraTable:
    """Read and validate a table of spectra.

    Raises:
        SpectrumError: it can't be read, or is no such table; the message has the file and the place.
    """
    try:
        header, values = read_number_table(path)
        if header[0].lower() not in ("wavelength", "wavelength_nm", "wavelengths"):
            raise SpectrumError(f"the first column must be headed 'wavelength' (in nm); found '{header[0]}'")
        if len(header) == 1:
            raise SpectrumError("no spectra: there is no column beside 'wavelength'")
        bands = Bands(values[:, 0].copy())
        require_nanometres(bands.centers_nm)
        names, scales = without_percent(header[1:])
        return SpectraTable(bands, tuple(names), values[:, 1:].T / scales)
    except SpectrumError as error:
        raise SpectrumError(f"{path}: {error}") from error


def without_percent(names: Sequence[str]) -> tuple[list[str], Float64[np.ndarray, "K 1"]]:
    """Names of columns without the mark of percent, and what the columns are to be divided by."""
    bare = [PERCENT.sub("", name) for name in names]
    is_percent = [name != given for name, given in zip(bare, names, strict=True)]
    return bare, np.where(is_percent, 100.0, 1.0)[:, None]


def read_number_table(path: Path) -> tuple[list[str], Float64[np.ndarray, "R C"]]:
    """The header of a CSV file, and its rows of numbers, at least one; errors name the line, but not the file."""
    header, values = [], array("d")  # a value takes 8 bytes so, and 60 as a text
    try:
        with io.TextIOWrapper(io.BytesIO(read_bounded(path, _MOST_BYTES)), "utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            for row in reader:
                if any(cell.strip() for cell in row):
                    if header:
                        values.extend(_parse_row(row, reader.line_num, header))
                    else:
                        header = [cell.strip() for cell in row]
    except OSError as error:
        raise SpectrumError(f"can't read spectra: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise SpectrumError(f"not a CSV file in UTF-8: {error}") from error
    if not header:
        raise SpectrumError(
            "the file is empty; expected a header 'wavelength,name,...' and one row a wavelength"
        )
    if not values:
        raise SpectrumError("there is a header but no row of values")
    return header, np.frombuffer(values).reshape(-1, len(header))


def write_spectra_csv(path: Path, table: SpectraTable) -> None:
    """Write a table with 9 significant digits, exact for float32; an older file is replaced in one step."""
    values = np.column_stack([table.bands.centers_nm, table.spectra.T])
    rows = ([f"{value:.9g}" for value in row] for row in values)
    write_file(path, csv_bytes([["wavelength", *table.names], *rows]))


def _parse_row(row: list[str], line: int, header: list[str]) -> list[float]:
    if len(row) != len(header):
        raise SpectrumError(f"line {line} has {len(row)} values, the header has {len(header)}")
    try:
        return [float(cell) for cell in row]
    except ValueError:
        wrong = next(i for i, cell in enumerate(row) if not is_number(cell))
        raise SpectrumError(
            f"line {line}, column '{header[wrong]}': '{row[wrong].strip()}' is not a number"
        ) from None


def is_number(cell: str) -> bool:
    """Whether a text is a number, NaN and infinity among them."""
    try:
        float(cell)
    except ValueError:
        return False
    return True
