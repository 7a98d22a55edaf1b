"""What is written of a render: the formats of each output, and its files, which take the rows of a view as they come.

Notation: `h x W` pixels, some rows of a view; `B` bands, `K` endmembers.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from jaxtyping import UInt8

from unmix_plugin.engine.outputs import METRES, WORLD_UNITS, Output, OutputKind
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.figures.look import Look
from unmix_plugin.figures.paint import (
    LIGHT_KINDS,
    as_bytes,
    background_of,
    class_colours,
    describe,
    id_palette,
    paint,
)
from unmix_plugin.figures.pictures import Canvas, CanvasLayout
from unmix_plugin.formats.envi import envi_cube_paths, envi_cube_rows
from unmix_plugin.formats.exr import layer_names, write_exr, write_spectral_exr
from unmix_plugin.formats.files import indexed_png_bytes, npy_rows, rgba_png_bytes, safe_name, write_file
from unmix_plugin.formats.video import FrameSink, video_frames
from unmix_plugin.products.render.maps import MapInfo, gdal_metadata
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.maps.indices import NAMED_INDICES
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.mixture_view import PictureValues
from unmix_plugin.trained.protocol import RenderableScene

_Format = Literal["envi", "exr", "npy", "png", "mp4", "tif"]
_FORMATS: tuple[_Format, ...] = get_args(_Format)
_LARGEST_TIFF = 1 << 31
"""Bytes; of more numbers BigTIFF is written, as addresses in a TIFF end at 4 GiB."""
_GDAL_NODATA = 42113
"""Tag of GDAL's."""
_DEFAULT_STILLS = ("spectral", "rgb", "abundances", "segmentation", "depth")


class _KindFormats(NamedTuple):
    suited: tuple[_Format, ...]
    stills: tuple[_Format, ...]
    """Where none are asked for, of single views."""
    moving: tuple[_Format, ...] = ("mp4",)
    """The same where views follow each other."""


_MAP = _KindFormats(("png", "npy", "exr", "envi", "mp4"), ("png", "npy"))
_PICTURE = _KindFormats(("png", "npy", "envi", "mp4"), ("png",))

_BY_KIND: dict[OutputKind, _KindFormats] = {
    "channels": _KindFormats(("envi", "exr", "npy", "mp4"), ("envi",), ("envi",)),
    "spectra": _KindFormats(("envi", "npy"), ("envi",), ("envi",)),
    "shares": _KindFormats(("envi", "exr", "npy", "png", "mp4"), ("envi", "png")),
    "srgb": _PICTURE,
    "linear": _KindFormats(("exr", "npy", "envi", "png", "mp4"), ("exr",)),
    "picture": _PICTURE,
    "grey": _MAP,
    "map": _MAP,
    "labels": _KindFormats(("png", "npy", "mp4"), ("png",)),
    "vectors": _MAP,
}
_COMPOSITE = _KindFormats(("png", "exr", "npy", "envi", "mp4"), ("png",))

_SHOWS_COLOURS = "a PNG shows colours: ask for"
_REASONS = {
    ("channels", "png"): f"{_SHOWS_COLOURS} rgb, band:NMnm, false-colour:NM,NM,NM or pca",
    ("spectra", "png"): f"{_SHOWS_COLOURS} band:NMnm, false-colour:NM,NM,NM or absorption:LOW-HIGH",
    ("spectra", "exr"): "the layout of spectral EXR has no place for it",
    ("srgb", "exr"): "it is encoded for displays and EXR holds linear light: ask for linear_rgb",
    ("picture", "exr"): "it is made for displays and EXR holds linear light",
    ("labels", "envi"): "ids are written as PNG, with their palette, or .npy",
    ("labels", "exr"): "ids are written as PNG, with their palette, or .npy",
}


class FormattedOutput(NamedTuple):
    """An output in a format."""

    output: Output
    format: _Format


