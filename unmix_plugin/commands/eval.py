"""`unmix-eval --run PATH`: measure a trained run on its evaluation views."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.engine.configs import DeviceName
from unmix_plugin.errors import counted

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float64
    from rich.console import Console

    from unmix_plugin.editing.recipe import Recipe
    from unmix_plugin.engine.processes.processes import Processes
    from unmix_plugin.engine.runs.load_run import LoadedPipeline
    from unmix_plugin.scenes.scene import Scene
    from unmix_plugin.trained.evaluation import Evaluation
    from unmix_plugin.trained.trained_scene import TrainedScene


@dataclass(frozen=True)
class EvalOptions:
    """Measure a trained run on its evaluation views: metrics.json, a table, and prediction beside truth as pictures.

    They are written to `eval/` in the run folder, in place of an earlier evaluation; those of an edited run to a folder
    of its own in `exports/`.
    """

    run: Path | None = None
    """Run folder, as training printed it; None takes the newest under --output-dir."""
    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it."""
    edits: Path | None = None
    """Recipe (YAML) of edits to make first; the result is compared with the scene as it was measured."""
    illuminant: str | None = None
    """Light to see both in: D65, A, E, FL2, ... or a .csv file (wavelength,power); None: the scene's own."""
    output_dir: Path = Path("outputs")
    """Folder in which to look for the newest run."""
    device: DeviceName = "auto"
    """Where to compute; auto takes CUDA where there is one."""
    num_devices: int = 1
    """Processes that share the views, on CUDA each on a device of its own."""


def evaluate(argv: list[str]) -> None:
    """Parse the arguments, render and measure each view, write and say what was found.

    Raises:
        RunError: the run is unusable, or its folder can't be written.
        SceneError: the scene is missing or malformed.
        ConfigError: the method does not unmix spectra, the recipe is wrong or does not fit the run, or the device is
            not there.
        SpectrumError: there is no such light.
    """
    options = tyro.cli(EvalOptions, prog="unmix-eval", args=argv)

    from unmix_plugin.engine.processes.launching import start_together
    from unmix_plugin.engine.processes.processes import joined

    start_together("unmix_plugin.commands.eval", argv, options.num_devices)
    with joined(options.device) as processes:
        _evaluate(options, processes)


def _evaluate(options: EvalOptions, processes: Processes) -> None:
    from unmix_plugin.commands.eval_by_model import evaluate_by_model
    from unmix_plugin.commands.reporting import CommandConsole, working
    from unmix_plugin.commands.run_choice import chosen_run, spectral_scene
    from unmix_plugin.editing.edited_run import requested_recipe
    from unmix_plugin.engine.runs.load_run import load_pipeline

    console = CommandConsole(quiet=not processes.is_first)
    with processes.together():
        path = chosen_run(options.run, options.output_dir)
        recipe = requested_recipe(options.edits, options.illuminant)
        with working(console, f"reading {path} and its scene"):
            loaded = load_pipeline(path, options.device, options.data)
    if recipe is None and spectral_scene(loaded.pipeline.datamanager) is None:
        if processes.is_first:
            evaluate_by_model(loaded, console)
        return
    with processes.together():
        subject = _subject(loaded, recipe, options)
        evaluation, ids = _evaluate_views(subject, console, processes)
    ids = _merged(subject, evaluation, ids, processes)
    if not processes.is_first:
        return
    num_pictures = 3 * len(ids)
    _draw_segmentations(subject, evaluation, ids, console)
    if subject.has_view_gains:
        print(
            "each evaluation view was aligned first: exposure and smooth white balance fitted to the measured view"
        )
    if subject.has_refined_poses:
        print(
            "each evaluation view was aligned first: its pose fitted to the measured view with the field as it is"
        )
    figures = _write_metrics(subject, evaluation)
    _show(console, figures, subject)
    print(f"{subject.folder / 'metrics.json'}  these figures, and those of each view")
    print(
        f"{subject.folder}  {counted(num_pictures, 'picture')}: rgb/, segmentation/ and abundances/, "
        "truth beside prediction"
    )


