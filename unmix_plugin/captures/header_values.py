"""What headers say of bands and of what numbers stand for, under many names and in many units; wavelengths also as a
user writes them and in the names of bands, channels and files.

Every reader brings what a file says to *entries*: texts (of lists with commas), numbers or lists by name, in any case,
with spaces or `_`. `state_bands` and `state_linear` look them up by one table of names; `check_bands` converts and
checks. What is left out, and why, is appended to the reader's list of warnings.

Notation: `B` bands; wavelengths in nm.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.captures.names import common_length
from unmix_plugin.captures.spectral_file import BandTable, Linear, linear_values
from unmix_plugin.errors import CaptureError, ConfigError, SpectrumError
from unmix_plugin.limits import read_bounded
from unmix_plugin.spectral.bands import are_band_numbers, nm_per_unit, require_nanometres

_CENTRES = re.compile(
    r"list_cw_[^_]*|bands|"
    r"((band|cent(er|re|ral)|sensor|emission)_?)*(wavelengths?|wavelen|wvls?|wls?|lambdas?|waves?)(_?(nm|um))?"
)
_WIDTHS = re.compile(r"(fwhms?|band_?widths?|list_fwhm_[^_]*)(_?(nm|um))?")
GOOD = re.compile(r"bbl|good_(wavelengths?|bands?)|list_cw_.*_flags")
_NAMES = re.compile(r"band_?names?")
_UNIT_NAMES = ("{}_units", "{}_unit", "wavelength_units", "wavelength_unit")
"""Of wavelengths whose name is put in."""
_DIVISOR = "reflectance_scale_factor"
"""Stored number of full reflectance, under the same name everywhere."""
_DIGITS = r"\d+(?:[.,]\d+)?"
_UNIT = r"(?:nm|nanomet(?:er|re)s?|[uµμ]m|micromet(?:er|re)s?|microns?)(?![a-z])"
PLUS_MINUS = r"(?:±|\+ ?/? ?-)"
"""Before half of a width, or how far a centre may be off."""
_NUMBER = re.compile(rf"(?<![\d.,])({_DIGITS})")
_WITH_UNIT = re.compile(rf"{_NUMBER.pattern}[ _-]?({_UNIT})", re.I)
_AROUND = re.compile(
    rf"{_NUMBER.pattern}(?:[ _-]?({_UNIT}))? ?\(? ?{PLUS_MINUS} ?{_DIGITS} ?\)?(?:[ _-]?({_UNIT}))?", re.I
)
_RANGE = re.compile(
    rf"(?<![\d.,])({_DIGITS})(?:[ _]?{_UNIT})? ?(?:[-\u2013\u2014]|to) ?({_DIGITS})[ _-]?({_UNIT})", re.I
)
_WIDEST_RANGE = 3.0
"""Greater over smaller end; a number farther from the one behind it counts files or is a date."""
_THOUSANDS = re.compile(r"[1-9]\d?\d?,\d{3}")
_LONGEST_NAME = 1000
"""Longer texts are no names, and looking for counters in them takes long."""
_COUNTER = re.compile(r"(?:bands?|b|ch|channel|frame|img|image|view|page|dsc|#)[ _-]*$", re.I)
"""What precedes a number that counts instead of measuring."""
_USUAL_NM = (200.0, 3000.0)
"""What a number without a unit must lie in to be taken for nm."""
PLAUSIBLE_NM = (100.0, 30_000.0)
"""Range of cameras, from the far ultraviolet to the thermal infrared."""
_LEAST_WIDTH_NM = 0.05
"""Widths below this are in another unit than the wavelengths, as are those wider than these."""
_UNUSABLE = "the file gives no wavelengths that can be used, see the notes"
_ASK = "give the wavelengths yourself (--wavelengths)"


def plain_names(entries: Mapping[str, Any]) -> dict[str, str]:
    """Names of entries by what tables have: without groups and variables before them, in lower case, with `_` for
    spaces; the first of those that are alike.

    >>> plain_names({"site/Wavelength Units": "nm", "cube#scale_factor": 2})
    {'wavelength_units': 'site/Wavelength Units', 'scale_factor': 'cube#scale_factor'}
    """
    named: dict[str, str] = {}
    for key in entries:
        named.setdefault(re.sub(r"[\s_]+", "_", re.split(r"[/#]", key)[-1].lower()), key)
    return named


def listed(value: Any, separators: str = r"[,;\s]") -> list[Any]:
    """Items of an entry: numbers of a list, or parts of a text, of which commas in a row part none.

    >>> listed("{1, 2,}"), listed([3.0, 4.0])
    (['1', '2'], [3.0, 4.0])
    """
    if not isinstance(value, str):
        return list(value) if isinstance(value, list) else np.asarray(value).reshape(-1).tolist()
    items = [" ".join(item.split()) for item in re.split(separators, value.strip("{}[]\0 \n"))]
    return [item for item in items if item]


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
    good: Sequence[object] | None = None
    """0 for a bad band."""
    names: Sequence[str] | None = None


def state_bands(entries: Mapping[str, Any], where: str) -> StatedBands:
    """What entries say of bands, the first of each kind; those whose names have no unit first.

    Args:
        where: What they are, for people: `header field`.
    """
    named = plain_names(entries)

    def find(
        names: re.Pattern[str], *units: str, separators: str = r"[,;\s]"
    ) -> tuple[str, list[Any] | None]:
        for unit in units:
            for name, key in named.items():
                items = listed(entries[key], separators) if names.fullmatch(name) else []
                if (
                    items
                    and _unit_in(name) == unit
                    and not (name == "bands" and _counts(items, unit_of(name)))
                ):
                    return name, items
        return "", None

    def unit_of(name: str) -> str | None:
        keys = [named[key] for key in (form.format(name) for form in _UNIT_NAMES) if key in named]
        unit = entries[keys[0]] if keys else _unit_in(name) or None
        return unit if unit is None or isinstance(unit, str) else str(listed(unit)[0])

    name, centres = find(_CENTRES, "", "nm", "um")
    fwhm, good = find(_WIDTHS, "", _unit_in(name))[1], find(GOOD, "")[1]
    marks = good and [int(mark) if isinstance(mark, bool) else mark for mark in good]
    names = find(_NAMES, "", separators=",")[1]
    return StatedBands(f"{where} '{named.get(name)}'", centres, unit_of(name), fwhm, marks, names)


def _unit_in(name: str) -> str:
    """The unit that a name ends with; empty without one."""
    return name[-2:] if name.endswith(("nm", "um")) else ""


def _counts(items: Sequence[Any], unit: str | None) -> bool:
    """Whether a list called `bands` has the number or numbers of bands, and not their wavelengths."""
    try:
        numbers = np.array(items, np.float64)
    except ValueError:
        return True
    has_unit = unit is not None and nm_per_unit(unit) is not None
    return not has_unit and (len(items) == 1 or are_band_numbers(numbers, may_have_gaps=True))


def state_linear(
    path: Path,
    num_bands: int,
    entries: Mapping[str, Any],
    where: str,
    pairs: Sequence[tuple[Sequence[str], Sequence[str]]],
    warnings: list[str],
) -> Linear | None:
    """Gains and offsets among entries, or one factor that divides. A lone `gain` is a part of the exposure.

    Args:
        where: What entries are, for people.
        pairs: Plain names of gains and of offsets; those of an earlier pair go before others.
    Raises:
        CaptureError: they are no numbers, impossible, or there is a factor beside them.
    """
    named, found = plain_names(entries), []
    for pair in pairs:
        keys = [next((named[name] for name in names if name in named), "") for names in pair]
        gains, offsets = (_floats(path, f"{where} '{key}'", entries.get(key, "")) for key in keys)
        if len(gains) == 1 and not offsets and named.get("gain") == keys[0]:
            continue
        stated = " and ".join(
            f"'{key}'" for key, column in zip(keys, (gains, offsets), strict=True) if column
        )
        if linear := linear_values(path, num_bands, gains, offsets, f"{where} {stated}"):
            found.append(linear)
    if len(found) > 1:
        warnings.append(f"{found[0].evidence} is applied, not {found[1].evidence}")
    key = named.get(_DIVISOR, "")
    factor = _factor(key, entries.get(key, "1"), warnings)
    if factor == 1:
        return found[0] if found else None
    if found:
        raise CaptureError(
            f"{path}: has '{key}' {factor:g} and other gains ({found[0].evidence}); take one of them out of the file, "
            "as it is unclear which the numbers need"
        )
    return linear_values(path, num_bands, [1 / factor], [], f"{where} '{key}'")


def _floats(path: Path, what: str, value: Any) -> list[float]:
    try:
        return [float(item) for item in listed(value)]
    except ValueError as error:
        found = str(error).partition(": ")[2]
        raise CaptureError(f"{path}: {what} has {found}; expected numbers, one a band") from None


def _factor(key: str, value: Any, warnings: list[str]) -> float:
    """A number above 0; 1 with a warning for anything else."""
    try:
        factor = float(listed(value)[0])
    except (ValueError, IndexError):
        factor = np.nan
    if 0 < factor < np.inf:
        return factor
    warnings.append(f"'{key}' is {value} and is left out; expected a number above 0")
    return 1.0


def check_bands(stated: StatedBands, num_bands: int, warnings: list[str]) -> BandTable:
    """The table of an image's bands, with units brought to nm and nothing impossible accepted.

    A wavelength of 0 marks a band that is not used, as PRISMA's files have it: the band counts as bad.
    """
    names = _fitting("names of bands", stated.names, num_bands, warnings)
    centres, evidence, factor, unused = None, BandTable.evidence, None, np.zeros(num_bands, bool)
    if stated.centres is not None:
        evidence = _UNUSABLE
        values = _numbers(f"{stated.where}: wavelengths", stated.centres, num_bands, warnings)
        if values is not None:
            unused = values == 0 if (values > 0).any() else unused
            used = values[~unused]
            factor, found = _nm_per_stated(values, used, stated)
            if factor is None:
                warnings.append(found)
            else:
                nearest = np.arange(num_bands)
                if unused.any():  # an unused band gets the wavelength of the nearest band that is used
                    nearest = np.abs(np.subtract.outer(nearest, np.flatnonzero(~unused))).argmin(axis=1)
                centres, evidence = used[nearest] * factor, found
                evidence += f"; {int(unused.sum())} are 0: bands that are not used" if unused.any() else ""
    named_fwhm = None
    named = None if centres is not None or names is None else wavelengths_in_names(list(map(str, names)))
    if named is not None and names is not None:
        centres, evidence = named[0], f"names of bands, such as {names[0]!r}: {named[1]}"
        named_fwhm = named[2] if stated.fwhm is None else None
    if centres is not None and (np.diff(centres[~unused]) == 0).any():
        warnings.append("two bands beside each other have the same wavelength")
    fwhm = _numbers("FWHM", stated.fwhm, num_bands, warnings)
    if fwhm is not None and factor is not None and (fwhm[~unused] > 0).all():
        fwhm = np.where(unused, fwhm[~unused].mean(), fwhm) * factor
        if centres is not None and ((fwhm > centres) | (fwhm < _LEAST_WIDTH_NM)).any():
            unit = f"{fwhm.min():g} to {fwhm.max():g} nm, as they have the unit of the wavelengths"
            warnings.append(f"FWHM are left out: they would be {unit}")
            fwhm = None
    else:
        fwhm = named_fwhm
    good = _numbers("marks of bad bands", stated.good, num_bands, warnings)
    bad = unused if good is None else (good == 0) | unused
    marks = None if good is None and not unused.any() else bad
    return BandTable(centres, evidence, fwhm, marks, None if names is None else tuple(map(str, names)))


def _fitting(
    what: str, values: Sequence[object] | None, count: int, warnings: list[str]
) -> Sequence[object] | None:
    if values is None or len(values) == count:
        return values
    warnings.append(f"{what} are left out: {len(values)} for {count} bands")
    return None


def _numbers(
    what: str, values: Sequence[object] | None, count: int, warnings: list[str]
) -> np.ndarray | None:
    """One finite number a band; None with a warning where it is anything else."""
    values = _fitting(what, values, count, warnings)
    if values is None:
        return None
    try:
        numbers = np.array([float(str(value)) for value in values])
    except ValueError as error:
        warnings.append(f"{what} are not a list of numbers ({str(error)[:80]}) and are left out")
        return None
    if not np.isfinite(numbers).all():
        band = int(np.argmin(np.isfinite(numbers)))
        warnings.append(f"{what} are left out: that of band {band} (from 0) is {numbers[band]:g}")
        return None
    return numbers


def _nm_per_stated(values: np.ndarray, used: np.ndarray, stated: StatedBands) -> tuple[float | None, str]:
    """How many nm one of the file's unit is, and the evidence; None and why where wavelengths can't be true.

    Args:
        values: One number a band.
        used: Those of bands that are used.
    """
    low, high = float(used.min()), float(used.max())

    def is_plausible(factor: float) -> bool:
        return PLAUSIBLE_NM[0] <= low * factor and high * factor <= PLAUSIBLE_NM[1]

    unit = (stated.unit or "").strip()
    factor, evidence = nm_per_unit(unit), f"{stated.where}, {unit}"
    if factor is None and unit.lower() in ("", "unknown"):
        if are_band_numbers(values):
            found = f"{values[0]:g} to {high:g} with no unit count the bands"
            return None, f"{stated.where}: {found} and are no wavelengths; {_ASK}"
        factor = next((f for f in (1.0, 1e3) if is_plausible(f)), None)
        taken = "nm" if factor == 1.0 else "micrometres"
        evidence = f"{stated.where}, no unit: {low:g} to {high:g} taken as {taken}"
    if factor is None:
        given = f"the unit {unit!r}" if unit else "no unit"
        return None, f"{stated.where}: {low:g} to {high:g} with {given} can't be brought to nm; {_ASK}"
    if not is_plausible(factor):
        return None, f"{stated.where}: {low:g} to {high:g} can't be in {unit}; {_ASK}"
    return factor, evidence


def wavelengths_in_names(
    names: Sequence[str],
) -> tuple[Float64[np.ndarray, " B"], str, Float64[np.ndarray, " B"] | None] | None:
    """Wavelengths out of names that each carry one: with a unit, or plain numbers that increase and can be nm.

    Returns:
        Centres in nm, with which unit or why they are taken for nm, and widths in nm where all names are ranges.

    >>> wavelengths_in_names(["red 0.66 um", "red edge 0.705 um"])
    (array([660., 705.]), 'with the unit um', None)
    >>> wavelengths_in_names(["Blue (0.45-0.52 um)", "Red (0.63-0.69 um)"])
    (array([485., 660.]), 'ranges with the unit um', array([70., 60.]))
    >>> wavelengths_in_names(["Blue 450±16 nm", "NIR 840±26 nm"])[0]
    array([450., 840.])
    >>> wavelengths_in_names(["Band 1", "Band 2"])
    """
    if not names or max(map(len, names)) > _LONGEST_NAME:
        return None
    ranges = [_ranges(name) for name in names]
    steps = np.diff([found[0][0] for found in ranges]) if all(len(found) == 1 for found in ranges) else ()
    # Equal or one apart, what stands before the hyphen is a date or counts.
    if len(steps) and np.isin(np.round(steps, 6), (0.0, 1.0)).all():
        ranges = [[] for _ in names]
    stated = [_with_unit(name, found) for name, found in zip(names, ranges, strict=True)]
    known = [one for one in stated if one is not None]
    if len(known) == len(names):
        centres, widths, units = zip(*known, strict=True)
        fwhm = None if None in widths else np.array(widths)
        return np.array(centres), f"{'' if fwhm is None else 'ranges '}with the unit {units[0]}", fwhm
    plain = _varying_numbers(names)
    if any(len(found) != 1 for found in plain):
        return None
    centres = np.array([float(found[0].replace(",", ".")) for found in plain])
    low, high = _USUAL_NM
    if (np.diff(centres) <= 0).any() or centres[0] < low or centres[-1] > high:
        return None
    return centres, f"no unit; {centres[0]:g} to {centres[-1]:g} increase and are taken as nm", None


def _with_unit(
    name: str, ranges: Sequence[tuple[float, float, str]]
) -> tuple[float, float | None, str] | None:
    """Centre and, of a range, width in nm, and the unit; None where a name has none or several, or what can't be."""
    around = [(text, before or after) for text, before, after in _AROUND.findall(name) if before or after]
    if not around and len(ranges) == 1:
        low, high, unit = ranges[0]
        return (round((low + high) / 2, 6), round(high - low, 6), unit) if low < high else None
    found = around or _WITH_UNIT.findall(name)
    centre = _nm(*found[0]) if len(found) == 1 else None
    return None if centre is None else (centre, None, found[0][1])


