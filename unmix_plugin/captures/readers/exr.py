"""OpenEXR images whose channels are bands.

Three ways of naming channels for wavelengths are known: `S0.450,000000nm` and `T.450,0nm` (Fichet et al. 2021, where a
comma stands for the decimal point since a dot parts layers), `360.00-407.00nm` (Mitsuba, a range), and a plain number.

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

from unmix_plugin.captures.spectral_file import (
    BandTable,
    ReadOptions,
    SpectralFile,
    loaded,
)
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import allow_decoded, allow_parts

_HEADER_BYTES = 2**20
_MARK = b"channels\0chlist\0"
_TYPES = (np.dtype("u4"), np.dtype("f2"), np.dtype("f4"))
_NUMBER = r"(\d+(?:[.,]\d+)?)"
_LAYER = r"(?:(?P<layer>\D(?:.*\D)?|[ST]\d?)\.)?"
_POWERS = {"": 0, "p": -12, "n": -9, "u": -6, "m": -3, "k": 3, "M": 6, "G": 9, "T": 12, "P": 15}
_LENGTH = re.compile(rf"{_LAYER}{_NUMBER}([{''.join(_POWERS)}]?)m")
_FREQUENCY = re.compile(rf"{_LAYER}{_NUMBER}([{''.join(_POWERS)}]?)Hz")
_RANGE = re.compile(rf"{_LAYER}{_NUMBER} ?- ?{_NUMBER} ?nm")
_PLAIN = re.compile(rf"{_LAYER}{_NUMBER}")
_METRES_PER_SECOND = 299_792_458.0
_ALPHA = ("A", "alpha")
_COLOURS = ("R", "G", "B")
_OF_ALL_FILES = ("pixelAspectRatio", "screenWindowWidth")
LAYERS = ("S0", "T", "")
"""Which of several layers is taken: radiance, reflectance, any other."""


@dataclass(frozen=True)
class _Channel:
    """One channel as the header lists it."""

    name: str
    dtype: np.dtype
    sampling: tuple[int, int]
    """1, 1 but for channels that leave out pixels."""


@dataclass(frozen=True)
class _SpectralChannel:
    """A channel whose name is a wavelength."""

    name: str
    layer: str
    """`S0`, `T`, or empty."""
    nm: float
    width_nm: float | None
    """Of a range."""


def open_exr(path: Path, options: ReadOptions) -> SpectralFile:
    """Open an image by its header; the numbers are read as a whole, when the first of them is asked for.

    `options.dataset` names a layer (`S0`, `T`), or one channel.

    Raises:
        CaptureError: the file is damaged, or has no such layer or channel.
    """
    with path.open("rb") as file:
        begin = file.read(_HEADER_BYTES)
    try:
        channels = _list_channels(begin)
    except ValueError as error:
        raise CaptureError(f"{path}: no OpenEXR image: {error}; copy the file again") from error
    allow_parts(path, len(channels), "channels", CaptureError)
    bands, notes = _choose(path, [channel.name for channel in channels], options.dataset)
    names = bands.names or ()
    chosen = [channel for channel in channels if channel.name in names]
    if any(channel.sampling != (1, 1) for channel in chosen):
        raise CaptureError(
            f"{path}: channels leave out pixels (sampling above 1); expected one number a pixel"
        )
    header = _opened(path, header_only=True).header()
    (left, top), (right, bottom) = header["dataWindow"]
    a_pixel = sum(channel.dtype.itemsize for channel in channels)  # the library decodes all of them
    size = (int(bottom) - int(top) + 1) * (int(right) - int(left) + 1) * a_pixel
    allow_decoded(path, size, CaptureError)
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        notes += ("the image is a part of a larger picture: its data window is not its display window",)
    others = [channel.name for channel in channels if channel.name not in names]
    attributes = {
        name: value
        for name, value in header.items()
        if isinstance(value, str | int | float) and name not in _OF_ALL_FILES
    }
    return SpectralFile(
        path=path,
        reader="exr",
        shape=(int(bottom) - int(top) + 1, int(right) - int(left) + 1, len(names)),
        dtype=np.result_type(*(channel.dtype for channel in chosen)),
        read_part=lambda rows, wanted: np.moveaxis(loaded(_load_exr, path, names)[wanted][:, rows], 0, -1),
        bands=bands,
        notes=notes,
        metadata=attributes | ({"other_channels": others} if others else {}),
    )


def _list_channels(header: bytes) -> list[_Channel]:
    """Channels of the first part, from the first bytes of a file; ValueError where they are damaged."""
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
        channels.append(_Channel(name, _TYPES[kind], (across, down)))
        position = end + 17
    return channels


def _choose(path: Path, names: list[str], wanted: str | None) -> tuple[BandTable, tuple[str, ...]]:
    """The channels of a layer that are wavelengths, or all channels if none is; and notes."""
    if not names:
        raise CaptureError(f"{path}: no channels in this OpenEXR image")
    if wanted is not None and wanted in names:
        return BandTable(names=(wanted,)), ()
    spectral = _spectral_channels(names)
    layers = sorted({channel.layer for channel in spectral}, key=lambda layer: (*LAYERS, layer).index(layer))
    if wanted is not None and wanted not in layers:
        raise CaptureError(
            f"{path}: no layer or channel '{wanted}'; it has {', '.join(layers + names)[:300]}"
        )
    if not spectral:
        bands = [name for name in names if name.rpartition(".")[2] not in _ALPHA] or names
        bands.sort(key=lambda name: _COLOURS.index(name) if name in _COLOURS else -1)
        return BandTable(names=tuple(bands)), ()
    layer = layers[0] if wanted is None else wanted
    taken = [channel for channel in spectral if channel.layer == layer]
    widths = [channel.width_nm for channel in taken if channel.width_nm is not None]
    table = BandTable(
        np.array([channel.nm for channel in taken]),
        f"names of channels, such as {taken[0].name!r}",
        np.array(widths) if len(widths) == len(taken) else None,
        names=tuple(channel.name for channel in taken),
    )
    others = ", ".join(repr(other) for other in layers if other != layer)
    return table, (f"layer '{layer}' is taken; the file also has {others}",) if others else ()


def _spectral_channels(names: Sequence[str]) -> list[_SpectralChannel]:
    """Channels that stand for wavelengths, by rising wavelength in each layer; plain numbers where none has a unit.

    >>> [channel.nm for channel in _spectral_channels(["R", "T.390,000000nm", "T.380,5nm"])]
    [380.5, 390.0]
    """
    with_unit = [channel for name in names if (channel := _with_unit(name))]
    plain = [
        channel
        for name in names
        if (match := _PLAIN.fullmatch(name)) and (channel := _checked(match, _number(match[2])))
    ]
    return sorted(with_unit or plain, key=lambda channel: (channel.layer, channel.nm))


def _with_unit(name: str) -> _SpectralChannel | None:
    if match := _RANGE.fullmatch(name):
        low, high = sorted((_number(match[2]), _number(match[3])))
        return _SpectralChannel(name, match["layer"] or "", (low + high) / 2, high - low or None)
    if match := _LENGTH.fullmatch(name):
        return _checked(match, _number(match[2]) * 10.0 ** _POWERS[match[3]] * 1e9)
    if (match := _FREQUENCY.fullmatch(name)) and _number(match[2]) > 0:
        return _checked(match, _METRES_PER_SECOND / (_number(match[2]) * 10.0 ** _POWERS[match[3]]) * 1e9)
    return None


def _checked(match: re.Match[str], nm: float) -> _SpectralChannel | None:
    """None for what no camera records: a plain number that counts, or light that comes back at another wavelength."""
    layer = match["layer"] or ""
    is_reradiated = _LENGTH.fullmatch(layer) or _FREQUENCY.fullmatch(layer)
    if is_reradiated or not 100.0 <= nm <= 30_000.0:
        return None
    return _SpectralChannel(match[0], layer, round(nm, 6), None)


def _number(text: str) -> float:
    return float(text.replace(",", "."))


def _load_exr(path: Path, names: tuple[str, ...]) -> np.ndarray:
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
