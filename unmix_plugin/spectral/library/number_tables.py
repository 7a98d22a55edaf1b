"""Columns of numbers in a text, one of them wavelengths: where they begin, how they are parted, what heads them.

Lines of words may stand before the head, one of units below it, and spectra may stand in rows as well as in columns.
What can be read in two ways with different numbers is refused with both.

Notation: `R` wavelengths, `C` columns of the file.
"""

from __future__ import annotations

import csv
import itertools
import re
import unicodedata
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.tables import Dialect, decode_text, possible_dialects, text_lines
from unmix_plugin.errors import SpectrumError, name_some
from unmix_plugin.limits import MOST_ITEMS, allow_parts, read_bounded
from unmix_plugin.spectral.bands import nm_per_unit

_MOST_BYTES = 1 << 26
"""Of a table; two thousand spectra in as many bands have 40 MB."""
_WAVELENGTH = re.compile(
    r"(?:(?:band|channel)? ?cent(?:er|re|ral)? ?|mean |peak )?wave[ -]?lengths?|wave?l|wl|wvl|cwl|lambda|λ|"
    r"wellenl(?:ä|ae|a)ngen?|longueurs? d['\u2019 ]?ondes?|longitud(?:es)? de onda|comprimentos? de onda|"
    r"lunghezz[ae] d['\u2019 ]?onda|golflengten?|v[åa]gl[äa]ngd|b[øo]lgel[æa]ngde|b[øo]lgelengde|aallonpituus|"
    r"d[łl]ugo[śs][ćc] fali|vlnov[áa] d[ée]lka|длина волны|波长|波長|파장"
)
_BARE_UNIT = re.compile(r"nm|[uμ]m|nanomet(?:er|re)s?|micromet(?:er|re)s?|microns?")
"""A head that is a unit alone; of one letter it would be a name."""
_PERCENT_UNIT = re.compile(r"[\[(]?(?:%|percent|per cent)[\])]?", re.IGNORECASE)
_THOUSANDS = re.compile(r"[1-9]\d{0,2}(?:[.,]\d{3})+")
_NO_TEXT = re.compile(r"[\x00-\x08\x0e-\x1b\x7f]")


@dataclass(frozen=True, eq=False)
class NumberTable:
    """Numbers of a text as they stand there, NaN where nothing was measured."""

    words: tuple[str, ...]
    """Lines before the head, or before the numbers where there is none."""
    head: tuple[str, ...] | None
    """Of each column; None where no word names the wavelengths."""
    units: tuple[str, ...] | None
    """Of each column where a line below the head gives them."""
    wavelength_column: int
    values: Float64[np.ndarray, "R C"]

    @property
    def nm_per_number(self) -> float | None:
        """What a number of the wavelengths is in nm; None where no word says so."""
        for text in (self.units, self.head):
            factor = None if text is None else _unit(text[self.wavelength_column])
            if factor is not None:
                return factor
        return None

    def columns_of(self, word: re.Pattern[str]) -> dict[int, str]:
        """Columns that a word heads, with what follows it there or stands below it: a unit, or nothing."""
        found = {}
        for index, cell in enumerate(self.head or ()):
            text = _plain(cell)
            if index != self.wavelength_column and (match := word.match(text)) is not None:
                below = "" if self.units is None else self.units[index].strip("[]() ")
                found[index] = below or _rest(text, match)
        return found

    def is_percent(self, column: int) -> bool:
        """Whether the line of units says so."""
        return self.units is not None and _PERCENT_UNIT.fullmatch(self.units[column]) is not None


class _MisfitError(SpectrumError):
    """A dialect in which a text is no table."""

    def __init__(self, message: str, columns: int = 0, rows: int = 0) -> None:
        super().__init__(message)
        self.progress = (columns, rows)
        """Columns of the head and rows that could be read: what fits most is what was meant."""


def read_lines(path: Path) -> tuple[list[str], str | None]:
    """The lines of a text file, and the delimiter that its first line states.

    Raises:
        SpectrumError: it can't be read, or is no text; the message does not name the file.
    """
    try:
        text = decode_text(read_bounded(path, _MOST_BYTES))
    except OSError as error:
        raise SpectrumError(f"can't read spectra: {error.strerror or error}") from error
    if _NO_TEXT.search(text):
        raise SpectrumError("is no text: it has bytes of another kind of file; export it as text")
    return text_lines(text)


