"""Do poses that are off come back, and do line cameras train as well as frames?

    python benchmarks/poses.py [--steps 10000] [--line-steps 10000]

The demo scene with the poses of all views off by 10 px in the mean is trained with `--poses refine`, beside the same
scene with its true poses and beside the wrong poses taken as they are. Then 16 sweeps of line cameras, with a slow
wobble of 10 px that their poses don't know, against 16 frames of as many pixels with true poses. They are evaluated on
frames, which see how far the world was bent, and on sweeps that wobble as well, as users of line cameras have them.
Poses are compared after a similarity; all trainings of a part take equally many steps.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import _common
import _machine
import torch
import tyro
from _pose_scenes import SWEPT, PosedScene, frames_off, pose_error, sweeps, views_for

from unmix_plugin.engine.geometry.cameras import Cameras

ERROR_PX = 10.0
"""Of the poses, mean over points and views."""
NUM_SWEEPS = 16
REFINE = ("--poses", "refine")
SHOWN = ("psnr", "psnr_matter", "ssim", "sam", "miou", "train_seconds")


@dataclass(frozen=True)
class Options:
    """Train on poses that are off and on line cameras."""

    steps: int = 10_000
    """Of each training on frames that are off: as many as a training has by default."""
    line_steps: int = 10_000
    """Of each training on line cameras, and of that on frames beside them."""
    size: int = 96
    """Edge of the pictures, pixels."""
    bands: int = 31
    seed: int = 0
    """Of the errors of poses."""
    views: int = 32
    """Of the scene of frames; three quarters are trained on."""
    samples_per_step: int = 25_000
    """Samples marched in a training step."""
    only: tuple[str, ...] = ()
    """Which parts to run, frames and lines; both if none is given. A part has a record of its own."""
    variants: tuple[str, ...] = ()
    """Which trainings of a part to run, such as "frames" "sweeps with wobble, refined"; all if none is given."""
    results: Path | None = None
    """Folder for poses.json and poses.md; None: beside the benchmarks."""
    quick: bool = False
    """A few steps on small pictures, to see that the benchmark works."""


def main(options: Options) -> None:
    """Make the scenes, train, measure, publish."""
    if options.quick:
        options = replace(options, steps=30, line_steps=30, size=32, bands=6, views=12)
    machine, measured, figures = _machine.describe_machine("cpu"), {}, []
    with tempfile.TemporaryDirectory(prefix="unmix-poses-") as folder:
        for name, run in {"frames": run_frames, "lines": run_lines}.items():
            if not options.only or name in options.only:
                measured[name] = run(options, Path(folder) / name)
                figures += JUDGES[name](measured[name])
    setting = {
        name: getattr(options, name)
        for name in ("steps", "line_steps", "size", "bands", "seed", "views", "samples_per_step")
    }
    question = "Poses off by 10 px, refined while training, and sweeps of line cameras, at equal steps"
    tables = tuple(_details(name, found) for name, found in measured.items())
    report = _common.Report(
        "-".join(("poses", *options.only)),
        question,
        {**setting, "error_px": ERROR_PX, "sweeps": NUM_SWEEPS},
        machine,
        figures,
        measured,
        tables,
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def run_frames(options: Options, place: Path) -> dict[str, Any]:
    """True poses; wrong ones, taken as they are and refined."""
    off = [
        frames_off(place / f"{error:g}", *_size(options), options.views, error, options.seed)
        for error in (0, ERROR_PX)
    ]
    trainings = {
        "true poses": (off[0], ()),
        "off, as they are": (off[1], ()),
        "off, refined": (off[1], REFINE),
    }
    return measure_all(trainings, options, options.steps, place)


def run_lines(options: Options, place: Path) -> dict[str, Any]:
    """As many frames with true poses; sweeps with a wobble, refined, and without it."""
    wobbling = sweeps(place / "wobble", *_size(options), NUM_SWEEPS, ERROR_PX, options.seed)
    steady = sweeps(place / "steady", *_size(options), NUM_SWEEPS, 0.0, options.seed)
    frames = frames_off(place / "frames", *_size(options), views_for(NUM_SWEEPS), 0.0, options.seed)
    trainings = {
        "frames": (frames, ()),
        "sweeps": (steady, ()),
        "sweeps with wobble, as they are": (wobbling, ()),
        "sweeps with wobble, refined": (wobbling, REFINE),
    }
    return measure_all(trainings, options, options.line_steps, place)


def measure_all(
    trainings: dict[str, tuple[PosedScene, tuple[str, ...]]], options: Options, steps: int, place: Path
) -> dict[str, Any]:
    """Those trainings that are wanted, each with its scene and the words that it is trained with."""
    return {
        name: measure(scene, words, options, steps, place)
        for name, (scene, words) in trainings.items()
        if not options.variants or name in options.variants
    }


def measure(
    scene: PosedScene, words: tuple[str, ...], options: Options, steps: int, place: Path
) -> dict[str, Any]:
    """Train, evaluate, and compare the poses of the training views."""
    trainer = _common.quiet_trainer(
        [
            *(
                "unmix-nerf",
                "--data",
                str(scene.folder),
                "--output-dir",
                str(place / "runs"),
                "--device",
                "cpu",
            ),
            *("--max-num-iterations", str(steps), *words),
            *("--pipeline.model.samples-per-step", str(options.samples_per_step)),
        ]
    )
    trainer.train()
    run = trainer.run.path
    _common.run_command([_common.console_script("unmix-eval"), "--run", str(run), "--device", "cpu"])
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    found = {name: metrics[name] for name in SHOWN} | _by_kind(metrics["per_view"])
    found |= {
        "aligned": metrics.get("aligned", []),
        "poses_px": trained_error(scene, run),
        "given_px": scene.error_px,
    }
    print(
        f"{scene.folder.name} {' '.join(words)}: {found['psnr']:.2f} dB, {found['poses_px']:.2f} px",
        flush=True,
    )
    return found


def _by_kind(views: list[dict[str, Any]]) -> dict[str, float]:
    """Figures of evaluation views that are frames, and PSNR of those that are sweeps, where there are any."""
    swept = [view for view in views if view["name"].startswith(SWEPT)]
    frames = [view for view in views if not view["name"].startswith(SWEPT)]

    def mean(chosen: list[dict[str, Any]], name: str) -> float:
        return sum(view[name] for view in chosen) / len(chosen)

    if not swept:
        return {}
    own = {name: mean(frames, name) for name in ("psnr", "psnr_matter", "ssim", "sam")}
    return own | {"psnr_of_sweeps": mean(swept, "psnr")}


def trained_error(scene: PosedScene, run: Path) -> float:
    """How far the run's training cameras are from the true ones, pixels."""
    from unmix_plugin.trained.open_run import load_run

    loaded = load_run(run, "cpu")
    views = [view.camera for view in loaded.scene.views if view.split == "train"]
    chosen = loaded.record.summary["train_indices"]
    truth = scene.truth[chosen] if len(scene.truth) > len(views) else scene.truth
    errors = _in_world(views, loaded.scene.frame)
    return pose_error(truth, errors)


