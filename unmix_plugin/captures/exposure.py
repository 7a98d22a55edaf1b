"""Exposure time and gain, under whichever name and unit a header, a tag or an attribute has them.

Specim writes `tint = 10.5` (milliseconds), others `integration time = 5 ms`, `exposure_us = 8000`, `Exposure Time (s)`.
Only ratios between files count, so a missing unit matters only where some files have one.

Notation: `B` bands.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import counted

_TIMES = {
    "tint": 1e-3,
    **dict.fromkeys(
        ("integrationtime", "inttime", "exposure", "exposuretime", "shutter", "shuttertime"), 1e-3
    ),
    **dict.fromkeys(("exptime", "shutterspeed"), 1.0),
}
"""Names of a time, and what a number without unit is in seconds: OpenEXR's expTime and EXIF's are in seconds."""
_GAINS = ("gain", "analoggain", "analoguegain", "digitalgain")
_OWNERS = ("camera", "sensor", "detector", "imager")
"""Words before a name that change nothing."""
_SECONDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "μs", "usec", "usecs", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-9),
}
_LONGEST_VALUE = 64
_MOST_DB = 200.0
_VALUE = re.compile(
    r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?:/(\d+(?:\.\d*)?))?\s*([^\W\d]*)", re.IGNORECASE
)
"""`20`, `20 ms`, `1/50 s`."""


def exposure_facts(entries: Mapping[str, Any], where: str) -> tuple[dict[str, Any], tuple[str, ...]]:
    """What entries of a file say of its exposure.

    Args:
        entries: Texts, numbers or lists (one number a band) by name.
        where: What they are, for people: `header field`.
    Returns:
        Metadata `exposure_s`, `gain` and `exposure_evidence`, as far as they are known; and warnings.

    >>> exposure_facts({"tint": "20"}, "header field")[0]["exposure_s"]
    0.02
    >>> exposure_facts({"Exposure Time (us)": "500"}, "header field")[0]["exposure_s"]
    0.0005
    """
    facts: dict[str, Any] = {}
    warnings: list[str] = []
    named = {name: _split(name) for name in entries}
    units = {name: str(entries[key]) for key, (name, unit) in named.items() if unit == "unit"}
    for key, (name, unit) in named.items():
        is_time = name in _TIMES
        if unit == "unit" or not (is_time or name in _GAINS):
            continue
        what = "exposure_s" if is_time else "gain"
        values = [_number(item, unit or units.get(name, ""), name) for item in _items(entries[key])]
        if not values or None in values:
            warnings.append(
                f"{where} '{key}' is {str(entries[key])[:60]!r}, which is not understood: exposures may differ"
            )
        elif what not in facts:
            numbers = [value[0] for value in values if value is not None]
            facts[what] = numbers[0] if len(set(numbers)) == 1 else numbers
            has_unit = all(value is not None and value[1] for value in values)
            taken = "" if has_unit else f", no unit: taken as {_assumed(name)}"
            facts[f"{what.removesuffix('_s')}_evidence"] = f"{where} '{key}'{taken}"
    return facts, tuple(warnings)


def is_exposure(name: str) -> bool:
    """Whether an entry of this name is an exposure time or a gain."""
    return _split(name)[0] in (*_TIMES, *_GAINS)


def _split(key: str) -> tuple[str, str]:
    """A name without what owns it, and the unit that it ends with.

    >>> _split("Integration_Time [ms]"), _split("camera gain"), _split("exposure time units")
    (('integrationtime', 'ms'), ('gain', ''), ('exposuretime', 'unit'))
    """
    words = re.findall(r"[^\W_]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", key).lower())
    unit = ""
    if len(words) > 1 and (words[-1] in _SECONDS or words[-1] in ("unit", "units", "db")):
        unit = words.pop().replace("units", "unit")
    while len(words) > 1 and words[0] in _OWNERS:
        words.pop(0)
    return "".join(words), unit


def _items(value: Any) -> list[str]:
    """Elements of a value as texts: one, or one a band."""
    if isinstance(value, str | bytes):
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        return [item for item in re.split(r"[,;{}\[\]()]+", text) if item.strip()]
    return [str(item) for item in np.asarray(value).reshape(-1).tolist()]


def _number(text: str, unit: str, name: str) -> tuple[float, bool] | None:
    """A time in seconds or a gain as a factor, and whether a unit was there; None for anything else."""
    match = _VALUE.fullmatch(text.strip()) if len(text) <= _LONGEST_VALUE else None
    if match is None:
        return None
    number = float(match[1]) / float(match[2] or 1) if float(match[2] or 1) else np.nan
    unit = (match[3] or unit).strip().lower()
    if name in _TIMES:
        factor = _SECONDS.get(unit, None if unit else _TIMES[name])
        return None if factor is None or not number > 0 else (float(f"{number * factor:.12g}"), bool(unit))
    if unit == "db":
        return (10.0 ** (number / 20.0), True) if abs(number) <= _MOST_DB else None
    # A gain of 0 without a unit can only be in decibels.
    return None if unit or not number >= 0 else (number or 1.0, False)


def _assumed(name: str) -> str:
    return "a factor" if name in _GAINS else {1.0: "seconds", 1e-3: "milliseconds"}[_TIMES[name]]


def exposure_of(file: SpectralFile) -> Float64[np.ndarray, " b"] | None:
    """Exposure time times gain, one number or one a band; None where the file does not say the time."""
    time, gain = file.metadata.get("exposure_s"), file.metadata.get("gain", 1.0)
    try:
        exposure = np.atleast_1d(np.asarray(time, dtype=np.float64) * np.asarray(gain, dtype=np.float64))
    except (TypeError, ValueError):
        return None
    is_usable = len(exposure) in (1, file.shape[2]) and np.isfinite(exposure).all() and (exposure > 0).all()
    return exposure if is_usable else None


@dataclass(frozen=True)
class Exposures:
    """What becomes of the exposures of views and references."""

    common: Float64[np.ndarray, " b"] | None = None
    """Exposure time times gain that all are brought to, one number or one a band; None where they are not compared."""
    notes: tuple[str, ...] = ()
    """What was done."""
    warnings: tuple[str, ...] = ()
    """What may be wrong."""


def compare_exposures(
    views: Sequence[SpectralFile],
    whites: Sequence[SpectralFile],
    darks: Sequence[SpectralFile],
    is_bent: bool,
) -> Exposures:
    """The exposure of the white reference, to which views are brought; without one, that of the first view.

    Args:
        views: At least one.
        whites, darks: References of all views, or one a view.
        is_bent: Whether the files are pictures for people, in which twice the exposure is not twice the number.
    """
    known, of_whites, of_darks = (
        [exposure for file in files if (exposure := exposure_of(file)) is not None]
        for files in (views, whites, darks)
    )
    warnings = _missing_units([*views, *whites])
    differs = len({tuple(exposure) for exposure in known}) > 1 or any(len(exposure) > 1 for exposure in known)
    if len(known) < len(views):
        missing = (
            f"{counted(len(views) - len(known), 'view')} without exposure time: exposures are not compared"
        )
        return Exposures(warnings=(*warnings, missing) if known or of_whites else tuple(warnings))
    taken = f"were exposed {_in_words(known)} s times gain"
    if is_bent:
        bent = f"pictures {taken}, which can't be undone as cameras bend the brightness of pictures: fix the exposure"
        return Exposures(warnings=(*warnings, bent) if differs else tuple(warnings))
    if len(of_whites) < len(whites) and differs:
        warnings.append(
            f"views {taken}, the white reference does not say how long: reflectances may be off by a factor"
        )
    if any(len({tuple(exposure), *map(tuple, [*known, *of_whites])}) > 1 for exposure in of_darks):
        warnings.append(
            f"the dark frame was exposed {_in_words(of_darks)} s times gain, views and white reference "
            f"{_in_words([*known, *of_whites])}: dark current grows with exposure, so take a dark frame at each"
        )
    common, of_whom = np.median(known[0], keepdims=True), "that of the first view"
    if of_whites:
        common, of_whom = (
            of_whites[0],
            "that of the white reference" if len(whites) == 1 else "that of its white reference",
        )
    is_same = len({tuple(exposure) for exposure in [*known, *of_whites, common]}) == 1
    brought = f"views {taken}: each is brought to {of_whom}, {_in_words(of_whites or [common])}"
    return Exposures(common, () if is_same else (brought,), tuple(warnings))


def _in_words(exposures: Iterable[Float64[np.ndarray, " b"]]) -> str:
    """The range of exposures.

    >>> _in_words([np.array([0.01]), np.array([0.02])])
    '0.01 to 0.02'
    """
    every = np.concatenate(list(exposures))
    low, high = every.min(), every.max()
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _missing_units(files: Iterable[SpectralFile]) -> list[str]:
    """Warnings where units are missing and matter."""
    metadata = [file.metadata for file in files if "exposure_s" in file.metadata]
    warnings = []
    for what, kind in (("exposure", "exposure times"), ("gain", "gains")):
        evidence = sorted({str(own.get(f"{what}_evidence", "")) for own in metadata} - {""})
        guessed = [text for text in evidence if "no unit" in text]
        gains = {repr(own.get("gain", 1.0)) for own in metadata}
        if guessed and (len(guessed) < len(evidence) if what == "exposure" else len(gains) > 1):
            warnings.append(
                f"{kind} have no unit in some files ({'; '.join(evidence)}): values may be off by a factor"
            )
    return warnings
