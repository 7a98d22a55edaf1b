"""How long views and their references were exposed: what files say, and what becomes of it.

Specim writes `tint = 10.5` (milliseconds), others `integration time = 5 ms`, `exposure_us = 8000`, `Exposure Time (s)`.
Only ratios between files count, so a missing unit matters only where some files have one.

Notation: `b` is 1, or the bands of a file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.calibration.references import finished_by
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import counted, name_some

_TIMES = {
    "tint": 1e-3,
    **dict.fromkeys(
        ("integrationtime", "inttime", "exposure", "exposuretime", "shutter", "shuttertime"), 1e-3
    ),
    **dict.fromkeys(("exptime", "shutterspeed", "exifexposuretime"), 1.0),
}
"""Names of a time, and what a number without unit is in seconds: OpenEXR's expTime and EXIF's are in seconds."""
_FACTS = {
    **dict.fromkeys(_TIMES, "exposure_s"),
    "gain": "gain",
    "analoggain": "analog",
    "analoguegain": "analog",
    "digitalgain": "digital",
    **dict.fromkeys(("exifisospeedratings", "exifisospeed"), "speed"),
    "exiffnumber": "f_number",
}
"""What names say. A plain gain is the whole one; the others multiply each other."""
_OF_EXIF = ("speed", "f_number")
"""Facts that count beside a time, and are left out where they make no sense."""
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
_VALUE = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?:/(\d+(?:\.\d*)?))?\s*([^\W\d]*)", re.I)
"""`20`, `20 ms`, `1/50 s`."""


def exposure_facts(entries: Mapping[str, Any], where: str, warnings: list[str]) -> dict[str, Any]:
    """What entries of a file say of its exposure: metadata `exposure_s`, `gain` and `f_number`, and `exposure_evidence`
    and `gain_evidence`, as far as they are known.

    Args:
        entries: Texts, numbers or lists (one number a band) by name; EXIF's begin with that word.
        where: What they are, for people: `header field`.
        warnings: What is not understood is appended.

    >>> exposure_facts({"tint": "20"}, "header field", [])["exposure_s"]
    0.02
    >>> exposure_facts({"Exposure Time (us)": "500"}, "header field", [])["exposure_s"]
    0.0005
    """
    found: dict[str, tuple[Any, str]] = {}
    named = {name: _split(name) for name in entries}
    units = {name: str(entries[key]) for key, (name, unit) in named.items() if unit == "unit"}
    for key, (name, unit) in named.items():
        what = _FACTS.get(name)
        if what is None or unit == "unit":
            continue
        stated: Any = entries[key]  # one, or one a band
        if isinstance(stated, str):
            items = [item for item in re.split(r"[,;{}\[\]()]+", stated) if item.strip()]
        else:
            items = [str(item) for item in np.asarray(stated).reshape(-1).tolist()]
        values = [_quantity(item, unit or units.get(name, ""), name) for item in items]
        known = [value for value in values if value is not None]
        if what in _OF_EXIF and (len(values) != 1 or not known or not 0 < known[0][0] < np.inf):
            continue
        if not known or len(known) < len(values):
            said = f"{where} '{key}' is {str(entries[key])[:60]!r}, which is not understood"
            warnings.append(f"{said}: exposures may differ")
        elif what not in found:
            numbers = [number for number, _ in known]
            has_unit = name.startswith("exif") or all(has_unit for _, has_unit in known)
            taken = {1.0: "seconds", 1e-3: "milliseconds"}[_TIMES[name]] if name in _TIMES else "a factor"
            evidence = f"{where} '{key}'" + ("" if has_unit else f", no unit: taken as {taken}")
            found[what] = numbers[0] if len(set(numbers)) == 1 else numbers, evidence
    return _combined(found, warnings)


def _combined(found: Mapping[str, tuple[Any, str]], warnings: list[str]) -> dict[str, Any]:
    """Metadata of what was found, with one gain: EXIF's speed beside a time, the whole one, or the product of parts."""
    facts: dict[str, Any] = {}
    if "exposure_s" in found:
        facts["exposure_s"], facts["exposure_evidence"] = found["exposure_s"]
        facts |= {"f_number": found["f_number"][0]} if "f_number" in found else {}
    wholes = (["speed"] if "exposure_s" in found else []) + ["gain"]
    parts = [name for name in wholes if name in found][:1]
    if parts := parts or [name for name in ("analog", "digital") if name in found]:
        numbers, evidence = zip(*(found[name] for name in parts), strict=True)
        if len({np.size(number) for number in numbers} - {1}) > 1:
            warnings.append(f"{' and '.join(evidence)} are lists of different lengths: exposures may differ")
        else:
            facts["gain"] = np.multiply.reduce(np.broadcast_arrays(*numbers)).tolist()
            facts["gain_evidence"] = " and ".join(evidence)
    return facts


