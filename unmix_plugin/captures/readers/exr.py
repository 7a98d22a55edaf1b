"""OpenEXR images whose channels are bands.

Three ways of naming channels for wavelengths are known: `S0.450,000000nm` and `T.450,0nm` (Fichet et al. 2021, where a
comma stands for the decimal point since a dot parts layers), `360.00-407.00nm` (Mitsuba, a range), and a plain number.

A file may have several parts, each with channels of its own; bands are looked for in all of them. The picture is the
display window: a data window that is smaller leaves pixels without a measurement, and what is outside is cut off.
Source: OpenEXR, Technical Introduction.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import io
import re
import struct
from collections import Counter
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from unmix_plugin.captures.cube import BandTable, Cube, Exposure, Factor, ReadOptions
from unmix_plugin.captures.fields import state_exposure
from unmix_plugin.captures.names import natural_order
from unmix_plugin.captures.numbers import Decoded, Numbers
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.wavelengths import PLAUSIBLE_NM, wavelengths_in_names
from unmix_plugin.errors import CaptureError, name_some
from unmix_plugin.limits import allow_decoded, allow_parts

_HEADER_BYTES = 2**20
_MARK = b"channels\0chlist\0"
_TYPES = (np.dtype("u4"), np.dtype("f2"), np.dtype("f4"))
_NUMBER = r"(\d+(?:[.,]\d+)?(?:[Ee][+-]?\d+)?)"
_LAYER = r"(?:(?P<layer>\D(?:.*\D)?|[ST]\d?)\.)?"
_POWERS = {"": 0, "p": -12, "n": -9, "u": -6, "m": -3, "k": 3, "M": 6, "G": 9, "T": 12, "P": 15}
_LENGTH = re.compile(rf"{_LAYER}{_NUMBER}([{''.join(_POWERS)}]?)m")
_FREQUENCY = re.compile(rf"{_LAYER}{_NUMBER}([{''.join(_POWERS)}]?)Hz")
_RANGE = re.compile(rf"{_LAYER}{_NUMBER} ?- ?{_NUMBER} ?nm")
_PLAIN = re.compile(rf"{_LAYER}{_NUMBER}")
_ALPHA = ("A", "alpha")
_COLOURS = (("R", "G", "B"), ("red", "green", "blue"))
_OF_ALL_FILES = ("pixelAspectRatio", "screenWindowWidth")
_DAMAGED = "can't be read as OpenEXR, copy the file again"
LAYERS = ("S0", "T", "")
"""Which of several layers is taken: radiance, reflectance, channels of no layer. Between layers of other names nothing
tells which one is meant."""


@dataclass(frozen=True)
class _Channel:
    """One channel as the header of its part lists it; it is whole if there is a number for each pixel."""

    name: str
    part: int
    dtype: np.dtype
    is_whole: bool


@dataclass(frozen=True)
class _SpectralChannel:
    """A channel whose name is a wavelength, in a layer `S0`, `T` or none; ranges have a width."""

    name: str
    layer: str
    nm: float
    width_nm: float | None


def open_exr(path: Path, options: ReadOptions) -> Cube:
    """Open an image by its header; the numbers are read as a whole, when the first of them is asked for.

    `options.dataset` names a layer (`S0`, `T`), a part, or one channel. Raises CaptureError: the file is damaged, or
    has no such layer, part or channel.
    """
    _ = _channels_of(path)
    parts = _opened(path, header_only=True).parts
    channels = _channels_of(path, ["deep" in str(part.type()).lower() for part in parts])
    allow_parts(path, len(channels), "channels", CaptureError)
    wanted, titles = options.dataset, [str(part.header.get("name", "")) for part in parts]
    considered = [one for one in channels if wanted is None or titles[one.part] == wanted]
    remarks: list[Remark] = []
    table, chosen = _choose(path, considered or channels, None if considered else wanted, remarks)
    if not all(channel.is_whole for channel in chosen):
        raise CaptureError(f"{path}: channels leave out pixels (sampling above 1, or a deep image)")
    header = parts[chosen[0].part].header
    frame = _window(header, "displayWindow")
    others = [channel.name for channel in channels if channel not in chosen]
    unused = set(range(len(parts))) - {channel.part for channel in chosen}
    if unused and table.wavelengths_nm is None:
        names = ", ".join(titles[index] or f"number {index}" for index in sorted(unused))
        remarks.append(Remark.of(Code.PARTS_LEFT_OUT, names=names))
    windows = {one.part: _window(parts[one.part].header, "dataWindow") for one in chosen}
    is_partial = False
    for index, window_of_part in windows.items():
        low, high = _on_both(window_of_part, frame)
        if (high <= low).any():
            has, whole = ((window - [[0], [1]]).tolist() for window in (window_of_part, frame))
            raise CaptureError(
                f"{path}: its data window {has} lies outside of the picture {whole} (left and top, right and bottom); "
                "expected a part of it: render it again"
            )
        is_partial |= bool((low > frame[0]).any() or (high < frame[1]).any())
        # The library decodes all channels of a part; what is taken is put on the picture.
        a_pixel = sum(channel.dtype.itemsize for channel in channels if channel.part == index)
        allow_decoded(path, max(_area(window_of_part), _area(frame)) * a_pixel, CaptureError)
    dtype = np.result_type(*(channel.dtype for channel in chosen))
    attributes = {
        name: value
        for name, value in header.items()
        if isinstance(value, str | int | float) and name not in _OF_ALL_FILES
    }
    exposure = state_exposure(attributes, "attribute", remarks)
    speed, aperture = (attributes.get(key) for key in ("isoSpeed", "aperture"))
    if exposure != Exposure():
        if isinstance(speed, float) and 0 < speed < np.inf:
            exposure = replace(exposure, gain=Factor((speed / 100,), "attribute 'isoSpeed'"))
        if isinstance(aperture, float) and 0 < aperture < np.inf:
            exposure = replace(exposure, f_number=aperture)
    counts = Counter(channel.part for channel in channels)
    listed = [
        {"name": title, "type": str(part.type()), "channels": counts[index]}
        for index, (title, part) in enumerate(zip(titles, parts, strict=True))
    ]
    if is_partial:
        remarks.append(Remark.of(Code.WINDOW_IS_PART))
    keys = tuple((channel.part, channel.name) for channel in chosen)
    dtype = np.result_type(dtype, np.float16) if is_partial else dtype
    height, width = (frame[1] - frame[0])[::-1].tolist()
    planes = len(chosen), height, width
    return Cube(
        path=path,
        reader="exr",
        shape=(height, width, len(chosen)),
        dtype=dtype,
        numbers=Numbers((Decoded(path, dtype, planes, _decode, (keys,)),), planes, "byx", dtype),
        bands=table,
        remarks=tuple(remarks),
        exposure=exposure,
        reflectance_source="the layer T" if (table.names or ("",))[0].startswith("T.") else "",
        others=attributes
        | ({"other_channels": others} if others else {})
        | ({"parts": listed} if len(parts) > 1 else {}),
    )


def channel_names(path: Path) -> list[str]:
    """Names of the channels in the order of the file. Raises CaptureError: the header is damaged."""
    return [channel.name for channel in _channels_of(path)]


def _channels_of(path: Path, is_deep: Sequence[bool] = (False,)) -> list[_Channel]:
    """Channels of all parts, read without the library, which damaged headers end.

    Args:
        is_deep: Of each part, whether its pixels hold any number of numbers.
    """
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
    channels, position = [], 0
    for part, deep in enumerate(is_deep):
        position = header.find(_MARK, position) + len(_MARK)
        if position < len(_MARK):
            raise CaptureError(f"{path} {_DAMAGED}: no list of channels is in the header")
        position += 4
        while position < len(header) and header[position] != 0:
            end = header.find(b"\0", position)
            if end < 0 or end + 17 > len(header):
                raise CaptureError(f"{path} {_DAMAGED}: the list of channels is cut short")
            kind, across, down = struct.unpack_from("<i4xii", header, end + 1)
            if not 0 <= kind < len(_TYPES):
                raise CaptureError(f"{path} {_DAMAGED}: a channel has the unknown type {kind}")
            name = header[position:end].decode("utf-8", "replace")
            channels.append(_Channel(name, part, _TYPES[kind], (across, down) == (1, 1) and not deep))
            position = end + 17
    return channels


def _window(header: dict[str, Any], key: str) -> Int[np.ndarray, "2 2"]:
    """Column and row of a rectangle's first pixel, and those behind its last."""
    first, last = (np.asarray(corner, np.int64) for corner in header[key])
    return np.stack([first, last + 1])


