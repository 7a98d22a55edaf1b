"""What a user asks of `unmix-process`. Imported for `--help` too, so nothing heavy is imported here."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from unmix_plugin.captures.cube import Axes, Capture, ReadOptions
from unmix_plugin.captures.poses.estimation import require_pycolmap
from unmix_plugin.captures.poses.marker_detection import parse_family, require_opencv
from unmix_plugin.captures.poses.turntable_observations import parse_angles
from unmix_plugin.engine.configs import short_flag
from unmix_plugin.errors import CaptureError, ConfigError, did_you_mean

_LAYOUTS = {
    "cubes": "cubes:find_cubes",
    "nespof": "transforms:find_nespof",
    "nespof-real": "transforms:find_nespof_real",
    "unmix-nerf": "transforms:find_unmix_nerf",
    "nerfstudio": "transforms:find_nerfstudio",
    "rig": "rig:find_rig",
    "lines": "cubes:find_lines",
}
"""Module of layouts/, and the function in it that makes a `Capture` of a folder, imported when it is used."""

LAYOUTS = tuple(_LAYOUTS)
GONE_LAYOUTS = {
    "hs-nerf": "save its .pt tensors as .npy (numpy.save), name these in transforms.json and take the layout unmix-nerf"
}
"""Layouts that earlier versions had, and what to do."""

FROM_PICTURES = ESTIMATE, MARKERS, TURNTABLE = "estimate", "markers", "turntable"
"""Words of --poses that ask to find poses instead of reading them."""
LINES = "lines"
"""The layout of line cameras, whose poses are those of lines."""
_MARKER_SIZES_M = (0.0005, 20.0)

MaskKind = Literal["auto", "files", "white", "black", "none"]


@dataclass(frozen=True)
class ProcessOptions:
    """Turn what an instrument wrote into a scene to train on."""

    layout: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="{" + ",".join(LAYOUTS) + "}")]
    """How the files of the capture are laid out."""
    data: Path
    """Folder of the capture."""
    output_dir: Annotated[Path, short_flag("output")]
    """Folder to write the scene to; it appears when the scene is complete."""
    poses: str | None = None
    """Where the cameras were: a file or folder of another program (transforms.json, COLMAP, Metashape, ...); or found
    in the images, by structure from motion (`estimate`), printed markers (`markers`) or the angles of a turned object
    (`turntable`); without it, the poses of the layout. Of `lines`, a table with the pose of each line or with a row a
    scan and what its stage did."""
    field_of_view: float | None = None
    """Of the layout `lines`: degrees that a line spans, from the first column to the last."""
    line_rate: float | None = None
    """Of the layout `lines`: lines a second, where tables need them; without it, as the files say."""
    camera_axes: Literal["opengl", "opencv"] = "opengl"
    """Of the layout `lines`: axes of the camera that rotations in its tables have: OpenGL's (+y up, it looks along -z)
    or OpenCV's (+y down, it looks along +z)."""
    marker_size: float | None = None
    """Side of a printed marker, metres: gives scale and upright to poses that are found in the images."""
    marker_family: str | None = None
    """OpenCV's name of the markers, such as DICT_4X4_50 or DICT_APRILTAG_36H11; without it, the one that is found."""
    known_distance: Annotated[
        tuple[str, str, str, str, float] | None,
        tyro.conf.arg(metavar="VIEW:C,R VIEW:C,R VIEW:C,R VIEW:C,R METRES"),
    ] = None
    """Gives the scale: two points, each by its pixels in two views (VIEW:column,row in the files, from 0), and the
    metres between them."""
    angles: Annotated[str | None, tyro.conf.arg(metavar="SPEC")] = None
    """By which the object was turned in each view, for `--poses turntable`: START:STOP:STEP in degrees (0:360:10), one
    for each place of the camera, with commas between; or a CSV file with the columns view, angle and, if there were
    several places, camera."""
    wavelengths: str | None = None
    """Band centres in nm for files that don't name them: a CSV file with a column `wavelength` (`fwhm` beside has
    the widths, `bbl` 0 for bad bands), or a list such as 620,555,503."""
    dataset: str | None = None
    """Data set to take from HDF5, NetCDF and MATLAB files that hold several."""
    axes: Axes | None = None
    """Order of the axes in files that don't fix it, the slowest first: y rows, x columns, b bands."""
    mosaic: Annotated[str | None, tyro.conf.arg(metavar="ROWSxCOLUMNS")] = None
    """Images of one band are raw frames of a camera with a mosaic of filters, such as 4x4 or 5x5: each pixel of a block
    is a band, row by row, in the order of --wavelengths."""
    dark: Path | None = None
    """Dark frame: an image taken with the shutter closed."""
    white: Path | None = None
    """White reference: an image of a white panel; cubes become reflectances."""
    white_rectangle: Annotated[
        tuple[str, int, int, int, int] | None, tyro.conf.arg(metavar="VIEW ROW COLUMN HEIGHT WIDTH")
    ] = None
    """The white reference is a panel in a view, or in the views of a shot of a rig: its first row and column, height
    and width in pixels."""
    white_reflectance: str = "1"
    """Reflectance of the white panel: a number, or a CSV file (wavelength,reflectance)."""
    mask: MaskKind = "auto"
    """What separates foreground from background: pictures of the capture (files), a white or a black background, or
    nothing (none); auto takes the alpha channel of the capture's pictures where they have one, otherwise a plain
    backdrop that all views show, if there is one."""
    drop_bands: str | None = None
    """Bands to leave out, as wavelengths and ranges in nm: 1350-1450,1900."""
    max_noise: float = 0.5
    """Bands whose noise is above this share of their signal are left out."""
    crop: Annotated[tuple[int, int, int, int] | None, tyro.conf.arg(metavar="ROW COLUMN HEIGHT WIDTH")] = None
    """Keep this rectangle of every view, in pixels of the files."""
    bin_pixels: int = 1
    """Average squares of this many pixels a side."""
    bin_bands: int = 1
    """Average this many neighbouring bands."""
    saturation: float | None = None
    """Stored number from which a pixel is saturated; without it, found from the values."""
    scale: float | None = None
    """Calibrated value that is written as 1; without it, found from the values."""
    leave_out: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Views to leave out, by name."""
    keep_view: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Views to keep although they look spoilt: black, overexposed, blurred, with another view's pose."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace a scene that this command made in the output folder."""

    @property
    def paths_read(self) -> list[tuple[str, Path]]:
        """What is named that is there and is read, each with its flag."""
        texts = {
            "--poses": self.poses,
            "--angles": self.angles,
            "--wavelengths": self.wavelengths,
            "--white-reflectance": self.white_reflectance,
        }
        named = [("--data", self.data), ("--dark", self.dark), ("--white", self.white)]
        named += [(flag, Path(text)) for flag, text in texts.items() if text is not None]
        named += [] if self.poses is None else [("--poses", self.data / self.poses)]
        return [(flag, path) for flag, path in named if path is not None and os.path.lexists(path)]


