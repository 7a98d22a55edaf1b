"""Do captures train as well before any plain backdrop, with a mask that nobody named and without one?

    python benchmarks/backdrops.py [--size 200 --steps 400 --poses true]

Writes the demo scene as an instrument would, before a backdrop that sends no light, one that is grey, one that is
white, and a shaded floor that meets a round wall in a seam; makes scenes of the raw counts without references, with the
default mask and with `--mask none`; trains each as long, and evaluates it against its own cubes. About 40 minutes on
two quiet cores.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro

from unmix_plugin.captures.demo import POSES, Backdrop, make_demo_capture

MASKS = ("auto", "none")
LIMITS = {"auto": _common.Limit(30.0, unit=" dB"), "none": _common.Limit(28.0, unit=" dB")}
"""Of evaluation views before the black backdrop."""
LOSS = _common.Limit(1.0, is_upper=True, unit=" dB")
"""Of the others against that one."""
_FLOOR_HEIGHT, _WALL_RADIUS = -0.6, 7.0
"""Of the shaded backdrop, in the demo scene's units."""


def shaded_with_a_seam(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Light of a floor and of the round wall behind it, lit from one side."""
    down = np.minimum(directions[:, 2], -1e-6)
    to_floor = np.where(directions[:, 2] < 0, (_FLOOR_HEIGHT - origins[:, 2]) / down, np.inf)
    across, place = directions[:, :2], origins[:, :2]
    a, b = (across**2).sum(axis=1), (across * place).sum(axis=1)
    to_wall = (np.sqrt(b * b - a * ((place**2).sum(axis=1) - _WALL_RADIUS**2)) - b) / a
    x, y, z = (origins + np.minimum(to_floor, to_wall)[:, None] * directions).T
    shade = 0.75 + 0.25 * np.cos(np.arctan2(y, x) - 0.6)
    floor, wall = 0.5 * (1 - 0.04 * np.hypot(x, y)), 0.35 * (1 - 0.06 * (z - _FLOOR_HEIGHT))
    return shade * np.where(to_floor < to_wall, floor, wall)


BACKDROPS: dict[str, Backdrop | None] = {
    "black": None,
    "grey": lambda _, directions: np.full(len(directions), 0.2),
    "white": lambda _, directions: np.full(len(directions), 0.95),
    "seam": shaded_with_a_seam,
}


@dataclass(frozen=True)
class Options:
    """Train before plain backdrops."""

    only: tuple[str, ...] = tuple(BACKDROPS)
    """Which backdrops."""
    seconds: float = 180.0
    """Of each training."""
    steps: int | None = None
    """Of each training, in place of seconds."""
    size: int = 400
    """Width and height of every image, pixels."""
    views: int = 40
    """Images of the capture."""
    poses: str = "estimate"
    """What --poses of unmix-process is given; true for those of the capture."""
    folder: Path | None = None
    """Keep captures, scenes and runs here; captures and scenes that are there are used."""
    results: Path | None = None
    """Folder for backdrops.json and backdrops.md; None: beside the benchmarks."""
    quick: bool = False
    """24 views of 96 pixels, true poses and 20 steps."""


def main(options: Options) -> None:
    """Measure and publish."""
    if options.quick:
        options = Options(options.only, 5.0, 20, 96, 24, "true", options.folder, options.results, True)
    measured: dict[str, dict[str, Any]] = {}
    with ExitStack() as stack:
        folder = options.folder or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-backdrops-"))
        )
        for name in options.only:
            capture = folder / name
            if not capture.is_dir():
                make_demo_capture(capture, options.size, views=options.views, backdrop=BACKDROPS[name])
            for mask in MASKS:
                measured[f"{name}, {mask}"] = measure(capture, mask, options)
    setting = {name: getattr(options, name) for name in ("seconds", "steps", "size", "views", "poses")}
    question = "Evaluation views of captures before plain backdrops, by the mask of unmix-process"
    rows = [[name, *(f"{value:.4g}" for value in found.values())] for name, found in measured.items()]
    table = _common.DetailTable("trainings", ["backdrop, mask", *next(iter(measured.values()))], rows)
    report = _common.Report(
        "backdrops",
        question,
        setting,
        _machine.describe_machine("cpu"),
        judge(measured),
        measured,
        (table,),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def measure(capture: Path, mask: str, options: Options) -> dict[str, Any]:
    """Process, train and evaluate."""
    scene = capture.with_name(f"{capture.name}-{mask}")
    process, train, evaluate = (
        _common.console_script(f"unmix-{name}") for name in ("process", "train", "eval")
    )
    poses = str(capture / POSES) if options.poses == "true" else options.poses
    words = ["cubes", "--data", str(capture), "--output-dir", str(scene), "--poses", poses, "--mask", mask]
    if not scene.is_dir():
        _common.run_command([process, *words])
    record = json.loads((scene / "process.json").read_text(encoding="utf-8"))
    print(f"{scene.name}: training ...", flush=True)
    words = [
        "unmix-nerf",
        "--data",
        str(scene),
        "--device",
        "cpu",
        "--output-dir",
        str(capture.parent / "runs"),
    ]
    seconds, steps = str(options.seconds), options.steps
    limit = ["--max-seconds", seconds] if steps is None else ["--max-num-iterations", str(steps)]
    run = _common.run_command([train, *words, *limit]).run
    _common.run_command([evaluate, "--run", str(run), "--device", "cpu"])
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    matter = float(np.mean([view["matter_share"] for view in record["views"]]))
    found = {"psnr": metrics["psnr"], "psnr_matter": metrics["psnr_matter"], "ssim": metrics["ssim"]}
    print(f"{scene.name}: PSNR {found['psnr']:.2f} dB", flush=True)
    return {**found, "matter_share": matter, "train_seconds": metrics["train_seconds"]}


def judge(measured: dict[str, dict[str, Any]]) -> list[_common.Figure]:
    """What is asked before the black backdrop, and of the others against it."""
    figures = []
    for mask in MASKS:
        black = measured.get(f"black, {mask}")
        for name in BACKDROPS:
            found = measured.get(f"{name}, {mask}")
            if found is None:
                continue
            if name == "black":
                figures.append(LIMITS[mask].judge(f"black backdrop, --mask {mask}: PSNR", found["psnr"]))
            elif black is not None:
                figures.append(
                    LOSS.judge(f"{name} backdrop, --mask {mask}: PSNR lost", black["psnr"] - found["psnr"])
                )
    return figures


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
