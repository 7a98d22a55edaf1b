"""`unmix-eval [RUN ...]`: measure trained runs on their evaluation views, and compare several."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.engine.printing import tell
from unmix_plugin.errors import ConfigError, counted
from unmix_plugin.products.product import RunOptions, SharedViews

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console
    from rich.table import Table

    from unmix_plugin.engine.processes import Processes
    from unmix_plugin.engine.runs.loading import LoadedPipeline
    from unmix_plugin.products.comparison import ComparedRun
    from unmix_plugin.products.evaluation import Evaluated
    from unmix_plugin.trained.trained_scene import TrainedScene


@dataclass(frozen=True)
class _EvalOptions(SharedViews, RunOptions):
    """Measure a trained run on its evaluation views: metrics.json, a table, and prediction beside truth as pictures.

    They are written to `eval/` in the run folder, in place of an earlier evaluation; those of an edited run to a folder
    of its own in `exports/`. Several runs are compared: one table with the differences to the first, also as CSV by
    view and band, and their pictures one above the other, in `exports/comparison/` of the first.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run folders, as training printed them; none takes the newest under --output-dir."""
    run: Path | None = None
    """The same for one run."""
    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it."""
    edits: Path | None = None
    """Recipe (YAML) of edits to make first; the result is compared with the scene as it was measured."""
    illuminant: str | None = None
    """Light to see both in: D65, A, E, FL2, ... or a .csv file (wavelength,power); None: the scene's own."""


def evaluate(argv: list[str]) -> None:
    """Parse the arguments, render and measure each view, write and say what was found."""
    options = tyro.cli(_EvalOptions, prog="unmix-eval", args=argv)

    from unmix_plugin.engine.processes import joined, start_together

    start_together("unmix_plugin.commands.eval", argv, options.num_devices)
    with joined(options.device) as processes:
        _evaluate(options, processes)


def _evaluate(options: _EvalOptions, processes: Processes) -> None:
    from unmix_plugin.commands.reporting import CommandConsole, chosen_run, refuse_to_look
    from unmix_plugin.engine.runs.loading import load_config

    console = CommandConsole(quiet=not processes.is_first)
    with processes.together():
        if options.run is not None and options.runs:
            raise ConfigError("name runs either with --run or without it")
        if len({run.resolve() for run in options.runs}) < len(options.runs):
            raise ConfigError("a run is named twice; a comparison needs different runs")
        if len(options.runs) > 1:
            refuse_to_look(options.output_dir)
        for run in options.runs:  # before minutes are spent on the first
            load_config(run)
    if len(options.runs) > 1:
        found = [_evaluate_run(run, options, console, processes, show=False) for run in options.runs]
        if processes.is_first:
            _compare(console, [run for run in found if run is not None])
        return
    with processes.together():
        path = chosen_run(options.runs[0] if options.runs else options.run, options.output_dir)
    _evaluate_run(path, options, console, processes, show=True)


def _compare(console: Console, runs: list[ComparedRun]) -> None:
    from rich.table import Table

    from unmix_plugin.commands.reporting import say
    from unmix_plugin.products.comparison import compare_runs, difference, shown

    folder = runs[0].path / "exports" / "comparison"
    found = compare_runs(runs, folder)
    table = Table(title=f"{counted(len(runs), 'run')}, with differences to the first", title_justify="left")
    table.add_column("setting or figure", overflow="fold")
    for label in found.labels:
        table.add_column(label, justify="right", overflow="fold")
    for name, values in found.rows:
        texts = [f"{one:.4g}" if isinstance(one, float) else shown(one) or "-" for one in values]
        more = [f" ({difference(one, values[0])})" if one != values[0] else "" for one in values]
        table.add_row(name, *(one + by.replace(" ()", "") for one, by in zip(texts, more, strict=True)))
    console.print(table)
    for remark in found.remarks:
        say(console, remark)
    drawn = counted(found.num_pictures, "picture")
    tell(f"{folder}  differences as CSV, of views and bands too, and {drawn}")


