"""Wavelengths: as a user writes them, as a file states them, and in the names of bands, channels and files.

Notation: `B` bands; wavelengths in nm.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.captures.spectral_file import BandTable
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.limits import read_bounded
from unmix_plugin.spectral.bands import nm_per_unit, require_nanometres

_NUMBER = re.compile(r"(?<![\d.,])(\d+(?:[.,]\d+)?)")
_WITH_UNIT = re.compile(
    _NUMBER.pattern + r"[ _-]?(nm|nanomet(?:er|re)s?|[uµμ]m|micromet(?:er|re)s?|microns?)(?![a-z])", re.I
)
_LONGEST_NAME = 1000
"""Longer texts are no names, and looking for counters in them takes long."""
_COUNTER = re.compile(r"(?:bands?|b|ch|channel|frame|img|image|view|page|dsc|#)[ _-]*$", re.I)
"""What precedes a number that counts instead of measuring."""
_USUAL_NM = (200.0, 3000.0)
"""What a number without a unit must lie in to be taken for nm."""
_PLAUSIBLE_NM = (100.0, 30_000.0)
"""Range of cameras, from the far ultraviolet to the thermal infrared."""
_LEAST_WIDTH_NM = 0.05
"""Widths below this are in another unit than the wavelengths, as are those wider than these."""
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
    """The table of an image's bands, with units brought to nm and nothing impossible accepted.

    A wavelength of 0 marks a band that is not used, as PRISMA's files have it: the band counts as bad.

    Returns:
        The table, and warnings of what of it is left out.
    """
    notes: list[str] = []
    names = _fitting("names of bands", stated.names, num_bands, notes)
    centres, evidence, factor, unused = None, BandTable.evidence, None, np.zeros(num_bands, bool)
    if stated.centres is not None:
        evidence = _UNUSABLE
        values = _numbers(f"{stated.where}: wavelengths", stated.centres, num_bands, notes)
        if values is not None:
            unused = values == 0 if (values > 0).any() else unused
            used = values[~unused]
            factor, found = _nm_per_stated(float(used.min()), float(used.max()), stated)
            if factor is None:
                notes.append(found)
            else:
                nearest = np.arange(num_bands)
                if unused.any():  # an unused band gets the wavelength of the nearest band that is used
                    nearest = np.abs(np.subtract.outer(nearest, np.flatnonzero(~unused))).argmin(axis=1)
                centres, evidence = used[nearest] * factor, found
                evidence += f"; {int(unused.sum())} are 0: bands that are not used" if unused.any() else ""
    named = None if centres is not None or names is None else wavelengths_in_names(list(map(str, names)))
    if named is not None and names is not None:
        centres, evidence = named[0], f"names of bands, such as {names[0]!r}: {named[1]}"
    if centres is not None and (np.diff(centres[~unused]) == 0).any():
        notes.append("two bands beside each other have the same wavelength")
    fwhm = _numbers("FWHM", stated.fwhm, num_bands, notes)
    if fwhm is not None and factor is not None and (fwhm[~unused] > 0).all():
        fwhm = np.where(unused, fwhm[~unused].mean(), fwhm) * factor
        if centres is not None and ((fwhm > centres) | (fwhm < _LEAST_WIDTH_NM)).any():
            unit = f"{fwhm.min():g} to {fwhm.max():g} nm, as they have the unit of the wavelengths"
            notes.append(f"FWHM are left out: they would be {unit}")
            fwhm = None
    else:
        fwhm = None
    good = _numbers("marks of bad bands", stated.good, num_bands, notes)
    bad = unused if good is None else (good == 0) | unused
    table = BandTable(
        centres,
        evidence,
        fwhm,
        None if good is None and not unused.any() else bad,
        None if names is None else tuple(map(str, names)),
    )
    return table, tuple(notes)


def _fitting(
    what: str, values: Sequence[object] | None, count: int, notes: list[str]
) -> Sequence[object] | None:
    if values is None or len(values) == count:
        return values
    notes.append(f"{what} are left out: {len(values)} for {count} bands")
    return None


def _numbers(what: str, values: Sequence[object] | None, count: int, notes: list[str]) -> np.ndarray | None:
    """One finite number a band; None with a note where it is anything else."""
    values = _fitting(what, values, count, notes)
    if values is None:
        return None
    try:
        numbers = np.array([float(str(value)) for value in values])
    except ValueError as error:
        notes.append(f"{what} are not a list of numbers ({str(error)[:80]}) and are left out")
        return None
    if not np.isfinite(numbers).all():
        band = int(np.argmin(np.isfinite(numbers)))
        notes.append(f"{what} are left out: that of band {band} (from 0) is {numbers[band]:g}")
        return None
    return numbers


def _nm_per_stated(low: float, high: float, stated: StatedBands) -> tuple[float | None, str]:
    """How many nm one of the file's unit is, and the evidence; None and why where wavelengths can't be true."""

    def is_plausible(factor: float) -> bool:
        return _PLAUSIBLE_NM[0] <= low * factor and high * factor <= _PLAUSIBLE_NM[1]

    unit = (stated.unit or "").strip()
    factor, evidence = nm_per_unit(unit), f"{stated.where}, {unit}"
    if factor is None and unit.lower() in ("", "unknown"):
        factor = next((f for f in (1.0, 1e3) if is_plausible(f)), None)
        taken = "nm" if factor == 1.0 else "micrometres"
        evidence = f"{stated.where}, no unit: {low:g} to {high:g} taken as {taken}"
    if factor is None:
        given = f"the unit {unit!r}" if unit else "no unit"
        return None, f"{stated.where}: {low:g} to {high:g} with {given} can't be brought to nm; {_ASK}"
    if not is_plausible(factor):
        return None, f"{stated.where}: {low:g} to {high:g} can't be in {unit}; {_ASK}"
    return factor, evidence


def wavelengths_in_names(names: Sequence[str]) -> tuple[Float64[np.ndarray, " B"], str] | None:
    """Wavelengths out of names that each carry one: with a unit, or plain numbers that increase and can be nm.

    Returns:
        Centres in nm, and with which unit or why they are taken for nm.

    >>> wavelengths_in_names(["red 0.66 um", "red edge 0.705 um"])
    (array([660., 705.]), 'with the unit um')
    >>> wavelengths_in_names(["Band 1", "Band 2"])
    """

    def number(text: str) -> float:
        return float(text.replace(",", "."))

    if not names or max(map(len, names)) > _LONGEST_NAME:
        return None
    with_unit = [_WITH_UNIT.findall(name) for name in names]
    if all(len(found) == 1 for found in with_unit):
        pairs = [found[0] for found in with_unit]
        centres = [number(text) * (nm_per_unit(unit) or 1.0) for text, unit in pairs]
        return np.array(centres), f"with the unit {pairs[0][1]}"
    plain = _varying_numbers(names)
    if any(len(found) != 1 for found in plain):
        return None
    centres = np.array([number(found[0]) for found in plain])
    low, high = _USUAL_NM
    if (np.diff(centres) <= 0).any() or centres[0] < low or centres[-1] > high:
        return None
    return centres, f"no unit; {centres[0]:g} to {centres[-1]:g} increase and are taken as nm"


def _varying_numbers(names: Sequence[str]) -> list[list[str]]:
    """Of each name the numbers outside of what all names begin with and end in, except counters."""

    def common_begin(texts: Sequence[str]) -> str:
        first, last = min(texts), max(texts)
        differs = (index for index, pair in enumerate(zip(first, last, strict=False)) if pair[0] != pair[1])
        return first[: next(differs, len(first))]

    begin = len(common_begin(names).rstrip("0123456789.,"))
    end = len(common_begin([other[::-1] for other in names])[::-1].lstrip("0123456789.,"))

    def varying(name: str) -> list[str]:
        inside = [
            match
            for match in _NUMBER.finditer(name)
            if begin <= match.start() and match.end() <= len(name) - end
        ]
        return [match[1] for match in inside if not _COUNTER.search(name, 0, match.start())]

    return [varying(name) for name in names]


def parse_wavelengths(text: str) -> Float64[np.ndarray, " B"]:
    """Band centres in nm from a list `620,555,503`, or from the column `wavelength` of a CSV file.

    A file may also hold one bare number a line, or one line of numbers. Raises ConfigError: no such file, no numbers,
    or numbers that are not wavelengths in nm.
    """
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = None
    try:
        if values is None:
            values = np.array([float(word) for word in _read_words(Path(text))])
    except ValueError as error:
        raise ConfigError(
            f"--wavelengths {text}: {error}; expected numbers in nm, such as 620,555,503, or a CSV file with a "
            "column 'wavelength'"
        ) from error
    if not len(values):
        raise ConfigError(f"--wavelengths {text} holds no numbers; expected band centres in nm")
    if not np.isfinite(values).all():
        raise ConfigError(f"--wavelengths {text} holds NaN or infinity; expected band centres in nm")
    try:
        require_nanometres(values)
    except SpectrumError as error:
        raise ConfigError(f"--wavelengths {text}: {error}") from error
    return values


def in_ranges(text: str, wavelengths_nm: Float64[np.ndarray, " B"]) -> Bool[np.ndarray, " B"]:
    """Which bands a text such as `1350-1450,1900` names; a single wavelength names the nearest band.

    Raises:
        ConfigError: the text is not such a list, or a part of it names no band.

    >>> in_ranges("500-600,700", np.array([450.0, 550.0, 650.0, 710.0]))
    array([False,  True, False,  True])
    """
    named = np.zeros(len(wavelengths_nm), bool)
    low, high = wavelengths_nm.min(), wavelengths_nm.max()
    for part in text.split(","):
        try:
            ends = [float(word) for word in part.strip().split("-")]
        except ValueError:
            ends = []
        if len(ends) not in (1, 2):
            raise ConfigError(
                f"--drop-bands {text}: '{part}' is not a wavelength or range; expected 1350-1450,1900"
            )
        if len(ends) == 1 and low <= ends[0] <= high:
            found = np.zeros(len(named), bool)
            found[np.argmin(np.abs(wavelengths_nm - ends[0]))] = True
        else:
            found = (wavelengths_nm >= ends[0]) & (wavelengths_nm <= ends[-1])
        if not found.any():
            raise ConfigError(
                f"--drop-bands {text}: no band in '{part.strip()}' nm; the bands lie at {low:g} to {high:g} nm"
            )
        named |= found
    return named


def _read_words(path: Path) -> list[str]:
    try:
        with io.TextIOWrapper(io.BytesIO(read_bounded(path)), "utf-8-sig", newline="") as file:
            rows = [[cell.strip() for cell in row] for row in csv.reader(file) if any(map(str.strip, row))]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(
            f"--wavelengths {path}: neither a list of numbers, such as 620,555,503, nor a CSV file ({reason})"
        ) from error
    if not rows:
        raise ConfigError(f"--wavelengths {path} is empty; expected a column 'wavelength'")
    heads = [cell.lower() for cell in rows[0]]
    column = next((i for i, cell in enumerate(heads) if cell.startswith("wavelength")), None)
    if column is not None:
        return [row[column] if column < len(row) else "" for row in rows[1:]]
    return [cell for cell in rows[0] if cell] if len(rows) == 1 else [row[0] for row in rows]
