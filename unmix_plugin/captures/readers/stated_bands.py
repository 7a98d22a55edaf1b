"""What a file says of its bands, checked: units brought to nm, and nothing impossible accepted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unmix_plugin.captures.readers.wavelength_text import nm_per_unit, wavelengths_in_names
from unmix_plugin.captures.spectral_file import BandTable

_PLAUSIBLE_NM = (100.0, 30_000.0)
"""Range of cameras, from the far ultraviolet to the thermal infrared."""
_UNUSABLE = "the file gives no wavelengths that can be used, see the notes"
_ASK = "give the wavelengths yourself (--wavelengths)"


@dataclass(frozen=True)
class StatedBands:
    """Values as they are in a file, text or numbers; None where the file has none."""

    where: str
    """Where the centres are: `header field 'wavelength'`."""
    centres: Sequence[object] | None = None
    unit: str | None = None
    fwhm: Sequence[object] | None = None
    good: Sequence[object] | None = None
    """0 for a bad band."""
    names: Sequence[str] | None = None


def check_bands(stated: StatedBands, num_bands: int) -> tuple[BandTable, tuple[str, ...]]:
    """The table of an image's bands, and notes on what of it can't be used."""
    notes: list[str] = []
    names = _fitting("names of bands", stated.names, num_bands, notes)
    centres, evidence, factor = None, BandTable.evidence, None
    if stated.centres is not None:
        evidence = _UNUSABLE
        numbers = _numbers(f"{stated.where}: wavelengths", stated.centres, num_bands, notes)
        if numbers is not None:
            centres, evidence, factor = _in_nm(numbers, stated, notes)
    if centres is None and names is not None:
        found = wavelengths_in_names([str(name) for name in names])
        if found is not None:
            centres, evidence = found.centres_nm, f"names of bands, such as {names[0]!r}: {found.evidence}"
    if centres is not None and (np.diff(centres) == 0).any():
        notes.append("two bands beside each other have the same wavelength")
    fwhm = _numbers("FWHM", stated.fwhm, num_bands, notes) if stated.fwhm is not None else None
    good = _numbers("marks of bad bands", stated.good, num_bands, notes) if stated.good is not None else None
    table = BandTable(
        centres,
        evidence,
        fwhm * factor if fwhm is not None and factor is not None and (fwhm > 0).all() else None,
        None if good is None else good == 0,
        None if names is None else tuple(map(str, names)),
    )
    return table, tuple(notes)


def _in_nm(
    values: np.ndarray, stated: StatedBands, notes: list[str]
) -> tuple[np.ndarray | None, str, float | None]:
    """Wavelengths in nm with their evidence and factor; None where the unit isn't known or can't be true."""
    low, high = float(values.min()), float(values.max())
    unit = (stated.unit or "").strip()
    factor = nm_per_unit(unit)
    if factor is None and unit.lower() in ("", "unknown"):
        factor = next((f for f in (1.0, 1e3) if _is_plausible(low * f, high * f)), None)
        taken = "nm" if factor == 1.0 else "micrometres"
        evidence = f"{stated.where}, no unit: {low:g} to {high:g} taken as {taken}"
    else:
        evidence = f"{stated.where}, {unit}"
    if factor is None:
        given = f"the unit {unit!r}" if unit else "no unit"
        notes.append(f"{stated.where}: {low:g} to {high:g} with {given} can't be brought to nm; {_ASK}")
    elif not _is_plausible(low * factor, high * factor):
        notes.append(f"{stated.where}: {low:g} to {high:g} can't be in {unit}; {_ASK}")
    else:
        return values * factor, evidence, factor
    return None, _UNUSABLE, None


def _is_plausible(low_nm: float, high_nm: float) -> bool:
    return _PLAUSIBLE_NM[0] <= low_nm and high_nm <= _PLAUSIBLE_NM[1]


def _numbers(what: str, values: Sequence[object], count: int, notes: list[str]) -> np.ndarray | None:
    """One finite number a band; None with a note where it is anything else."""
    fitting = _fitting(what, values, count, notes)
    if fitting is None:
        return None
    try:
        numbers = np.array([float(str(value)) for value in fitting])
    except ValueError as error:
        notes.append(f"{what} are not a list of numbers ({str(error)[:80]}) and are left out")
        return None
    if not np.isfinite(numbers).all():
        band = int(np.argmin(np.isfinite(numbers)))
        notes.append(f"{what} are left out: that of band {band} (from 0) is {numbers[band]:g}")
        return None
    return numbers


def _fitting(
    what: str, values: Sequence[object] | None, count: int, notes: list[str]
) -> Sequence[object] | None:
    if values is None or len(values) == count:
        return values
    notes.append(f"{what} are left out: {len(values)} for {count} bands")
    return None
