"""Wavelengths in text: units, and numbers in the names of bands, channels and files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

_NM_PER_UNIT = {
    **dict.fromkeys(("nm", "nanometer", "nanometers", "nanometre", "nanometres"), 1.0),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns"), 1e3),
    **dict.fromkeys(("micrometer", "micrometers", "micrometre", "micrometres"), 1e3),
    **dict.fromkeys(("a", "å", "angstrom", "angstroms"), 0.1),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1e9),
}
_NUMBER = r"(?<![\d.,])(\d+(?:[.,]\d+)?)"
_WITH_UNIT = re.compile(
    _NUMBER + r"[ _-]?(nm|nanomet(?:er|re)s?|[uµμ]m|micromet(?:er|re)s?|microns?)(?![a-z])", re.I
)
_PLAIN = re.compile(_NUMBER)
_COUNTER = re.compile(r"(?:bands?|b|ch|channel|frame|img|image|view|page|dsc|#)[ _-]*$", re.I)
"""What precedes a number that counts instead of measuring."""
_USUAL_NM = (200.0, 3000.0)
"""What a number without a unit must lie in to be taken for nm."""


@dataclass(frozen=True)
class NamedWavelengths:
    """Wavelengths that names carry."""

    centres_nm: Float64[np.ndarray, " B"]
    evidence: str
    """With which unit, or why they are taken for nm."""


def nm_per_unit(unit: str) -> float | None:
    """How many nm one of the unit is; None for what is not a unit of length that files use.

    >>> nm_per_unit("Micrometers")
    1000.0
    """
    return _NM_PER_UNIT.get(unit.strip().lower())


def wavelengths_in_names(names: Sequence[str]) -> NamedWavelengths | None:
    """Wavelengths out of names that each carry one: with a unit, or plain numbers that increase and can be nm.

    >>> wavelengths_in_names(["red 0.66 um", "red edge 0.705 um"]).centres_nm
    array([660., 705.])
    >>> wavelengths_in_names(["Band 1", "Band 2"])
    """
    with_unit = [_WITH_UNIT.findall(name) for name in names]
    if names and all(len(found) == 1 for found in with_unit):
        pairs = [found[0] for found in with_unit]
        centres = [_number(number) * (nm_per_unit(unit) or 1.0) for number, unit in pairs]
        return NamedWavelengths(np.array(centres), f"with the unit {pairs[0][1]}")
    plain = [_varying_numbers(name, names) for name in names]
    if any(len(found) != 1 for found in plain):
        return None
    centres = np.array([_number(found[0][1]) for found in plain])
    low, high = _USUAL_NM
    if (np.diff(centres) <= 0).any() or centres[0] < low or centres[-1] > high:
        return None
    return NamedWavelengths(
        centres, f"no unit; {centres[0]:g} to {centres[-1]:g} increase and are taken as nm"
    )


def _varying_numbers(name: str, names: Sequence[str]) -> list[re.Match[str]]:
    """Numbers outside of what all names begin with and end in, except counters."""
    begin = len(_common_begin(names).rstrip("0123456789.,"))
    end = len(_common_begin([other[::-1] for other in names])[::-1].lstrip("0123456789.,"))
    inside = (
        match for match in _PLAIN.finditer(name) if match.start() >= begin and match.end() <= len(name) - end
    )
    return [match for match in inside if not _counts(name, match)]


def _common_begin(names: Sequence[str]) -> str:
    first, last = min(names), max(names)
    differs = (index for index, pair in enumerate(zip(first, last, strict=False)) if pair[0] != pair[1])
    return first[: next(differs, len(first))]


def _counts(name: str, match: re.Match[str]) -> bool:
    return _COUNTER.search(name[: match.start()]) is not None


def _number(text: str) -> float:
    return float(text.replace(",", "."))
