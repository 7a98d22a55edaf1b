"""Do edits of materials and light do what they say?

    python benchmarks/editing.py [--run RUN] [--lit-run RUN]

Trains on a scene with known materials and on the built-in scene by the commands that a user would give, edits the runs
by recipes, and measures evaluation views:

- swapping two endmembers twice against the original;
- replacing the endmember that stands for the best separated material (largest intersection over union) by the true
  reflectance of each other material: spectral angle between the pixels of which it is at least nine tenths and that
  reflectance in the scene's light;
- retinting the same endmember: CIEDE2000 between the asked colour and the mean sRGB colour of the pixels of which it is
  at least three quarters;
- lighting the built-in scene, learnt in daylight, with illuminant A: mean CIEDE2000, over all pixels that show matter,
  to the same views that the scene's generator makes under A, at the same exposure by the rule that edits follow.

Takes eight minutes, less with runs that are there already.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import _common
import _edits
import _machine
import tyro

SWAP = _common.Limit(1e-6, is_upper=True)
REPLACE = _common.Limit(0.1, is_upper=True, unit=" rad")
RETINT = _common.Limit(3.0, is_upper=True)
RELIGHT = _common.Limit(3.0, is_upper=True)


@dataclass(frozen=True)
class Options:
    """Edit a run with known materials, and relight a run of the built-in scene."""

    scene: Path = field(default_factory=lambda: _common.cached_scene("table"))
    """Scene with true materials, light and labels."""
    run: Path | None = None
    """A run of it; None trains one."""
    lit_run: Path | None = None
    """A run of the built-in scene; None trains one."""
    max_seconds: float = 180.0
    """Seconds of training of each run that is trained."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train and render."""
    results: Path | None = None
    """Folder for editing.json and editing.md; None: beside the benchmarks."""
    quick: bool = False
    """Three seconds of training."""


def main(options: Options) -> None:
    """Measure and publish."""
    if options.run is None:
        _common.require_scenes(options.scene)
    machine = _machine.describe_machine(options.device)
    seconds = 3.0 if options.quick else options.max_seconds
    with tempfile.TemporaryDirectory(prefix="unmix-editing-") as folder:
        run = options.run or train(options.scene, seconds, options.device, Path(folder))
        lit_run = options.lit_run or train(Path("demo"), seconds, options.device, Path(folder))
        subject = _edits.Subject.of(run, options.scene, options.device)
        measured: dict[str, Any] = {
            "train_seconds": {"edited run": train_seconds(run), "relit run": train_seconds(lit_run)},
            "swap": _edits.measure_swap(subject),
            "replace": _edits.measure_replacing(subject, options.scene),
            "retint": _edits.measure_retinting(subject),
            "relight": _edits.measure_relighting(lit_run, Path(folder), options.device),
        }
    setting = {
        "scene": options.scene.name,
        "seconds of training": measured["train_seconds"],
        "options": "defaults, but --pipeline.model.num-endmembers = number of materials",
        "device": options.device,
    }
    report = _common.Report(
        "editing",
        "Edits of materials and light, on evaluation views",
        setting,
        machine,
        judge(measured),
        measured,
        details(measured),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def train(data: Path, max_seconds: float, device: str, runs: Path) -> Path:
    """Train on a scene; the run folder."""
    import json

    count = 6
    if data != Path("demo"):
        count = len(json.loads((data / "transforms.json").read_text(encoding="utf-8"))["materials"])
    print(f"{data.name}: training {max_seconds:g} s with {count} endmembers ...", flush=True)
    words = ["unmix-nerf", "--data", str(data), "--max-seconds", str(max_seconds), "--device", device]
    words += ["--output-dir", str(runs), "--pipeline.model.num-endmembers", str(count)]
    return _common.run_command([_common.console_script("unmix-train"), *words]).run


def train_seconds(run: Path) -> float:
    """How long a run was trained."""
    from unmix_plugin.engine.runs.loading import load_model

    return load_model(run, "cpu").training.train_seconds


def judge(measured: dict[str, Any]) -> list[_common.Figure]:
    """The lines of the table."""
    replacing, retinting, lit = measured["replace"], measured["retint"], measured["relight"]
    angles = list(replacing["angle_rad"].values())
    before = list(replacing["angle_before_rad"].values())
    worst = max(found["pictures"] for found in retinting.values())
    loose = max(found["pictures, share of half"] for found in retinting.values())
    own = max(found["spectrum, match: spectrum"] for found in retinting.values())
    of = f"{replacing['material']} ({replacing['pixels']} pixels, IoU {replacing['intersection over union']:.2f})"
    return [
        SWAP.judge("swap twice: greatest difference to the original", measured["swap"]["twice"]),
        _common.reported("swap once: the same", f"{measured['swap']['once']:.3f}"),
        REPLACE.judge(
            f"replace {of}: mean angle to the new material, mean over materials", sum(angles) / len(angles)
        ),
        _common.reported("the same, worst and best material", f"{max(angles):.3f} and {min(angles):.3f} rad"),
        _common.reported("the same before replacing, mean", f"{sum(before) / len(before):.3f} rad"),
        RETINT.judge(
            f"retint {replacing['material']}: mean colour of its pixels, worst of {len(retinting)}", worst
        ),
        _common.reported("the same over all pixels of which it is at least half", f"{loose:.2f}"),
        _common.reported("retint with match: spectrum: colour of the spectrum, worst", f"{own:.3f}"),
        RELIGHT.judge("relight with A: mean CIEDE2000 to the scene made in A", lit["relit"]),
        _common.reported(
            "the same of the scene measured in daylight and relit", f"{lit['measured and relit']:.3f}"
        ),
        _common.reported("the same without relighting", f"{lit['not relit']:.2f}"),
        _common.reported(
            f"the run's own error in daylight, as learnt ({lit['psnr']:.1f} dB)", f"{lit['as learnt']:.2f}"
        ),
    ]


def details(measured: dict[str, Any]) -> tuple[_common.DetailTable, ...]:
    """Each replacement and each colour."""
    replacing = measured["replace"]
    rows = [
        [name, f"{angle:.3f}", f"{replacing['angle_before_rad'][name]:.3f}"]
        for name, angle in replacing["angle_rad"].items()
    ]
    headers = ["replaced by", "mean angle, rad", "before"]
    colours = [
        [colour, *(f"{value:.4g}" for value in found.values())]
        for colour, found in measured["retint"].items()
    ]
    names = list(next(iter(measured["retint"].values())))
    return (
        _common.DetailTable(f"{replacing['material']} replaced", headers, rows),
        _common.DetailTable("Colours: CIEDE2000", ["asked", *names], colours),
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
