"""How long does it take to 34 dB at 512 x 512 pixels, and how long does a rendered frame take?

    python benchmarks/cost512.py

Trains on the built-in scene in 48 views of 512 x 512 pixels and 31 bands, with the defaults of all but the number of
steps, and renders evaluation views. Processor time is given beside wall time: with one thread, a quiet machine takes
about as many seconds of wall time, with two fewer. Takes about five minutes, one of them for writing the scene.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

import _common
import _machine
import torch
import tyro

from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.model import UnmixModel
from unmix_plugin.scenes.demo.scene import make_demo_scene

PSNR = _common.Limit(34.0, unit=" dB")
SECONDS = _common.Limit(180.0, 60.0, is_upper=True, unit=" s")
FRAME_SECONDS = _common.Limit(1.0, 0.4, is_upper=True, unit=" s")


@dataclass(frozen=True)
class Options:
    """Time to 34 dB and of a frame, at 512 x 512 pixels."""

    size: int = 512
    """Width and height of a view, pixels."""
    views: int = 48
    """Of the scene."""
    steps: int = 1200
    """Training steps."""
    eval_views: int = 4
    """Rendered and compared."""
    scene: Path | None = None
    """The scene, where it was written before by unmix-demo-scene."""
    results: Path | None = None
    """Folder for cost512.json and cost512.md; None: beside the benchmarks."""
    quick: bool = False
    """A small scene and few steps."""


def main(options: Options) -> None:
    """Measure and publish."""
    machine = _machine.describe_machine()
    size, views, steps = (64, 8, 20) if options.quick else (options.size, options.views, options.steps)
    with TemporaryDirectory(prefix="unmix-cost512-") as folder:
        scene = options.scene or Path(folder) / "scene"
        if options.scene is None:
            make_demo_scene(scene, size, views=views)
        words = ["unmix-nerf", "--data", str(scene), "--output-dir", str(Path(folder) / "runs")]
        words += ["--device", "cpu", "--max-num-iterations", str(steps)]
        trainer = _common.quiet_trainer(words)
        measured = trained(trainer, steps)
        with _common.averaged(trainer):
            measured |= rendered(trainer, options.eval_views)
    setting = {
        "scene": f"built-in, {views} views x {size} x {size} pixels x 31 bands",
        "steps": steps,
        "threads": torch.get_num_threads(),
    }
    report = _common.Report(
        "cost512",
        "Cost at 512 x 512 pixels",
        setting,
        machine,
        judge(measured),
        measured,
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def trained(trainer: Trainer, steps: int) -> dict[str, Any]:
    """Seconds of the training."""
    began = time.process_time(), time.perf_counter()
    rays = _common.take_steps(trainer, range(steps), steps)
    return {
        "training_cpu_seconds": time.process_time() - began[0],
        "training_wall_seconds": time.perf_counter() - began[1],
        "rays": rays,
    }


def rendered(trainer: Trainer, count: int) -> dict[str, Any]:
    """PSNR of evaluation views, and seconds of a frame."""
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    assert isinstance(model, UnmixModel)
    model.eval()
    found, seconds = [], []
    for index in range(0, manager.num_eval_images, max(1, manager.num_eval_images // count)):
        camera, batch = manager.eval_image(index)
        began = time.process_time(), time.perf_counter()
        outputs = model.get_outputs_for_camera(camera)
        seconds.append((time.process_time() - began[0], time.perf_counter() - began[1]))
        found.append(model.get_image_metrics_and_images(outputs, batch)[0]["psnr"])
    return {
        "psnr": mean(found),
        "frame_cpu_seconds": min(cpu for cpu, _ in seconds),
        "frame_wall_seconds": min(wall for _, wall in seconds),
    }


def judge(measured: dict[str, Any]) -> list[_common.Figure]:
    """What is asked at this size."""
    is_reached = measured["psnr"] >= PSNR.required
    return [
        PSNR.judge("PSNR of evaluation views", measured["psnr"]),
        SECONDS.judge(
            "processor time of the training to 34 dB",
            measured["training_cpu_seconds"] if is_reached else None,
        ),
        _common.reported(
            "wall time of the training on this machine", f"{measured['training_wall_seconds']:.0f} s"
        ),
        FRAME_SECONDS.judge("processor time of a frame", measured["frame_cpu_seconds"]),
        _common.reported("wall time of a frame on this machine", f"{measured['frame_wall_seconds']:.2f} s"),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