@dataclass(frozen=True)
class _Subject:
    """What is measured."""

    loaded: LoadedPipeline
    scene: TrainedScene
    light_factors: Float64[np.ndarray, " B"] | None
    """What measured radiance is multiplied with; None: nothing."""
    folder: Path
    """Where to write."""
    edits: str | None
    """The recipe's text."""

    @property
    def has_view_gains(self) -> bool:
        """Whether each training view has a gain of its own."""
        return getattr(self.loaded.config.pipeline.model, "light", None) == "per-view"

    @property
    def has_refined_poses(self) -> bool:
        """Whether training corrected poses."""
        return getattr(self.loaded.config.pipeline.model, "poses", None) == "refine"

    @property
    def aligned(self) -> list[str]:
        """What of each evaluation view was fitted to the measured one before it was measured."""
        gains = self.has_view_gains and not _scene_of(self.loaded).is_rig
        return [*(["pose"] if self.has_refined_poses else []), *(["gain"] if gains else [])]


def _subject(loaded: LoadedPipeline, recipe: Recipe | None, options: EvalOptions) -> _Subject:
    from unmix_plugin.editing.apply import edit_scene, light_factors
    from unmix_plugin.editing.yaml_writing import recipe_to_yaml
    from unmix_plugin.trained.open_run import require_materials
    from unmix_plugin.trained.snapshot import snapshot

    name = loaded.config.method_name
    scene = require_materials(snapshot(loaded.pipeline.model, name, loaded.scene), name)
    if recipe is None:
        return _Subject(loaded, scene, None, loaded.run.eval, None)
    edited = edit_scene(scene, recipe)
    for note in edited.notes:
        print(note)
    words = ["eval", *([options.edits.stem] if options.edits else [])]
    words += [Path(options.illuminant).stem] if options.illuminant else []
    folder = loaded.run.exports / re.sub(r"[^\w.-]+", "_", "-".join(words))
    factors = None if recipe.illuminant is None else light_factors(scene, recipe)
    return _Subject(loaded, edited, factors, folder, recipe_to_yaml(recipe))


def _scene_of(loaded: LoadedPipeline) -> Scene:
    from unmix_plugin.commands.run_choice import spectral_scene
    from unmix_plugin.errors import ConfigError

    scene = spectral_scene(loaded.pipeline.datamanager)
    if scene is None:
        raise ConfigError(
            f"{loaded.run.path} is a run of {loaded.config.method_name}, which has no spectral scene"
        )
    return scene


def _evaluate_views(
    subject: _Subject, console: Console, processes: Processes
) -> tuple[Evaluation, dict[int, np.ndarray]]:
    """Measure and draw this process's share of the views; the ids alone are kept, since their colours are known after
    the last view."""
    import torch

    from unmix_plugin.commands.reporting import follow
    from unmix_plugin.formats.files import write_file
    from unmix_plugin.products.evaluation_pictures import draw_colour, draw_matched_abundances, material_look
    from unmix_plugin.trained.evaluation import Evaluation, scene_truth, view_truth
    from unmix_plugin.trained.pose_alignment import align_pose
    from unmix_plugin.trained.row_alignment import align_rows
    from unmix_plugin.trained.view_alignment import align_gain
    from unmix_plugin.trained.view_rendering import render_view, subpixels_for

    scene, folder, factors = _scene_of(subject.loaded), subject.folder, subject.light_factors
    materials = subject.scene.materials
    evaluation = Evaluation(scene_truth(scene).in_light(factors), materials.endmembers, materials.names)
    look = material_look(evaluation)
    ids: dict[int, np.ndarray] = {}
    for index in follow(console, "evaluating views", scene.eval_indices[processes.rank :: processes.count]):
        truth = view_truth(scene, index).in_light(factors)
        rays = subpixels_for(scene, index, subject.scene.subpixels, subject.scene.pixel_size)
        camera = scene.cameras[index]
        if subject.has_refined_poses:
            align = align_rows if camera.is_line_camera(0) else align_pose
            camera = align(subject.scene, camera, truth)
        predicted = render_view(subject.scene, camera, rays)
        if subject.has_view_gains and not scene.is_rig:
            predicted = align_gain(predicted, truth, torch.from_numpy(scene.wavelengths_nm))
        if scene.is_rig:
            evaluation.sensors[truth.name] = scene.sensor_of(index).name
        psnr_db = evaluation.add(truth, predicted)["psnr"]
        name = f"{truth.name}.png"
        write_file(folder / "rgb" / name, draw_colour(truth, predicted, evaluation.truth.bands, psnr_db))
        write_file(folder / "abundances" / name, draw_matched_abundances(truth, predicted, evaluation, look))
        ids[index] = predicted.segmentation.numpy()
    return evaluation, ids


