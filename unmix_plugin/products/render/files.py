"""Each output of a render as a file that takes the rows of a view as they come.

Notation: `h x W` pixels, some rows of a view; `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from unmix_plugin.engine.registry import Output
from unmix_plugin.figures.pictures import Canvas, CanvasLayout
from unmix_plugin.formats.envi import envi_cube_paths, envi_cube_rows
from unmix_plugin.formats.exr import layer_names, write_exr, write_spectral_exr
from unmix_plugin.formats.files import indexed_png_bytes, npy_rows, rgba_png_bytes, write_file
from unmix_plugin.formats.video import FrameSink, video_frames
from unmix_plugin.products.render.formats import FormattedOutput, file_name
from unmix_plugin.products.render.pictures import (
    LIGHT_KINDS,
    Palette,
    opaque_band,
    opaque_tiles,
    transparent_tiles,
)
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.segmentation import NOTHING_ID

_SWEEP_SECONDS, _SWEEP_FPS = 6.0, (4.0, 24.0)


COVERAGE = "coverage"
"""Name among the values of rows of how much of each pixel shows something, a sky included."""


@dataclass(frozen=True)
class Rows:
    """Some rows of a view."""

    first: int
    """Row of the first of them."""
    values: dict[str, np.ndarray]
    """Outputs by name, (h, W, ...) float32, ids uint8; `accumulation` and `coverage` are always there."""

    def filled_by(self, output: Output) -> np.ndarray:
        """(h, W) float32, [0, 1]: how much of each pixel an output fills: light also comes from the sky."""
        return self.values[COVERAGE if output.kind in LIGHT_KINDS | {"channels"} else "accumulation"]


RowsSink: TypeAlias = Callable[[Rows], None]
"""Takes the rows of a view from the top down."""


@dataclass(frozen=True)
class RenderSetting:
    """What all files of a render share."""

    folder: Path
    """Where they go."""
    size: tuple[int, int]
    """Width and height of a view in pixels."""
    palette: Palette
    bands: Bands | None
    """Of outputs of kind `channels`; None where the scene has no spectra."""
    channels: dict[str, tuple[str, ...]]
    """Names of the channels of each output that has several."""
    frames_per_second: float | None
    """Of sweeps; None: so that they take about six seconds."""


def still_paths(folder: Path, formatted: FormattedOutput, view_name: str) -> list[Path]:
    """Files of an output of one view."""
    base = folder / file_name(formatted.output) / view_name
    if formatted.format == "envi":
        return envi_cube_paths(base)
    return [base.with_name(f"{view_name}.{formatted.format}")]


def video_path(folder: Path, formatted: FormattedOutput) -> Path:
    """File of an output of all views."""
    return folder / f"{file_name(formatted.output)}.{formatted.format}"


@contextmanager
def still(formatted: FormattedOutput, view_name: str, setting: RenderSetting) -> Iterator[RowsSink]:
    """Context that gives a sink for the rows of one view; at its end the files are there.

    Raises:
        RunError: the disk is full or refuses.
    """
    with still_at(still_paths(setting.folder, formatted, view_name)[0], formatted, setting) as sink:
        yield sink


@contextmanager
def still_at(path: Path, formatted: FormattedOutput, setting: RenderSetting) -> Iterator[RowsSink]:
    """The same in a file of any name; of ENVI's two, that of the header.

    Raises:
        RunError: the disk is full or refuses.
    """
    open_file = {"npy": _npy, "envi": _envi, "exr": _exr, "png": _png, "mp4": _sweep}[formatted.format]
    with open_file(formatted.output, path, setting) as sink:
        yield sink


@contextmanager
def video(
    formatted: FormattedOutput, setting: RenderSetting, frames_per_second: float
) -> Iterator[FrameSink]:
    """Context that gives a sink for the frames of an output of all views; at its end the video is there.

    Raises:
        RunError: the disk is full or refuses.
    """
    path = video_path(setting.folder, formatted)
    with video_frames(path, *_layout(formatted.output, setting).size, frames_per_second) as add:
        yield add


@contextmanager
def frame(output: Output, progress: float, setting: RenderSetting, add: FrameSink) -> Iterator[RowsSink]:
    """Context that gives a sink for the rows of one view; at its end they are a frame.

    Args:
        output: What is shown; of spectra one band.
        progress: How far the video is, in [0, 1]: of spectra, it goes through the bands.
        setting: Of the render.
        add: The video.
    """
    if output.kind == "channels":
        names = setting.channels[output.name]
        band = round(progress * (len(names) - 1))
        canvas = Canvas(_layout(output, setting), 3, [names[band]])
        yield lambda rows: canvas.put(
            rows.first, opaque_band(rows.values[output.name][..., band], rows.filled_by(output))
        )
    else:
        canvas = _canvas(output, setting, 3)
        yield lambda rows: canvas.put(
            rows.first,
            opaque_tiles(output, rows.values[output.name], rows.filled_by(output), setting.palette),
        )
    add(canvas.pixels)


def shape_of(output: Output, setting: RenderSetting) -> tuple[int, ...]:
    """Shape of an output of a whole view."""
    width, height = setting.size
    names = setting.channels.get(output.name)
    return (height, width) if names is None else (height, width, len(names))


@contextmanager
def _npy(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    dtype = np.uint8 if output.kind == "labels" else np.float32
    with npy_rows(path, shape_of(output, setting), dtype) as add:
        yield lambda rows: add(rows.values[output.name])


@contextmanager
def _envi(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    width, height = setting.size
    names = setting.channels.get(output.name, (output.name,))
    shape = (height, width, len(names))
    bands = setting.bands if output.kind == "channels" else None
    description = f"{output.name}: {output.what}"
    with envi_cube_rows(path.with_suffix(""), shape, bands, list(names), description) as add:
        yield lambda rows: add(rows.values[output.name].reshape(-1, *shape[1:]))


@contextmanager
def _exr(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    width, height = setting.size
    names = _exr_names(output, setting)
    # One plane a channel, as the format wants them: nothing is copied when the file is written.
    planes = np.zeros((len(names), height, width), dtype=np.float32)
    bands = setting.bands if output.kind == "channels" else None
    to_rgb = None if bands is None else rgb_matrix(bands).numpy()
    preview = np.zeros((0 if bands is None else 3, height, width), dtype=np.float32)
    opacity = np.zeros((height, width), dtype=np.float32)

    def add(rows: Rows) -> None:
        values = rows.values[output.name].reshape(-1, width, len(planes))
        place = slice(rows.first, rows.first + len(values))
        planes[:, place] = np.moveaxis(values, -1, 0)
        opacity[place] = rows.filled_by(output)
        if to_rgb is not None:
            preview[:, place] = np.moveaxis(np.clip(np.clip(values, 0, None) @ to_rgb, 0, 1), -1, 0)

    yield add
    comments = f"{output.name}: {output.what}"
    if bands is not None:
        spectra, rgb = np.moveaxis(planes, 0, -1), np.moveaxis(preview, 0, -1)
        write_spectral_exr(path, spectra, bands, rgb, opacity, comments)
        return
    pixels = dict(zip(names, planes, strict=True))
    write_exr(path, {**pixels, "A": opacity} if output.kind == "linear" else pixels, {"comments": comments})


@contextmanager
def _png(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    palette = setting.palette
    if output.kind == "labels":
        ids = np.full(setting.size[::-1], NOTHING_ID, dtype=np.uint8)

        def add(rows: Rows) -> None:
            found = rows.values[output.name]
            ids[rows.first : rows.first + len(found)] = found

        yield add
        write_file(path, indexed_png_bytes(ids, palette.by_id, NOTHING_ID, palette.describe(output)))
        return
    canvas = _canvas(output, setting, 4)
    yield lambda rows: canvas.put(
        rows.first, transparent_tiles(output, rows.values[output.name], rows.filled_by(output), palette)
    )
    write_file(path, rgba_png_bytes(canvas.pixels, palette.describe(output)))


@contextmanager
def _sweep(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    """Band after band of one view."""
    width, height = setting.size
    names = setting.channels[output.name]
    frames = np.zeros((len(names), height, width, 3), dtype=np.uint8)

    def add(rows: Rows) -> None:
        values = rows.values[output.name]
        for band, radiance in enumerate(np.moveaxis(values, -1, 0)):
            painted = opaque_band(radiance, rows.filled_by(output))
            frames[band, rows.first : rows.first + len(values)] = painted[:, :, 0]

    yield add
    usual = float(np.clip(len(names) / _SWEEP_SECONDS, *_SWEEP_FPS))
    layout = _layout(output, setting)
    with video_frames(path, *layout.size, setting.frames_per_second or usual) as show:
        for name, one in zip(names, frames, strict=True):
            canvas = Canvas(layout, 3, [name])
            canvas.put(0, one[:, :, None])
            show(canvas.pixels)


def _canvas(output: Output, setting: RenderSetting, num_channels: int) -> Canvas:
    layout = _layout(output, setting)
    if output.kind != "shares":
        return Canvas(layout, num_channels)
    swatches = setting.palette.colours if setting.palette.names else ()
    return Canvas(layout, num_channels, setting.channels[output.name], swatches)


def _layout(output: Output, setting: RenderSetting) -> CanvasLayout:
    """One tile, or one for each share under its name; of spectra, one band at a time under its wavelength."""
    if output.kind not in ("channels", "shares"):
        return CanvasLayout.of(setting.size)
    count = 1 if output.kind == "channels" else None
    return CanvasLayout.of(setting.size, setting.channels[output.name], count)


def _exr_names(output: Output, setting: RenderSetting) -> list[str]:
    """Channels, in OpenEXR's terms where it has some."""
    if output.kind == "linear":
        return ["R", "G", "B"]
    if output.kind == "vectors":
        return [f"{file_name(output)}.{axis}" for axis in "XYZ"]
    if output.name in setting.channels:
        return layer_names(file_name(output), setting.channels[output.name])
    return ["Z" if output.name == "depth" else file_name(output).replace(".", "_")]