def file_name(output: Output) -> str:
    """An output's name as part of a file's: odd characters become `-`, folders of a target's file are left out.

    A formula ends with some letters of its hash, since `r650/r550` and `r650*r550` would have the same name.

    >>> file_name(Output("false-colour:860,650,550", "linear", "", ""))
    'false-colour-860-650-550'
    """
    has_file = output.name.startswith(("target:", "library:"))
    short = re.sub(r"[^:]*[/\\]", "", output.name) if has_file else output.name
    plain = re.sub(r"[^\w.+-]+", "-", short).strip("-.")
    shown = output.name.removeprefix("interval:")
    is_formula = shown.startswith("index:") and shown.removeprefix("index:") not in NAMED_INDICES
    ending = f"-{hashlib.sha256(output.name.encode()).hexdigest()[:8]}" if is_formula else ""
    return safe_name(plain + ending)


def needs_legend(formatted: FormattedOutput, scene: RenderableScene) -> bool:
    """Whether an output's pictures have colours that have to be explained, and that can be."""
    kind = formatted.output.kind
    has_meaning = kind in ("map", "shares") or (kind == "labels" and scene.materials is not None)
    return formatted.format in ("png", "mp4") and has_meaning


def choose_formats(
    outputs: Sequence[str], formats: Sequence[str], scene: RenderableScene, is_path: bool
) -> tuple[FormattedOutput, ...]:
    """Every output in every asked format that suits it.

    Args:
        outputs: Names, or `all`, every output that takes no argument; none: those that are usually wanted, as far as
            the scene has them.
        formats: Of `_FORMATS`; none: what suits each output best, whether views follow each other or not.
    Raises:
        ConfigError: an unknown output or format, a format that suits no output, or an output that no format suits.
        SpectrumError: a wavelength outside the bands.
    """
    known = [output.name for output in scene.outputs]
    if not outputs:
        usual = ("rgb",) if is_path else _DEFAULT_STILLS
        outputs = [name for name in usual if name in known] or known
    names = dict.fromkeys(one for name in outputs for one in (known if name == "all" else [name]))
    chosen = [scene.output(name) for name in names]
    wanted: list[_Format] = [_format(name) for name in dict.fromkeys(formats)]
    if "tif" in wanted:
        _require_tifffile()
    owners: dict[str, str] = {}
    for output in chosen:
        owner = owners.setdefault(file_name(output).casefold(), output.name)
        if owner != output.name:
            raise ConfigError(
                f"the outputs {owner} and {output.name} would have the same files; ask for one of them"
            )
    found: list[FormattedOutput] = []
    for output in chosen:
        # Linear light is for other programs, but a composite of bands is for people.
        is_composite = output.kind == "linear" and ":" in output.name
        possible = _COMPOSITE if is_composite else _BY_KIND[output.kind]
        able = (*possible.suited, "tif")  # numbers of any kind
        suited: tuple[_Format, ...] = tuple(one for one in wanted if one in able)
        if wanted and not suited:
            reason = _REASONS.get((output.kind, wanted[0]), "the format does not suit it")
            raise ConfigError(
                f"{output.name} can't be written as {' or '.join(wanted)}: {reason}. "
                f"Formats for {output.name}: {', '.join(able)}"
            )
        usual = possible.moving if is_path else possible.stills
        found += [FormattedOutput(output, one) for one in suited or usual]
    for one in wanted:
        if all(formatted.format != one for formatted in found):
            raise ConfigError(
                f"--formats {one} suits none of the outputs asked for: {' or '.join(owners.values())}"
            )
    return tuple(found)


def with_units(outputs: Sequence[FormattedOutput], info: MapInfo | None) -> tuple[FormattedOutput, ...]:
    """The outputs of a map, whose lengths are metres as its coordinates are, or of other views."""
    if info is None or not info.is_metric:
        return tuple(outputs)
    return tuple(
        one._replace(output=replace(one.output, unit=METRES)) if one.output.unit == WORLD_UNITS else one
        for one in outputs
    )


def _require_tifffile() -> Any:
    """tifffile, which only captures need otherwise."""
    try:
        return importlib.import_module("tifffile")
    except ImportError as error:
        raise ConfigError(
            "--formats tif needs tifffile: python -m pip install tifffile imagecodecs"
        ) from error


