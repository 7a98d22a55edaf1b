"""Do raw counts without poses become as good a scene as with true poses?

    python benchmarks/captures.py [--steps 2000]

Writes the demo scene as an instrument would (`unmix-demo-scene --raw`), makes two scenes of it with `unmix-process`,
one with estimated and one with true poses, trains on both with as many steps, and evaluates both with the truth. All by
the commands that a user would give. Takes about 15 minutes.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro

REGISTERED = _common.Limit(0.95)
POSE_ERROR = _common.Limit(0.5, is_upper=True, unit=" px")
REFLECTANCE_ERROR = _common.Limit(0.01, is_upper=True)
PSNR_LOSS = _common.Limit(1.0, is_upper=True, unit=" dB")
MIOU_LOSS = _common.Limit(0.03, is_upper=True)

KINDS = ("estimated", "true")
EVERY_EVAL = 4
"""Every so many views one is for evaluation."""
COMPARED_VIEWS = 5
"""Views whose reflectance is compared with the truth."""


@dataclass(frozen=True)
class Options:
    """From raw counts to trained scenes, with estimated and with true poses."""

    steps: int = 2000
    """Steps of each training."""
    size: int = 400
    """Width and height of every image, pixels."""
    views: int = 40
    """Images of the capture."""
    mask: str = "black"
    """What --mask of unmix-process is given."""
    folder: Path | None = None
    """Keep capture, scenes and runs here."""
    results: Path | None = None
    """Folder for captures.json and captures.md; None: beside the benchmarks."""
    quick: bool = False
    """24 views of 192 pixels and 40 steps."""


def main(options: Options) -> None:
    """Measure and publish."""
    steps, size, views = (40, 192, 24) if options.quick else (options.steps, options.size, options.views)
    machine = _machine.describe_machine()
    with ExitStack() as stack:
        folder = options.folder or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-capture-"))
        )
        capture = folder / "capture"
        seconds = {"capture": make_capture(capture, size, views)}
        for kind, poses in zip(KINDS, ("estimate", str(capture / "poses-true.json")), strict=True):
            seconds[f"process, {kind} poses"] = process(capture, folder / kind, poses, options.mask)
        measured = {
            "seconds": seconds,
            "poses": pose_errors(folder / "estimated", capture, views),
            "reflectance": reflectance_errors(folder / "true", size, views),
            "dropped_bands": dropped_bands(folder / "true"),
        }
        for kind in KINDS:
            add_truth(folder / kind, capture)
            measured[kind] = train_and_evaluate(folder / kind, steps)
    setting = {
        "steps": steps,
        "size": size,
        "views": views,
        "mask": options.mask,
        "options": "defaults, but --endmembers = number of materials",
    }
    question = "The demo scene as raw counts: estimated poses against true ones"
    tables = (metrics_table(measured), seconds_table(seconds))
    report = _common.Report("captures", question, setting, machine, judge(measured), measured, tables)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def make_capture(folder: Path, size: int, views: int) -> float:
    """Write the raw capture; seconds."""
    words = ["--raw", str(folder), "--size", str(size), "--views", str(views)]
    return _common.run_command([_common.console_script("unmix-demo-scene"), *words]).seconds


def process(capture: Path, scene: Path, poses: str, mask: str) -> float:
    """Make a scene of the capture; seconds."""
    words = ["cubes", "--data", str(capture), "--output-dir", str(scene), "--poses", poses, "--mask", mask]
    for what in ("white", "dark"):
        words += [f"--{what}", str(capture / f"{what}.hdr")]
    print(f"{scene.name} poses: processing ...", flush=True)
    return _common.run_command([_common.console_script("unmix-process"), *words]).seconds


def pose_errors(scene: Path, capture: Path, views: int) -> dict[str, float]:
    """Share of registered views, and how far their poses are from the truth."""
    from tests.factories.poses import align_poses
    from unmix_plugin.captures.poses.reading import read_poses

    estimated, truth = read_poses(scene / "transforms.json"), read_poses(capture / "poses-true.json")
    by_stem = {Path(name).stem: name for name in truth.cameras}
    names = {name: by_stem[Path(name).stem] for name in estimated.cameras}
    found = align_poses(estimated, truth, names)
    return {
        "registered_share": len(names) / views,
        "rms_px": found.rms_px,
        "largest_px": float(found.errors_px.max()),
        "rotation_deg": float(found.rotation_errors_deg.mean()),
        "position": float(found.position_errors.mean()),
    }


def reflectance_errors(scene: Path, size: int, views: int) -> dict[str, float]:
    """Mean absolute difference between the scene's cubes and what was rendered, without noise, on matter."""
    from unmix_plugin.scenes.demo.scene import demo_cameras, reflected
    from unmix_plugin.scenes.demo.shading import reflectances, render_view, speckled_things

    record = json.loads((scene / "process.json").read_text(encoding="utf-8"))["stored"]
    content = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    spectra = reflectances(np.array(content["wavelengths"]))
    cameras, things = demo_cameras(size, views), speckled_things()
    errors, levels = [], []
    for index in np.linspace(0, views - 1, COMPARED_VIEWS).astype(int).tolist():
        view = render_view(cameras, index, things=things)
        matter = view.alpha >= 0.5
        expected = reflected(view, spectra)[matter].clip(0, record["calibrated_value_of_1"])
        stored = np.load(scene / "cubes" / f"view_{index:03d}.npy")[matter]
        found = stored * (record["calibrated_value_of_1"] / record["value_scale"])
        errors.append(np.abs(found - expected).mean())
        levels.append(expected.mean())
    return {"mean_error": float(np.mean(errors)), "mean_reflectance": float(np.mean(levels))}


