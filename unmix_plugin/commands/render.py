"""`unmix-render --run PATH`: views of a trained run from any camera as files, from the run folder alone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.engine.printing import tell
from unmix_plugin.errors import ConfigError, counted
from unmix_plugin.products.render import RenderOptions

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.processes import Processes
    from unmix_plugin.figures.look import Look
    from unmix_plugin.products.render.cameras import RenderCameras
    from unmix_plugin.products.render.files import FormattedOutput
    from unmix_plugin.products.render.job import Survey
    from unmix_plugin.trained.open_run import LoadedRun


def render(argv: list[str]) -> None:
    """Parse the arguments, render each view, list the files."""
    options = tyro.cli(RenderOptions, prog="unmix-render", args=argv)
    options.asked_size()  # refused before processes start and the run is read
    options.asked_look()

    from unmix_plugin.engine.processes import joined, start_together

    start_together("unmix_plugin.commands.render", argv, options.num_devices)
    with joined(options.device) as processes:
        _render_run(options, processes)


def _render_run(options: RenderOptions, processes: Processes) -> None:
    from unmix_plugin.commands.reporting import CommandConsole, chosen_run, say, working
    from unmix_plugin.editing.edited_run import load_edited_run
    from unmix_plugin.products.render.cameras import choose_cameras
    from unmix_plugin.products.render.files import choose_formats, with_units

    console = CommandConsole(quiet=not processes.is_first)
    with processes.together():
        path = chosen_run(options.run, options.output_dir)
        with working(console, f"reading {path}"):
            loaded = load_edited_run(path, options.device, options.edits, options.illuminant, options.sensor)
            loaded = _relit(loaded, options)
            cameras = choose_cameras(loaded.scene, options, loaded.scale)
        for line in loaded.scene.notes:
            say(console, line)
        own = {view.name: view.camera.size(0) for view in loaded.scene.views}
        if len({own[view.name] for view in cameras.views if view.name in own}) > 1:
            say(
                console,
                "the scene's views have several sizes; pictures of a render have one, and each view keeps its vertical "
                "field of view: products of unmix-export keep the size of each view",
            )
        outputs = choose_formats(options.outputs, options.formats, loaded.scene, cameras.is_path)
        outputs = with_units(outputs, cameras.map_info)
        formats = {one.format for one in outputs}
        if options.fps is not None and not cameras.is_path and "mp4" not in formats:
            raise ConfigError(
                "--fps is for videos, and none is asked for; add mp4 to --formats, or leave it out"
            )
        has_place = cameras.map_info is None or cameras.map_info.has_coordinates
        if not has_place and formats & {"envi", "tif"}:
            say(
                console,
                f"--cameras {options.cameras}: files have no map coordinates, which would mirror or misplace the map",
            )
    _render(options, loaded, cameras, outputs, console, processes)


def _relit(loaded: LoadedRun, options: RenderOptions) -> LoadedRun:
    """The run in the environment asked for."""
    from dataclasses import replace

    from unmix_plugin.trained.model_scene import LightChoice, relit

    choice = LightChoice(options.environment, options.environment_rotation, options.environment_exposure)
    if choice == LightChoice():
        return loaded
    numbers = {"--environment-rotation": choice.rotation_deg, "--environment-exposure": choice.exposure_stops}
    for flag, value in numbers.items():
        if not math.isfinite(value):
            raise ConfigError(f"{flag} is {value:g}; give a finite number")
    return replace(loaded, scene=relit(loaded.scene, choice, loaded.config.method_name))


def _render(
    options: RenderOptions,
    loaded: LoadedRun,
    cameras: RenderCameras,
    outputs: tuple[FormattedOutput, ...],
    console: Console,
    processes: Processes,
) -> None:
    """Render block by block, then list what was written."""
    from unmix_plugin.commands.reporting import follow, say, working
    from unmix_plugin.figures.paint import legend_of
    from unmix_plugin.formats.files import refuse_to_overwrite, safe_name, write_file
    from unmix_plugin.products.render.files import file_name, needs_legend
    from unmix_plugin.products.render.job import RenderJob, Survey, needs_survey, output_paths, take_survey
    from unmix_plugin.products.render.pictures import draw_legend, legend_csv
    from unmix_plugin.trained.camera_files import camera_file_bytes

    scene, asked = loaded.scene, dict.fromkeys(one.output for one in outputs)
    folder = (options.output or loaded.folder.exports / "render").resolve()
    legends = {
        folder / f"{file_name(one.output)}_legend.png": one.output
        for one in outputs
        if needs_legend(one, scene)
    }
    tables = {
        folder / f"{file_name(output)}_legend.csv": output
        for output in asked
        if output.classes and output.kind == "labels"
    }
    camera_files: dict[Path, bytes] = {}
    if cameras.map_info is None:  # which no camera file can hold
        frames_per_second = (cameras.frames_per_second or 24.0) if cameras.is_path else None
        name = safe_name(f"cameras-{Path(options.cameras).stem}")
        data = camera_file_bytes(cameras.views, frames_per_second, scene.frame)
        camera_files[folder / f"{name}.json"] = data
    paths = [path for one in outputs for path in output_paths(folder, one, cameras)]
    paths += [*legends, *tables]
    paths += [path for path, data in camera_files.items() if not path.is_file() or path.read_bytes() != data]
    with processes.together():
        if processes.is_first:
            refuse_to_overwrite(paths, options.overwrite)
            # First, so that a folder that can't be written is noticed early.
            for path, data in camera_files.items():
                write_file(path, data)
    names, (width, height) = dict.fromkeys(output.name for output in asked), cameras.size
    say(
        console,
        f"{counted(len(cameras.views), 'view')} of {width} x {height} pixels: {', '.join(names)}",
    )
    survey = Survey()
    with processes.together():
        if needs_survey(asked, options.asked_look()):
            with working(console, "looking at all views for what their pictures share"):
                survey = take_survey(scene, cameras.views, asked, cameras.map_info, options.asked_look())
    job = RenderJob(scene, cameras, outputs, survey, folder, processes, options.asked_look())
    job.render(follow(console, "rendering", job.blocks()))
    if not processes.is_first:
        return
    for path, output in legends.items():
        write_file(
            path, draw_legend(output, legend_of(output, survey.ranges.get(output.name), options.asked_look()))
        )
    for path, output in tables.items():
        write_file(path, legend_csv(output.classes))
    _list(folder, outputs, cameras, survey, options.asked_look())
    for path in (*legends, *tables):
        tell(f"{path}  what the colours mean")
    for path in camera_files:
        tell(f"{path}  the cameras, to be given to --cameras again")


def _list(
    folder: Path,
    outputs: tuple[FormattedOutput, ...],
    cameras: RenderCameras,
    survey: Survey,
    look: Look,
) -> None:
    """A line for each output and format: where, how many, what."""
    from unmix_plugin.figures.paint import describe
    from unmix_plugin.products.render.job import is_video_of_all, output_paths

    for one in outputs:
        paths = output_paths(folder, one, cameras)
        is_picture = one.format in ("png", "mp4")
        what = one.output.what
        if is_picture and one.output.kind != "channels":
            given = survey.ranges.get(one.output.name)
            what = describe(one.output, given, look, is_opaque=one.format == "mp4")
        if is_video_of_all(one, cameras):
            tell(f"{paths[0]}  {counted(len(cameras.views), 'frame')}; {what}")
        elif len(paths) == 1:
            tell(f"{paths[0]}  {what}")
        else:
            suffixes = " and ".join(dict.fromkeys(f"*{path.suffix}" for path in paths))
            tell(f"{paths[0].parent}  {len(paths)} files {suffixes}; {what}")


if __name__ == "__main__":  # of one of several processes
    run_command(render)
