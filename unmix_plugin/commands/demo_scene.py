"""`unmix-demo-scene DIR`: write the built-in scene as a folder of any size, or as an instrument would (`--raw`)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from unmix_plugin.engine.printing import tell
from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class _DemoSceneOptions:
    """Write a small ray-traced scene with true labels, abundances and endmembers."""

    directory: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder to write; made if it is not there."""
    raw: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write what an instrument would have written instead: raw counts as ENVI cubes, a white reference, a dark frame,
    and no poses; for unmix-process."""
    lines: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """As --raw, as scans of a line camera on a linear stage and on an arm that goes around, with tables of what the
    stages did; for unmix-process lines."""
    markers: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """With --raw: lay a board of printed markers around the plate, for --poses markers of unmix-process."""
    size: int | None = None
    """Width and height of every image, pixels; 96, 400 with --raw, 160 with --lines."""
    bands: int | None = None
    """Bands, evenly spaced over 400-700 nm; 31."""
    views: int | None = None
    """Images on a dome, every 4th for evaluation; 32, or 40 with --raw. Scans, every 4th from the arm; 24."""
    illuminant: str | None = None
    """What lights the scene: a CIE illuminant (D50, D65, A, E, FL2, ...) or a .csv file (wavelength,power); D50, or A
    with --raw and --lines."""
    place: Literal["table", "world", "room"] = "table"
    """What is around the table: nothing, so that images have alpha; a ground that runs to the horizon under a sky;
    or a room with windows onto the same world, seen as by a phone held by hand."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Accept a folder that is not empty: a demo scene in it is replaced, other files stay."""


def write_demo_scene(arguments: list[str]) -> None:
    """Parse the arguments, write the scene or the capture, say what is where."""
    options = tyro.cli(_DemoSceneOptions, prog="unmix-demo-scene", args=arguments)
    if options.raw and options.lines:
        raise ConfigError("--raw writes pictures and --lines writes scans; give one of them")
    flag = "--raw" if options.raw else "--lines"
    if (options.raw or options.lines) and options.place != "table":
        raise ConfigError(
            f"{flag} writes the table alone, not --place {options.place}; leave one of them out"
        )
    if options.markers and not options.raw:
        raise ConfigError("--markers is for what an instrument would have written; give --raw too")
    if options.raw:
        _write_capture(options)
    elif options.lines:
        _write_scans(options)
    else:
        _write_scene(options)


def _write_scene(options: _DemoSceneOptions) -> None:
    from unmix_plugin.commands.reporting import shell_line
    from unmix_plugin.scenes.demo.scene import (
        DEFAULT_BANDS,
        DEFAULT_SIZE,
        DEFAULT_VIEWS,
        PLACES,
        make_demo_scene,
    )
    from unmix_plugin.scenes.demo.shading import LAMP
    from unmix_plugin.spectral.colour.conversion import parse_light

    folder, place, started = options.directory, PLACES[options.place], time.perf_counter()
    size, bands, views = _numbers(options, (DEFAULT_SIZE, DEFAULT_BANDS, DEFAULT_VIEWS))
    light = parse_light(options.illuminant or LAMP)
    make_demo_scene(folder, size, bands, views, options.overwrite, light, place)
    evaluation = len(list((folder / "abundances").glob("eval_*")))
    tell(
        f"{folder}: {views} views ({views - evaluation} to train on, {evaluation} for evaluation) of {size} x {size} "
        f"pixels and {bands} bands, in {time.perf_counter() - started:.1f} s"
    )
    for name, content in (
        ("transforms.json", "cameras, wavelengths, splits"),
        ("cubes", "radiance in [0, 1], float16 (H, W, B)"),
        ("images", "sRGB with alpha" if place.sky is None else "sRGB"),
        ("labels", "true material of each pixel, 255 where there is none"),
        ("abundances", "true abundances of evaluation views, float16 (H, W, K)"),
        ("endmembers.csv", "true reflectances"),
        ("illuminant.csv", "the lamp's spectrum"),
    ):
        tell(f"  {folder / name}  {content}")
    tell(f"train on it: {shell_line('unmix-train', 'unmix-nerf', '--data', folder)}")


