"""What entries of all formats mean: of what numbers stand for, and of exposures, under many names and in many units.

Every reader brings what a file says to *entries*: texts (of lists with commas), numbers or lists by name, in any case,
with spaces or `_`. `state_linear` and `state_exposure` look them up by the tables here; `band_entries.py` does so for
bands. What is left out, and why, is appended to the reader's list of remarks.

Specim writes `tint = 10.5` (milliseconds), others `integration time = 5 ms`, `exposure_us = 8000`, `Exposure Time (s)`.
Only ratios between files count, so a missing unit matters only where some files have one.

Notation: `B` bands.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.cube import Exposure, Factor, Linear, Meaning, linear_values
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.errors import CaptureError

PARTS = r"[,;\s]"
"""What parts the items of a text."""
_DIVISOR = "reflectance_scale_factor"
"""Stored number of full reflectance, under the same name everywhere. Source: NV5, ENVI Header Files."""
_CF_FACTOR = "scale_factor"
"""In this spelling always multiplies. Source: CF conventions, 8.1."""
_MEANINGS = {
    _DIVISOR: Meaning.REFLECTANCE,
    "data_reflectance_gain_values": Meaning.REFLECTANCE,
    "data_reflectance_offset_values": Meaning.REFLECTANCE,
    "data_gain_values": Meaning.RADIANCE,
    "data_offset_values": Meaning.RADIANCE,
}
"""What values are by the entries that lead to them, the first that is there. Source: NV5, ENVI Header Files, by which
data gains make W/(m2 um sr)."""


@dataclass(frozen=True)
class GainFields:
    """Names of entries by which value = gain * stored + offset, one a band or one for all; the first found counts."""

    gains: tuple[str, ...]
    """Multiply."""
    offsets: tuple[str, ...]
    """Are added."""
    source: str
    """Who says so."""
    divide_above_one: tuple[str, ...] = ()
    """Of the gains, those of which a single number above 1 without an offset divides, unless CF's spelling says that it
    multiplies: NEON's `Scale_Factor` of 10000."""


class Format(Enum):
    """Whose entries are looked up; of several fields the first that are stated are applied."""

    ENVI = (
        GainFields(
            ("data_reflectance_gain_values",), ("data_reflectance_offset_values",), "NV5, ENVI Header Files"
        ),
        GainFields(("data_gain_values",), ("data_offset_values",), "NV5, ENVI Header Files"),
    )
    GDAL = (
        GainFields(
            ("scale", "scale_factor", "gain", "data_gain_values"),
            ("offset", "add_offset", "bias", "data_offset_values"),
            "GDAL, Raster Data Model: scale and offset; XML of EnMAP and DESIS",
        ),
    )
    ARRAYS = (
        GainFields(
            ("scale_factor", "scalefactor", "scale", "gain", "gains", "slope"),
            ("add_offset", "offset", "offsets", "bias", "intercept"),
            "CF conventions, 8.1; NEON, Spectrometer orthorectified surface reflectance",
            divide_above_one=("scale_factor", "scalefactor", "scale"),
        ),
    )

    @property
    def gains(self) -> tuple[str, ...]:
        """All names of gains."""
        return tuple(name for fields in self.value for name in fields.gains)

    @property
    def offsets(self) -> tuple[str, ...]:
        """All names of offsets."""
        return tuple(name for fields in self.value for name in fields.offsets)


OF_ALL_IMAGES = (_CF_FACTOR, _DIVISOR, "add_offset")
"""Names that hold for all images of a file of arrays; others mean this only beside the numbers themselves."""


def plain_names(entries: Mapping[str, Any]) -> dict[str, str]:
    """Names of entries by what tables have: without groups and variables before them, in lower case, with `_` for
    spaces; the first of those that are alike.

    >>> plain_names({"site/Wavelength Units": "nm", "cube#scale_factor": 2})
    {'wavelength_units': 'site/Wavelength Units', 'scale_factor': 'cube#scale_factor'}
    """
    named: dict[str, str] = {}
    for key in entries:
        named.setdefault(named_by(key), key)
    return named


