"""Is a run that was stopped at half and resumed the run that was never stopped?

    python benchmarks/resume.py

Trains on a small built-in scene on the CPU with a fixed seed, once straight through and once stopped by Ctrl-C at half
and resumed, all by the commands that a user would give; then compares what both runs wrote. Takes two minutes.
"""

from __future__ import annotations

import json
import signal
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import torch
import tyro

from unmix_plugin.commands.entry import INTERRUPTED
from unmix_plugin.engine.runs.checkpoints import Checkpoint, newest_complete_checkpoint
from unmix_plugin.scenes.demo.scene import make_demo_scene

LOSS_DIFFERENCE = _common.Limit(1e-6, is_upper=True)
SEED = 7
SIZE, BANDS, VIEWS = 48, 16, 12
POLL_SECONDS = 0.01
CLOCK_ENTRIES = ("seconds", "rays_per_second")
"""Entries of metrics.jsonl that no two runs share."""


@dataclass(frozen=True)
class Options:
    """A straight run beside one stopped at half and resumed."""

    steps: int = 800
    """Training steps of both."""
    results: Path | None = None
    """Folder for resume.json and resume.md; None: beside the benchmarks."""
    quick: bool = False
    """Forty steps."""


@dataclass(frozen=True)
class Finished:
    """What a finished run wrote."""

    lines: list[dict[str, Any]]
    """Of every training step, without what depends on the clock."""
    checkpoint: Checkpoint

    @property
    def last(self) -> dict[str, Any]:
        """The last step's line."""
        return self.lines[-1]

    @property
    def learning_rates(self) -> list[dict[str, float]]:
        """Of every step, by parameter group."""
        return [{k: v for k, v in line.items() if k.startswith("lr/")} for line in self.lines]


def main(options: Options) -> None:
    """Run both, compare, publish."""
    machine = _machine.describe_machine()
    steps = 40 if options.quick else options.steps
    with tempfile.TemporaryDirectory(prefix="unmix-resume-") as name:
        folder = Path(name)
        make_demo_scene(folder / "demo", SIZE, BANDS, VIEWS)
        print(f"training {steps} steps straight ...", flush=True)
        straight = _common.run_command(training_words(folder, steps)).run
        print("training again, stopped at half ...", flush=True)
        stopped, stopped_at = stop_at_half(folder, steps)
        print(f"stopped after {stopped_at} steps; resuming ...", flush=True)
        resume = [_common.console_script("unmix-train"), "unmix-nerf", "--load-run", str(stopped)]
        resumed = _common.run_command(resume).run
        expected, actual = read(straight), read(resumed)
    setting = {
        "scene": f"built-in, {SIZE} x {SIZE} pixels, {BANDS} bands, {VIEWS} views",
        "options": f"defaults, but --seed {SEED} --device cpu --max-num-iterations {steps} --steps-per-log 1",
        "steps": steps,
        "stopped by Ctrl-C after": stopped_at,
    }
    measured = compare(expected, actual)
    question = "A run stopped at half and resumed, against a straight one"
    report = _common.Report("resume", question, setting, machine, judge(measured, steps), measured)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def training_words(folder: Path, steps: int) -> list[str]:
    """The command that trains."""
    words = [_common.console_script("unmix-train"), "unmix-nerf", "--data", str(folder / "demo")]
    words += ["--output-dir", str(folder / "runs"), "--device", "cpu", "--seed", str(SEED)]
    return [*words, "--max-num-iterations", str(steps), "--steps-per-log", "1"]


