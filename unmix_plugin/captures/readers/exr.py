"""OpenEXR images whose channels are bands; see `exr_channels` for how their names are understood.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.readers.exr_channels import ExrChannel, list_channels, spectral_channels
from unmix_plugin.captures.readers.loaded_arrays import loaded
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile
from unmix_plugin.errors import CaptureError

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