def _ranges(name: str) -> list[tuple[float, float, str]]:
    """First and last wavelength in nm, and the unit, of each `450-520 nm` in a name."""
    found = []
    for match in _RANGE.finditer(name):
        first, last = _nm(match[1], match[3]), _nm(match[2], match[3])
        counts = _COUNTER.search(name, 0, match.start()) or re.match(r"0\d", match[1])
        if first and last and not counts and max(first, last) <= _WIDEST_RANGE * min(first, last):
            found.append((first, last, match[3]))
    return found


def _nm(text: str, unit: str) -> float | None:
    """A number with its unit in nm; a comma parts thousands only where it can't be a decimal mark. None for what no
    camera sees.

    >>> _nm("0,450", "um"), _nm("1,002", "nm"), _nm("16", "nm")
    (450.0, 1002.0, None)
    """
    texts = [text.replace(",", "."), text.replace(",", "") if _THOUSANDS.fullmatch(text) else "nan"]
    values = [round(float(one) * (nm_per_unit(unit) or 1.0), 6) for one in texts]
    return next((nm for nm in values if PLAUSIBLE_NM[0] <= nm <= PLAUSIBLE_NM[1]), None)


def _varying_numbers(names: Sequence[str]) -> list[list[str]]:
    """Of each name the numbers outside of what all names begin with and end in, except counters."""

    begin = len(names[0][: common_length(names)].rstrip("0123456789.,"))
    backwards = [name[::-1] for name in names]
    end = len(backwards[0][: common_length(backwards)].rstrip("0123456789.,"))
    return [
        [
            match[1]
            for match in _NUMBER.finditer(name)
            if begin <= match.start() and match.end() <= len(name) - end
            if not _COUNTER.search(name, 0, match.start())
        ]
        for name in names
    ]


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
    columns = 1 if column is None else len(heads)
    longer = next((row for row in rows if any(row[columns:])), None)
    if longer is not None and (column is not None or len(rows) > 1):
        expected = f"{columns}, as in the header, and a point as the decimal mark"
        if column is None:
            expected = "one number with a decimal point, or a header that names the column 'wavelength'"
        raise ConfigError(
            f"--wavelengths {path}: the line '{','.join(longer)[:40]}' has {len(longer)} cells; expected {expected}"
        )
    if column is not None:
        return [row[column] if column < len(row) else "" for row in rows[1:]]
    return [cell for cell in rows[0] if cell] if len(rows) == 1 else [row[0] for row in rows]
