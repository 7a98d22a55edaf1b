"""Spectra and wavelengths in text files, read in one way whatever they are for: libraries, lamps, sensors, panels,
endmembers, targets, lists of wavelengths.

| text | from |
|---|---|
| wavelengths and spectra in headed columns, or in rows | spreadsheets, ASD ViewSpec, Spectral Evolution (.sed) |
| a wavelength and a value a line, without a head | anything; ECOSTRESS, ASTER and USGS splib06 |
| values alone beside a list of wavelengths | USGS splib07 |
| wavelength, reference, target and reflectance in percent after `data=` | Spectra Vista (.sig) |

Columns are parted and decimals signed in any way, in any encoding (`engine.tables`). Wavelengths are in the unit that
is stated, in nm if none is, or in micrometres where they are too small for nm. Values are divided by 100 where percent
are stated, and only there. What is marked as not measured, by an empty cell, NaN, -1.23e34 (USGS), -999 and the like,
is NaN.

Sources: Baldridge et al. 2009 and Meerdink et al. 2019 (ASTER, ECOSTRESS); Kokaly et al. 2017, USGS Data Series 1035;
SVC HR-1024i user manual; Spectral Evolution DARWin manual; ASD ViewSpec Pro user manual.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import are_band_numbers, require_nanometres
from unmix_plugin.spectral.library.number_tables import NumberTable, read_lines, table_in

TABLE_SUFFIXES = ("csv", "tsv", "txt", "asc", "sig", "sed")
"""Of text files that are taken for spectra."""
_COLUMN_SUFFIXES = ("csv", "tsv")
"""Whose spectra have the names of their columns, however general; others are called by their file."""
_PERCENT = re.compile(
    r"(?:[\s_,/]*[\[(]\s*(?:in )?(?:%|percent|per cent|prozent|pct)\s*[\])]|(?<![\d\s_])[\s_,/]*%|"
    r"(?<![\d\s_])[\s_,/]+(?:in )?(?:%|percent|per cent|prozent|pct))\s*$|^%\s*(?=r(?:efl\w*)?\b)",
    re.IGNORECASE,
)
"""`paint (%)`, `paint %`, `paint in percent`, `%R`; `clay 20 %` is a name."""
_DEVIATION = re.compile(
    r"(?:^|[\W_])(?:std|stdev|sd|std[. ]?dev|(?:standard )?deviation|error|err|uncertainty|sigma)(?:$|[\W_])",
    re.IGNORECASE,
)
_NO_SPECTRUM = re.compile(
    r"(?:#|no\.?|nr\.?|index|bands?(?: (?:no\.?|nr\.?|number))?|chan(?:nel)?s?\.?\s?#?|fwhm.*|band[ _-]?widths?.*)",
    re.IGNORECASE,
)
"""Heads of columns that count, or tell widths."""
_WIDTHS = re.compile(
    r"fwhm|full width(?: at)? half max(?:imum)?|band[ -]?widths?|widths?(?=\W*(?:[nuµμ]m\b|$))"
)
_GOOD_BANDS = re.compile(r"(?:bbl|good(?: (?:wavelengths?|bands?))?)$")
_REFLECTANCE = re.compile(r"refl|tgt\.?/ref", re.IGNORECASE)
_RAW = re.compile(r"\b(?:rad|radiance|irrad|irradiance|dn|counts?|reference|target)\b", re.IGNORECASE)
"""Heads of columns from which an instrument computed the reflectance beside them."""
_GENERAL = re.compile(
    r"values?|(?:rel\w*\.? )?refl\w*\.?(?: \[1\.0\])?|tgt\.?/ref\.?|intensity|data|y", re.IGNORECASE
)
_NO_WAVELENGTH = re.compile(
    r"wave ?numbers?|\bcm\s?\^?-1|\b1/cm\b|frequency|\b[TG]?Hz\b|photon energy|\beV\b", re.IGNORECASE
)
"""In the line above numbers without a head."""
_MARKERS, _HIGHEST_MARKER, _LEAST_REFLECTANCE = (-999.0, -9999.0), -99.0, -0.99
"""Stored numbers that stand for what was not measured: the first, and what is at most both of the others, as it is
stored and as a reflectance. Noise stored as ten-thousandths reaches one alone."""
_LARGEST_UM = 100.0
"""Greatest wavelength that counts as micrometres where no unit is stated."""
_UNITS_OF_X = {"micromet": 1000.0, "micron": 1000.0, "nanomet": 1.0}


@dataclass(frozen=True, eq=False)
class MeasuredSpectra:
    """The spectra of a file."""

    names: tuple[str, ...]
    wavelengths_nm: Float64[np.ndarray, " R"]
    """In any order."""
    values: Float64[np.ndarray, "K R"]
    """NaN where nothing was measured."""


@dataclass(frozen=True, eq=False)
class ListedBands:
    """The bands of a sensor as a text file lists them."""

    centers_nm: Float64[np.ndarray, " B"]
    nm_per_number: float
    """What a number of the file is in nm."""
    widths: Float64[np.ndarray, " B"] | None = None
    """Full width at half maximum, in the unit of the file; NaN where there is none."""
    width_unit: str = ""
    """As the file has it; empty where it has none."""
    is_good: Float64[np.ndarray, " B"] | None = None
    """0 for a bad band, NaN where nothing is said."""


def without_markers(
    stored: Float64[np.ndarray, "K R"], scale: float | Float64[np.ndarray, "K 1"]
) -> Float64[np.ndarray, "K R"]:
    """Stored numbers divided by their scale, NaN where they mark what was not measured."""
    values = stored / scale
    is_marker = (stored <= _HIGHEST_MARKER) & (values <= _LEAST_REFLECTANCE) | np.isin(stored, _MARKERS)
    return np.where(is_marker, np.nan, values)


def read_spectral_text(path: Path) -> MeasuredSpectra:
    """The spectra of a text file, at least one.

    Raises:
        SpectrumError: it can't be read, or holds none; the message does not name the file.
    """
    lines, delimiter = read_lines(path)
    first = next((line for line in lines if line.strip()), "")
    record = re.match(r"\s*(\S+) Record=\d+:\s*(.*\S)", first)
    if record is not None:
        lists = table_in(path, lines, delimiter, fewest_columns=1)
        if lists.values.shape[1] == 1:
            nm = _usgs_wavelengths(path, len(lists.values))
            return MeasuredSpectra((" ".join(record[2].split()),), nm, without_markers(lists.values.T, 1.0))
    if "Spectra Vista SIG Data" in first:
        return _read_svc(path, lines)
    table = table_in(path, lines, delimiter)
    stated = {key.strip().lower(): value.strip() for key, _, value in (w.partition(":") for w in table.words)}
    quantity = stated.get("y units", "reflectance")
    if "reflectance" not in quantity.lower():
        raise SpectrumError(f"'Y Units' is {quantity!r}; expected reflectance")
    if table.head is None:
        columns, names = [1], [_title(path, table, stated, record is not None)]
    else:
        columns, names = _named_columns(path, table.head, table.wavelength_column)
    is_percent = [
        "percent" in quantity.lower()
        or table.is_percent(column)
        or _PERCENT.search(table.head[column] if table.head else "") is not None
        for column in columns
    ]
    is_row = table.values[:, table.wavelength_column] > 0  # USGS marks deleted channels there, too
    if table.head is not None:
        is_row[:] = True
    values = table.values[is_row]
    scale = np.where(is_percent, 100.0, 1.0)[:, None]
    nm = values[:, table.wavelength_column] * _nm_per_number(table, stated)
    return MeasuredSpectra(tuple(names), nm, without_markers(values[:, columns].T, scale))


def read_bands(path: Path) -> ListedBands:
    """Bands of a text file: its column of wavelengths, those of widths (`fwhm`) and of marks (`bbl`) if there are such,
    whatever else stands beside; or a wavelength a line; or one line of them.

    Raises:
        SpectrumError: it can't be read, holds no wavelengths, or several columns of widths; the message does not name
            the file.
    """
    lines, delimiter = read_lines(path)
    table = table_in(path, lines, delimiter, fewest_columns=1, are_others_words=True)
    rows, columns = table.values.shape
    if table.head is None and columns > 1 and rows > 1:
        raise SpectrumError(
            f"the line '{lines[0].strip()[:40]}' has {columns} cells; expected one number a line, or a header that "
            "names the column 'wavelength'"
        )
    numbers = (
        table.values[0] if table.head is None and rows == 1 else table.values[:, table.wavelength_column]
    )
    factor, widths, marks = (
        _nm_per_number(table, {}),
        table.columns_of(_WIDTHS),
        table.columns_of(_GOOD_BANDS),
    )
    for of_kind in (widths, marks):
        if len(of_kind) > 1:
            named = " and ".join(f"'{table.head[column]}'" for column in of_kind if table.head)
            raise SpectrumError(f"the columns {named} say the same of each band; leave one of them")
    width, unit = next(iter(widths.items()), (None, ""))
    return ListedBands(
        numbers * factor,
        factor,
        widths=None if width is None else table.values[:, width],
        width_unit=unit,
        is_good=next((table.values[:, column] for column in marks), None),
    )


def _named_columns(path: Path, head: Sequence[str], wavelengths: int) -> tuple[list[int], list[str]]:
    """Columns that are spectra, and their names without the mark of percent."""
    columns = [
        index
        for index, name in enumerate(head)
        if index != wavelengths and not _DEVIATION.search(name) and not _NO_SPECTRUM.fullmatch(name)
    ]
    reflectances = [index for index in columns if _REFLECTANCE.search(head[index])]
    raw = [index for index in columns if _RAW.search(head[index]) and index not in reflectances]
    if reflectances and raw and len(reflectances) + len(raw) == len(columns):
        columns = reflectances
    if not columns:
        raise SpectrumError("no spectra: there is no column beside the wavelengths")
    names = [_PERCENT.sub("", head[index]).strip() for index in columns]
    is_general = len(names) == 1 and _GENERAL.fullmatch(names[0]) is not None
    if is_general and path.suffix.lower()[1:] not in _COLUMN_SUFFIXES:
        names = [path.stem]
    return columns, names


def _title(path: Path, table: NumberTable, stated: Mapping[str, str], is_record: bool) -> str:
    """What a spectrum without a head is called, refused where more than one stands there."""
    if table.words and _NO_WAVELENGTH.search(table.words[-1]):
        raise SpectrumError(
            f"'{table.words[-1][:60]}' names no wavelengths; expected them in nm or micrometres: convert them"
        )
    is_usgs = is_record or any("USGS" in line for line in table.words[:3])
    count = table.values.shape[1]
    if count > 2 + is_usgs:  # those of USGS have deviations in the third column
        raise SpectrumError(
            f"a line has {count} numbers, and what column 3 means is unknown; leave a wavelength and a value, or "
            "write a head 'wavelength,NAME,...' above several spectra"
        )
    # The second line from the last before the numbers of splib06 is the title.
    title = stated.get("name") or (table.words[-2] if is_usgs and len(table.words) > 1 else path.stem)
    return " ".join(title.split())


def _nm_per_number(table: NumberTable, stated: Mapping[str, str]) -> float:
    """By the head, by a line `X Units`, or else by the size of the numbers, which no camera sees as nm."""
    if table.nm_per_number is not None:
        return table.nm_per_number
    unit = stated.get("x units", "")
    factor = next((factor for word, factor in _UNITS_OF_X.items() if word in unit.lower()), None)
    if unit and factor is None:
        raise SpectrumError(f"'X Units' is {unit!r}; expected micrometers or nanometers")
    numbers = table.values[:, table.wavelength_column]
    is_um = numbers.min() > 0 and numbers.max() < _LARGEST_UM and not are_band_numbers(numbers)
    return factor or (1000.0 if is_um else 1.0)


def _read_svc(path: Path, lines: Sequence[str]) -> MeasuredSpectra:
    """A file of Spectra Vista: reflectance of the target in percent of the reference."""
    begin = next((index for index, line in enumerate(lines) if re.match(r"\s*data\s*=", line)), None)
    if begin is None:
        raise SpectrumError("a file of Spectra Vista without its line 'data='")
    table = table_in(path, lines[begin + 1 :], " ")
    if table.values.shape[1] != 4:
        raise SpectrumError(
            f"{table.values.shape[1]} numbers per line; Spectra Vista writes wavelength, reference, target, reflectance"
        )
    nm, _, _, percent = table.values.T
    name = next((line.partition("=")[2].strip() for line in lines[:begin] if line.startswith("name")), "")
    title = re.sub(r"\.sig$", "", re.split(r"[\\/]", name)[-1], flags=re.IGNORECASE)
    return MeasuredSpectra((title or path.stem,), nm.copy(), without_markers(percent[None], 100.0))


def _usgs_wavelengths(path: Path, count: int) -> Float64[np.ndarray, " B"]:
    """Of splib07, whose spectra are lists of values alone: the one list of wavelengths of that length nearby."""
    folders = (path.parent, path.resolve().parent.parent)
    near = [one for folder in folders for one in sorted(folder.glob("*[Ww]avelengths*.txt"))]
    tables = (table_in(one, *read_lines(one), fewest_columns=1).values for one in near)
    lists = {tuple(values[:, 0].tolist()) for values in tables if values.shape == (count, 1)}
    if len(lists) != 1:
        raise SpectrumError(
            f"it has {count} values without wavelengths, and {len(lists)} lists of {count} wavelengths lie beside it "
            "or above; put the *Wavelengths*.txt of its spectrometer there"
        )
    return np.array(lists.pop()) * 1000.0


def require_wavelengths(wavelengths_nm: Float64[np.ndarray, " R"]) -> None:
    """Refuse what are no wavelengths in nm. Raises SpectrumError."""
    if not np.isfinite(wavelengths_nm).all():
        raise SpectrumError("wavelengths hold NaN or infinity; expected band centres in nm")
    require_nanometres(wavelengths_nm)
