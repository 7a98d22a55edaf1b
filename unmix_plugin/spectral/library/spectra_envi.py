"""ENVI spectral libraries: a header `x.hdr` of `key = value` lines, and a file of numbers, one spectrum a line.

Of the header these keys count: `samples` (bands), `lines` (spectra), `data type`, `byte order`, `header offset`,
`wavelength` and `wavelength units`, `spectra names`, `reflectance scale factor` (values are divided by it) and
`data ignore value`. Spectra are stored one after the other.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands, require_nanometres
from unmix_plugin.spectral.library.envi_text import parse_envi_header
from unmix_plugin.spectral.library.spectra_csv import SpectraTable

_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_NM_PER_UNIT = {
    **dict.fromkeys(("", "nm", "nanometers", "nanometer"), 1.0),
    **dict.fromkeys(("um", "micrometers", "micrometer", "microns"), 1e3),
}
_GREATEST_COUNT = 2**53
_SMALLEST_SCALE = 1e-30
_DATA_SUFFIXES = (".sli", ".SLI", "", ".dat", ".img", ".lib", ".raw")


def read_spectra_envi(path: Path) -> SpectraTable:
    """Read and validate an ENVI spectral library.

    Args:
        path: Its header, or the file of numbers beside which the header lies.
    Raises:
        SpectrumError: a part is missing, is not such a library, has a unit of wavelength that is not known, or holds
            values that are ignored, not finite or negative.
    """
    header_path = path if path.suffix.lower() == ".hdr" else path.with_suffix(".hdr")
    try:
        header = _read_header(header_path)
        values = _read_values(header, header_path)
        centers = _numbers(header, "wavelength", values.shape[1]) * _nm_per_unit(header)
        names = _names(header, len(values))
        bands, scale = Bands(centers), _number(header, "reflectance scale factor", 1.0)
        require_nanometres(bands.centers_nm)
        if not _SMALLEST_SCALE <= scale <= 1.0 / _SMALLEST_SCALE:
            raise SpectrumError(
                f"'reflectance scale factor' is {scale:g}; expected a number above 0, such as 10000"
            )
        return SpectraTable(bands, names, values / scale)
    except SpectrumError as error:
        raise SpectrumError(f"{header_path}: {error}") from error
    except OSError as error:
        raise SpectrumError(f"{header_path}: can't read: {error.strerror or error}") from error


def _read_header(path: Path) -> dict[str, str]:
    """Keys in lower case, and their values; lists with their braces cut off."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SpectrumError(f"no ENVI header: not text in UTF-8 ({error.reason})") from error
    try:
        return parse_envi_header(text)
    except ValueError as error:
        raise SpectrumError(f"no ENVI header: {error}") from error


def _read_values(header: dict[str, str], header_path: Path) -> Float64[np.ndarray, "K B"]:
    code = _count(header, "data type")
    if code not in _TYPES:
        raise SpectrumError(f"'data type' is {code}; known: {', '.join(map(str, _TYPES))}")
    shape = _count(header, "lines", least=1), _count(header, "samples", least=1)
    kind = np.dtype((">" if _count(header, "byte order", 0) else "<") + _TYPES[code])
    offset, data_path = _count(header, "header offset", 0), _data_path(header_path)
    found = max(0, data_path.stat().st_size - offset)
    needed = shape[0] * shape[1] * kind.itemsize
    if found < needed:
        raise SpectrumError(
            f"{data_path.name} has {found} bytes; {shape[0]} spectra of {shape[1]} values need {needed}"
        )
    with data_path.open("rb") as file:
        file.seek(offset)
        stored = np.frombuffer(file.read(needed), kind).reshape(shape)
    with np.errstate(all="ignore"):  # signalling NaN, and an ignored value that the type can't hold
        values = stored.astype(np.float64)
        if "data ignore value" in header:
            values[values == np.array(_any_number(header, "data ignore value")).astype(kind)] = np.nan
    return values


def _data_path(header_path: Path) -> Path:
    for suffix in _DATA_SUFFIXES:
        found = header_path.with_suffix(suffix)
        if found.is_file():
            return found
    raise SpectrumError(f"no file of numbers beside it; expected {header_path.with_suffix('.sli').name}")


def _nm_per_unit(header: dict[str, str]) -> float:
    unit = header.get("wavelength units", "").strip().lower()
    if unit not in _NM_PER_UNIT:
        raise SpectrumError(f"'wavelength units' is {unit!r}; expected Nanometers or Micrometers")
    return _NM_PER_UNIT[unit]


def _names(header: dict[str, str], count: int) -> tuple[str, ...]:
    names = tuple(" ".join(name.split()) for name in header.get("spectra names", "").split(","))
    if names == ("",):
        return tuple(f"spectrum {index}" for index in range(count))
    if len(names) != count:
        raise SpectrumError(f"{len(names)} 'spectra names' for {count} spectra")
    return names


def _numbers(header: dict[str, str], key: str, count: int) -> Float64[np.ndarray, " B"]:
    try:
        values = np.array([float(number) for number in header.get(key, "").split(",")])
    except ValueError:
        raise SpectrumError(f"'{key}' is missing or no list of numbers") from None
    if len(values) != count:
        raise SpectrumError(f"'{key}' has {len(values)} values for {count} bands")
    return values


def _number(header: dict[str, str], key: str, default: float | int | None = None) -> float:
    """A finite number."""
    if key not in header and default is not None:
        return float(default)
    number = _any_number(header, key)
    if not math.isfinite(number):
        raise SpectrumError(f"'{key}' is {header[key]}; expected a finite number")
    return number


def _any_number(header: dict[str, str], key: str) -> float:
    try:
        return float(header[key])
    except (KeyError, ValueError):
        raise SpectrumError(f"'{key}' is {header.get(key, 'missing')}; expected a number") from None


def _count(header: dict[str, str], key: str, default: int | None = None, least: int = 0) -> int:
    """A whole number from `least` up."""
    number = _number(header, key, default)
    if number != int(number) or not least <= number <= _GREATEST_COUNT:
        raise SpectrumError(f"'{key}' is {header[key]}; expected a whole number of at least {least}")
    return int(number)