def check_options(options: ProcessOptions) -> None:
    """Refuse what no capture makes right. Raises ConfigError: a layout that is none, options that don't go together, or
    a number out of its range."""
    if options.layout in GONE_LAYOUTS:
        raise ConfigError(f"the layout '{options.layout}' is no longer read: {GONE_LAYOUTS[options.layout]}")
    if options.layout not in LAYOUTS:
        raise ConfigError(
            f"'{options.layout}' is not a layout; expected one of {', '.join(LAYOUTS)}"
            + did_you_mean(options.layout, LAYOUTS, form="; {}")
        )
    if options.white is not None and options.white_rectangle is not None:
        raise ConfigError("--white and --white-rectangle both name a white reference; give one of them")
    if options.white_reflectance != "1" and options.white is None and options.white_rectangle is None:
        raise ConfigError("--white-reflectance needs a white reference: --white or --white-rectangle")
    for name, number in (("--bin-pixels", options.bin_pixels), ("--bin-bands", options.bin_bands)):
        if number < 1:
            raise ConfigError(f"{name} {number}: expected 1 or more")
    if options.saturation is not None and not 0 < options.saturation < float("inf"):
        raise ConfigError(f"--saturation {options.saturation:g}: expected a stored number above 0")
    if not options.max_noise > 0:
        raise ConfigError(f"--max-noise {options.max_noise:g}: expected a share above 0")


