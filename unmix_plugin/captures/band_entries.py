"""Bands by the entries of files: centres and widths in whatever unit, marks of bad bands, and names.

`state_bands` finds the entries, under many names; `check_bands` brings them to nm, and accepts nothing impossible. What
is left out, and why, is appended to the reader's list of remarks.

Notation: `B` bands; wavelengths in nm.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from unmix_plugin.captures.cube import BandTable
from unmix_plugin.captures.fields import PARTS, listed, plain_names
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.wavelengths import PLAUSIBLE_NM, nm_per_width, wavelengths_in_names
from unmix_plugin.spectral.bands import are_band_numbers, nm_per_unit

_CENTRES = re.compile(
    r"list_cw_[^_]*|bands|"
    r"((band|cent(er|re|ral)|sensor|emission)_?)*(wavelengths?|wavelen|wvls?|wls?|lambdas?|waves?)(_?(nm|um|3d))?"
)
_WIDTHS = re.compile(r"(fwhms?|band_?widths?|list_fwhm_[^_]*)(_?(nm|um))?")
GOOD = re.compile(r"bbl|good_(wavelengths?|bands?)|list_cw_.*_flags")
NAMES = re.compile(r"band_?names?")
_UNUSABLE = "the file gives no wavelengths that can be used, see the notes"


def says_bands(name: str) -> bool:
    """Whether an entry of this plain name lists something of bands."""
    return any(names.fullmatch(name) for names in (_CENTRES, _WIDTHS, GOOD))


@dataclass(frozen=True)
class StatedBands:
    """Values as they are in a file, text or numbers; None where the file has none."""

    where: str
    """Where the centres are: `header field 'wavelength'`."""
    centres: Sequence[object] | None = None
    unit: str | None = None
    fwhm: Sequence[object] | None = None
    fwhm_unit: str | None = None
    """None where it is that of the centres."""
    good: Sequence[object] | None = None
    """0 for a bad band."""
    names: Sequence[str] | None = None


def state_bands(entries: Mapping[str, Any], where: str) -> StatedBands:
    """What entries say of bands, the first of each kind; those whose names have no unit first.

    Args:
        where: What they are, for people: `header field`.
    """
    named = plain_names(entries)

    def find(names: re.Pattern[str], *units: str, separators: str = PARTS) -> tuple[str, list[Any] | None]:
        for unit in units:
            found = {
                name: listed(entries[key], separators)
                for name, key in named.items()
                if names.fullmatch(name) and _unit_in(name) == unit
            }
            if "bands" in found and counts_bands(found["bands"], unit_of("bands")):
                del found["bands"]
            if longest := max(found, key=lambda name: len(found[name]), default=""):
                return longest, found[longest] or None
        return "", None

    def unit_of(name: str, is_of_all: bool = True) -> str | None:
        # Those of a list called `wavelength`, or of all bands.
        is_of_all &= not _unit_in(name) and "wavelength" not in named
        of_all = ("wavelength_units", "wavelength_unit") if is_of_all else ()
        keys = [named[key] for key in (f"{name}_units", f"{name}_unit", *of_all) if key in named]
        unit = entries[keys[0]] if keys else _unit_in(name) or None
        return unit if unit is None or isinstance(unit, str) else str(listed(unit)[0])

    name, centres = find(_CENTRES, "", "nm", "um")
    width, fwhm = find(_WIDTHS, "", _unit_in(name), "nm", "um")
    good = find(GOOD, "")[1]
    marks = good and [int(mark) if isinstance(mark, bool) else mark for mark in good]
    names, where = find(NAMES, "", separators=",")[1], f"{where} '{named.get(name)}'"
    return StatedBands(
        where,
        centres=centres,
        unit=unit_of(name),
        fwhm=fwhm,
        fwhm_unit=unit_of(width, is_of_all=False),
        good=marks,
        names=names,
    )


def _unit_in(name: str) -> str:
    """The unit that a name ends with; empty without one."""
    return name[-2:] if name.endswith(("nm", "um")) else ""


def counts_bands(items: Sequence[Any], unit: str | None) -> bool:
    """Whether a list called `bands` has the number or numbers of bands, and not their wavelengths."""
    try:
        numbers = np.array(items, np.float64)
    except (TypeError, ValueError):
        return True
    has_unit = unit is not None and nm_per_unit(unit) is not None
    return not has_unit and (len(items) < 2 or are_band_numbers(numbers, may_have_gaps=True))


def check_bands(stated: StatedBands, num_bands: int, remarks: list[Remark]) -> BandTable:
    """The table of an image's bands, with units brought to nm and nothing impossible accepted.

    A wavelength of 0 marks a band that is not used, as PRISMA's files have it: the band counts as bad.
    """
    names = _fitting("names of bands", stated.names, num_bands, remarks)
    centres, source, factor, unused = None, BandTable.source, None, np.zeros(num_bands, bool)
    if stated.centres is not None:
        source = _UNUSABLE
        values = _numbers(f"{stated.where}: wavelengths", stated.centres, num_bands, remarks)
        if values is not None:
            unused = values == 0 if (values > 0).any() else unused
            used = values[~unused]
            factor, found = _nm_per_stated(values, used, stated)
            if isinstance(found, Remark):
                remarks.append(found)
            elif factor is not None:
                # An unused band gets the wavelength of the nearest band that is used, of two the first.
                middles = np.convolve(np.flatnonzero(~unused), (0.5, 0.5), "valid")
                nearest = np.searchsorted(middles, np.arange(num_bands))
                centres, source = used[nearest] * factor, found
                source += f"; {int(unused.sum())} are 0: bands that are not used" if unused.any() else ""
    named_fwhm = None
    named = None if centres is not None or names is None else wavelengths_in_names(list(map(str, names)))
    if named is not None and names is not None:
        centres, source = named[0], f"names of bands, such as {names[0]!r}: {named[1]}"
        named_fwhm = named[2] if stated.fwhm is None else None
        factor = nm_per_unit((stated.unit or "").strip()) or 1.0
    if centres is not None and (np.diff(centres[~unused]) == 0).any():
        remarks.append(Remark.of(Code.WAVELENGTH_REPEATED))
    fwhm = _numbers("FWHM", stated.fwhm, num_bands, remarks)
    if fwhm is not None and centres is None:
        remarks.append(Remark.of(Code.WIDTHS_ALONE))
    elif fwhm is not None and (fwhm[~unused] <= 0).any():
        remarks.append(Remark.of(Code.WIDTHS_NOT_POSITIVE, low=f"{fwhm[~unused].min():g}"))
    if fwhm is not None and factor is not None and centres is not None and (fwhm[~unused] > 0).all():
        fwhm = np.where(unused, fwhm[~unused].mean(), fwhm)
        fwhm = _widths_nm(fwhm, (stated.fwhm_unit or "").strip(), factor, centres, remarks)
    else:
        fwhm = named_fwhm
    good = _numbers("marks of bad bands", stated.good, num_bands, remarks)
    bad = unused if good is None else (good == 0) | unused
    marks = None if good is None and not unused.any() else bad
    return BandTable(centres, source, fwhm, marks, None if names is None else tuple(map(str, names)))


def _widths_nm(
    widths: np.ndarray, unit: str, factor: float, centres: np.ndarray, remarks: list[Remark]
) -> np.ndarray | None:
    """Widths by their own unit, otherwise by that of the wavelengths, of which one is `factor` nm, or by nm or
    micrometres where that can't be; None with a warning where nothing fits."""
    stated, fitting = nm_per_width(widths, unit, factor, centres)
    low, high = widths.min(), widths.max()
    if fitting is None:
        shown = f"in {unit!r}" if stated is None else f"{low * stated:g} to {high * stated:g} nm"
        remarks.append(Remark.of(Code.WIDTHS_IMPOSSIBLE, range=shown))
        return None
    if fitting != stated:
        taken = "nm" if fitting == 1.0 else "micrometres"
        remarks.append(Remark.of(Code.WIDTHS_IN_OTHER_UNIT, low=f"{low:g}", high=f"{high:g}", unit=taken))
    return widths * fitting


