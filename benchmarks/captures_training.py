"""How well does training do on captures: light that moves, masks that err, a dark scene with blown-out pixels?

    python benchmarks/captures_training.py [--basil FOLDER] [--only basil]

Trains the scene `turntable` for 180 s and the real capture "Basil" for 600 s, with the defaults of everything but the
number of endmembers, and again without each of what captures need: evidence on alpha, light that moves, errors that
follow the brightness. About 45 minutes on two quiet cores.
"""

from __future__ import annotations

import json
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import _basil
import _common
import _machine
import tyro

VARIANTS: dict[str, tuple[str, ...]] = {
    "defaults": (),
    "alpha as law": ("--pipeline.datamanager.trust-alpha",),
    "fixed light": ("--pipeline.model.light", "fixed"),
    "plain errors": (
        *("--pipeline.model.losses.exposure", "1"),
        *("--pipeline.model.losses.relative", "0"),
    ),
}
"""Words that a command gets for each, beside those of the scene."""
USELESS = {("turntable", "plain errors"), ("basil", "alpha as law")}
"""What would change nothing: one scene is well exposed, the other's light does not contradict its alpha."""
SECONDS = {"turntable": 180.0, "basil": 600.0}
"""Of each training."""
_DB, _RAD = " dB", " rad"
LIMITS: dict[str, dict[str, _common.Limit]] = {
    "turntable": {
        "psnr": _common.Limit(30.0, 33.0, unit=_DB),
        "sam": _common.Limit(0.045, is_upper=True, unit=_RAD),
        "miou": _common.Limit(0.82),
        "abundance_rmse": _common.Limit(0.09, is_upper=True),
    },
    "basil": {
        "psnr": _common.Limit(27.0, 29.0, unit=_DB),
        "psnr_unsaturated": _common.Limit(38.0, unit=_DB),
        "psnr_matter_unsaturated": _common.Limit(34.0, unit=_DB),
        "sam": _common.Limit(0.12, is_upper=True, unit=_RAD),
    },
}
SHOWN = (
    *("psnr", "psnr_unsaturated", "psnr_matter", "psnr_matter_unsaturated", "psnr_white"),
    *("ssim", "sam", "miou", "abundance_rmse", "endmember_angle", "train_seconds"),
)


@dataclass(frozen=True)
class Options:
    """Train on captures, with and without what they need."""

    turntable: Path = field(default_factory=lambda: _common.cached_scene("turntable"))
    """The scene turntable of scenes.py; left out where it is missing and Basil is not."""
    basil: Path | None = None
    """The files of "Basil" of HS-NeRF, which docs/background/real-captures.md says where to get."""
    only: tuple[str, ...] = ()
    """Names of the scenes to run, turntable and basil; all if none is given."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which to train; if not all, what is written is named after them, too: captures_training-basil-defaults."""
    steps: int | None = None
    """Of each training; None: the seconds that are asked for."""
    runs: Path | None = None
    """Keep the run folders here."""
    results: Path | None = None
    """Folder for captures_training-SCENE.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """Ten steps of each."""


def main(options: Options) -> None:
    """Measure and publish every scene."""
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-captures-")))
        scenes = _scenes(options, place)
        if not scenes:
            if "turntable" in (options.only or LIMITS):
                _common.require_scenes(options.turntable)
            print("Basil is missing: name the folder of its files (--basil)", file=sys.stderr)
            raise SystemExit(2)
        for name, words in scenes.items():
            _common.publish(
                report(name, words, options, place), _common.results_folder(options.results, options.quick)
            )


def report(name: str, words: list[str], options: Options, place: Path) -> _common.Report:
    """All variants of a scene that would change something."""
    machine = _machine.describe_machine("cpu")
    variants = [variant for variant in options.variants if (name, variant) not in USELESS]
    words = [*words, *_limit(name, options)]
    measured = {
        variant: measure(f"{name}, {variant}", [*words, *VARIANTS[variant]], options, place)
        for variant in variants
    }
    setting = {
        **({"seconds": SECONDS[name]} if options.steps is None else {"steps": options.steps}),
        "variants": {variant: " ".join(VARIANTS[variant]) for variant in variants},
    }
    question = "Evaluation views of a capture, and what each part of training on it is worth"
    figures, tables = judge(name, measured), (details(name, measured),)
    parts = [name, *(variants if options.variants != tuple(VARIANTS) else ())]
    named = "-".join(parts).replace(" ", "-")
    return _common.Report("captures_training", question, setting, machine, figures, measured, tables, named)


def _scenes(options: Options, place: Path) -> dict[str, list[str]]:
    """Words that name each scene and its number of endmembers."""
    found = {}
    turntable, basil = options.turntable, options.basil
    if turntable.is_dir() and "turntable" in (options.only or LIMITS):
        found["turntable"] = ["--data", str(turntable), "--endmembers", "6"]
    if basil is not None and "basil" in (options.only or LIMITS):
        found["basil"] = ["--data", str(_basil.make_scene(basil, place / "basil")), "--endmembers", "3"]
    return found


def _limit(name: str, options: Options) -> list[str]:
    steps = 10 if options.quick else options.steps
    if steps is None:
        return ["--max-seconds", str(SECONDS[name])]
    return ["--max-num-iterations", str(steps)]


def measure(title: str, words: list[str], options: Options, place: Path) -> dict[str, Any]:
    """Train and evaluate."""
    print(f"{title}: training ...", flush=True)
    output = ["--device", "cpu", "--output-dir", str(options.runs or place / "runs")]
    train, evaluate = (_common.console_script(f"unmix-{name}") for name in ("train", "eval"))
    run = _common.run_command([train, "unmix-nerf", *words, *output]).run
    _common.run_command([evaluate, "--run", str(run), "--device", "cpu"])
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    print(f"{title}: PSNR {metrics['psnr']:.2f} dB", flush=True)
    return {name: metrics[name] for name in SHOWN}


def judge(name: str, found: dict[str, dict[str, Any]]) -> list[_common.Figure]:
    """What is asked of the defaults."""
    if "defaults" not in found:
        return []
    return [limit.judge(f"{name}: {key}", found["defaults"][key]) for key, limit in LIMITS[name].items()]


def details(name: str, found: dict[str, dict[str, Any]]) -> _common.DetailTable:
    """Every figure of every variant that there is truth for."""
    rows = [
        [key, *(f"{values[key]:.4g}" for values in found.values())]
        for key in SHOWN
        if all(values[key] is not None for values in found.values())
    ]
    return _common.DetailTable(name, ["metric", *found], rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