def table_in(
    path: Path,
    lines: Sequence[str],
    delimiter: str | None = None,
    fewest_columns: int = 2,
    are_others_words: bool = False,
) -> NumberTable:
    """The one table in the lines of a file.

    Args:
        delimiter: What parts columns, where that is stated.
        fewest_columns: Fewer are no table.
        are_others_words: Whether columns beside the wavelengths may hold words, which become NaN.
    Raises:
        SpectrumError: there is none, or it can be read in two ways; the message names the line, but not the file.
    """
    if not any(map(str.strip, lines)):
        raise SpectrumError(
            "the file is empty; expected a header 'wavelength,name,...' and one row a wavelength"
        )
    allow_parts(path, len(lines), "lines", SpectrumError, MOST_ITEMS)
    found: list[tuple[Dialect, NumberTable]] = []
    misfits: list[_MisfitError] = []
    for dialect in possible_dialects(lines, delimiter):
        if dialect.delimiter == " " and any(one.delimiter == "\t" for one, _ in found):
            continue
        try:
            found.append((dialect, _TableReader(dialect, fewest_columns, are_others_words).read(lines)))
        except _MisfitError as misfit:
            misfits.append(misfit)
        except csv.Error as error:
            misfits.append(_MisfitError(f"not a table: {error}"))
    if not found:
        raise SpectrumError(str(max(misfits, key=lambda misfit: misfit.progress)))
    most = max(len(table.values) for _, table in found)  # fewer rows: numbers were taken for words
    headed = [one for one in found if one[1].head is not None]
    (dialect, table), *others = headed or [one for one in found if len(one[1].values) == most]
    for other, reading in others:
        if not np.array_equal(reading.values, table.values, equal_nan=True):
            raise SpectrumError(
                f"it can be read in two ways: {_first_row(table)} with {dialect}, or {_first_row(reading)} with "
                f"{other}; save it with semicolons or tabs between columns, or with a head"
            )
    _refuse_thousands(lines, dialect)
    return table


def _first_row(table: NumberTable) -> str:
    return " and ".join(f"{value:g}" for value in table.values[0])