def _format(name: str) -> _Format:
    if name in _FORMATS:
        return name
    hint = did_you_mean(name, _FORMATS, likeness=0.5, form=" ({})")
    raise ConfigError(f"there is no format {name!r}{hint}; known are {', '.join(_FORMATS)}")


_SWEEP_SECONDS, _SWEEP_FPS = 6.0, (4.0, 24.0)


@dataclass(frozen=True)
class Rows:
    """Some rows of a view."""

    first: int
    """Row of the first of them."""
    values: dict[str, np.ndarray]
    """Numbers by output, (h, W, ...) float32, ids uint8: of outputs in formats that hold numbers."""
    painted: dict[str, PictureValues]
    """By output: what pictures are painted from."""
    opacity: np.ndarray
    """(h, W) float32, [0, 1]."""
    coverage: np.ndarray
    """(h, W) float32, [0, 1]: how much of each pixel shows something, a sky included."""


def is_painted(formatted: FormattedOutput) -> bool:
    """Whether a file shows colours rather than numbers: PNG of ids has numbers, with a palette."""
    return formatted.format == "mp4" or (formatted.format == "png" and formatted.output.kind != "labels")


RowsSink: TypeAlias = Callable[[Rows], None]
"""Takes the rows of a view from the top down."""


@dataclass(frozen=True)
class RenderSetting:
    """What all files of a render share."""

    folder: Path
    """Where they go."""
    size: tuple[int, int]
    """Width and height of a view in pixels."""
    ranges: dict[str, tuple[float, float]]
    """Values at the ends of the colours of outputs whose range only the views tell, by output."""
    bands: dict[str, Bands]
    """Of each output whose channels are bands."""
    channels: dict[str, tuple[str, ...]]
    """Names of the channels of each output that has several."""
    frames_per_second: float | None = None
    """Of sweeps; None: so that they take about six seconds."""
    map_info: MapInfo | None = None
    """Where a map lies."""
    label: str = ""
    """Of what the numbers are, in ENVI and EXR files; empty: the output's name."""
    look: Look = Look()
    """How pictures show it."""

    def described(self, output: Output) -> str:
        """What the numbers of a file are."""
        return f"{self.label or output.name}: {output.what}"


def still_paths(folder: Path, formatted: FormattedOutput, view_name: str) -> list[Path]:
    """Files of an output of one view."""
    base = folder / file_name(formatted.output) / view_name
    if formatted.format == "envi":
        return envi_cube_paths(base)
    return [base.with_name(f"{view_name}.{formatted.format}")]


def video_path(folder: Path, formatted: FormattedOutput) -> Path:
    """File of an output of all views."""
    return folder / f"{file_name(formatted.output)}.{formatted.format}"


def still(path: Path, formatted: FormattedOutput, setting: RenderSetting) -> AbstractContextManager[RowsSink]:
    """Context that gives a sink for the rows of one view; at its end the file is there; of ENVI's two, the header."""
    files = {"npy": _npy, "envi": _envi, "exr": _exr, "png": _png, "mp4": _sweep, "tif": _tif}
    return files[formatted.format](formatted.output, path, setting)


def video(
    formatted: FormattedOutput, setting: RenderSetting, frames_per_second: float
) -> AbstractContextManager[FrameSink]:
    """Context that gives a sink for the frames of an output of all views; raises as `still` does."""
    size = _layout(formatted.output, setting).size
    return video_frames(video_path(setting.folder, formatted), *size, frames_per_second)


@contextmanager
def frame(output: Output, progress: float, setting: RenderSetting, add: FrameSink) -> Iterator[RowsSink]:
    """Context that gives a sink for the rows of one view; at its end they are a frame, which the video `add` gets.

    Of spectra one band is shown: a video goes through the bands by its `progress`, in [0, 1].
    """
    if output.kind == "channels":
        names = setting.channels[output.name]
        band = round(progress * (len(names) - 1))
        canvas = Canvas(_layout(output, setting), 3, [names[band]])
        yield lambda rows: canvas.put(rows.first, _band_tile(rows.painted[output.name], band, setting.look))
    else:
        canvas, put = _picture(output, setting, is_opaque=True)
        yield put
    add(canvas.pixels)


