"""Wavelengths in words: in the names of bands, channels and files, and as a user writes them.

Notation: `B` bands; wavelengths in nm.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.captures.cube import BandTable
from unmix_plugin.captures.names import common_length
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.bands import nm_per_unit, require_nanometres
from unmix_plugin.spectral.library.spectral_tables import ListedBands, read_bands

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
_OTHER_UNIT = re.compile(r" ?(?:cm|[muµμ]m|microns?|[muµμ]s|[kmgt]?hz)(?![a-z])", re.I)
"""What follows a wavenumber, a length, a time or a frequency, which are no wavelengths in nm; 0.45um is read before."""
_LEAST_WIDTH_NM = 0.05
"""Widths below this are in another unit, as are those wider than their wavelengths."""
_USUAL_NM = (200.0, 3000.0)
"""What a number without a unit must lie in to be taken for nm."""
PLAUSIBLE_NM = (100.0, 30_000.0)
"""Range of cameras, from the far ultraviolet to the thermal infrared."""


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
    # Of each name the numbers outside of what all names begin with and end in, except counters and those with a unit
    # that is none of wavelengths.
    begin = len(names[0][: common_length(names)].rstrip("0123456789.,"))
    backwards = [name[::-1] for name in names]
    end = len(backwards[0][: common_length(backwards)].rstrip("0123456789.,"))
    plain = [
        [
            match[1]
            for match in _NUMBER.finditer(name)
            if begin <= match.start() and match.end() <= len(name) - end
            if not _COUNTER.search(name, 0, match.start()) and not _OTHER_UNIT.match(name, match.end())
        ]
        for name in names
    ]
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


def nm_per_width(
    widths: Float64[np.ndarray, " B"],
    unit: str,
    nm_per_wavelength: float,
    centres_nm: Float64[np.ndarray, " B"],
) -> tuple[float | None, float | None]:
    """What a number of a list of widths is in nm.

    Args:
        unit: That of the list; empty or `unknown` where it has none.
        nm_per_wavelength: Unit of the wavelengths beside it, which a list without a unit is in, too; or else in nm or
            micrometres, where it can't be in that one.
    Returns:
        By what is stated, None for what is no unit; and what fits, None where nothing does.
    """
    is_stated = unit.lower() not in ("", "unknown")
    stated = nm_per_unit(unit) if is_stated else nm_per_wavelength
    tried = [stated] if is_stated else [stated, 1.0, 1e3]

    def fits(factor: float | None) -> bool:
        nm = widths * (factor or np.nan)
        return bool(((nm >= _LEAST_WIDTH_NM) & (nm <= centres_nm)).all())

    return stated, next(filter(fits, tried), None)


def parse_bands(text: str) -> BandTable:
    """Bands from a list of their centres in nm, `620,555,503`, or from a text file: its column of wavelengths with
    those of widths (`fwhm`) and marks of good bands (`bbl`) beside, one number a line, or one line of numbers.

    Raises:
        ConfigError: no such file, no numbers, numbers that are not wavelengths in nm, or widths and marks that are none
            of their bands.
    """
    what = f"--wavelengths {text}"
    try:
        listed = ListedBands(np.array([float(word) for word in text.split(",")]), nm_per_number=1.0)
    except ValueError:
        if not Path(text).exists():
            raise ConfigError(
                f"{what}: neither a list of numbers, such as 620,555,503, nor a CSV file or another table that is there"
            ) from None
        try:
            listed = read_bands(Path(text))
        except SpectrumError as error:
            raise ConfigError(
                f"{what}: {error}; expected numbers in nm, such as 620,555,503, or a table with a column 'wavelength'"
            ) from error
    centres_nm, widths, is_good = listed.centers_nm, listed.widths, listed.is_good
    if not np.isfinite(centres_nm).all():
        raise ConfigError(f"{what} holds NaN or infinity; expected band centres in nm")
    try:
        require_nanometres(centres_nm)
    except SpectrumError as error:
        raise ConfigError(f"{what}: {error}") from error
    source, advice = "given with --wavelengths", "correct the column, or take it out"
    if widths is not None:
        if not (np.isfinite(widths) & (widths > 0)).all():
            band = int(np.argmin(np.isfinite(widths) & (widths > 0)))
            raise ConfigError(
                f"{what}: the width at {centres_nm[band]:g} nm is {widths[band]:g}; expected the full width at half "
                f"maximum of each band, above 0: {advice}"
            )
        unit = listed.width_unit
        stated, factor = nm_per_width(widths, unit, listed.nm_per_number, centres_nm)
        if factor is None:
            found = (
                f"in {unit!r}"
                if stated is None
                else f"{widths.min() * stated:g} to {widths.max() * stated:g} nm"
            )
            raise ConfigError(
                f"{what}: widths of bands {found}; expected them in nm or micrometres, narrower than their "
                f"wavelengths: {advice}"
            )
        source += "" if factor == stated else f", widths taken as {'nm' if factor == 1.0 else 'micrometres'}"
        widths = widths * factor
    if is_good is not None and not np.isin(is_good, (0.0, 1.0)).all():
        raise ConfigError(f"{what}: marks of good bands must be 1, and 0 for bad ones: {advice}")
    return BandTable(centres_nm, source, widths, None if is_good is None else is_good == 0, is_given=True)


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
