"""`unmix-eval --run PATH`: measure a trained run on its evaluation views."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.engine.configs import DeviceName

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    from unmix_plugin.engine.load_run import LoadedPipeline
    from unmix_plugin.exports.evaluation import Evaluation
    from unmix_plugin.exports.evaluation_pictures import MaterialLook
    from unmix_plugin.scenes.scene import Scene


@dataclass(frozen=True)
class EvalOptions:
    """Measure a trained run on its evaluation views: metrics.json, a table, and prediction beside truth as pictures.

    They are written to `eval/` in the run folder, in place of an earlier evaluation.
    """

    run: Path | None = None
    """Run folder, as training printed it; None takes the newest under --output-dir."""
    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it."""
    output_dir: Path = Path("outputs")
    """Folder in which to look for the newest run."""
    device: DeviceName = "auto"
    """Where to compute; auto takes CUDA where there is one."""


def evaluate(words: list[str]) -> None:
    """Parse the words, render and measure each view, write and say what was found.

    Raises:
        RunError: the run is unusable, or its folder can't be written.
        SceneError: the scene is missing or malformed.
        ConfigError: the method does not unmix spectra, or the device is not there.
    """
    options = tyro.cli(EvalOptions, prog="unmix-eval", args=words)

    from rich.console import Console

    from unmix_plugin.commands.reporting import working
    from unmix_plugin.commands.run_choice import chosen_run
    from unmix_plugin.engine.load_run import load_pipeline

    console = Console()
    path = chosen_run(options.run, options.output_dir)
    with working(console, f"reading {path} and its scene"):
        loaded = load_pipeline(path, options.device, options.data)
    evaluation, num_pictures = _evaluate_views(loaded, console)
    figures = _write_metrics(loaded, evaluation)
    _show(console, figures, loaded.run.path)
    folder = loaded.run.eval
    print(f"{folder / 'metrics.json'}  these figures, and those of each view")
    print(f"{folder}  {num_pictures} pictures: rgb/, segmentation/ and abundances/, truth beside prediction")


def _scene_of(loaded: LoadedPipeline) -> Scene:
    from unmix_plugin.errors import ConfigError
    from unmix_plugin.scenes.scene import Scene

    scene = getattr(loaded.pipeline.datamanager, "scene", None)
    if not isinstance(scene, Scene):
        raise ConfigError(
            f"{loaded.run.path} is a run of {loaded.config.method_name}, which has no spectral scene"
        )
    return scene


def _evaluate_views(loaded: LoadedPipeline, console: Console) -> tuple[Evaluation, int]:
    """Measure and draw view by view; the ids alone are kept, since their colours are known after the last view."""
    from unmix_plugin.commands.reporting import follow
    from unmix_plugin.exports.evaluation import Evaluation, scene_truth, view_truth
    from unmix_plugin.exports.evaluation_pictures import draw_colour, draw_matched_abundances, material_look
    from unmix_plugin.exports.files import write_file
    from unmix_plugin.exports.run_materials import materials_of
    from unmix_plugin.exports.view_rendering import render_view

    scene, model, folder = _scene_of(loaded), loaded.pipeline.model, loaded.run.eval
    evaluation = Evaluation(scene_truth(scene), materials_of(model).endmembers)
    look = material_look(evaluation)
    ids: dict[int, np.ndarray] = {}
    for index in follow(console, "evaluating views", scene.eval_indices):
        truth = view_truth(scene, index)
        predicted = render_view(model, scene.cameras[index])
        psnr_db = evaluation.add(truth, predicted)["psnr"]
        name = f"{truth.name}.png"
        write_file(folder / "rgb" / name, draw_colour(truth, predicted, evaluation.truth.bands, psnr_db))
        write_file(folder / "abundances" / name, draw_matched_abundances(truth, predicted, evaluation, look))
        ids[index] = predicted.segmentation.numpy()
    _draw_segmentations(loaded, evaluation, look, ids, console)
    return evaluation, 3 * len(ids)


def _draw_segmentations(
    loaded: LoadedPipeline,
    evaluation: Evaluation,
    look: MaterialLook,
    ids: dict[int, np.ndarray],
    console: Console,
) -> None:
    from unmix_plugin.commands.reporting import follow
    from unmix_plugin.exports.evaluation_pictures import draw_matched_segmentation
    from unmix_plugin.exports.files import write_file

    scene, matching = _scene_of(loaded), evaluation.segmentation().matching
    for index in follow(console, "drawing segmentations", list(ids)):
        name = scene.frames[index].name
        drawn = draw_matched_segmentation(name, scene.labels(index), ids[index], look, matching)
        write_file(loaded.run.eval / "segmentation" / f"{name}.png", drawn)


def _write_metrics(loaded: LoadedPipeline, evaluation: Evaluation) -> dict[str, Any]:
    """Write metrics.json; the scene's figures, None where there is no truth."""
    from unmix_plugin.exports.evaluation import DEFINITIONS, finite_or_none
    from unmix_plugin.exports.files import write_file

    training = loaded.training
    values = finite_or_none(
        {
            **evaluation.figures(),
            "train_seconds": training.train_seconds,
            "train_rays_per_second": training.train_rays_per_second,
        }
    )
    figures = {name: values[name] for name in DEFINITIONS}
    per_view = [{"name": name, **finite_or_none(found)} for name, found in evaluation.per_view.items()]
    content = {**figures, "per_view": per_view, "definitions": DEFINITIONS}
    write_file(
        loaded.run.eval / "metrics.json", (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()
    )
    return figures


def _show(console: Console, figures: dict[str, Any], path: Path) -> None:
    """The figures as a table."""
    from rich.table import Table

    from unmix_plugin.exports.evaluation import DEFINITIONS

    table = Table(
        title=f"{path.name}: {figures['views']} evaluation views, {figures['bands']} bands",
        title_justify="left",
    )
    table.add_column("figure", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("what it is")
    for name, value in figures.items():
        table.add_row(name, "no truth" if value is None else f"{value:.4g}", DEFINITIONS[name])
    console.print(table)


def main() -> None:
    """Console script."""
    run_command(evaluate)
