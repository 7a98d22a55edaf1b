"""Names of channels of an OpenEXR image that stand for wavelengths.

Three ways of naming are known: `S0.450,000000nm` and `T.450,0nm` (Fichet et al. 2021, where a comma stands for the
decimal point since a dot parts layers), `360.00-407.00nm` (Mitsuba, a range), and a plain number.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_MARK = b"channels\0chlist\0"
_TYPES = (np.dtype("u4"), np.dtype("f2"), np.dtype("f4"))
_NUMBER = r"(\d+(?:[.,]\d+)?)"
_LAYER = r"(?:(?P<layer>\D(?:.*\D)?|[ST]\d?)\.)?"
_PREFIXES = {
    "": 1.0,
    "p": 1e-12,
    "n": 1e-9,
    "u": 1e-6,
    "m": 1e-3,
    "k": 1e3,
    "M": 1e6,
    "G": 1e9,
    "T": 1e12,
    "P": 1e15,
}
_LENGTH = re.compile(rf"{_LAYER}{_NUMBER}([{''.join(_PREFIXES)}]?)m")
_FREQUENCY = re.compile(rf"{_LAYER}{_NUMBER}([{''.join(_PREFIXES)}]?)Hz")
_RANGE = re.compile(rf"{_LAYER}{_NUMBER} ?- ?{_NUMBER} ?nm")
_PLAIN = re.compile(rf"{_LAYER}{_NUMBER}")
_METRES_PER_SECOND = 299_792_458.0


@dataclass(frozen=True)
class ExrChannel:
    """One channel as the header lists it."""

    name: str
    dtype: np.dtype
    sampling: tuple[int, int]
    """1, 1 but for channels that leave out pixels."""


@dataclass(frozen=True)
class SpectralChannel:
    """A channel whose name is a wavelength."""

    name: str
    layer: str
    """`S0`, `T`, or empty."""
    nm: float
    width_nm: float | None
    """Of a range."""


def list_channels(header: bytes) -> list[ExrChannel]:
    """Channels of the first part, from the first bytes of a file.

    Raises:
        ValueError: there is no list of channels, or it is damaged.
    """
    position = header.find(_MARK) + len(_MARK)
    if position < len(_MARK):
        raise ValueError("no list of channels in the header")
    position, channels = position + 4, []
    while position < len(header) and header[position] != 0:
        end = header.find(b"\0", position)
        if end < 0 or end + 17 > len(header):
            raise ValueError("the list of channels is cut short")
        kind, across, down = struct.unpack_from("<i4xii", header, end + 1)
        if not 0 <= kind < len(_TYPES):
            raise ValueError(f"a channel has the unknown type {kind}")
        name = header[position:end].decode("utf-8", "replace")
        channels.append(ExrChannel(name, _TYPES[kind], (across, down)))
        position = end + 17
    return channels


def spectral_channels(names: Sequence[str]) -> list[SpectralChannel]:
    """Channels that stand for wavelengths, by rising wavelength in each layer.

    >>> [channel.nm for channel in spectral_channels(["R", "T.390,000000nm", "T.380,5nm"])]
    [380.5, 390.0]
    """
    with_unit = [channel for name in names if (channel := _with_unit(name))]
    found = with_unit or [channel for name in names if (channel := _plain(name))]
    return sorted(found, key=lambda channel: (channel.layer, channel.nm))


def _with_unit(name: str) -> SpectralChannel | None:
    if match := _RANGE.fullmatch(name):
        low, high = sorted((_number(match[2]), _number(match[3])))
        return SpectralChannel(name, match["layer"] or "", (low + high) / 2, high - low or None)
    if match := _LENGTH.fullmatch(name):
        return _checked(name, match["layer"], _number(match[2]) * _PREFIXES[match[3]] * 1e9)
    if (match := _FREQUENCY.fullmatch(name)) and _number(match[2]) > 0:
        return _checked(
            name, match["layer"], _METRES_PER_SECOND / (_number(match[2]) * _PREFIXES[match[3]]) * 1e9
        )
    return None


def _plain(name: str) -> SpectralChannel | None:
    match = _PLAIN.fullmatch(name)
    return _checked(name, match["layer"], _number(match[2])) if match else None


def _checked(name: str, layer: str | None, nm: float) -> SpectralChannel | None:
    """None for what no camera records: a plain number that counts, or light that comes back at another wavelength."""
    if layer and (_LENGTH.fullmatch(layer) or _FREQUENCY.fullmatch(layer)):
        return None
    return SpectralChannel(name, layer or "", round(nm, 6), None) if 100.0 <= nm <= 30_000.0 else None


def _number(text: str) -> float:
    return float(text.replace(",", "."))
