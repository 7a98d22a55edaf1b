"""How long do people wait for what a run gives: all outputs of the evaluation views, a page, a report, a video?

    python benchmarks/export_speed.py [--scene DIR] [--run RUN]

Trains on the scene for a while (or takes a run of it that is there), then times the commands that a user would give:
start of the program, first use of kernels, files. Outputs are written once with the format that suits each best, and
once with every format that suits it. Takes about five minutes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import _common
import _machine
import tyro

_QUICK = _common.Limit(10.0, is_upper=True, unit=" s")


@dataclass(frozen=True)
class Product:
    """A command that a user waits for."""

    script: str
    words: tuple[str, ...]
    limit: _common.Limit | None = None
    """Of its wall seconds."""


ALL = ("--outputs", "all")
PRODUCTS = {
    "all outputs of the evaluation views": Product(
        "unmix-render", ALL, _common.Limit(30.0, is_upper=True, unit=" s")
    ),
    "the same in every format that suits each": Product(
        "unmix-render", (*ALL, "--formats", "envi", "exr", "npy", "png", "mp4")
    ),
    "page": Product("unmix-export", ("page",), _QUICK),
    "report": Product("unmix-export", ("report",), _QUICK),
    "orbit, 120 frames of 512 rows": Product(
        "unmix-render",
        ("--cameras", "orbit", "--frames", "120", "--size", "512x512", "--outputs", "rgb"),
        _common.Limit(90.0, is_upper=True, unit=" s"),
    ),
}


AS_FAST = _common.Limit(1.5, is_upper=True, unit=" times")
_FOUR_VIEWS = (
    "--cameras",
    "dataset-train",
    "--view",
    "0",
    "1",
    "2",
    "3",
    "--size",
    "512x512",
    "--outputs",
    "rgb",
)
_FROM_PYTHON = """
import sys
import unmix_plugin
scene = unmix_plugin.open_run(sys.argv[1], device=sys.argv[2])
for view in scene.views[-4:]:
    scene.look(view.camera.resized(512, 512))["rgb"].cpu()
"""
"""As many views by the library."""


@dataclass(frozen=True)
class Options:
    """Time what is made of a run of a scene."""

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
    """Train, make each product, publish."""
    machine = _machine.describe_machine(options.device)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-export-speed-")))
        run = options.run or train(options, folder)
        setting = describe(run, options)
        measured = {}
        for what, product in PRODUCTS.items():
            print(f"{what} ...", flush=True)
            measured[what] = measure(run, product, options, folder / f"product-{len(measured)}")
        ways = {
            busy: four_views(run, options, folder / f"views-{busy}", busy)
            for busy in (0, os.cpu_count() or 1)
        }
    of = f"{setting['views']} evaluation views of {setting['size']}, {setting['bands']} bands"
    figures = [*judge(measured), *judge_ways(ways)]
    report = _common.Report(
        "export_speed",
        f"Products of a run with {of}",
        setting,
        machine,
        figures,
        {**measured, "four views": ways},
    )
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
        "scene": Path(record["summary"].get("root", "scene")).name,
        "views": len(cameras["camera_to_world"]),
        "size": f"{cameras['width']} x {cameras['height']} pixels",
        "bands": len(metadata["wavelengths_nm"]),
        "rays per pixel": metadata["subpixels"] ** 2,
        "device": options.device,
    }


def measure(run: Path, product: Product, options: Options, output: Path) -> dict[str, Any]:
    """Time one command."""
    words = list(product.words)
    if options.quick and "--frames" in words:
        words[words.index("--frames") + 1] = "4"
    load_average = _machine.load_average()
    arguments = [*words, "--run", str(run), "--output", str(output), "--device", options.device]
    ended = _common.run_command([_common.console_script(product.script), *arguments])
    written = [path for path in output.rglob("*") if path.is_file()]
    return {
        "seconds": ended.seconds,
        "load_average_at_start": load_average,
        "files": len(written),
        "megabytes": sum(path.stat().st_size for path in written) / 1e6,
        "peak_gib": ended.peak_bytes / 2**30,
    }


def four_views(run: Path, options: Options, output: Path, busy: int) -> dict[str, float]:
    """Wall seconds for four views of 512 rows by the command and from Python, beside so many busy processes."""
    by_command = [
        _common.console_script("unmix-render"),
        *_FOUR_VIEWS,
        "--run",
        str(run),
        "--output",
        str(output),
    ]
    ways = {
        "by command": [*by_command, "--device", options.device],
        "from Python": [sys.executable, "-c", _FROM_PYTHON, str(run), options.device],
    }
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
    try:
        return {way: _common.run_command(words).seconds for way, words in ways.items()}
    finally:
        for other in others:
            other.kill()
            other.wait()


def judge_ways(ways: dict[int, dict[str, float]]) -> list[_common.Figure]:
    """Whether the library is as fast as the command, on a busy machine, too."""
    figures = []
    for busy, seconds in ways.items():
        beside = f"beside {busy} busy processes" if busy else "alone"
        figures.append(
            _common.reported(f"four views of 512 rows by command, {beside}", f"{seconds['by command']:.1f} s")
        )
        ratio = seconds["from Python"] / seconds["by command"]
        figures.append(AS_FAST.judge(f"the same from Python, {beside}", ratio))
    return figures


def judge(measured: dict[str, dict[str, Any]]) -> list[_common.Figure]:
    """The times asked for, and what else there is to say."""
    figures = []
    for what, found in measured.items():
        limit, seconds = PRODUCTS[what].limit, found["seconds"]
        figures += [
            _common.reported(what, f"{seconds:.1f} s") if limit is None else limit.judge(what, seconds),
            _common.reported(
                f"{what}: written",
                f"{found['files']} files, {found['megabytes']:.0f} MB, peak memory {found['peak_gib']:.2f} GiB",
            ),
        ]
    loads = ", ".join(f"{found['load_average_at_start']:.1f}" for found in measured.values())
    return [*figures, _common.reported("load average at the start of each", loads)]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