def _write_capture(options: _DemoSceneOptions) -> None:
    from unmix_plugin.captures.demo import (
        MARKER_FAMILY,
        MARKER_SIZE,
        POSES,
        RAW_BANDS,
        RAW_LAMP,
        RAW_SIZE,
        RAW_VIEWS,
        make_demo_capture,
        marked_place,
    )
    from unmix_plugin.commands.reporting import CommandConsole, follow, shell_line
    from unmix_plugin.spectral.colour.conversion import parse_light

    folder, started = options.directory, time.perf_counter()
    size, bands, views = _numbers(options, (RAW_SIZE, RAW_BANDS, RAW_VIEWS))
    light = parse_light(options.illuminant or RAW_LAMP)
    place = marked_place() if options.markers else None
    shown = partial(follow, CommandConsole())
    make_demo_capture(folder, size, bands, views, options.overwrite, light, place, follow=shown)
    tell(
        f"{folder}: {views} raw views of {size} x {size} pixels and {bands} bands, 3 of them bad, in "
        f"{time.perf_counter() - started:.1f} s"
    )
    for name, content in (
        ("view_000.hdr", "and .raw, the first view: counts, uint16, ENVI bil"),
        ("white.hdr", "white reference"),
        ("dark.hdr", "dark frame"),
        (POSES, "where the cameras were, to compare with poses that were estimated"),
        ("truth", "true materials of each pixel and their reflectances, the lamp's spectrum"),
    ):
        tell(f"  {folder / name}  {content}")
    words = ["unmix-process", "cubes", "--data", folder, "--output-dir", "SCENE"]
    words += ["--white", folder / "white.hdr", "--dark", folder / "dark.hdr", "--poses"]
    marked = ["markers", "--marker-size", MARKER_SIZE, "--marker-family", MARKER_FAMILY]
    tell(f"make a scene of it: {shell_line(*words, *(marked if options.markers else ['estimate']))}")


def _write_scans(options: _DemoSceneOptions) -> None:
    from unmix_plugin.captures.demo import (
        FIELD_OF_VIEW_DEG,
        LINE_POSES,
        LINE_SCANS,
        LINE_SIZE,
        RAW_BANDS,
        RAW_LAMP,
        SCANNED,
        STAGES,
        STAGES_FILE,
        make_demo_capture,
    )
    from unmix_plugin.commands.reporting import CommandConsole, follow, shell_line
    from unmix_plugin.spectral.colour.conversion import parse_light

    folder, started = options.directory, time.perf_counter()
    size, bands, scans = _numbers(options, (LINE_SIZE, RAW_BANDS, LINE_SCANS))
    make_demo_capture(
        folder,
        size,
        bands,
        scans,
        options.overwrite,
        illuminant=parse_light(options.illuminant or RAW_LAMP),
        place=SCANNED,
        poses=STAGES_FILE,
        follow=partial(follow, CommandConsole()),
    )
    tell(
        f"{folder}: {scans} raw scans of {size} lines, {size} columns and {bands} bands, 3 of them bad, in "
        f"{time.perf_counter() - started:.1f} s"
    )
    for name, content in (
        ("view_000.hdr", "and .raw, the first scan: counts, uint16, ENVI bil"),
        ("white.hdr", "white reference"),
        ("dark.hdr", "dark frame"),
        (STAGES, "a row a scan: where the camera began, and what the linear stage or the arm did"),
        (LINE_POSES, "the same as a pose a line"),
        ("truth", "true materials of each pixel and their reflectances, the lamp's spectrum"),
    ):
        tell(f"  {folder / name}  {content}")
    words = ["unmix-process", "lines", "--data", folder, "--output-dir", "SCENE"]
    words += ["--white", folder / "white.hdr", "--dark", folder / "dark.hdr"]
    words += ["--poses", folder / STAGES, "--field-of-view", f"{FIELD_OF_VIEW_DEG:g}"]
    tell(f"make a scene of it: {shell_line(*words)}")


def _numbers(options: _DemoSceneOptions, defaults: tuple[int, int, int]) -> tuple[int, ...]:
    """Size, bands and views, as asked, or the defaults."""
    asked = (options.size, options.bands, options.views)
    return tuple(default if value is None else value for value, default in zip(asked, defaults, strict=True))
