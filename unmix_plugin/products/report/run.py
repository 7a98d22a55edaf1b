"""Sections of a report that show no picture: the scene, the figures, the training, the settings, the versions."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin import __version__
from unmix_plugin.engine.runs.config_json import config_to_json
from unmix_plugin.engine.runs.load_run import LoadedModel
from unmix_plugin.figures.html_page import (
    Section,
    details,
    facts,
    figure,
    figures,
    paragraph,
    preformatted,
    table,
)
from unmix_plugin.figures.svg_chart import Chart, Line, draw_chart, draw_legend
from unmix_plugin.spectral.composition import Materials
from unmix_plugin.trained.evaluation import DEFINITIONS
from unmix_plugin.trained.world_frame import world_frame

_PACKAGES = ("torch", "warp-lang", "numpy", "scipy", "scikit-image", "colour-science", "matplotlib", "pillow")
_SHOWN_FIGURES = {
    "psnr": "PSNR",
    "sam": "spectral angle",
    "miou": "mean IoU",
    "abundance_rmse": "abundance RMSE",
}
_UNITS = {"psnr": " dB", "sam": " rad"}


def scene_section(
    loaded: LoadedModel, materials: Materials, figures_of_merit: Mapping[str, Any] | None
) -> Section:
    """What was trained on what, and how well that went, in a few words."""
    scene, training = loaded.scene, loaded.training
    summary, cameras = scene.summary, scene.train_cameras
    size = (scene.scene_box.size.cpu().double().numpy() / world_frame(scene).scale).tolist()
    light = "recorded" if summary.get("illuminant") else "unknown, taken as flat"
    known = [word for word in ("alpha", "labels", "abundances") if summary.get(f"has_{word}")]
    pairs = [
        ("Scene", scene_name(loaded)),
        ("Bands", str(materials.bands)),
        ("Views", f"{len(scene.train_cameras)} training, {len(scene.eval_cameras)} evaluation"),
        ("Image size", f"{cameras.width} x {cameras.height} pixels"),
        ("Scene box", " x ".join(f"{edge:.3g}" for edge in size) + " world units"),
        ("Light", light),
        ("Comes with", ", ".join(known) or "images alone"),
        ("Endmembers", str(len(materials.names))),
        ("Training", f"{training.steps:,} steps, {training.train_seconds:,.0f} s"),
        ("Rays", f"{training.total_rays:,}"),
    ]
    values = figures_of_merit or {}
    merits = [
        (label, f"{values[key]:.4g}{_UNITS.get(key, '')}")
        for key, label in _SHOWN_FIGURES.items()
        if values.get(key) is not None
    ]
    return Section("scene", "Scene", facts([*merits, *pairs]))


def scene_name(loaded: LoadedModel) -> str:
    """What the run calls its scene: the folder's name."""
    root = loaded.scene.summary.get("root")
    return Path(str(root)).name if root else loaded.run.path.parents[1].name


def figures_section(values: Mapping[str, Any] | None, source: str) -> Section:
    """All figures of merit with their definitions.

    Args:
        values: By name, as `eval/metrics.json` has them; None where there are none.
        source: Where they are from.
    """
    if values is None:
        text = "Not evaluated: run unmix-eval, which needs the scene, and make the report again."
        return Section("figures", "Figures", paragraph(text, "warning"))
    definitions = {**DEFINITIONS, **(values.get("definitions") or {})}
    rows = [
        [name, "no truth" if values[name] is None else f"{values[name]:.4g}", definitions[name]]
        for name in DEFINITIONS
        if name in values
    ]
    return Section(
        "figures", "Figures", paragraph(source, "note") + table(["figure", "value", "what it is"], rows, (1,))
    )


def training_section(loaded: LoadedModel) -> Section:
    """Loss, PSNR and learning rates over training; a word where the run has no record of them."""
    records = read_metrics(loaded.run.metrics_path)
    train = [record for record in records if record.get("split") == "train"]
    if len(train) < 2:
        return Section("training", "Training", paragraph("The run has no record of its training.", "note"))
    rates = sorted({key for record in train for key in record if key.startswith("lr/")})
    colours = ("#0b5cad", "#c8501e", "#2d8659", "#7d4fb0")
    evaluated = [record for record in records if record.get("split") == "eval_all"]
    psnr = [_line(train, "psnr", "training batches", colours[0])]
    if len(evaluated) > 1:
        psnr.append(_line(evaluated, "psnr", "evaluation views", colours[1]))
    charts = [
        ("loss", [_line(train, "loss", "loss", colours[0])], True),
        ("PSNR (dB)", psnr, False),
        (
            "learning rate",
            [
                _line(train, key, key.removeprefix("lr/"), colour)
                for key, colour in zip(rates, colours, strict=False)
            ],
            True,
        ),
        ("rays a second", [_line(train, "rays_per_second", "rays a second", colours[0])], False),
    ]
    drawn = [
        figure(
            draw_chart(
                Chart(
                    lines, "seconds of training", label, f"{label} over training", is_log, size=(520.0, 260.0)
                )
            ),
            draw_legend(lines) if len(lines) > 1 else "",
        )
        for label, lines, is_log in charts
        if lines
    ]
    return Section("training", "Training", figures(drawn, 2))


def settings_section(loaded: LoadedModel) -> Section:
    """Every setting of the run."""
    text = json.dumps(config_to_json(replace(loaded.config, load_run=None)), indent=1)
    return Section("settings", "Settings", details("config.json", preformatted(text)))


def versions_section(loaded: LoadedModel, notes: Sequence[str]) -> Section:
    """What made this report, of what.

    Args:
        loaded: The run.
        notes: What else has to be said.
    """
    hashes = loaded.scene.summary.get("input_hashes") or {}
    now = datetime.now(timezone.utc)
    rows = [
        ["run", str(loaded.run.path)],
        ["scene", str(loaded.scene.summary.get("root", "unknown"))],
        ["input files", f"{len(hashes)}, with their SHA-256 in the run's scene.json"],
        ["report made", f"{now:%Y-%m-%d %H:%M} UTC"],
        ["unmix-nerf", __version__],
        ["Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"],
        *([name, version] for name in _PACKAGES if (version := _version(name)) is not None),
    ]
    html = "".join(paragraph(note, "note") for note in notes)
    return Section("versions", "Versions", html + table([], rows))


def read_metrics(path: Path) -> list[dict[str, Any]]:
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


def _line(records: Sequence[Mapping[str, Any]], key: str, label: str, colour: str) -> Line:
    seconds = np.array([_number(record.get("seconds")) for record in records])
    values = np.array([_number(record.get(key)) for record in records])
    return Line(seconds, values, label, colour)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