def named_by(key: str) -> str:
    """The plain name of an entry."""
    return re.sub(r"[\s_]+", "_", re.split(r"[/#]", key)[-1].lower())


def listed(value: Any, separators: str = PARTS) -> list[Any]:
    """Items of an entry: numbers of a list, or parts of a text, of which commas in a row part none.

    >>> listed("{1, 2,}"), listed([3.0, 4.0])
    (['1', '2'], [3.0, 4.0])
    """
    if not isinstance(value, str):
        return list(value) if isinstance(value, list) else np.asarray(value).reshape(-1).tolist()
    items = [" ".join(item.split()) for item in re.split(separators, value.strip("{}[]\0 \n"))]
    return [item for item in items if item]


def state_linear(
    path: Path,
    num_bands: int,
    entries: Mapping[str, Any],
    *,
    where: str,
    format_of: Format,
    remarks: list[Remark],
) -> Linear | None:
    """Gains and offsets among entries, or one factor that divides. A lone `gain` is a part of the exposure.

    Args:
        where: What entries are, for people.
    Raises:
        CaptureError: they are no numbers, impossible, or there is a factor beside gains or a large offset.
    """
    named, found, has_gains = plain_names(entries), [], False
    for fields in format_of.value:
        pair = fields.gains, fields.offsets
        keys = [next((named[name] for name in names if name in named), "") for names in pair]
        gains, offsets = (_floats(path, f"{where} '{key}'", entries.get(key, "")) for key in keys)
        may_divide = keys[0] != _CF_FACTOR and named_by(keys[0]) in fields.divide_above_one and not keys[1]
        if may_divide and len(gains) == 1 and gains[0] > 1:
            gains = [1 / gains[0]]
        if len(gains) == 1 and not offsets and named.get("gain") == keys[0]:
            continue
        used = tuple(key for key, column in zip(keys, (gains, offsets), strict=True) if column)
        used_names = {named_by(key) for key in used}
        meaning = next((means for name, means in _MEANINGS.items() if name in used_names), Meaning.FRACTION)
        linear = linear_values(
            path,
            num_bands,
            gains=gains,
            offsets=offsets,
            source=f"{where} {' and '.join(map(repr, used))}",
            meaning=meaning,
            entries=used,
        )
        if linear is not None:
            found.append(linear)
            has_gains |= bool(gains)
    if len(found) > 1:
        remarks.append(Remark.of(Code.GAINS_CHOSEN, applied=found[0].source, other=found[1].source))
    key = named.get(_DIVISOR, "")
    factors = _factors(path, key, entries.get(key, "1"))
    if set(factors) == {1.0}:
        return found[0] if found else None
    # An offset above 1 is one of stored numbers, not of reflectances, to which the factor leads.
    if has_gains or (found and np.abs(found[0].offsets).max() > 1):
        raise CaptureError(
            f"{path}: has '{key}' {factors[0]:g} and other gains, or an offset above 1 ({found[0].source}); take one "
            "out of the file, as it is unclear which the numbers need"
        )
    return linear_values(
        path,
        num_bands,
        gains=[1 / factor for factor in factors],
        offsets=found[0].offsets.tolist() if found else [],
        source=f"{f'{found[0].source} and' if found else where} '{key}'",
        meaning=Meaning.REFLECTANCE,
        entries=(*(found[0].entries if found else ()), key),
    )


def _floats(path: Path, what: str, value: Any) -> list[float]:
    try:
        return [float(item) for item in listed(value)]
    except ValueError as error:
        found = str(error).partition(": ")[2]
        raise CaptureError(f"{path}: {what} has {found}; expected numbers, one a band") from None


def _factors(path: Path, key: str, value: Any) -> list[float]:
    """A number of 1 or more with a comment behind it, or one a band.

    Raises:
        CaptureError: anything else: without it, or with its inverse, all numbers would be false.
    """
    items = [value.partition(";")[0]] if isinstance(value, str) else listed(value)
    try:
        factors = [float(item) for item in items]
    except ValueError:
        factors = []
    if factors and all(1 <= factor < np.inf for factor in factors):
        return factors
    raise CaptureError(
        f"{path}: '{key}' is {value}; expected the stored number of full reflectance, 1 or more: correct it or "
        "take it out"
    )


