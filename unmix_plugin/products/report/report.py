"""One HTML file about a run: everything that it learnt and how well, to read, to send or to print."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unmix_plugin import __version__
from unmix_plugin.engine.runs.config_json import config_to_json
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.plotting import ChartLine, LineChart
from unmix_plugin.products.product import Job, Product
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.evaluation import DEFINITIONS
from unmix_plugin.trained.open_run import LoadedRun
from unmix_plugin.trained.run_views import world_frame

if TYPE_CHECKING:
    from unmix_plugin.products.report.pictures import ReportViews
    from unmix_plugin.scenes.scene import Scene
    from unmix_plugin.trained.run_views import RunView


_PACKAGES = ("torch", "warp-lang", "numpy", "scipy", "scikit-image", "colour-science", "matplotlib", "pillow")
_MAIN_FIGURES = {
    "psnr": ("PSNR", " dB"),
    "sam": ("spectral angle", " rad"),
    "miou": ("mean IoU", ""),
    "abundance_rmse": ("abundance RMSE", ""),
}
_COLOURS = ("#0b5cad", "#c8501e", "#2d8659", "#7d4fb0")


def scene_facts(
    loaded: LoadedRun, materials: Materials, figures: Mapping[str, Any] | None
) -> list[tuple[str, str]]:
    """What was trained on what, and how well that went, in a few words."""
    scene, training = loaded.record, loaded.training
    summary, cameras = scene.summary, scene.train_cameras
    size = (scene.scene_box.size.cpu().double().numpy() / world_frame(scene).scale).tolist()
    sizes = sorted({cameras.size(index) for index in range(len(cameras))}, reverse=True)
    known = [word for word in ("alpha", "labels", "abundances") if summary.get(f"has_{word}")]
    return [
        *(
            (label, f"{figures[key]:.4g}{unit}")
            for key, (label, unit) in _MAIN_FIGURES.items()
            if figures is not None and figures.get(key) is not None
        ),
        ("Scene", scene_name(loaded)),
        ("Bands", str(materials.bands)),
        ("Views", f"{len(scene.train_cameras)} training, {len(scene.eval_cameras)} evaluation"),
        ("Image size", ", ".join(f"{width} x {height}" for width, height in sizes) + " pixels"),
        ("Scene box", " x ".join(f"{edge:.3g}" for edge in size) + " world units"),
        ("Light", "recorded" if summary.get("illuminant") else "unknown, taken as flat"),
        ("Comes with", ", ".join(known) or "images alone"),
        ("Endmembers", str(len(materials.names))),
        ("Training", f"{training.steps:,} steps, {training.train_seconds:,.0f} s"),
        ("Rays", f"{training.total_rays:,}"),
    ]


def scene_name(loaded: LoadedRun) -> str:
    """What the run calls its scene: the folder's name."""
    root = loaded.record.summary.get("root")
    return Path(str(root)).name if root else loaded.folder.path.parents[1].name


