"""How well does training do on captures: light that moves, masks that err, a dark scene with blown-out pixels?

    python benchmarks/captures_training.py [--max-seconds 600]

Trains the scene `turntable` and the real capture "Basil" with the defaults of everything but the number of endmembers,
and again without each of what captures need: evidence on alpha, light that moves, exposure. All variants of a scene
take the same number of steps, or the same seconds, after which what is written is named (captures_training-600s).
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
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
    "no exposure": ("--pipeline.model.losses.exposure", "1", "--pipeline.model.losses.outlier", "1000"),
}
"""Words that a command gets for each, beside those of the scene."""
USELESS = {("turntable", "no exposure"), ("basil", "alpha as law")}
"""What would change nothing: one scene is well exposed, the other's light does not contradict its alpha."""
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

    shared: Path = _common.REPOSITORY.parent / "shared"
    """Folder with scenes/turntable and real/basil; what is missing is left out."""
    only: tuple[str, ...] = ()
    """Names of the scenes to run, turntable and basil; all if none is given."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which to train."""
    steps: int = 500
    """Of each training."""
    max_seconds: float | None = None
    """Of each training, instead of steps."""
    runs: Path | None = None
    """Keep the run folders here."""
    results: Path | None = None
    """Folder for captures_training.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """Ten steps of each."""


def main(options: Options) -> None:
    """Measure every scene and publish."""
    machine, measured = _machine.describe_machine("cpu"), {}
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-captures-")))
        for name, words in _scenes(options, place).items():
            words = [*words, *_limit(options)]
            measured[name] = {
                variant: measure(f"{name}, {variant}", [*words, *VARIANTS[variant]], options, place)
                for variant in options.variants
                if (name, variant) not in USELESS
            }
    if not measured:
        print(f"no scene to measure in {options.shared}")
        return
    seconds = options.max_seconds
    setting = {
        **({"steps": options.steps} if seconds is None else {"seconds": seconds}),
        "variants": {name: " ".join(VARIANTS[name]) for name in options.variants},
    }
    figures = [figure for name, found in measured.items() for figure in judge(name, found)]
    tables = tuple(details(name, found) for name, found in measured.items())
    question = "Evaluation views of captures, and what each part of training on them is worth"
    report = _common.Report(
        "captures_training",
        question,
        setting,
        machine,
        figures,
        measured,
        tables,
        _common.seconds_variant(seconds),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def _scenes(options: Options, place: Path) -> dict[str, list[str]]:
    """Words that name each scene and its number of endmembers."""
    found = {}
    turntable, basil = options.shared / "scenes" / "turntable", options.shared / "real" / "basil"
    if turntable.is_dir() and "turntable" in (options.only or LIMITS):
        found["turntable"] = ["--data", str(turntable), "--endmembers", "6"]
    if basil.is_dir() and "basil" in (options.only or LIMITS):
        found["basil"] = ["--data", str(_basil.make_scene(basil, place / "basil")), "--endmembers", "3"]
    return found


def _limit(options: Options) -> list[str]:
    if options.quick:
        return ["--max-num-iterations", "10"]
    if options.max_seconds is not None:
        return ["--max-seconds", str(options.max_seconds)]
    return ["--max-num-iterations", str(options.steps)]


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
