"""Wavelengths as a user writes them: lists, ranges, CSV files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.bands import require_nanometres


def parse_wavelengths(text: str) -> Float64[np.ndarray, " B"]:
    """Band centres in nm from a list `620,555,503`, or from the column `wavelength` of a CSV file.

    A file may also hold one bare number a line, or one line of numbers.

    Raises:
        ConfigError: no such file, no numbers, or numbers that are not wavelengths in nm.
    """
    words = text.split(",")
    if not all(map(_is_number, words)):
        words = _read_words(Path(text))
    try:
        values = np.array([float(word) for word in words])
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


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read_words(path: Path) -> list[str]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
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