_BAND = Output("band", "grey", "one band", "light of one band")


def _band_tile(channels: PictureValues, band: int, look: Look) -> UInt8[np.ndarray, "h W 1 3"]:
    """One band of a spectrum on black as grey."""
    painted = paint(_BAND, channels.values[..., band], channels.opacity, look=replace(look, colour_map=None))
    return as_bytes(painted.over(background_of(look)))


def _picture(output: Output, setting: RenderSetting, *, is_opaque: bool) -> tuple[Canvas, RowsSink]:
    """A canvas, and a sink that paints rows on it, opaque or with opacity."""
    look, captions, swatches = setting.look, (), ()
    if output.kind == "shares" and not look.mixed:
        captions = setting.channels[output.name]
        swatches = [colour for _, colour in output.classes]
    canvas = Canvas(_layout(output, setting), 3 if is_opaque else 4, captions, swatches)

    def put(rows: Rows) -> None:
        given = rows.painted[output.name]
        painted = paint(given.output, given.values, given.opacity, setting.ranges.get(output.name), look)
        canvas.put(rows.first, as_bytes(painted.over(background_of(look))) if is_opaque else painted.rgba())

    return canvas, put


def _layout(output: Output, setting: RenderSetting) -> CanvasLayout:
    """One tile, or one for each share under its name; of spectra, one band at a time under its wavelength."""
    if output.kind not in ("channels", "shares") or (output.kind == "shares" and setting.look.mixed):
        return CanvasLayout.of(setting.size)
    count = 1 if output.kind == "channels" else None
    return CanvasLayout.of(setting.size, setting.channels[output.name], count)


def _whole(output: Output, setting: RenderSetting) -> tuple[RowsSink, np.ndarray, np.ndarray]:
    """A sink that keeps all rows; what it keeps, a plane (H, W) a channel; and how much of each pixel is filled."""
    width, height = setting.size
    count = len(setting.channels.get(output.name, (output.name,)))
    planes = np.zeros((count, height, width), dtype=np.uint8 if output.kind == "labels" else np.float32)
    filled = np.zeros((height, width), dtype=np.float32)

    def add(rows: Rows) -> None:
        values = rows.values[output.name].reshape(-1, width, count)
        place = slice(rows.first, rows.first + len(values))
        planes[:, place] = np.moveaxis(values, -1, 0)
        filled[place] = rows.coverage if output.kind in LIGHT_KINDS | {"channels"} else rows.opacity

    return add, planes, filled


