"""Each product of a render as a file that takes the rows of a view as they come.

Notation: `h x W` pixels, some rows of a view; `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from unmix_plugin.figures.picture_canvas import Canvas, CanvasLayout
from unmix_plugin.formats.envi_cube import envi_cube_paths, envi_cube_rows
from unmix_plugin.formats.exr import layer_names, write_exr
from unmix_plugin.formats.files import write_file
from unmix_plugin.formats.npy import npy_rows
from unmix_plugin.formats.png import indexed_png_bytes, rgba_png_bytes
from unmix_plugin.formats.spectral_exr import write_spectral_exr
from unmix_plugin.formats.video import FrameSink, video_frames
from unmix_plugin.products.render.outputs import Product, RenderOutput
from unmix_plugin.products.render.pictures import Palette, opaque_band, opaque_tiles, transparent_tiles
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.segmentation import NOTHING_ID

_THREE_NAMES = {"vectors": ("x", "y", "z")}
_SWEEP_SECONDS, _SWEEP_FPS = 6.0, (4.0, 24.0)


@dataclass(frozen=True)
class Rows:
    """Some rows of a view."""

    first: int
    """Row of the first of them."""
    values: dict[str, np.ndarray]
    """Outputs by name, (h, W, ...) float32, ids uint8; `accumulation` is always there."""

    @property
    def opacity(self) -> np.ndarray:
        """(h, W) float32, [0, 1]."""
        return self.values["accumulation"]


RowsSink: TypeAlias = Callable[[Rows], None]
"""Takes the rows of a view from the top down."""


@dataclass(frozen=True)
class Setting:
    """What all files of a render share."""

    folder: Path
    """Where they go."""
    size: tuple[int, int]
    """Width and height of a view in pixels."""
    materials: Materials
    palette: Palette
    frames_per_second: float | None
    """Of sweeps; None: so that they take about six seconds."""


def still_paths(folder: Path, product: Product, view_name: str) -> list[Path]:
    """Files of a product of one view."""
    base = folder / product.output.file_name / view_name
    if product.format == "envi":
        return envi_cube_paths(base)
    return [base.with_name(f"{view_name}.{product.format}")]


def video_path(folder: Path, product: Product) -> Path:
    """File of a product of all views."""
    return folder / f"{product.output.file_name}.{product.format}"


@contextmanager
def still(product: Product, view_name: str, setting: Setting) -> Iterator[RowsSink]:
    """Context that gives a sink for the rows of one view; at its end the files are there.

    Raises:
        RunError: the disk is full or refuses.
    """
    open_file = {"npy": _npy, "envi": _envi, "exr": _exr, "png": _png, "mp4": _sweep}[product.format]
    path = still_paths(setting.folder, product, view_name)[0]
    with open_file(product.output, path, setting) as sink:
        yield sink


@contextmanager
def video(product: Product, setting: Setting, frames_per_second: float) -> Iterator[FrameSink]:
    """Context that gives a sink for the frames of a product of all views; at its end the video is there.

    Raises:
        RunError: the disk is full or refuses.
    """
    path = video_path(setting.folder, product)
    with video_frames(path, *_layout(product.output, setting).size, frames_per_second) as add:
        yield add


@contextmanager
def frame(output: RenderOutput, progress: float, setting: Setting, add: FrameSink) -> Iterator[RowsSink]:
    """Context that gives a sink for the rows of one view; at its end they are a frame.

    Args:
        output: What is shown; of spectra one band.
        progress: How far the video is, in [0, 1]: of spectra, the bands are gone through.
        setting: Of the render.
        add: The video.
    """
    if output.kind.name == "spectra":
        bands = setting.materials.bands
        band = round(progress * (len(bands) - 1))
        canvas = Canvas(_layout(output, setting), 3, [_band_name(bands.centers_nm[band])])
        yield lambda rows: canvas.put(
            rows.first, opaque_band(rows.values[output.name][..., band], rows.opacity)
        )
    else:
        canvas = _canvas(output, setting, 3)
        yield lambda rows: canvas.put(
            rows.first, opaque_tiles(output, rows.values[output.name], rows.opacity, setting.palette)
        )
    add(canvas.pixels)


def shape_of(output: RenderOutput, setting: Setting) -> tuple[int, ...]:
    """Shape of an output of a whole view."""
    width, height = setting.size
    return (height, width, *_channels(output, setting.materials))


def _channels(output: RenderOutput, materials: Materials) -> tuple[int, ...]:
    kind = output.kind.name
    if kind in ("spectra", "shares"):
        return (len(materials.bands if kind == "spectra" else materials.names),)
    return () if kind in ("radiance", "map", "labels") else (3,)


@contextmanager
def _npy(output: RenderOutput, path: Path, setting: Setting) -> Iterator[RowsSink]:
    dtype = np.uint8 if output.kind.name == "labels" else np.float32
    with npy_rows(path, shape_of(output, setting), dtype) as add:
        yield lambda rows: add(rows.values[output.name])


@contextmanager
def _envi(output: RenderOutput, path: Path, setting: Setting) -> Iterator[RowsSink]:
    width, height = setting.size
    channels = _channels(output, setting.materials)
    shape = (height, width, channels[0] if channels else 1)
    bands = setting.materials.bands if output.kind.name == "spectra" else None
    description = f"{output.name}: {output.what}"
    with envi_cube_rows(
        path.with_suffix(""), shape, bands, _channel_names(output, setting), description
    ) as add:
        yield lambda rows: add(rows.values[output.name].reshape(-1, *shape[1:]))


@contextmanager
def _exr(output: RenderOutput, path: Path, setting: Setting) -> Iterator[RowsSink]:
    width, height = setting.size
    channels = _channels(output, setting.materials)
    # One plane a channel, as the format wants them: nothing is copied when the file is written.
    planes = np.zeros((channels[0] if channels else 1, height, width), dtype=np.float32)
    is_spectral = output.kind.name == "spectra"
    preview = np.zeros((3 if is_spectral else 0, height, width), dtype=np.float32)
    to_rgb = rgb_matrix(setting.materials.bands).numpy()
    opacity = np.zeros((height, width), dtype=np.float32)

    def add(rows: Rows) -> None:
        values = rows.values[output.name].reshape(-1, width, len(planes))
        place = slice(rows.first, rows.first + len(values))
        planes[:, place] = np.moveaxis(values, -1, 0)
        opacity[place] = rows.opacity
        if is_spectral:
            preview[:, place] = np.moveaxis(np.clip(np.clip(values, 0, None) @ to_rgb, 0, 1), -1, 0)

    yield add
    comments = f"{output.name}: {output.what}"
    if is_spectral:
        spectra, rgb = np.moveaxis(planes, 0, -1), np.moveaxis(preview, 0, -1)
        write_spectral_exr(path, spectra, setting.materials.bands, rgb, opacity, comments)
        return
    names = _exr_names(output, setting)
    pixels = dict(zip(names, planes, strict=True))
    write_exr(
        path, {**pixels, "A": opacity} if output.kind.name == "light" else pixels, {"comments": comments}
    )


@contextmanager
def _png(output: RenderOutput, path: Path, setting: Setting) -> Iterator[RowsSink]:
    palette = setting.palette
    if output.kind.name == "labels":
        ids = np.full(setting.size[::-1], NOTHING_ID, dtype=np.uint8)

        def add(rows: Rows) -> None:
            found = rows.values[output.name]
            ids[rows.first : rows.first + len(found)] = found

        yield add
        write_file(path, indexed_png_bytes(ids, palette.by_id, NOTHING_ID, palette.describe(output)))
        return
    canvas = _canvas(output, setting, 4)
    yield lambda rows: canvas.put(
        rows.first, transparent_tiles(output, rows.values[output.name], rows.opacity, palette)
    )
    write_file(path, rgba_png_bytes(canvas.pixels, palette.describe(output)))


@contextmanager
def _sweep(output: RenderOutput, path: Path, setting: Setting) -> Iterator[RowsSink]:
    """Band after band of one view."""
    width, height = setting.size
    wavelengths = setting.materials.bands.centers_nm
    frames = np.zeros((len(wavelengths), height, width, 3), dtype=np.uint8)

    def add(rows: Rows) -> None:
        values = rows.values[output.name]
        for band, radiance in enumerate(np.moveaxis(values, -1, 0)):
            painted = opaque_band(radiance, rows.opacity)
            frames[band, rows.first : rows.first + len(values)] = painted[:, :, 0]

    yield add
    usual = float(np.clip(len(wavelengths) / _SWEEP_SECONDS, *_SWEEP_FPS))
    layout = _layout(output, setting)
    with video_frames(path, *layout.size, setting.frames_per_second or usual) as show:
        for wavelength, one in zip(wavelengths, frames, strict=True):
            canvas = Canvas(layout, 3, [_band_name(wavelength)])
            canvas.put(0, one[:, :, None])
            show(canvas.pixels)


def _canvas(output: RenderOutput, setting: Setting, num_channels: int) -> Canvas:
    layout = _layout(output, setting)
    if output.kind.name != "shares":
        return Canvas(layout, num_channels)
    return Canvas(layout, num_channels, setting.palette.names, setting.palette.colours)


def _layout(output: RenderOutput, setting: Setting) -> CanvasLayout:
    """One tile, or one for each endmember under its name; of spectra, one band at a time under its wavelength."""
    if output.kind.name == "shares":
        return CanvasLayout.of(setting.size, setting.palette.names)
    if output.kind.name == "spectra":
        return CanvasLayout.of(setting.size, _channel_names(output, setting), count=1)
    return CanvasLayout.of(setting.size)


def _band_name(wavelength_nm: float) -> str:
    return f"{wavelength_nm:g} nm"


def _channel_names(output: RenderOutput, setting: Setting) -> list[str]:
    kind = output.kind.name
    if kind == "spectra":
        return [_band_name(wavelength) for wavelength in setting.materials.bands.centers_nm]
    if kind == "shares":
        return list(setting.materials.names)
    if kind in ("radiance", "map"):
        return [output.name]
    return list(_THREE_NAMES.get(kind, ("red", "green", "blue")))


def _exr_names(output: RenderOutput, setting: Setting) -> list[str]:
    """Channels, in OpenEXR's terms where it has some."""
    kind = output.kind.name
    if kind == "light":
        return ["R", "G", "B"]
    if kind == "vectors":
        return [f"{output.file_name}.{axis}" for axis in "XYZ"]
    if kind == "shares":
        return layer_names(output.file_name, setting.materials.names)
    return ["Z" if output.name == "depth" else output.file_name.replace(".", "_")]
