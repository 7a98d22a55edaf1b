"""How long does it take to render all evaluation views of a scene with all outputs?

    python benchmarks/export_speed.py [--scene DIR] [--run RUN]

Trains on the scene for a while (or takes a run of it that is there), then times `unmix-render --outputs all` on the
evaluation views, as a user would wait for it: start of the program, first use of kernels, files. Once with the format
that suits each output best, and once with every format that suits it. Takes about two minutes.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import _common
import _machine
import tyro

SECONDS = _common.Limit(30.0, is_upper=True, unit=" s")
FORMATS = {
    "the format that suits each output best": (),
    "every format that suits each output": ("--formats", "envi", "exr", "npy", "png", "mp4"),
}
"""What is timed; the first is what is asked of."""


@dataclass(frozen=True)
class Options:
    """Render all evaluation views of a scene with all outputs."""

    scene: Path = field(default_factory=lambda: _common.cached_scene("table"))
    """Scene folder to train on."""
    run: Path | None = None
    """Run folder to render from, in place of training."""
    max_seconds: float = 45.0
    """Seconds of training."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train and to render."""
    results: Path | None = None
    """Folder for export_speed.json and export_speed.md; None: beside the benchmarks."""
    quick: bool = False
    """Two seconds of training on a small built-in scene."""


def main(options: Options) -> None:
    """Train, render twice, publish."""
    machine = _machine.describe_machine(options.device)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-export-speed-")))
        run = options.run or train(options, folder)
        setting = describe(run, options)
        measured = {what: measure(run, words, options.device, folder) for what, words in FORMATS.items()}
    question = f"All outputs of {setting['views']} evaluation views of {setting['size']} and {setting['bands']} bands"
    report = _common.Report("export_speed", question, setting, machine, judge(measured), measured)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def train(options: Options, folder: Path) -> Path:
    """A run of the scene."""
    scene, seconds = options.scene, options.max_seconds
    if options.quick:
        scene, seconds = folder / "scene", 2.0
        script = _common.console_script("unmix-demo-scene")
        _common.run_command([script, str(scene), "--size", "32", "--bands", "8", "--views", "8"])
    _common.require_scenes(scene)
    words = ["--data", str(scene), "--output-dir", str(folder / "outputs"), "--device", options.device]
    script = _common.console_script("unmix-train")
    return _common.run_command([script, "unmix-nerf", *words, "--max-seconds", f"{seconds:g}"]).run


def describe(run: Path, options: Options) -> dict[str, Any]:
    """What was rendered, from the run's own record."""
    record = json.loads((run / "scene.json").read_text(encoding="utf-8"))
    cameras, metadata = record["eval_cameras"], record["metadata"]
    return {
        "command": "unmix-render --outputs all",
        "scene": Path(record["summary"].get("root", "scene")).name,
        "views": len(cameras["camera_to_world"]),
        "size": f"{cameras['width']} x {cameras['height']} pixels",
        "bands": len(metadata["wavelengths_nm"]),
        "rays a pixel": metadata["subpixels"] ** 2,
        "device": options.device,
    }


def measure(run: Path, words: tuple[str, ...], device: str, folder: Path) -> dict[str, Any]:
    """Time one render."""
    output = folder / f"render-{len(words)}"
    script = _common.console_script("unmix-render")
    load_average = _machine.load_average()
    arguments = ["--run", str(run), "--output", str(output), "--outputs", "all", "--device", device, *words]
    ended = _common.run_command([script, *arguments])
    written = [path for path in output.rglob("*") if path.is_file()]
    return {
        "seconds": ended.seconds,
        "load_average_at_start": load_average,
        "files": len(written),
        "megabytes": sum(path.stat().st_size for path in written) / 1e6,
        "peak_gib": ended.peak_bytes / 2**30,
    }


def judge(measured: dict[str, dict[str, Any]]) -> list[_common.Figure]:
    """The time asked for, and what else there is to say."""
    best, every = measured.values()
    first, second = measured
    return [
        SECONDS.judge(f"seconds, {first}", best["seconds"]),
        _common.reported(f"seconds, {second}", f"{every['seconds']:.1f} s"),
        *(
            _common.reported(
                f"written, {what}",
                f"{found['files']} files, {found['megabytes']:.0f} MB, peak memory {found['peak_gib']:.2f} GiB",
            )
            for what, found in measured.items()
        ),
        _common.reported(
            "load average at the start of each",
            ", ".join(f"{found['load_average_at_start']:.1f}" for found in measured.values()),
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