def _fitting(
    what: str, values: Sequence[object] | None, count: int, remarks: list[Remark]
) -> Sequence[object] | None:
    if values is None or len(values) == count:
        return values
    remarks.append(Remark.of(Code.BAND_LIST_MISFIT, what=what, number=len(values), bands=count))
    return None


def _numbers(
    what: str, values: Sequence[object] | None, count: int, remarks: list[Remark]
) -> np.ndarray | None:
    """One finite number a band; None with a warning where it is anything else."""
    values = _fitting(what, values, count, remarks)
    if values is None:
        return None
    try:
        numbers = np.array([float(str(value)) for value in values])
    except ValueError as error:
        remarks.append(Remark.of(Code.BAND_LIST_NO_NUMBERS, what=what, error=str(error)[:80]))
        return None
    if not np.isfinite(numbers).all():
        band = int(np.argmin(np.isfinite(numbers)))
        remarks.append(Remark.of(Code.BAND_LIST_NOT_FINITE, what=what, band=band, value=f"{numbers[band]:g}"))
        return None
    return numbers


def _nm_per_stated(
    values: np.ndarray, used: np.ndarray, stated: StatedBands
) -> tuple[float, str] | tuple[None, Remark]:
    """How many nm one of the file's unit is, and the source; None and why where wavelengths can't be true.

    Args:
        values: One number a band.
        used: Those of bands that are used.
    """
    low, high = float(used.min()), float(used.max())

    def is_plausible(factor: float) -> bool:
        return PLAUSIBLE_NM[0] <= low * factor and high * factor <= PLAUSIBLE_NM[1]

    facts = {"entry": stated.where, "low": f"{low:g}", "high": f"{high:g}"}
    unit = (stated.unit or "").strip()
    factor, source = nm_per_unit(unit), f"{stated.where}, {unit}"
    if factor is None and unit.lower() in ("", "unknown"):
        if are_band_numbers(values):
            first = f"{values[0]:g}"
            return None, Remark.of(Code.WAVELENGTHS_COUNT_BANDS, **facts | {"low": first})
        factor = next((f for f in (1.0, 1e3) if is_plausible(f)), None)
        taken = "nm" if factor == 1.0 else "micrometres"
        source = f"{stated.where}, no unit: {low:g} to {high:g} taken as {taken}"
    if factor is None:
        given = f"the unit {unit!r}" if unit else "no unit"
        return None, Remark.of(Code.WAVELENGTHS_WITHOUT_UNIT, **facts, unit=given)
    if not is_plausible(factor):
        return None, Remark.of(Code.WAVELENGTHS_IMPOSSIBLE, **facts, unit=unit)
    return factor, source