def _on_both(window: Int[np.ndarray, "2 2"], frame: Int[np.ndarray, "2 2"]) -> Int[np.ndarray, "2 2"]:
    return np.stack([np.maximum(window[0], frame[0]), np.minimum(window[1], frame[1])])


def _area(window: Int[np.ndarray, "2 2"]) -> int:
    return prod(max(0, side) for side in (window[1] - window[0]).tolist())


def _choose(
    path: Path, channels: list[_Channel], wanted: str | None, remarks: list[Remark]
) -> tuple[BandTable, list[_Channel]]:
    """The channels of a layer that are wavelengths, or all of the first part if none is."""
    names = [channel.name for channel in channels]
    if not names:
        raise CaptureError(f"{path}: no channels in this OpenEXR image")
    if wanted is not None and wanted in names:
        return BandTable(names=(wanted,)), [channels[names.index(wanted)]]
    by_name = {channel.name: channel for channel in reversed(channels)}
    spectral = _spectral_channels(list(by_name))
    if in_hertz := [name for name in names if _FREQUENCY.fullmatch(name)]:
        raise CaptureError(
            f"{path}: the channel {in_hertz[0]} is named by a frequency, which is not read; name channels by "
            "wavelengths, such as S0.550,000000nm"
        )
    known = {channel.layer for channel in spectral}
    layers = [layer for layer in LAYERS if layer in known] + sorted(known - {*LAYERS})
    if wanted is not None and wanted not in layers:
        there = ", ".join(layers + names)[:300]
        raise CaptureError(f"{path}: no layer, part or channel '{wanted}'; it has {there}")
    if not spectral:
        of_first = [channel.name for channel in channels if channel.part == channels[0].part]
        bands = [name for name in of_first if name.rpartition(".")[2] not in _ALPHA] or of_first
        bands = _in_order(bands)
        found, table = wavelengths_in_names(bands), BandTable(names=tuple(bands))
        if found is not None:
            source = f"names of channels, such as {bands[0]!r}: {found[1]}"
            table = replace(table, wavelengths_nm=found[0], source=source, fwhm_nm=found[2])
        return table, [by_name[name] for name in bands]
    if wanted is None and len(layers) > 1 and layers[0] not in LAYERS:
        raise CaptureError(
            f"{path}: {len(layers)} layers hold wavelengths ({name_some(layers)}), and none of them is S0 (radiance) "
            "or T (reflectance); name one (--dataset)"
        )
    layer = layers[0] if wanted is None else wanted
    taken = [channel for channel in spectral if channel.layer == layer]
    widths = [channel.width_nm for channel in taken if channel.width_nm is not None]
    table = BandTable(
        np.array([channel.nm for channel in taken]),
        f"names of channels, such as {taken[0].name!r}",
        np.array(widths) if len(widths) == len(taken) else None,
        names=tuple(channel.name for channel in taken),
    )
    chosen = [by_name[channel.name] for channel in taken]
    if others := [repr(other) for other in layers if other != layer and wanted is None]:
        remarks.append(Remark.of(Code.LAYER_TAKEN, layer=layer, others=", ".join(others)))
    alike = {channel.part for channel in channels if channel.name in (table.names or ())}
    if repeated := alike - {channel.part for channel in chosen}:
        remarks.append(Remark.of(Code.PARTS_ALIKE, number=len(repeated)))
    return table, chosen


