"""Does everything work on a CUDA GPU, and how fast is it there?

    python benchmarks/gpu.py

One command of at most nine minutes. Where PyTorch finds a GPU it runs every test that uses one, times each operator
beside its PyTorch twin, trains the scene table for 20 s and the built-in scene at 512 x 512 pixels for 30 s,
evaluates both, and measures a frame of 512 x 512 pixels as the viewer shows it. Elsewhere it says why not and writes
nothing.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Literal

import _common
import _machine
import tyro

TESTS = ("tests/gpu", "tests/operators", "tests/test_model.py", "tests/engine/test_second_method.py")
IN_PARALLEL = ("-n", "8", "-p", "no:benchmark")  # a plugin that refuses to be beside others
SIDE = 512
FRAME_RATE = _common.Limit(30, unit=" frames/s")
SAMPLES_PER_SECOND = _common.Limit(10e6, unit=" samples/s")
TABLE = _common.Limit(35, unit=" dB")
LARGE_SCENE = _common.Limit(33, unit=" dB")


@dataclass(frozen=True)
class Options:
    """Tests, operators, trainings and viewer frames on a CUDA GPU."""

    scenes: Path = field(default_factory=_common.scenes_folder)
    """Folder that holds the scene table."""
    results: Path | None = None
    """Folder for gpu.json and the table; None: beside the benchmarks."""
    rehearse: bool = False
    """Do it all on the CPU, small, to see that it would work; figures mean nothing and nothing is written."""

    leave_out: tuple[str, ...] = ()
    """Parts to leave out where time is short: operators, table, "large scene", viewer."""

    @property
    def device(self) -> Literal["cpu", "cuda"]:
        """Where to compute."""
        return "cpu" if self.rehearse else "cuda"


def main(options: Options) -> None:
    """Measure and publish, or say why not."""
    from unmix_plugin.engine.machine import resolve_device
    from unmix_plugin.errors import ConfigError

    try:
        resolve_device(options.device)
    except ConfigError as error:
        print(f"nothing measured: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    if "table" not in options.leave_out:
        _common.require_scenes(options.scenes / "table")
    figures, measured = [run_tests()], {}
    with TemporaryDirectory(prefix="unmix-gpu-") as folder:
        for name, part in parts(Path(folder), options).items():
            if name in options.leave_out:
                continue
            try:
                found, measured[name] = part()
            except (Exception, SystemExit) as error:  # noqa: BLE001 - a result like another, and the rest is wanted
                traceback.print_exc()
                found = _common.required(name, "an end", False, f"{type(error).__name__}: {error}"[:200])
            figures.append(found)
            print(found, flush=True)
    report = _common.Report(
        "gpu",
        "Tests, operators, trainings and viewer frames on a CUDA GPU",
        {"device": options.device, "large scene": f"built-in, {SIDE} x {SIDE} pixels"},
        _machine.describe_machine(options.device),
        figures,
        measured,
        (),
    )
    _common.publish(report, _common.results_folder(options.results, options.rehearse))


def run_tests() -> _common.Figure:
    """Every test that computes on CUDA."""
    words = ["-q", "--tb=short", *IN_PARALLEL, "-k", "cuda or gpu or CUDA", *TESTS]
    words = [sys.executable, "-m", "pytest", *words]
    ended = subprocess.run(words, cwd=_common.REPOSITORY, capture_output=True, text=True, check=False)
    print(ended.stdout, ended.stderr, flush=True)
    return _common.required(
        "tests that use the GPU", "pass", ended.returncode == 0, ended.stdout.splitlines()[-1]
    )


def parts(work: Path, options: Options) -> dict[str, Callable[[], tuple[_common.Figure, Any]]]:
    """What is measured after the tests, by name; the last one looks at what the one before trained."""
    table, large = options.scenes / "table", work / "large"
    return {
        "operators": partial(time_operators, work, options),
        "table": partial(train, table, work, 20, 7, TABLE, options),
        "large scene": partial(train, large, work, 30, 6, LARGE_SCENE, options),
        "viewer": partial(frame_rate, work, options.device),
    }


def time_operators(work: Path, options: Options) -> tuple[_common.Figure, Any]:
    """Rendering operators beside their twins, by the benchmark made for it."""
    script = Path(__file__).with_name("operators.py")
    words = [sys.executable, script, "--device", options.device, "--results", work]
    subprocess.run([*words, *["--quick"] * options.rehearse], check=True)
    (written,) = work.glob("operators*.json")
    found = json.loads(written.read_text())["measured"]
    slowest = min(values["samples_per_second"]["kernel"] for values in found["operators"].values())
    return SAMPLES_PER_SECOND.judge("slowest operator", slowest), found


def train(
    data: Path, work: Path, seconds: int, materials: int, limit: _common.Limit, options: Options
) -> tuple[_common.Figure, Any]:
    """PSNR of evaluation views after some seconds of training with the defaults, and the other metrics."""
    from unmix_plugin.scenes.demo.scene import make_demo_scene

    if not data.exists():
        make_demo_scene(data, 32 if options.rehearse else SIDE)
    seconds = 3 if options.rehearse else seconds
    device = ("--device", options.device)
    words = ["unmix-nerf", "--data", data, "--output-dir", work / data.name, *device]
    words += ["--max-seconds", seconds, "--endmembers", materials, "--viewer.no-enabled"]
    run = _common.run_command([_common.console_script("unmix-train"), *map(str, words)]).run
    _common.run_command([_common.console_script("unmix-eval"), "--run", str(run), *device])
    values = json.loads((run / "eval" / "metrics.json").read_text())
    return limit.judge(f"{data.name}: PSNR after {seconds} s", values["psnr"]), values


def frame_rate(work: Path, device: str) -> tuple[_common.Figure, Any]:
    """Pictures a second of one view of the run of the large scene, with their copy to the host."""
    from unmix_plugin import open_run

    (config,) = (work / "large").rglob("config.json")
    scene = open_run(config.parent, device=device)
    camera, seconds = scene.views[0].camera.resized(SIDE, SIDE), []
    for _ in range(30):
        started = time.perf_counter()
        scene.look(camera, subpixels=1)["rgb"].cpu()
        seconds.append(time.perf_counter() - started)
    return FRAME_RATE.judge(f"viewer at {SIDE} x {SIDE}", 1 / median(seconds[5:])), seconds


if __name__ == "__main__":
    main(tyro.cli(Options))