def figure_rows(values: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Each figure of merit, as `eval/metrics.json` has it, with its definition."""
    definitions = {**DEFINITIONS, **(values.get("definitions") or {})}
    return [
        (name, "no truth" if values[name] is None else f"{values[name]:.4g}", definitions[name])
        for name in DEFINITIONS
        if name in values
    ]


def training_charts(path: Path) -> list[LineChart]:
    """Loss, PSNR, learning rates and speed over training, from a run's `metrics.jsonl`; none without a record."""
    records = _read_metrics(path)
    train = [record for record in records if record.get("split") == "train"]
    if len(train) < 2:
        return []
    rates = sorted({key for record in train for key in record if key.startswith("lr/")})
    evaluated = [record for record in records if record.get("split") == "eval_all"]
    psnr = [_line(train, "psnr", "training batches", _COLOURS[0])]
    if len(evaluated) > 1:
        psnr.append(_line(evaluated, "psnr", "evaluation views", _COLOURS[1]))
    learning_rates = [
        _line(train, key, key.removeprefix("lr/"), colour)
        for key, colour in zip(rates, _COLOURS, strict=False)
    ]
    charts = [
        ("loss", [_line(train, "loss", "loss", _COLOURS[0])], True),
        ("PSNR (dB)", psnr, False),
        ("learning rate", learning_rates, True),
        ("rays a second", [_line(train, "rays_per_second", "rays a second", _COLOURS[0])], False),
    ]
    return [
        LineChart(lines, "seconds of training", label, is_log, size=(520.0, 260.0))
        for label, lines, is_log in charts
        if lines
    ]


def settings_text(loaded: LoadedRun) -> str:
    """Every setting of the run, as JSON."""
    return json.dumps(config_to_json(replace(loaded.config, load_run=None)), indent=1)


def version_rows(loaded: LoadedRun) -> list[tuple[str, str]]:
    """What made this report, of what."""
    hashes = loaded.record.summary.get("input_hashes") or {}
    return [
        ("run", str(loaded.folder.path)),
        ("scene", str(loaded.record.summary.get("root", "unknown"))),
        ("input files", f"{len(hashes)}, with their SHA-256 in the run's scene.json"),
        ("report made", f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC"),
        ("unmix-nerf", __version__),
        ("Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
        *((name, version) for name in _PACKAGES if (version := _version(name)) is not None),
    ]


def _read_metrics(path: Path) -> list[dict[str, Any]]:
    """Lines of a run's `metrics.jsonl`; those that a killed run left incomplete are passed over."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    records: list[dict[str, Any]] = []
    for line in lines:
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict):
            records.append(record)
    return records


def _line(records: Sequence[Mapping[str, Any]], key: str, label: str, colour: str) -> ChartLine:
    seconds = np.array([_number(record.get("seconds")) for record in records])
    values = np.array([_number(record.get(key)) for record in records])
    return ChartLine(seconds, values, label, colour)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


_VIEWS_WITH_SHARES = 2


@dataclass(frozen=True)
class Report(Product):
    """One HTML file about the run, report.html, which needs nothing else: scene, views, materials with their nearest
    known ones, abundances, segmentation, figures of merit, errors, training, settings. Measured images and labels are
    shown where the scene folder is found."""

    name = "report"

    max_views: int = 24
    """Most evaluation views to render; of more, an even choice."""
    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it."""
    library: tuple[Path, ...] = ()
    """Own reflectances to compare with too: .csv files or ENVI spectral libraries."""

    def write(self, job: Job) -> list[Path]:
        """Render, compare and lay out."""
        from unmix_plugin.products.report.page import write_report
        from unmix_plugin.products.report.pictures import evenly
        from unmix_plugin.trained.run_materials import library_with

        if self.max_views < 1:
            raise ConfigError(f"--max-views is {self.max_views}; choose at least 1")
        job.claim([report_path(job.folder)])
        library = library_with(self.library)
        chosen = evenly(job.views("eval"), self.max_views)
        views, notes = self._look(job, chosen), []
        if self._is_edited:
            notes.append(
                "Edited: what is rendered here is the run with the edits or the light asked for; figures and training "
                "are those of the run itself."
            )
        if len(chosen) < len(job.loaded.record.eval_cameras):
            notes.append(
                f"Rendered: {len(chosen)} of {len(job.loaded.record.eval_cameras)} evaluation views."
            )
        with job.working("laying out the report"):
            return [write_report(job.folder, job.loaded, views, library, _stored_figures(job), notes)]

    @property
    def _is_edited(self) -> bool:
        return self.edits is not None or self.illuminant is not None

    def _look(self, job: Job, chosen: list[RunView]) -> ReportViews:
        """Render the views, and compare each with what was measured, if the scene folder is found and unchanged."""
        from unmix_plugin.products.report.pictures import ReportViews, evenly
        from unmix_plugin.trained.evaluation import Evaluation, scene_truth, view_truth

        materials, scene = job.materials, self._scene(job)
        evaluation = None
        if scene is not None:
            evaluation = Evaluation(scene_truth(scene), materials.endmembers, materials.names)
        with_shares = {view.name for view in evenly(chosen, _VIEWS_WITH_SHARES)}
        views = ReportViews(materials, evaluation, with_shares)
        indices = {} if scene is None else {frame.name: index for index, frame in enumerate(scene.frames)}
        for view in job.follow("rendering views", chosen):
            truth = None if scene is None else view_truth(scene, indices[view.name])
            if truth is not None and truth.sensor is not None:
                truth = None  # of a rig, only views with all bands are put beside the prediction
            views.add(view.name, job.render(view), truth)
        return views

    def _scene(self, job: Job) -> Scene | None:
        from unmix_plugin.trained.open_run import find_scene

        if self._is_edited:
            return None
        with job.working("looking for the scene"):
            scene = find_scene(job.loaded.record.summary, job.loaded.folder.path, self.data)
        if scene is None:
            job.say("the scene folder was not found: nothing measured in the report; give it with --data")
        return scene


def report_path(folder: Path) -> Path:
    """The file that `write_report` makes."""
    return folder / "report.html"


def _stored_figures(job: Job) -> dict[str, Any] | None:
    """What `unmix-eval` found, if it was run."""
    path = job.loaded.folder.eval / "metrics.json"
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