@dataclass
class _TableReader:
    """Reads the rows of a text in one dialect."""

    dialect: Dialect
    fewest_columns: int
    are_others_words: bool
    words: list[list[str]] = field(default_factory=list)
    head: list[str] | None = None
    units: list[str] | None = None
    column: int = 0

    def read(self, lines: Sequence[str]) -> NumberTable:
        rows = self.dialect.rows(lines)
        for line, cells in rows:
            filled = _without_empty_end(cells)
            if self._is_row_of_wavelengths(filled):
                return self._read_transposed(filled, rows)
            if self._begins_numbers(filled):
                return self._read_rows(line, cells, rows)
            if self.head is not None and self._are_units(filled):
                self.units = filled
                continue
            self.words.append(filled)
            columns = wavelength_columns(filled)
            self.head, self.units = (cells, None) if columns else (None, None)
            self.column = columns[0] if columns else 0
        if self.head is not None and len(self.words[-1]) >= self.fewest_columns:
            raise _MisfitError("there is a header but no row of values", len(self.words[-1]))
        self._require_spectra(0)
        raise _MisfitError("there are no numbers in it")

    def _begins_numbers(self, cells: Sequence[str]) -> bool:
        is_number = self.dialect.is_number
        if self.head is not None and self.column < len(cells) and is_number(cells[self.column]):
            return True
        is_row = is_number(cells[0]) and self._is_numeric(cells)
        if is_row:  # a sentence that has a word for wavelengths
            self.head, self.column = None, 0
        return is_row

    def _are_units(self, cells: Sequence[str]) -> bool:
        if len(cells) <= self.column:
            return False
        unit = cells[self.column].strip("[]() ")
        others = [cell for index, cell in enumerate(cells) if index != self.column]
        return nm_per_unit(unit) is not None or (
            not unit and all(not cell or _PERCENT_UNIT.fullmatch(cell) for cell in others)
        )

    def _is_row_of_wavelengths(self, cells: Sequence[str]) -> bool:
        is_named = len(cells) > 2 and (not cells[0] or bool(wavelength_columns(cells[:1])))
        return is_named and all(map(self.dialect.is_number, cells[1:]))

    def _require_spectra(self, columns: int) -> None:
        """That beside a head of wavelengths alone there are values."""
        is_alone = self.head is not None and len(self.words[-1]) == 1
        if is_alone and self.fewest_columns > 1 and columns <= 1:
            raise _MisfitError("no spectra: there is no column beside the wavelengths", 1)

    def _read_rows(self, line: int, first: list[str], rows: Iterator[tuple[int, list[str]]]) -> NumberTable:
        columns = len(_without_empty_end(first))
        self._require_spectra(columns)
        head = self._fitted_head(columns)
        width = columns if head is None else len(head)
        if width < self.fewest_columns:
            raise _MisfitError("no lines with a wavelength and a value", 0 if head is None else width)
        if head is None:
            self._refuse_unnamed(width)
        values = array("d")  # a value takes 8 bytes so, and 60 as a text
        for number, row in itertools.chain([(line, first)], rows):
            while len(row) > width and not row[-1]:
                row.pop()
            try:
                values.extend(self._numbers(row, head, width))
            except ValueError as error:
                raise _MisfitError(f"line {number}{error}", width, len(values) // width) from None
        return NumberTable(
            _joined(self.words if head is None else self.words[:-1]),
            None if head is None else tuple(head),
            None if self.units is None else tuple((self.units + [""] * width)[:width]),
            self.column if head is not None else 0,
            np.frombuffer(values).reshape(-1, width).copy(),
        )

    def _refuse_unnamed(self, width: int) -> None:
        """Refuse a line of words above the numbers that heads them, but not with wavelengths."""
        if self.words and self.dialect.delimiter != " " and len(self.words[-1]) == width > 1:
            raise _MisfitError(
                "the first column must be headed 'wavelength' (in nm) or with its unit, such as 'Wavelength (um)'; "
                f"found '{self.words[-1][0]}'",
                width,
            )

    def _fitted_head(self, columns: int) -> list[str] | None:
        """The head; blanks may stand within the name of a single spectrum where they part columns."""
        if self.head is None:
            return None
        head = _without_empty_end(self.head)
        if self.dialect.delimiter == " " and columns == 2 < len(head) and self.column == 0:
            return [head[0], " ".join(head[1:])]
        return head

    def _numbers(self, row: Sequence[str], head: Sequence[str] | None, width: int) -> list[float]:
        """The numbers of a row; a ValueError with what follows the number of its line."""
        if len(row) != width:
            if head is not None and width < len(row) <= len(self.head or ()):
                raise ValueError(
                    f": each spectrum needs a name of its own; found {name_some(self.head or (), 8)}"
                )
            is_both = self.dialect == Dialect(",", ".") and len(row) == 2 * width
            hint = "; are commas decimal signs too? Then save it with semicolons" if is_both else ""
            expected = (
                f"{len(row)} values, {'others have' if head is None else 'the header has'} {width}{hint}"
            )
            raise ValueError(f" has {expected}" if self._is_numeric(row) else self._among(row))
        found = [self.dialect.number(cell) for cell in row]
        for index, value in enumerate(found):
            is_needed = index == self.column or not self.are_others_words
            if value is None and is_needed and head is None:
                raise ValueError(self._among(row))
            if (value is None and is_needed) or (index == self.column and value != value):
                name = "wavelength" if head is None else head[index]
                raise ValueError(f", column '{name}': '{row[index][:40]}' is not a number")
        return [np.nan if value is None else value for value in found]

    def _is_numeric(self, row: Sequence[str]) -> bool:
        return all(self.dialect.number(cell) is not None for cell in row)

    def _among(self, row: Sequence[str]) -> str:
        return f": {' '.join(row)[:40]!r} stands among the numbers"

    def _read_transposed(self, cells: Sequence[str], rows: Iterator[tuple[int, list[str]]]) -> NumberTable:
        """A spectrum a row: its name, then a value at each wavelength of the first row."""
        names, spectra, width = (
            [cells[0] or "wavelength"],
            [[self.dialect.number(cell) for cell in cells[1:]]],
            len(cells),
        )
        for line, row in rows:
            row = _without_empty_end(row)
            row += [""] * (width - len(row))
            if len(row) > width or not row[0]:
                raise _MisfitError(f"line {line} has {len(row)} values, the first row {width}", width)
            if self.dialect.is_number(row[0]):
                raise _MisfitError(
                    f"line {line}: the number {row[0]} stands where a spectrum's name does", width
                )
            if not self._is_numeric(row[1:]):
                raise _MisfitError(f"line {line}: {' '.join(row[1:])[:40]!r} are not numbers", width)
            spectra.append([self.dialect.number(cell) for cell in row[1:]])
            names.append(row[0])
        if len(names) < self.fewest_columns:
            raise _MisfitError("no spectra: there is no row below the wavelengths", width)
        values = np.array(spectra, dtype=np.float64).T.copy()
        return NumberTable(_joined(self.words), tuple(names), None, 0, values)


def _joined(rows: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Rows of words as lines."""
    return tuple(" ".join(filter(None, cells)) for cells in rows)


def _without_empty_end(cells: Sequence[str]) -> list[str]:
    """The cells up to the last one that holds something: spreadsheets end lines in as many delimiters as they like."""
    count = max((index + 1 for index, cell in enumerate(cells) if cell), default=0)
    return list(cells[:count])


def wavelength_columns(cells: Sequence[str]) -> list[int]:
    """Columns whose head names wavelengths, or is a unit of them."""
    return [index for index, cell in enumerate(cells) if _names_wavelengths(cell)]


def _names_wavelengths(cell: str) -> bool:
    text = _plain(cell)
    if _BARE_UNIT.fullmatch(text.strip("[]() ")):
        return True
    word = _WAVELENGTH.match(text)
    return word is not None and (not _rest(text, word) or _unit(cell) is not None)


def _unit(cell: str) -> float | None:
    """What the unit in a head is in nm."""
    text = _plain(cell)
    word = _WAVELENGTH.match(text)
    return nm_per_unit(text.strip("[]() ") if word is None else _rest(text, word))


def _rest(text: str, word: re.Match[str]) -> str:
    """What follows the word for wavelengths, without brackets and signs."""
    return re.sub(r"^(?:in|en|\() ", "", text[word.end() :].strip(" ,:;./-[](){}<>"))


def _plain(cell: str) -> str:
    return " ".join(unicodedata.normalize("NFKC", cell[:80]).lower().replace("_", " ").strip(" \"'#").split())


def _refuse_thousands(lines: Sequence[str], dialect: Dialect) -> None:
    """Refuse a column in which `1,002` stands beside `998`: a thousand and two, or one? Decimals lie near the numbers
    beside them."""
    if dialect.delimiter == "," or not any(map(_THOUSANDS.search, lines)):
        return
    columns: dict[int, list[str]] = {}
    for _, cells in dialect.rows(lines):
        for index, cell in enumerate(cells):
            if dialect.is_number(cell) and len(columns.setdefault(index, [])) < 1 << 12:
                columns[index].append(cell)
    for cells in columns.values():
        signed = [cell for cell in cells if "." in cell or "," in cell]
        plain = [cell for cell in cells if cell.isdecimal() and len(cell) == 3]
        if not (signed and plain and all(map(_THOUSANDS.fullmatch, signed))):
            continue
        whole = [float(re.sub(r"[.,]", "", cell)) for cell in cells]
        decimal = [dialect.number(cell) or 0.0 for cell in cells]
        if _spread(whole) < _spread(decimal):
            raise SpectrumError(
                f"'{signed[0]}' beside '{plain[0]}' can be read in two ways, as {dialect.number(signed[0]):g} and as "
                f"{re.sub(r'[.,]', '', signed[0])}; save it without signs for thousands"
            )


def _spread(values: Sequence[float]) -> float:
    """The greatest over the least that is above 0."""
    above = [value for value in values if value > 0]
    return max(above) / min(above) if above else 1.0