def _in_order(names: Sequence[str]) -> list[str]:
    """By name, but red, green and blue of each layer in this order, behind all that is no colour.

    >>> _in_order(["Z", "a.B", "a.G", "a.R", "B"])
    ['B', 'Z', 'a.R', 'a.G', 'a.B']
    """

    def place(name: str) -> tuple[int, list[tuple[int, str]], int]:
        layer, dot, last = name.rpartition(".")
        for colours in _COLOURS:
            if last in colours and {layer + dot + one for one in colours} <= {*names}:
                return 1, natural_order(layer), colours.index(last)
        return 0, natural_order(name), 0

    return sorted(names, key=place)


def _spectral_channels(names: Sequence[str]) -> list[_SpectralChannel]:
    """Channels that stand for wavelengths, by rising wavelength in each layer; plain numbers where none has a unit.

    >>> [channel.nm for channel in _spectral_channels(["R", "T.390,000000nm", "T.380,5nm"])]
    [380.5, 390.0]
    """
    for patterns in ((_RANGE, _LENGTH), (_PLAIN,)):
        found = [channel for name in names if (channel := _spectral_channel(name, patterns))]
        if found:
            return sorted(found, key=lambda channel: (channel.layer, channel.nm))
    return []


def _spectral_channel(name: str, patterns: Sequence[re.Pattern[str]]) -> _SpectralChannel | None:
    """None for what no camera records: a plain number that counts, or light that comes back at another wavelength."""
    match = next(filter(None, (pattern.fullmatch(name) for pattern in patterns)), None)
    if match is None:
        return None
    layer, number = match["layer"] or "", _number(match[2])
    if match.re is _RANGE:
        low, high = sorted((number, _number(match[3])))
        is_seen = PLAUSIBLE_NM[0] <= low and high <= PLAUSIBLE_NM[1]
        return _SpectralChannel(name, layer, (low + high) / 2, high - low or None) if is_seen else None
    nm = number if match.re is _PLAIN else number * 10.0 ** _POWERS[match[3]]
    if match.re is _LENGTH:
        nm *= 1e9
    if _LENGTH.fullmatch(layer) or not PLAUSIBLE_NM[0] <= nm <= PLAUSIBLE_NM[1]:
        return None
    return _SpectralChannel(name, layer, round(nm, 6), None)