def check_pose_options(options: ProcessOptions, names: Sequence[str]) -> None:
    """Refuse what does not go together in finding poses, before anything is computed.

    Args:
        names: Of all views.
    Raises:
        ConfigError: an option is wrong, or asks for what this way of finding poses does not use.
        CaptureError: a library that is needed is not installed.
    """
    if options.layout != LINES:
        if (options.field_of_view, options.line_rate, options.camera_axes) != (None, None, "opengl"):
            raise ConfigError(f"--field-of-view, --line-rate and --camera-axes go with the layout '{LINES}'")
    elif options.poses in FROM_PICTURES:
        raise ConfigError(
            f"--poses {options.poses} finds one pose a picture, while each line of a scan has its own; give a table"
        )
    elif options.known_distance is not None:
        raise ConfigError("--known-distance follows frame cameras alone; name the unit in the table: x (mm)")
    elif options.line_rate is not None and not 0 < options.line_rate < float("inf"):
        raise ConfigError(f"--line-rate {options.line_rate:g}: expected lines a second, above 0")
    for flag, value in (("--marker-size", options.marker_size), ("--marker-family", options.marker_family)):
        if value is not None and options.poses not in FROM_PICTURES:
            raise ConfigError(f"{flag} goes with --poses {', '.join(FROM_PICTURES)}; give one of them")
    if options.marker_family is not None and options.marker_size is None and options.poses != MARKERS:
        raise ConfigError("--marker-family needs --marker-size, the side of a marker in metres")
    low, high = _MARKER_SIZES_M
    if options.marker_size is not None and not low <= options.marker_size <= high:
        raise ConfigError(f"--marker-size {options.marker_size:g}: expected metres, {low} to {high:g}")
    if options.marker_family is not None:
        parse_family(options.marker_family)
    if (options.angles is None) == (options.poses == TURNTABLE):
        raise ConfigError(f"--poses {TURNTABLE} and --angles go together, such as --angles 0:360:10")
    if options.angles is not None:
        parse_angles(options.angles, names)
    if options.poses in (MARKERS, TURNTABLE) or options.marker_size is not None:
        require_opencv()
    if options.poses == ESTIMATE:
        require_pycolmap()


def parse_mosaic(text: str | None) -> tuple[int, int] | None:
    """Rows and columns of filters. Raises ConfigError: the text is not such as 4x4.

    >>> parse_mosaic("2x4")
    (2, 4)
    """
    if text is None:
        return None
    found = re.fullmatch(r"\s*(\d{1,2})\s*[xX×]\s*(\d{1,2})\s*", text)  # noqa: RUF001
    if found is None or not 1 < int(found[1]) * int(found[2]) <= 256 or min(int(found[1]), int(found[2])) < 1:
        raise ConfigError(f"--mosaic {text}: expected rows x columns of filters, such as 4x4")
    return int(found[1]), int(found[2])


def plain_options(options: ProcessOptions) -> dict[str, Any]:
    """Options as JSON-able values."""
    return {key: str(value) if isinstance(value, Path) else value for key, value in asdict(options).items()}


def find_views(layout: str, root: Path, options: ReadOptions) -> Capture:
    """The views of a capture in one of `LAYOUTS`. Raises CaptureError: there is no such folder, or the layout finds no
    views in it."""
    if not root.is_dir():
        found = "is a file" if root.is_file() else "is not there"
        raise CaptureError(f"{root} {found}; give the folder of the capture with --data")
    module, function = _LAYOUTS[layout].split(":")
    find: Callable[[Path, ReadOptions], Capture] = getattr(
        import_module(f"unmix_plugin.captures.layouts.{module}"), function
    )
    return find(root, options)