def is_exposure(name: str) -> bool:
    """Whether an entry of this name says something of the exposure."""
    return _split(name)[0] in _FACTS


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


def _quantity(text: str, unit: str, name: str) -> tuple[float, bool] | None:
    """A time in seconds, a gain as a factor or an f-number, and whether a unit was there; None for anything else."""
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
    if unit or not number >= 0:
        return None
    if _FACTS[name] in _OF_EXIF:
        return (number / 100 if _FACTS[name] == "speed" else number), True
    return number or 1.0, False  # a gain of 0 without a unit can only be in decibels


# What becomes of exposures.


def exposure_of(file: SpectralFile, to_light: bool = True) -> Float64[np.ndarray, " b"] | None:
    """Exposure time times gain, and over the square of the f-number if that is known, one number or one a band; None
    where the file does not say the time.

    Args:
        to_light: Whether the aperture counts, which lets in light but no dark current.
    """
    time, gain = file.metadata.get("exposure_s"), file.metadata.get("gain", 1.0)
    f_number = file.metadata.get("f_number", 1.0) if to_light else 1.0
    try:
        exposure = np.asarray(time, dtype=np.float64) * np.asarray(gain, dtype=np.float64)
        exposure = np.atleast_1d(exposure / f_number**2)
    except (TypeError, ValueError):
        return None
    is_usable = len(exposure) in (1, file.shape[2]) and np.isfinite(exposure).all() and (exposure > 0).all()
    return exposure if is_usable else None


@dataclass(frozen=True)
class Exposures:
    """What becomes of the exposures of views and references."""

    common: Float64[np.ndarray, " b"] | None = None
    """What all are brought to (see `exposure_of`), one number or one a band; None where exposures are not compared."""
    notes: tuple[str, ...] = ()
    """What was done."""
    warnings: tuple[str, ...] = ()
    """What may be wrong."""