def _evaluate_run(
    path: Path, options: _EvalOptions, console: Console, processes: Processes, *, show: bool
) -> ComparedRun | None:
    """Measure one run and write what was found into its folder; None in all processes but the first."""
    from functools import partial

    from unmix_plugin.commands.reporting import follow, spectral_scene, working
    from unmix_plugin.editing.apply import edit_scene, light_factors
    from unmix_plugin.editing.edited_run import requested_recipe
    from unmix_plugin.editing.recipe_files import recipe_to_yaml
    from unmix_plugin.engine.runs.config_json import config_to_json, flattened
    from unmix_plugin.engine.runs.loading import load_pipeline
    from unmix_plugin.formats.files import safe_name
    from unmix_plugin.products.comparison import ComparedRun
    from unmix_plugin.products.evaluation import evaluate_images, evaluate_scene, evaluate_spectra

    with processes.together():
        recipe = requested_recipe(options.edits, options.illuminant)
        with working(console, f"reading {path} and its scene"):
            loaded = load_pipeline(path, options.device, options.data)
        scene, folder, factors = _materials_scene(loaded, recipe is not None), loaded.folder.eval, None
        if scene is not None and recipe is not None:
            factors = None if recipe.illuminant is None else light_factors(scene, recipe)[0]
            scene = edit_scene(scene, recipe)
            for note in scene.notes:
                tell(note)
            words = ["eval", *(Path(given).stem for given in (options.edits, options.illuminant) if given)]
            folder = loaded.folder.exports / safe_name("-".join(words))
    measured = spectral_scene(loaded.pipeline.datamanager)
    shown = partial(follow, console)
    if scene is not None and measured is not None:
        found = evaluate_scene(scene, measured, factors, folder, shown, processes)
    elif not processes.is_first:
        found = None
    else:
        found = None if measured is None else evaluate_spectra(loaded.pipeline, measured, folder, shown)
        found = found or evaluate_images(loaded.pipeline, folder, shown)
    if found is None:
        return None
    if recipe is not None:
        found.more["edits"] = recipe_to_yaml(recipe)
    times = {"train_seconds": loaded.training.train_seconds}
    if found.bands:
        times["train_rays_per_second"] = loaded.training.train_rays_per_second
    figures = found.write(folder / "metrics.json", times)
    config = replace(loaded.config, data=None, output_dir=Path(), load_run=None)
    compared = ComparedRun(
        loaded.folder.path,
        config.method_name,
        figures,
        {view["name"]: view for view in found.per_image},
        found.bands,
        loaded.record.eval_cameras.camera_to_world.numpy(),
        folder,
        flattened(config_to_json(config)),
        tuple(found.more.get("aligned", ())),
    )
    if show:
        _report(console, compared, found, scene is not None, recipe is not None, factors is not None)
    return compared


def _report(
    console: Console,
    run: ComparedRun,
    found: Evaluated,
    has_materials: bool,
    is_edited: bool,
    is_relit: bool,
) -> None:
    """Figures as a table, what is to be known beside them, and where everything is."""
    from unmix_plugin.trained.unexplained import describe_unexplained
    from unmix_plugin.trained.view_fit import describe_misfits, read_misfits

    for what, how in _ALIGNED.items():
        if what in found.more.get("aligned", ()):
            tell(f"each evaluation view was aligned first: {how}")
    figures, title = run.figures, f"{run.path.name}: {counted(run.figures['views'], 'evaluation view')}"
    if "bands" in figures:
        title += f", {counted(figures['bands'], 'band')}"
        title += ", edited, against the scene as measured" if is_edited else ""
        title += " (in the same light)" if is_relit else ""
    console.print(_figures_table(found, figures, title))
    unknown = [name for name, value in figures.items() if value is None]
    if unknown:
        tell(f"not measured, since the scene does not have the truth for it: {', '.join(unknown)}")
    for sentence in [*describe_misfits(read_misfits(run.path)), *describe_unexplained(run.path)]:
        tell(sentence)
    tell(f"{run.pictures / 'metrics.json'}  these figures, and those of each view")
    if found.num_pictures:
        kinds = ": rgb/, segmentation/ and abundances/, truth, where there is one, beside prediction"
        drawn = counted(found.num_pictures, "picture")
        tell(f"{run.pictures}  {drawn}{kinds if has_materials else ''}")


def _figures_table(found: Evaluated, figures: Mapping[str, float | None], title: str) -> Table:
    """The figures that are known, with what they are beside those that are everybody's."""
    from rich.table import Table

    from unmix_plugin.trained.evaluation import DEFINITIONS

    table = Table(title=title, title_justify="left")
    table.add_column("figure", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("what it is")
    meanings = DEFINITIONS if "bands" in figures else {n: DEFINITIONS[n] for n in ("views", "train_seconds")}
    rows = [(name, value, meanings.get(name, "")) for name, value in figures.items()]
    rows += [(name, value, "as the method itself measures it") for name, value in found.own.items()]
    for name, value, what in rows:
        if value is not None:
            unit = next((unit for word, unit in _UNITS.items() if word in name.split("_")), "")
            table.add_row(name, f"{value:.4g}{unit}", what)
    return table


_ALIGNED = {
    "gain": "exposure and smooth white balance fitted to the measured view",
    "pose": "its pose fitted to the measured view with the field as it is",
}
_UNITS = {"psnr": " dB", "sam": " rad", "angle": " rad", "seconds": " s"}


def _materials_scene(loaded: LoadedPipeline, is_edited: bool) -> TrainedScene | None:
    """The scene of mixed materials that the run's method makes; None where its model measures its images itself."""
    from unmix_plugin.commands.reporting import spectral_scene
    from unmix_plugin.trained.open_run import mixture_scene, require_materials

    name, scene = loaded.config.method_name, None
    if spectral_scene(loaded.pipeline.datamanager) is not None:
        scene = mixture_scene(loaded.pipeline.model, name, loaded.record)
    return require_materials(scene, name) if is_edited else scene


if __name__ == "__main__":  # of one of several processes
    run_command(evaluate)