def _number(text: str) -> float:
    return float(text.replace(",", "."))


def _decode(path: Path, planes: np.ndarray, keys: Sequence[tuple[int, str]]) -> None:
    """Channels (B, H, W) by part and name, on the display window; NaN where a part has no pixels."""
    parts = _opened(path).parts
    frame = _window(parts[keys[0][0]].header, "displayWindow")
    for plane, (index, name) in zip(planes, keys, strict=True):
        pixels, window = parts[index].channels[name].pixels, _window(parts[index].header, "dataWindow")
        if (window != frame).any():
            plane[:] = np.nan
        low, high = _on_both(window, frame)
        (x, y), (right, bottom) = low - frame[0], high - frame[0]
        (left, top), (width, height) = low - window[0], high - low
        plane[y:bottom, x:right] = pixels[top : top + height, left : left + width]


def _opened(path: Path, **options: bool) -> Any:
    """What the OpenEXR library reads; it prints what is damaged and goes on without it."""
    import OpenEXR

    printed = io.StringIO()
    with redirect_stdout(printed):
        file = OpenEXR.File(str(path), separate_channels=True, **options)
    if printed.getvalue():
        raise CaptureError(
            f"{path}: damaged: {printed.getvalue().rpartition(' - ')[2].strip()}; copy it again"
        )
    return file
