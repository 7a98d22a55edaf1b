"""How well do few views do? A scene trained on 5, on 10 and on all of its training views, with the defaults.

    python benchmarks/few_views.py [--scene FOLDER] [--steps 1000]

The views are those that lie farthest from each other, the first given. Evaluation views stay the same.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro

SHOWN = ("psnr", "psnr_matter", "ssim", "sam", "miou", "abundance_rmse", "endmember_angle", "train_seconds")


@dataclass(frozen=True)
class Options:
    """Train on few of a scene's views."""

    scene: Path = field(default_factory=lambda: _common.cached_scene("table"))
    """Scene folder with `train_filenames` and `materials`."""
    views: tuple[int, ...] = (5, 10, 1000)
    """Numbers of training views; more than there are means all."""
    steps: int = 1000
    """Of each training."""
    results: Path | None = None
    """Folder for few_views.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """Ten steps of each."""


def main(options: Options) -> None:
    """Train on each number of views and publish."""
    _common.require_scenes(options.scene)
    machine, measured = _machine.describe_machine("cpu"), {}
    steps = 10 if options.quick else options.steps
    content = json.loads((options.scene / "transforms.json").read_text(encoding="utf-8"))
    for count in options.views:
        kept = spread_views(content, count)
        with tempfile.TemporaryDirectory(prefix="unmix-few-") as folder:
            measured[f"{len(kept)} views"] = measure(options.scene, content, kept, steps, Path(folder))
    figures = [
        _common.reported(f"{name}: {key}", f"{found[key]:.4g}")
        for name, found in measured.items()
        for key in ("psnr", "sam", "miou")
    ]
    rows = [[key, *(f"{found[key]:.4g}" for found in measured.values())] for key in SHOWN]
    table = _common.DetailTable("All figures", ["metric", *measured], rows)
    setting = {"scene": options.scene.name, "steps": steps, "options": "defaults, K = number of materials"}
    report = _common.Report("few_views", "Few training views", setting, machine, figures, measured, (table,))
    _common.publish(report, _common.results_folder(options.results, options.quick))


def spread_views(content: dict[str, Any], count: int) -> list[str]:
    """Training views of which each lies farthest from those before it."""
    train = set(content["train_filenames"])
    frames = [frame for frame in content["frames"] if frame["file_path"] in train]
    places = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    chosen = [0]
    while len(chosen) < min(count, len(frames)):
        distances = np.linalg.norm(places[:, None] - places[chosen], axis=-1).min(axis=1)
        chosen.append(int(distances.argmax()))
    return [frames[index]["file_path"] for index in sorted(chosen)]


def measure(
    scene: Path, content: dict[str, Any], kept: list[str], steps: int, folder: Path
) -> dict[str, Any]:
    """Train on some views and evaluate."""
    print(f"{len(kept)} views: training ...", flush=True)
    data = folder / scene.name
    data.mkdir()
    for path in scene.iterdir():
        if path.name != "transforms.json":
            copy = shutil.copytree if path.is_dir() else shutil.copyfile
            copy(path, data / path.name)
    left_out = set(content["train_filenames"]) - set(kept)
    frames = [frame for frame in content["frames"] if frame["file_path"] not in left_out]
    written = {**content, "train_filenames": kept, "frames": frames}
    (data / "transforms.json").write_text(json.dumps(written), encoding="utf-8")
    train, evaluate = (_common.console_script(f"unmix-{command}") for command in ("train", "eval"))
    words = ["--data", str(data), "--max-num-iterations", str(steps), "--output-dir", str(folder / "runs")]
    words += ["--endmembers", str(len(content["materials"])), "--device", "cpu", "--viewer.no-enabled"]
    run = _common.run_command([train, "unmix-nerf", *words]).run
    _common.run_command([evaluate, "--run", str(run), "--device", "cpu"])
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    print(f"{len(kept)} views: PSNR {metrics['psnr']:.2f} dB", flush=True)
    return {key: metrics[key] for key in SHOWN}


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