def dropped_bands(scene: Path) -> list[str]:
    """Bands that were left out, with the reason."""
    record = json.loads((scene / "process.json").read_text(encoding="utf-8"))
    (sensor,) = record["plan"]["sensors"].values()
    return [f"{band['wavelength_nm']:g} nm: {band['reason']}" for band in sensor["dropped_bands"]]


def add_truth(scene: Path, capture: Path) -> None:
    """Give a scene the true labels and the same evaluation views as the other."""
    path = scene / "transforms.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    shutil.copytree(capture / "truth", scene / "truth", dirs_exist_ok=True)
    names: dict[bool, list[str]] = {True: [], False: []}
    for frame in content["frames"]:
        stem = Path(frame["file_path"]).stem
        frame["seg_file_path"] = f"truth/{stem}.png"
        is_eval = int(stem.removeprefix("view_")) % EVERY_EVAL == EVERY_EVAL // 2
        names[is_eval].append(frame["file_path"])
    content |= {"train_filenames": names[False], "val_filenames": names[True], "test_filenames": names[True]}
    content["materials"] = list(materials())
    path.write_text(json.dumps(content), encoding="utf-8")


def materials() -> tuple[str, ...]:
    """What the demo scene is made of."""
    from unmix_plugin.scenes.demo.shading import MATERIALS

    return MATERIALS


def train_and_evaluate(scene: Path, steps: int) -> dict[str, Any]:
    """Figures of the evaluation views."""
    words = ["unmix-nerf", "--data", str(scene), "--endmembers", str(len(materials()))]
    words += ["--max-num-iterations", str(steps), "--output-dir", str(scene.parent / "runs")]
    print(f"{scene.name} poses: training {steps} steps ...", flush=True)
    trained = _common.run_command([_common.console_script("unmix-train"), *words])
    _common.run_command([_common.console_script("unmix-eval"), "--run", str(trained.run)])
    metrics = json.loads((trained.run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    return {key: value for key, value in metrics.items() if key not in ("definitions", "per_view")}


def judge(measured: dict[str, Any]) -> list[_common.Figure]:
    """What was asked of each step."""
    poses, reflectance = measured["poses"], measured["reflectance"]
    psnr_loss, miou_loss = (measured["true"][key] - measured["estimated"][key] for key in ("psnr", "miou"))
    relative = reflectance["mean_error"] / reflectance["mean_reflectance"]
    return [
        REGISTERED.judge("share of views that were registered", poses["registered_share"]),
        POSE_ERROR.judge("pose error, root mean square over points and views", poses["rms_px"]),
        _common.reported("pose error of the worst view", f"{poses['largest_px']:.3g} px"),
        REFLECTANCE_ERROR.judge("mean error of reflectance on matter", reflectance["mean_error"]),
        _common.reported("the same as a share of the mean reflectance", f"{relative:.2%}"),
        _common.reported("bands left out", "; ".join(measured["dropped_bands"])),
        PSNR_LOSS.judge("PSNR lost to estimated poses", psnr_loss),
        MIOU_LOSS.judge("mIoU lost to estimated poses", miou_loss),
    ]


def metrics_table(measured: dict[str, Any]) -> _common.DetailTable:
    """Every metric of both trainings."""
    rows = [[key, *(_number(measured[kind][key]) for kind in KINDS)] for key in measured["true"]]
    return _common.DetailTable("All metrics", ["metric", *(f"{kind} poses" for kind in KINDS)], rows)


def seconds_table(seconds: dict[str, float]) -> _common.DetailTable:
    """What the commands took."""
    return _common.DetailTable(
        "Seconds", ["command", "s"], [[name, f"{value:.0f}"] for name, value in seconds.items()]
    )


def _number(value: Any) -> str:
    return "no truth" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
