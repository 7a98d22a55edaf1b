"""Does a run survive being killed at any moment?

    python benchmarks/kill.py

Twenty times: trains on a small built-in scene and saves often, kills the process by SIGKILL, loads the newest complete
checkpoint, and lets `unmix-train --load-run` go on from it. Ten of the kills come at a random moment after the first
checkpoint, ten during saving: five once the tensors' temporary file is seen, five between tensors and record. What
lies in the folder afterwards proves that a checkpoint was half-written; a kill that came too late for that is made
again. Takes about six minutes.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import _common
import _machine
import tyro

from unmix_plugin.engine.runs.checkpoints import newest_complete_checkpoint
from unmix_plugin.engine.runs.loading import load_model
from unmix_plugin.engine.runs.run_folder import checkpoint_steps
from unmix_plugin.errors import UnmixError
from unmix_plugin.scenes.demo.scene import make_demo_scene

SIZE, BANDS, VIEWS = 32, 8, 8
STEPS_PER_SAVE, STEPS_RESUMED = 10, 15
LATEST_RANDOM_SECONDS = 3.0
"""Kills come, or wait for their moment, so many seconds after the first checkpoint at the latest."""
LATEST_SAVING_SECONDS = 0.02
"""Kills while tensors are written come so long after their temporary file was seen at the latest."""
POLL_SECONDS = 2e-4
STARTING_SECONDS = 120.0
ATTEMPTS = 10
"""Kills that may miss their moment, for each that must hit it."""

Moment: TypeAlias = Literal["random", "tensors", "record"]
"""Any moment; while the tensors are written; between tensors and record."""


@dataclass(frozen=True)
class Options:
    """Kill training at random moments and during saving, then load and resume."""

    kills: int = 20
    """Half of them at random, half during saving."""
    seed: int = 0
    """Of the random moments."""
    results: Path | None = None
    """Folder for kill.json and kill.md; None: beside the benchmarks."""
    quick: bool = False
    """Three kills, one at each kind of moment."""


@dataclass(frozen=True)
class Kill:
    """One kill and what came after it."""

    moment: Moment
    attempts: int
    """Kills until one hit its moment."""
    seconds: float
    """From the first checkpoint to the kill."""
    left_behind: tuple[str, ...]
    """Files of a checkpoint that was being written."""
    steps_found: tuple[int, ...]
    """Checkpoints in the folder, newest first."""
    loaded_step: int | None
    """Of the newest complete checkpoint; None if it did not load."""
    resumed_to: int | None
    """Step that the resumed run ended at and saved; None if it did not."""
    failure: str = ""

    @property
    def survived(self) -> bool:
        """Loaded, and resumed as far as it was told."""
        return self.loaded_step is not None and self.resumed_to == self.loaded_step + STEPS_RESUMED


def main(options: Options) -> None:
    """Kill, look, publish."""
    machine = _machine.describe_machine()
    moments = plan(3 if options.quick else options.kills)
    generator = random.Random(options.seed)
    kills = []
    with tempfile.TemporaryDirectory(prefix="unmix-kill-") as name:
        folder = Path(name)
        make_demo_scene(folder / "demo", SIZE, BANDS, VIEWS)
        for number, moment in enumerate(moments, 1):
            kills.append(kill_once(folder, moment, generator))
            outcome = "survived" if kills[-1].survived else f"lost: {kills[-1].failure}"
            print(f"kill {number} of {len(moments)}, moment {moment}: {outcome}", flush=True)
    setting = {
        "scene": f"built-in, {SIZE} x {SIZE} pixels, {BANDS} bands, {VIEWS} views",
        "options": f"defaults, but --device cpu --steps-per-save {STEPS_PER_SAVE}",
        "seed": options.seed,
        "steps resumed": STEPS_RESUMED,
    }
    question = "Training killed by SIGKILL: the newest complete checkpoint loads and resumes"
    report = _common.Report("kill", question, setting, machine, judge(kills), kills, (table(kills),))
    _common.publish(report, _common.results_folder(options.results, options.quick))


def plan(kills: int) -> list[Moment]:
    """Half of the kills during saving (rounded up), of these half between tensors and record."""
    saving: list[Moment] = ["tensors", "record"] * kills
    random_moments: list[Moment] = ["random"] * (kills // 2)
    return random_moments + saving[: kills - kills // 2]


def kill_once(folder: Path, moment: Moment, generator: random.Random) -> Kill:
    """Train, kill until the moment is hit, then load and resume."""
    for attempt in range(1, ATTEMPTS + 1):
        run, seconds = train_and_kill(folder, moment, generator)
        left_behind = half_written(run / "checkpoints")
        if moment == "random" or left_behind:
            return inspect(run, moment, attempt, seconds, left_behind)
    raise SystemExit(f"none of {ATTEMPTS} kills hit the moment {moment!r}")


def train_and_kill(folder: Path, moment: Moment, generator: random.Random) -> tuple[Path, float]:
    """Start training and kill it; the run folder, and the seconds from its first checkpoint to the kill."""
    runs = folder / "runs"
    before = set(runs.glob("*/*/*"))
    words = [_common.console_script("unmix-train"), "unmix-nerf", "--data", str(folder / "demo")]
    words += ["--output-dir", str(runs), "--device", "cpu", "--steps-per-save", str(STEPS_PER_SAVE)]
    with tempfile.TemporaryFile() as log:
        process = _common.start([*words, "--max-num-iterations", "1000000"], log)
        try:
            (run,) = wait_for(
                lambda: [run for run in set(runs.glob("*/*/*")) - before if has_checkpoint(run)]
            )
            started = time.perf_counter()
            wait_for_moment(run / "checkpoints", moment, generator)
            if process.poll() is not None:
                log.seek(0)
                raise SystemExit(f"training ended before it was killed: {log.read().decode()}")
        finally:
            process.kill()
            process.wait()
    return run, time.perf_counter() - started


def wait_for_moment(checkpoints: Path, moment: Moment, generator: random.Random) -> None:
    """Return when it is time to kill."""
    time.sleep(generator.uniform(0.0, LATEST_RANDOM_SECONDS))
    if moment == "tensors":
        wait_for(lambda: list(checkpoints.glob(".step-*.safetensors.tmp")))
        time.sleep(generator.uniform(0.0, LATEST_SAVING_SECONDS))
    elif moment == "record":
        wait_for(lambda: tensors_without_record(checkpoints))


def wait_for(look: Callable[[], list[Path]]) -> list[Path]:
    """Look until something is there."""
    until = time.monotonic() + STARTING_SECONDS
    while time.monotonic() < until:
        found = look()
        if found:
            return found
        time.sleep(POLL_SECONDS)
    raise SystemExit(f"training did not get as far as expected in {STARTING_SECONDS:g} s")


def has_checkpoint(run: Path) -> bool:
    """Whether a run has a checkpoint."""
    return bool(checkpoint_steps(run / "checkpoints"))


def tensors_without_record(checkpoints: Path) -> list[Path]:
    """Tensors whose record is still to come, or has just been removed with the tensors to follow."""
    return [path for path in checkpoints.glob("step-*.safetensors") if not path.with_suffix(".json").exists()]


def half_written(checkpoints: Path) -> tuple[str, ...]:
    """Names of what a writer left that was killed at work."""
    paths = [*checkpoints.glob(".*.tmp"), *tensors_without_record(checkpoints)]
    return tuple(sorted(path.name for path in paths))


def inspect(run: Path, moment: Moment, attempts: int, seconds: float, left_behind: tuple[str, ...]) -> Kill:
    """Load the newest complete checkpoint and resume from it."""
    steps = tuple(checkpoint_steps(run / "checkpoints"))
    try:
        loaded = load_model(run, "cpu").training.steps
    except UnmixError as error:
        return Kill(moment, attempts, seconds, left_behind, steps, None, None, str(error))
    words = [_common.console_script("unmix-train"), "unmix-nerf", "--load-run", str(run)]
    words += ["--max-num-iterations", str(loaded + STEPS_RESUMED)]
    ended = _common.run_command(words, must_succeed=False)
    checkpoint = newest_complete_checkpoint(run / "checkpoints")
    remains = half_written(run / "checkpoints")
    if ended.status != 0 or remains:
        failure = f"exit code {ended.status}, left in the folder: {remains}: {ended.output[-500:]}"
        return Kill(moment, attempts, seconds, left_behind, steps, loaded, None, failure)
    return Kill(moment, attempts, seconds, left_behind, steps, loaded, checkpoint.step)


def judge(kills: list[Kill]) -> list[_common.Figure]:
    """All kills, and those during saving."""
    saving = [kill for kill in kills if kill.left_behind]
    return [
        _common.required(
            f"{what}: checkpoint loads and resumes",
            "every time",
            all(kill.survived for kill in chosen),
            f"{sum(kill.survived for kill in chosen)} of {len(chosen)}",
        )
        for what, chosen in (("kills", kills), ("of these with a half-written checkpoint", saving))
    ]


def table(kills: list[Kill]) -> _common.DetailTable:
    """Every kill."""
    headers = (
        "moment",
        "attempts",
        "after, s",
        "left behind",
        "checkpoints",
        "loaded",
        "resumed to",
        "failure",
    )
    rows = [
        (
            kill.moment,
            str(kill.attempts),
            f"{kill.seconds:.3f}",
            ", ".join(kill.left_behind) or "nothing",
            ", ".join(map(str, kill.steps_found)),
            str(kill.loaded_step),
            str(kill.resumed_to),
            kill.failure,
        )
        for kill in kills
    ]
    return _common.DetailTable("Every kill", headers, rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
