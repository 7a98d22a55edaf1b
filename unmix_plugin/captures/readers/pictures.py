"""PNG, JPEG and OpenEXR pictures, and folders that hold one file a band.

Numbers are as they are stored: what is gamma-encoded stays so, and `metadata["encoding"]` says it.

Channels of OpenEXR name wavelengths in three ways: `S0.450,000000nm` and `T.450,0nm` (Fichet et al. 2021, where a comma
stands for the decimal point since a dot parts layers), `360.00-407.00nm` (Mitsuba, a range), and a plain number.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import io
import re
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import band_of, parse_xmp
from unmix_plugin.captures.spectral_file import (
    BandTable,
    ReadOptions,
    SpectralFile,
    import_extra,
    loaded,
    stack_bands,
)
from unmix_plugin.captures.wavelengths import wavelengths_in_names
from unmix_plugin.errors import CaptureError

_GREY = {"1": "u1", "L": "u1", "LA": "u1", "I;16": "u2", "I;16B": "u2", "I": "u2"}
_COLOUR = ("RGB", "RGBA", "P", "PA", "CMYK", "YCbCr")
_DEPTH_AT, _KIND_AT = 24, 25
"""Bits of a number, and kind of colours, in the first bytes of a PNG."""
_WITH_COLOURS = (2, 6)
_ORIENTATION = 0x0112
"""EXIF's code; 1 to 8, where 1 is not turned."""


def open_picture(path: Path, _: ReadOptions) -> SpectralFile:
    """Open a picture by its header; it is decoded when its first numbers are asked for.

    Raises:
        CaptureError: it is damaged, or of a kind that has neither one band nor three.
    """
    from PIL import Image

    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        mode, (width, height), info = picture.mode, picture.size, dict(picture.info)
        orientation = picture.getexif().get(_ORIENTATION, 1)
    with path.open("rb") as file:
        begin = file.read(_KIND_AT + 1)
    # Pillow would cut the colours of a PNG of 16 bits to 8.
    is_deep = begin[:4] == b"\x89PNG" and begin[_DEPTH_AT] == 16 and begin[_KIND_AT] in _WITH_COLOURS
    if mode not in _GREY and mode not in _COLOUR:
        raise CaptureError(f"{path}: a picture of mode {mode}; expected grey or RGB")
    num_bands = 1 if mode in _GREY else 3
    dtype = np.dtype("u2") if is_deep else np.dtype(_GREY.get(mode, "u1"))
    alpha = mode in ("RGBA", "LA", "PA") or "transparency" in info
    xmp = parse_xmp(info.get("xmp") or b"")
    bands = band_of(xmp)
    if bands is None or bands.wavelengths_nm is None or len(bands.wavelengths_nm) != num_bands:
        bands = BandTable(names=("red", "green", "blue") if num_bands == 3 else None)
    metadata: dict[str, Any] = {"xmp": xmp} if xmp else {}
    if num_bands == 3 and dtype.itemsize == 1 and bands.wavelengths_nm is None:
        metadata["encoding"] = "sRGB"
    if orientation in range(2, 9):
        metadata["orientation"] = orientation
    if alpha:
        metadata["has_alpha"] = True
    return SpectralFile(
        path=path,
        reader="picture",
        shape=(height, width, num_bands),
        dtype=dtype,
        read_part=lambda rows, wanted: loaded(_load_deep if is_deep else _load, path)[rows][..., wanted],
        bands=bands,
        interleave="bip" if num_bands == 3 else None,
        notes=("the picture has opacity, which is not a band and is left out",) if alpha else (),
        metadata=metadata,
    )


def _load(path: Path) -> np.ndarray:
    """Numbers (H, W, 1 or 3), neither turned nor linearised."""
    from PIL import Image

    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        if picture.mode in _GREY:
            grey = picture.convert("L") if picture.mode in ("1", "LA") else picture
            return np.asarray(grey).astype(_GREY[picture.mode])[..., None]
        return np.asarray(picture.convert("RGB"))


def _load_deep(path: Path) -> np.ndarray:
    return import_extra("imagecodecs").png_decode(path.read_bytes())[..., :3]


_KINDS = {".tif": "TIFF", ".tiff": "TIFF", ".png": "PNG", ".exr": "OpenEXR", ".jpg": "JPEG", ".jpeg": "JPEG"}


def open_band_folder(folder: Path, open_band: Callable[[Path], SpectralFile]) -> SpectralFile:
    """Open the files of a folder as the bands of one image, by rising wavelength or in the order of their names.

    Wavelengths are in the files, or in their names.

    Raises:
        CaptureError: there are no such files, or they hold several bands each or differ in size.
    """
    found = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    kinds = Counter(_KINDS[path.suffix.lower()] for path in found if path.suffix.lower() in _KINDS)
    if not kinds:
        raise CaptureError(f"{folder}: no band files in this folder; expected one {', '.join(_KINDS)} a band")
    kind, number = kinds.most_common(1)[0]
    files = sorted((path for path in found if _KINDS.get(path.suffix.lower()) == kind), key=_natural)
    bands = [open_band(path) for path in files]
    for band in bands:
        if band.shape[2] != 1:
            raise CaptureError(
                f"{band.path}: {band.shape[2]} bands; expected one band a file in {folder}, or one file with all"
            )
    if any(band.bands.wavelengths_nm is None for band in bands):
        bands = _with_wavelengths_of_names(bands)
    centres = [band.bands.wavelengths_nm[0] for band in bands if band.bands.wavelengths_nm is not None]
    if len(centres) == len(bands):
        bands = [bands[index] for index in np.argsort(centres, kind="stable")]
    stack, others = stack_bands(bands, folder), kinds.total() - number
    noun = "picture of another kind" if others == 1 else "pictures of other kinds"
    notes = (f"{others} {noun} than {kind} in the folder left out",) if others else ()
    return replace(stack, interleave="bsq", notes=stack.notes + notes)


def _with_wavelengths_of_names(bands: list[SpectralFile]) -> list[SpectralFile]:
    found = wavelengths_in_names([band.path.stem for band in bands])
    if found is None:
        return bands
    evidence = f"names of files, such as {bands[0].path.name!r}: {found[1]}"
    return [
        replace(band, bands=replace(band.bands, wavelengths_nm=np.array([nm]), evidence=evidence))
        for band, nm in zip(bands, found[0].tolist(), strict=True)
    ]


def _natural(path: Path) -> list[tuple[int, str]]:
    """Numbers in names by their size: band_9 before band_10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() and len(part) < 19 else (-1, part) for part in parts]


# OpenEXR, whose channels are bands.

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
    bands, notes = _choose(path, [channel.name for channel in channels], options.dataset)
    names = bands.names or ()
    chosen = [channel for channel in channels if channel.name in names]
    if any(channel.sampling != (1, 1) for channel in chosen):
        raise CaptureError(
            f"{path}: channels leave out pixels (sampling above 1); expected one number a pixel"
        )
    header = _opened(path, header_only=True).header()
    (left, top), (right, bottom) = header["dataWindow"]
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
