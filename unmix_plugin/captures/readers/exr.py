"""Names of channels of an OpenEXR image that stand for wavelengths.

Three ways of naming are known: `S0.450,000000nm` and `T.450,0nm` (Fichet et al. 2021, where a comma stands for the
decimal point since a dot parts layers), `360.00-407.00nm` (Mitsuba, a range), and a plain number.

OpenEXR images whose channels are bands; see `exr_channels` for how their names are understood.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.spectral_file import BandTable, ReadOptions, SpectralFile, loaded
from unmix_plugin.errors import CaptureError

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


_HEADER_BYTES = 2**20
_ALPHA = ("A", "alpha")
_OF_ALL_FILES = ("pixelAspectRatio", "screenWindowWidth")
_COLOURS = ("R", "G", "B")
_LAYERS = ("S0", "T", "")
"""Which of several layers is taken: radiance, reflectance, any other."""


@dataclass(frozen=True)
class _Choice:
    """The channels that are the bands."""

    names: tuple[str, ...]
    bands: BandTable
    notes: tuple[str, ...] = ()


def open_exr(path: Path, options: ReadOptions) -> SpectralFile:
    """Open an image by its header; the numbers are read as a whole, when the first of them is asked for.

    `options.dataset` names a layer (`S0`, `T`), or one channel.

    Raises:
        CaptureError: the file is damaged, or has no such layer or channel.
    """
    with path.open("rb") as file:
        begin = file.read(_HEADER_BYTES)
    try:
        channels = list_channels(begin)
    except ValueError as error:
        raise CaptureError(f"{path}: no OpenEXR image: {error}; copy the file again") from error
    choice = _choose(path, channels, options.dataset)
    chosen = [channel for channel in channels if channel.name in choice.names]
    if any(channel.sampling != (1, 1) for channel in chosen):
        raise CaptureError(
            f"{path}: channels leave out pixels (sampling above 1); expected one number a pixel"
        )
    header = _header(path)
    (left, top), (right, bottom) = header["dataWindow"]
    shape = (int(bottom) - int(top) + 1, int(right) - int(left) + 1, len(choice.names))
    others = [channel.name for channel in channels if channel.name not in choice.names]
    return SpectralFile(
        path=path,
        reader="exr",
        shape=shape,
        dtype=np.result_type(*(channel.dtype for channel in chosen)),
        read_part=lambda rows, wanted: np.moveaxis(loaded(_load, path, choice.names)[wanted][:, rows], 0, -1),
        bands=choice.bands,
        notes=choice.notes + _window_notes(header),
        metadata={**_attributes(header), **({"other_channels": others} if others else {})},
    )


def _choose(path: Path, channels: Sequence[ExrChannel], wanted: str | None) -> _Choice:
    """The channels of a layer that are wavelengths, or all channels if none is."""
    names = [channel.name for channel in channels]
    if not names:
        raise CaptureError(f"{path}: no channels in this OpenEXR image")
    if wanted is not None and wanted in names:
        return _Choice((wanted,), BandTable(names=(wanted,)))
    spectral = spectral_channels(names)
    layers = sorted({channel.layer for channel in spectral}, key=lambda layer: (*_LAYERS, layer).index(layer))
    if wanted is not None and wanted not in layers:
        raise CaptureError(
            f"{path}: no layer or channel '{wanted}'; it has {', '.join(layers + names)[:300]}"
        )
    if not spectral:
        bands = [name for name in names if name.rpartition(".")[2] not in _ALPHA] or names
        bands.sort(key=lambda name: _COLOURS.index(name) if name in _COLOURS else -1)
        return _Choice(tuple(bands), BandTable(names=tuple(bands)))
    layer = layers[0] if wanted is None else wanted
    taken = [channel for channel in spectral if channel.layer == layer]
    widths = [channel.width_nm for channel in taken if channel.width_nm is not None]
    bands = BandTable(
        np.array([channel.nm for channel in taken]),
        f"names of channels, such as {taken[0].name!r}",
        np.array(widths) if len(widths) == len(taken) else None,
        names=tuple(channel.name for channel in taken),
    )
    others = [other for other in layers if other != layer]
    note = f"layer '{layer}' is taken; the file also has {', '.join(map(repr, others))}"
    return _Choice(tuple(channel.name for channel in taken), bands, (note,) if others else ())


def _header(path: Path) -> dict[str, Any]:
    return _opened(path, header_only=True).header()


def _load(path: Path, names: tuple[str, ...]) -> np.ndarray:
    """Channels (B, H, W), each in its own piece of memory."""
    found = _opened(path).channels()
    return np.stack([found[name].pixels for name in names])


def _opened(path: Path, **options: bool) -> Any:
    """What the OpenEXR library reads; it prints what is damaged and goes on without it."""
    import OpenEXR

    printed = io.StringIO()
    with redirect_stdout(printed):
        file = OpenEXR.File(str(path), separate_channels=True, **options)
    if printed.getvalue():
        raise CaptureError(
            f"{path}: damaged: {printed.getvalue().rpartition(' - ')[2].strip()}; copy the file again"
        )
    return file


def _window_notes(header: dict[str, Any]) -> tuple[str, ...]:
    if np.array_equal(header["dataWindow"], header["displayWindow"]):
        return ()
    return ("the image is a part of a larger picture: its data window is not its display window",)


def _attributes(header: dict[str, Any]) -> dict[str, Any]:
    """Attributes that are text or numbers."""
    return {
        name: value
        for name, value in header.items()
        if isinstance(value, str | int | float) and name not in _OF_ALL_FILES
    }