# Exposure time and gain.


class _Exposed(Enum):
    """Factors of an exposure."""

    TIME = "the time, in seconds"
    GAIN = "the whole gain"
    ANALOG_GAIN = "a part of the gain, which multiplies the others"
    DIGITAL_GAIN = "another part of the gain"
    SPEED = "the gain as an ISO speed, of which 100 is 1"
    F_NUMBER = "of the lens, the light over its square"

    @property
    def is_optional(self) -> bool:
        """Whether EXIF alone has it: it counts beside a time of EXIF, and is left out where it makes no sense."""
        return self in (_Exposed.SPEED, _Exposed.F_NUMBER)


_SECONDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "μs", "usec", "usecs", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-9),
}


@dataclass(frozen=True)
class _ExposureField:
    """Entries that state one factor of an exposure."""

    names: tuple[str, ...]
    """Without spaces, in lower case, without what owns them (`camera`)."""
    factor: _Exposed
    assumed: str
    """Unit of numbers without one; empty where the name fixes it."""
    source: str
    """Who says so."""

    @property
    def seconds(self) -> float:
        """That a time without a unit is multiplied by."""
        return _SECONDS[self.assumed or "seconds"]


_EXPOSURE_FIELDS = (
    _ExposureField(
        ("tint", "integrationtime", "inttime", "exposure", "exposuretime", "shutter", "shuttertime"),
        _Exposed.TIME,
        "milliseconds",
        "headers of Specim and Resonon",
    ),
    _ExposureField(("exptime", "shutterspeed"), _Exposed.TIME, "seconds", "OpenEXR, standard attributes"),
    _ExposureField(("exifexposuretime",), _Exposed.TIME, "", "CIPA DC-008, tags of Exif"),
    _ExposureField(("exifisospeedratings", "exifisospeed"), _Exposed.SPEED, "", "CIPA DC-008, tags of Exif"),
    _ExposureField(("exiffnumber",), _Exposed.F_NUMBER, "", "CIPA DC-008, tags of Exif"),
    _ExposureField(("gain",), _Exposed.GAIN, "a factor", "massipipe, of headers of Resonon"),
    _ExposureField(
        ("analoggain", "analoguegain"), _Exposed.ANALOG_GAIN, "a factor", "GenICam SFNC, Analog Control"
    ),
    _ExposureField(("digitalgain",), _Exposed.DIGITAL_GAIN, "a factor", "GenICam SFNC, Analog Control"),
)
_EXPOSURE_FIELD = {name: row for row in _EXPOSURE_FIELDS for name in row.names}
_OWNERS = ("camera", "sensor", "detector", "imager")
"""Words before a name that change nothing."""
_LONGEST_VALUE = 64
_MOST_DB = 200.0
_VALUE = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?:/(\d+(?:\.\d*)?))?\s*([^\W\d]*)", re.I)
"""`20`, `20 ms`, `1/50 s`."""