def _merged(
    subject: _Subject, evaluation: Evaluation, ids: dict[int, np.ndarray], processes: Processes
) -> dict[int, np.ndarray]:
    """The ids of all views; in the first process `evaluation` then has counted all of them."""
    if processes.count == 1:
        return ids
    parts = processes.gather((evaluation, ids))
    if not processes.is_first:
        return ids
    scene = _scene_of(subject.loaded)
    order = [scene.frames[index].name for index in scene.eval_indices]
    evaluation.merge((other for other, _ in parts[1:]), order)
    return {index: found for _, part in parts for index, found in part.items()}


def _draw_segmentations(
    subject: _Subject, evaluation: Evaluation, ids: dict[int, np.ndarray], console: Console
) -> None:
    from unmix_plugin.commands.reporting import follow
    from unmix_plugin.formats.files import write_file
    from unmix_plugin.products.evaluation_pictures import draw_matched_segmentation, material_look

    look = material_look(evaluation)
    scene, matching = _scene_of(subject.loaded), evaluation.segmentation().matching
    for index in follow(console, "drawing segmentations", list(ids)):
        name = scene.frames[index].name
        drawn = draw_matched_segmentation(name, scene.labels(index), ids[index], look, matching)
        write_file(subject.folder / "segmentation" / f"{name}.png", drawn)


def _write_metrics(subject: _Subject, evaluation: Evaluation) -> dict[str, Any]:
    """Write metrics.json; the scene's figures, None where there is no truth."""
    from unmix_plugin.formats.files import write_file
    from unmix_plugin.trained.evaluation import DEFINITIONS, finite_or_none

    training = subject.loaded.training
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
    per_sensor = {name: finite_or_none(found) for name, found in evaluation.per_sensor().items()}
    content |= {"per_sensor": per_sensor} if per_sensor else {}
    content |= {"aligned": subject.aligned} if subject.aligned else {}
    content |= {} if subject.edits is None else {"edits": subject.edits}
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    write_file(subject.folder / "metrics.json", text.encode())
    return figures


def _show(console: Console, figures: dict[str, Any], subject: _Subject) -> None:
    """The figures as a table."""
    from rich.table import Table

    from unmix_plugin.trained.evaluation import DEFINITIONS

    of = "" if subject.edits is None else ", edited, against the scene as measured"
    of += "" if subject.light_factors is None else " (in the same light)"
    name = subject.loaded.run.path.name
    title = f"{name}: {counted(figures['views'], 'evaluation view')}, {counted(figures['bands'], 'band')}{of}"
    table = Table(title=title, title_justify="left")
    table.add_column("figure", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("what it is")
    for name, value in figures.items():
        table.add_row(name, "no truth" if value is None else f"{value:.4g}", DEFINITIONS[name])
    console.print(table)


def main() -> None:
    """Console script."""
    run_command(evaluate)


if __name__ == "__main__":
    main()