def compare_exposures(
    views: Sequence[SpectralFile],
    whites: Sequence[SpectralFile],
    darks: Sequence[tuple[SpectralFile, SpectralFile]],
    is_bent: bool,
    may_be_finished: bool = False,
) -> Exposures:
    """The exposure of the white reference, to which views are brought; without one, that of the first view.

    Args:
        views: At least one.
        whites: References of all views, or one a view.
        darks: Each dark frame with a view or a white that it is subtracted from.
        is_bent: Whether the files are pictures for people, in which twice the exposure is not twice the number.
        may_be_finished: Whether values look like reflectances, which nothing is divided by but a reference.
    """
    files = (*views, *whites)
    known, of_whites = (
        [e for file in some if (e := exposure_of(file)) is not None] for some in (views, whites)
    )
    differs = len({tuple(exposure) for exposure in known}) > 1 or any(len(exposure) > 1 for exposure in known)
    apertures = {"f_number" in file.metadata for file in files if exposure_of(file) is not None}
    unit = "s times gain over the square of the f-number" if True in apertures else "s times gain"
    taken = f"were exposed {_in_words(known)} {unit}" if known else ""
    finished = [finished_by(file, by_name=not whites) for file in views]
    if None not in finished and not is_bent:
        kept = f"values are not divided by that, as {finished[0]} says that they are reflectance or radiance already"
        return Exposures(notes=(f"views {taken}: {kept}",) if differs else ())
    misfits = _misfits(views, whites)
    warnings, why = [*_missing_units(files), *misfits], None
    if len(known) < len(views):
        missing = counted(len(views) - len(known), "view")
        is_partial = bool(known or of_whites) and not misfits
        why = f"{missing} without exposure time: exposures are not compared" * is_partial
    elif len(apertures) > 1:
        lacking = name_some([file.path.name for file in files if "f_number" not in file.metadata])
        unknown = f"the f-number of the lens is known of some files and not of {lacking}"
        why = f"{unknown}: exposures are not compared; write it into all, or none"
    elif is_bent:
        bent = "which can't be undone as cameras bend the brightness of pictures: fix the exposure"
        why = f"pictures {taken}, {bent}" * differs
    elif may_be_finished and differs and not (whites or darks):
        why = (
            f"views {taken}: values are not divided by that, as they are at most about 1 and taken for reflectances. "
            "If they grow with the exposure, as raw numbers do, give a white reference, or divide them by it yourself"
        )
    if why is not None:
        return Exposures(warnings=(*warnings, *filter(None, [why])))
    if len(of_whites) < len(whites) and differs and not misfits:
        warnings.append(
            f"views {taken}, the white reference does not say how long: reflectances may be off by a factor"
        )
    pairs = [(exposure_of(dark, False), exposure_of(other, False)) for dark, other in darks]
    unlike = [(a, b) for a, b in pairs if a is not None and b is not None and not np.array_equal(a, b)]
    if unlike:
        of_darks, of_others = (_in_words(exposures) for exposures in zip(*unlike, strict=True))
        warnings.append(
            f"the dark frame was exposed {of_darks} s times gain, what it is subtracted from {of_others}: dark current "
            "grows with exposure, so take a dark frame at each"
        )
    common, of_whom = np.median(known[0], keepdims=True), "the first view"
    if of_whites:
        common, of_whom = of_whites[0], f"{'the' if len(whites) == 1 else 'its'} white reference"
    is_same = len({tuple(exposure) for exposure in [*known, *of_whites, common]}) == 1
    brought = f"views {taken}: each is brought to that of {of_whom}, {_in_words(of_whites or [common])}"
    return Exposures(common, () if is_same else (brought,), tuple(warnings))


def _in_words(exposures: Iterable[Float64[np.ndarray, " _"]]) -> str:
    """The range of exposures.

    >>> _in_words([np.array([0.01]), np.array([0.02])])
    '0.01 to 0.02'
    """
    every = np.concatenate(list(exposures))
    low, high = every.min(), every.max()
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _misfits(views: Sequence[SpectralFile], whites: Sequence[SpectralFile]) -> list[str]:
    """A warning where exposures are neither one number nor one a band, unless a white has the same ones."""
    files = (*views, *whites)
    stated = {repr((file.metadata.get("exposure_s"), file.metadata.get("gain"))) for file in files}
    if whites and len(stated) == 1:
        return []
    found: dict[str, tuple[int, int]] = {}
    for file in files:
        sizes = {np.size(file.metadata.get(name, 1.0)) for name in ("exposure_s", "gain")}
        if (odd := sizes - {1, file.shape[2]}) and "exposure_s" in file.metadata:
            found[file.path.name] = max(odd), file.shape[2]
    if not found:
        return []
    numbers = " or ".join(str(size) for size in sorted({size for size, _ in found.values()}))
    bands = counted(next(iter(found.values()))[1], "band")
    said = f"{name_some([*found])}: {numbers} exposure times or gains for {bands}"
    advice = "Give one number, or one a band, with points as decimal marks"
    return [f"{said}: exposures may differ and were not compared. {advice}"]


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