def state_exposure(entries: Mapping[str, Any], where: str, remarks: list[Remark]) -> Exposure:
    """What entries of a file say of its exposure.

    Args:
        entries: Texts, numbers or lists (one number a band) by name; EXIF's begin with that word.
        where: What they are, for people: `header field`.
        remarks: What is not understood is appended.

    >>> state_exposure({"tint": "20"}, "header field", []).time.number
    0.02
    >>> state_exposure({"Exposure Time (us)": "500"}, "header field", []).time.number
    0.0005
    """
    found: dict[_Exposed, Factor] = {}
    is_exif = False
    named = {key: _split(key) for key in entries}
    units = {name: str(entries[key]) for key, (name, unit) in named.items() if unit == "unit"}
    for key, (name, unit) in named.items():
        row = _EXPOSURE_FIELD.get(name)
        if row is None or unit == "unit":
            continue
        stated: Any = entries[key]  # one, or one a band
        if isinstance(stated, str):
            items = [item for item in re.split(r"[,;{}\[\]()]+", stated) if item.strip()]
        else:
            items = [str(item) for item in np.asarray(stated).reshape(-1).tolist()]
        values = [_quantity(item, unit or units.get(name, ""), row) for item in items]
        known = [value for value in values if value is not None]
        if row.factor.is_optional and (len(values) != 1 or not known or not 0 < known[0][0] < np.inf):
            continue
        if not known or len(known) < len(values):
            stated = repr(", ".join(items)[:60])
            remarks.append(Remark.of(Code.EXPOSURE_NOT_UNDERSTOOD, entry=f"{where} '{key}'", value=stated))
        elif row.factor not in found:
            numbers = tuple(number for number, _ in known)
            assumed = "" if all(has_unit for _, has_unit in known) else row.assumed
            numbers = numbers[:1] if len(set(numbers)) == 1 else numbers
            found[row.factor] = Factor(numbers, f"{where} '{key}'", assumed)
            is_exif |= name == "exifexposuretime"
    if not is_exif:
        found = {factor: value for factor, value in found.items() if not factor.is_optional}
    f_number = found.get(_Exposed.F_NUMBER)
    # The whole gain, as EXIF's speed or as it is, otherwise the product of its parts.
    gain = found.get(_Exposed.SPEED, found.get(_Exposed.GAIN))
    parts = [found[part] for part in (_Exposed.ANALOG_GAIN, _Exposed.DIGITAL_GAIN) if part in found]
    sources = " and ".join(part.source for part in parts)
    if gain is None and len({len(part.numbers) for part in parts} - {1}) > 1:
        remarks.append(Remark.of(Code.GAIN_PARTS_MISFIT, entries=sources))
    elif gain is None and parts:
        product = np.multiply.reduce(np.broadcast_arrays(*(part.numbers for part in parts)))
        assumed = next((part.assumed for part in parts if part.assumed), "")
        gain = Factor(tuple(product.tolist()), sources, assumed)
    return Exposure(found.get(_Exposed.TIME), gain, None if f_number is None else f_number.numbers[0])


def is_exposure(name: str) -> bool:
    """Whether an entry of this name says something of the exposure."""
    return _split(name)[0] in _EXPOSURE_FIELD


def _split(key: str) -> tuple[str, str]:
    """A name without what owns it, and the unit that it ends with.

    >>> _split("Integration_Time [ms]"), _split("camera gain"), _split("exposure time units")
    (('integrationtime', 'ms'), ('gain', ''), ('exposuretime', 'unit'))
    """
    words = re.findall(r"[^\W_]+", re.sub(r"(?<=[a-z]{2})(?=[A-Z])", " ", key).lower())
    unit = ""
    if len(words) > 1 and (words[-1] in _SECONDS or words[-1] in ("unit", "units", "db")):
        unit = words.pop().replace("units", "unit")
    while len(words) > 1 and words[0] in _OWNERS:
        words.pop(0)
    return "".join(words), unit


def _quantity(text: str, unit: str, row: _ExposureField) -> tuple[float, bool] | None:
    """A time in seconds, a gain as a factor or an f-number, and whether a unit was there or none is needed; None for
    anything else."""
    match = _VALUE.fullmatch(text.strip()) if len(text) <= _LONGEST_VALUE else None
    if match is None:
        return None
    number = float(match[1]) / float(match[2] or 1) if float(match[2] or 1) else np.nan
    unit = (match[3] or unit).strip().lower()
    if row.factor is _Exposed.TIME:
        factor = _SECONDS.get(unit, None if unit else row.seconds)
        has_unit = bool(unit) or not row.assumed
        return None if factor is None or not number > 0 else (float(f"{number * factor:.12g}"), has_unit)
    if unit == "db":
        return (10.0 ** (number / 20.0), True) if abs(number) <= _MOST_DB else None
    if unit or not number >= 0:
        return None
    if row.factor.is_optional:
        return (number / 100 if row.factor is _Exposed.SPEED else number), True
    return number or 1.0, False  # a gain of 0 without a unit can only be in decibels