def _in_world(views: list[Cameras], frame: Any) -> Cameras:
    """One-camera values in model space as cameras in the world."""
    from unmix_plugin.engine.geometry.key_poses import KeyPoses

    rotation = torch.tensor(frame.rotation.T, dtype=torch.float64)

    def world(poses: torch.Tensor) -> torch.Tensor:
        places = torch.tensor(frame.to_world(poses[:, :, 3].double().numpy()))
        return torch.cat([rotation @ poses[:, :, :3].double(), places[:, :, None]], dim=-1).float()

    keys = [view.key_poses for view in views]
    joined = (
        KeyPoses.join([replace(key, poses=world(key.poses)) for key in keys if key is not None])
        if keys[0]
        else None
    )
    return Cameras(
        world(torch.cat([view.camera_to_world for view in views])),
        torch.cat([view.focal_px for view in views]),
        torch.cat([view.center_px for view in views]),
        torch.cat([view.distortion for view in views]),
        views[0].width,
        views[0].height,
        key_poses=joined,
    )


def judge_frames(found: dict[str, Any]) -> list[_common.Figure]:
    """What is asked of poses that are off."""
    given = _lost(found, "true poses", "off, as they are", "psnr")
    return [
        _common.reported("poses off, as they are: PSNR lost", "" if given is None else f"{given:.2f} dB"),
        _common.Limit(1.0, is_upper=True, unit=" dB").judge(
            "poses off, refined: PSNR lost", _lost(found, "true poses", "off, refined", "psnr")
        ),
        _common.Limit(0.03, is_upper=True).judge(
            "poses off, refined: mIoU lost", _lost(found, "true poses", "off, refined", "miou")
        ),
        _common.Limit(1.0, is_upper=True, unit=" px").judge(
            "poses off, refined: error left", found.get("off, refined", {}).get("poses_px")
        ),
    ]


def judge_lines(found: dict[str, Any]) -> list[_common.Figure]:
    """What is asked of line cameras."""
    refined = "sweeps with wobble, refined"
    steady = _lost(found, "frames", "sweeps", "psnr")
    return [
        _common.reported(
            "sweeps without wobble: PSNR below frames", "" if steady is None else f"{steady:.2f} dB"
        ),
        _common.Limit(1.5, is_upper=True, unit=" dB").judge(
            "sweeps with wobble, refined: PSNR below frames", _lost(found, "frames", refined, "psnr")
        ),
        _common.Limit(1.5, is_upper=True, unit=" dB").judge(
            "the same, evaluation views swept too", _lost(found, "frames", refined, "psnr", "psnr_of_sweeps")
        ),
        _common.Limit(1.0, is_upper=True, unit=" px").judge(
            "sweeps, refined: wobble left", found.get(refined, {}).get("poses_px")
        ),
    ]


def _lost(
    found: dict[str, Any], best: str, other: str, figure: str, other_figure: str | None = None
) -> float | None:
    """By how much one training is below another; None where one of them was not measured."""
    values = [found.get(best, {}).get(figure), found.get(other, {}).get(other_figure or figure)]
    return None if None in values else values[0] - values[1]


JUDGES = {"frames": judge_frames, "lines": judge_lines}


def _size(options: Options) -> tuple[int, int]:
    return options.size, options.bands


def _details(name: str, found: dict[str, Any]) -> _common.DetailTable:
    keys = (*SHOWN, "psnr_of_sweeps", "given_px", "poses_px", "aligned")
    rows = [[key, *(_text(values.get(key)) for values in found.values())] for key in keys]
    return _common.DetailTable(name, ["metric", *found], rows)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(value) or "nothing"
    return "not measured" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
