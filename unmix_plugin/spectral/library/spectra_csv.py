"""Spectra that are known at all wavelengths of one sampling: from text files, resampled, and as CSV.

Written are one row a wavelength and one column a spectrum, headed `wavelength,name,...`, with wavelengths in nm, in
UTF-8. What is read is in `spectral_tables`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.engine.tables import csv_bytes
from unmix_plugin.errors import SpectrumError, name_some
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectral_tables import read_spectral_text, require_wavelengths

TOLERANCE_NM = 1e-3
"""What tables lose of wavelengths by rounding them: centres that differ by no more are the same, and a reach beyond the
data by no more is not extrapolation."""


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


def read_spectra(path: Path, outside: float | None = None) -> SpectraTable:
    """The spectra of a text file, each known at all of its wavelengths.

    Wavelengths at its ends at which nothing was measured are left out.

    Args:
        outside: What a spectrum is below and above where it was measured, if others were measured there.
    Raises:
        SpectrumError: it can't be read, is no table of spectra, or has a gap; the message has the file and the place.
    """
    try:
        measured = read_spectral_text(path)
        order = np.argsort(measured.wavelengths_nm, kind="stable")
        nm, values = measured.wavelengths_nm[order], measured.values[:, order]
        known = np.flatnonzero(np.isfinite(values).any(axis=0))
        inside = slice(known[0], known[-1] + 1) if len(known) else slice(None)
        nm, values = nm[inside], values[:, inside].copy()
        if outside is not None:
            for row in values:
                own = np.flatnonzero(np.isfinite(row))
                row[: own[0] if len(own) else None] = outside
                row[own[-1] + 1 if len(own) else 0 :] = outside
        bands = Bands(nm)
        require_wavelengths(nm)
        return SpectraTable(bands, measured.names, values)
    except SpectrumError as error:
        raise SpectrumError(f"{path}: {error}") from error


def write_spectra_csv(path: Path, table: SpectraTable) -> None:
    """Write a table with 9 significant digits, exact for float32; an older file is replaced in one step."""
    values = np.column_stack([table.bands.centers_nm, table.spectra.T])
    rows = ([f"{value:.9g}" for value in row] for row in values)
    write_file(path, csv_bytes([["wavelength", *table.names], *rows]))