@contextmanager
def _npy(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    width, height = setting.size
    names = setting.channels.get(output.name)
    shape = (height, width) if names is None else (height, width, len(names))
    with npy_rows(path, shape, np.uint8 if output.kind == "labels" else np.float32) as add:
        yield lambda rows: add(rows.values[output.name])


@contextmanager
def _envi(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    width, height = setting.size
    names = setting.channels.get(output.name, (output.name,))
    shape = (height, width, len(names))
    bands = setting.bands.get(output.name)
    description = setting.described(output)
    more = {} if setting.map_info is None else dict(setting.map_info.envi)
    if output.nothing is not None:
        more["data ignore value"] = output.nothing
    if bands is None and output.centers_nm:
        # In the order of the channels, which for a false colour is seldom that of bands.
        more |= {"wavelength units": "Nanometers", "wavelength": output.centers_nm}
    with envi_cube_rows(path.with_suffix(""), shape, bands, list(names), description, more) as add:
        yield lambda rows: add(rows.values[output.name].reshape(-1, *shape[1:]))


@contextmanager
def _tif(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    """Numbers as TIFF, a band after the other under its name; of a map as GeoTIFF."""
    add, planes, _ = _whole(output, setting)
    yield add
    buffer, info = io.BytesIO(), setting.map_info
    tags = [] if info is None else info.geotiff
    if output.nothing is not None:
        tags.append((_GDAL_NODATA, 2, len(str(output.nothing)) + 1, str(output.nothing), True))
    names = list(setting.channels.get(output.name, (output.name,)))
    # Centre of each channel, nm, where each is one band, and the widths where they are known.
    bands = setting.bands.get(output.name)
    centers_nm = output.centers_nm if bands is None else bands.centers_nm.tolist()
    fwhm_nm = () if bands is None or bands.fwhm_nm is None else bands.fwhm_nm.tolist()
    tags.append(gdal_metadata(names, centers_nm, fwhm_nm))
    # Which band is red, green and blue; or the colour of each id.
    kinds: dict[OutputKind, str] = {
        **dict.fromkeys(("srgb", "linear", "picture"), "rgb"),
        "labels": "palette",
    }
    palette = None
    if output.kind == "labels":
        palette = np.round(65535 * id_palette(class_colours(output)).T).astype(np.uint16)
    with _require_tifffile().TiffWriter(buffer, bigtiff=planes.nbytes > _LARGEST_TIFF) as writer:
        writer.write(
            planes,
            photometric=kinds.get(output.kind, "minisblack"),
            colormap=palette,
            planarconfig="separate" if len(names) > 1 else None,
            compression="zlib",
            description=json.dumps({"output": output.name, "what": output.what, "bands": names}),
            metadata=None,
            extratags=tags,
        )
    write_file(path, buffer.getvalue())


@contextmanager
def _exr(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    # One plane a channel, as the format wants them: nothing is copied when the file is written.
    add, planes, opacity = _whole(output, setting)
    yield add
    comments = setting.described(output)
    bands = setting.bands.get(output.name)
    if output.kind == "channels" and bands is not None:
        to_rgb = rgb_matrix(bands).numpy()
        rows = (np.clip(row, 0, None).T @ to_rgb for row in planes.swapaxes(0, 1))
        preview = np.stack([np.clip(row, 0, 1) for row in rows])
        spectra = np.moveaxis(planes, 0, -1)
        write_spectral_exr(path, spectra, bands, preview, opacity, comments, output.quantity or "radiance")
        return
    pixels = dict(zip(_exr_names(output, setting), planes, strict=True))
    write_exr(path, {**pixels, "A": opacity} if output.kind == "linear" else pixels, {"comments": comments})


def _exr_names(output: Output, setting: RenderSetting) -> list[str]:
    """Channels, in OpenEXR's terms where it has some."""
    if output.kind == "linear":
        return ["R", "G", "B"]
    if output.kind == "vectors":
        return [f"{file_name(output)}.{axis}" for axis in "XYZ"]
    if output.name in setting.channels:
        return layer_names(file_name(output), setting.channels[output.name])
    return ["Z" if output.name == "depth" else file_name(output).replace(".", "_")]


@contextmanager
def _png(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    about = describe(output, setting.ranges.get(output.name), setting.look)
    if output.kind == "labels":
        add, planes, _ = _whole(output, setting)
        yield add
        data = indexed_png_bytes(planes[0], id_palette(class_colours(output)), NOTHING_ID, about)
    else:
        canvas, put = _picture(output, setting, is_opaque=setting.look.background is not None)
        yield put
        data = rgba_png_bytes(canvas.pixels, about)
    write_file(path, data)


@contextmanager
def _sweep(output: Output, path: Path, setting: RenderSetting) -> Iterator[RowsSink]:
    """Band after band of one view."""
    rows_kept: list[Rows] = []
    yield rows_kept.append
    names, layout = setting.channels[output.name], _layout(output, setting)
    usual = float(np.clip(len(names) / _SWEEP_SECONDS, *_SWEEP_FPS))
    with video_frames(path, *layout.size, setting.frames_per_second or usual) as show:
        for band, name in enumerate(names):
            canvas = Canvas(layout, 3, [name])
            for rows in rows_kept:
                canvas.put(rows.first, _band_tile(rows.painted[output.name], band, setting.look))
            show(canvas.pixels)