def stop_at_half(folder: Path, steps: int) -> tuple[Path, int]:
    """Train until Ctrl-C at half; the run folder, and the steps it had taken.

    Raises:
        SystemExit: it ended before, or did not end as it should.
    """
    with tempfile.TemporaryFile() as log:
        before = set((folder / "runs").glob("*/*/*"))
        process = _common.start(training_words(folder, steps), log)
        try:
            while process.poll() is None and steps_taken(folder, before) < steps // 2:
                time.sleep(POLL_SECONDS)
            process.send_signal(signal.SIGINT)
            status = process.wait()
        finally:
            process.kill()
            process.wait()
        if status != INTERRUPTED:
            log.seek(0)
            raise SystemExit(f"stopping ended with {status}: {log.read().decode()}")
    (run,) = set((folder / "runs").glob("*/*/*")) - before
    return run, newest(run).step


def steps_taken(folder: Path, before: set[Path]) -> int:
    """Steps that the new run has logged so far."""
    for run in set((folder / "runs").glob("*/*/*")) - before:
        lines = _common.json_lines(run / "metrics.jsonl")
        return lines[-1]["step"] if lines else 0
    return 0


def newest(run: Path) -> Checkpoint:
    """The newest complete checkpoint of a run that has one."""
    return newest_complete_checkpoint(run / "checkpoints")


def read(run: Path) -> Finished:
    """What both runs are compared by."""
    lines = [line for line in _common.json_lines(run / "metrics.jsonl") if line["split"] == "train"]
    steady = [{key: value for key, value in line.items() if key not in CLOCK_ENTRIES} for line in lines]
    return Finished(steady, newest(run))


def compare(expected: Finished, actual: Finished) -> dict[str, Any]:
    """All differences between two runs."""
    tensors, others = expected.checkpoint.tensors, actual.checkpoint.tensors
    differing = [
        name for name in tensors if name not in others or not torch.equal(tensors[name], others[name])
    ]
    records = [
        {key: value for key, value in run.checkpoint.record.items() if key not in ("train_seconds", "sha256")}
        for run in (expected, actual)
    ]
    losses = [
        relative_difference(a["loss"], b["loss"]) for a, b in zip(expected.lines, actual.lines, strict=False)
    ]
    return {
        "steps": [expected.checkpoint.step, actual.checkpoint.step],
        "steps_logged": [len(expected.lines), len(actual.lines)],
        "final_learning_rates": [run.checkpoint.record["learning_rates"] for run in (expected, actual)],
        "learning_rates_equal_in_every_step": expected.learning_rates == actual.learning_rates,
        "final_loss": [expected.last["loss"], actual.last["loss"]],
        "final_loss_relative_difference": relative_difference(expected.last["loss"], actual.last["loss"]),
        "largest_loss_relative_difference": max(losses),
        "tensors": len(tensors),
        "differing_tensors": differing + [name for name in others if name not in tensors],
        "differing_record_entries": sorted(
            key
            for key in records[0]
            if key != "train_rays_per_second" and records[0][key] != records[1].get(key)
        ),
    }


def relative_difference(a: float, b: float) -> float:
    """Of b from a, as a part of a."""
    return abs(a - b) / abs(a)


def judge(measured: dict[str, Any], steps: int) -> list[_common.Figure]:
    """The lines of the table."""
    same_steps = measured["steps"] == measured["steps_logged"] == [steps, steps]
    rates, differing = measured["final_learning_rates"], measured["differing_tensors"]
    same_rates = rates[0] == rates[1] and measured["learning_rates_equal_in_every_step"]
    num_equal = measured["tensors"] - len(differing)
    return [
        _common.required("steps", "the same", same_steps, " and ".join(map(str, measured["steps"]))),
        _common.required(
            "learning rates",
            "the same",
            same_rates,
            json.dumps(rates[1]) if same_rates else json.dumps(rates),
        ),
        LOSS_DIFFERENCE.judge("final loss, relative difference", measured["final_loss_relative_difference"]),
        _common.reported(
            "loss of any step, relative difference", f"{measured['largest_loss_relative_difference']:.3g}"
        ),
        _common.required(
            "parameters and optimiser at the end",
            "the same to the bit",
            not differing,
            f"{num_equal} of {measured['tensors']} tensors equal",
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
