"""Does any damaged capture or run folder end a command otherwise than with exit code 0 or 2?

    python benchmarks/fuzz_commands.py

Small captures of every layout and file format, and a trained run, each with one or two of its files damaged as in
`tests/fuzz/mutation.py`, are given to the command in a process of its own, forked from one that has imported it. A seed
and a case's number reproduce the damage. Two cores take about fifteen minutes.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import _common
import _machine
import torch
import tyro

sys.path.insert(0, str(_common.REPOSITORY))  # for makers of captures and damage, which lie with the tests

from tests.factories import captures, data_sets, rig_flight
from tests.factories.runs import small_run
from tests.fuzz.capture_samples import ENVI_DATA, SAMPLES
from tests.fuzz.mutation import mutate_bytes, mutate_json, mutate_png
from unmix_plugin.commands.entry import run_command
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.process import process
from unmix_plugin.commands.render import render

LONGEST_S, MOST_BYTES = 25.0, 10**9
"""Processor time of a command, and by how much its process may grow."""
CHUNK = 20

Command = tuple[Callable[[list[str]], object], Sequence[str]]
"""A command and its words, of which `IN` and `OUT` stand for folders."""
RUN_COMMANDS: tuple[Command, ...] = (
    (export, ("endmembers", "--run", "IN", "--output", "OUT")),
    (export, ("abundances", "--run", "IN", "--output", "OUT")),
    (evaluate, ("--run", "IN")),
    (render, ("--run", "IN", "--output", "OUT", "--view", "0")),
)


@dataclass(frozen=True)
class Options:
    """Give damaged folders to commands."""

    captures: int = 2600
    """Damaged captures."""
    runs: int = 208
    """Damaged run folders."""
    seed: int = 1
    """Of the damage."""
    processes: int = 2
    """At a time."""
    results: Path | None = None
    """Folder for fuzz_commands.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """Forty captures and eight runs."""


@dataclass(frozen=True)
class Ended:
    """How a case ended."""

    folder: str
    case: int
    status: int
    """Exit code; minus a signal's number."""
    seconds: float
    grown_bytes: int
    output: str


def main(options: Options) -> None:
    """Damage, run, publish."""
    captures, runs = (40, 8) if options.quick else (options.captures, options.runs)
    with tempfile.TemporaryDirectory(prefix="unmix-fuzz-") as place:
        made = make_folders(Path(place))
        commands = {name: ((process, words),) for name, words in made.items()} | {"run": RUN_COMMANDS}
        kinds = list(made)
        cases = [(kinds[case % len(kinds)], case) for case in range(captures)]
        cases += [("run", case) for case in range(runs)]
        chunks = [
            (Path(place), commands, cases[i : i + CHUNK], options.seed) for i in range(0, len(cases), CHUNK)
        ]
        with ProcessPoolExecutor(options.processes, mp_context=get_context("spawn")) as pool:
            ended = [one for chunk in pool.map(run_chunk, chunks) for one in chunk]
    bad = [one for one in ended if one.status not in (0, 2) or one.output.count("Traceback")]
    slowest, largest = max(ended, key=lambda e: e.seconds), max(ended, key=lambda e: e.grown_bytes)
    upper = _common.Limit
    figures = [
        upper(0, is_upper=True).judge("cases that ended otherwise than with 0 or 2", len(bad)),
        upper(LONGEST_S, is_upper=True, unit=" s").judge("longest, processor time", slowest.seconds),
        upper(MOST_BYTES / 1e6, is_upper=True, unit=" MB").judge("most memory", largest.grown_bytes / 1e6),
        upper(options.captures).judge("captures", sum(one.folder != "run" for one in ended)),
        upper(options.runs).judge("run folders", sum(one.folder == "run" for one in ended)),
    ]
    rows = []
    for name in commands:
        of_kind = [one for one in ended if one.folder == name]
        rows.append(
            (
                *(name, str(len(of_kind)), str(sum(one.status == 0 for one in of_kind))),
                f"{max((one.seconds for one in of_kind), default=0.0):.2f}",
            )
        )
    every = _common.DetailTable("Folders", ("folder", "cases", "exit 0", "longest, s"), rows)
    worst = _common.DetailTable(
        "Ended otherwise",
        ("folder", "case", "status", "end of the output"),
        [(one.folder, str(one.case), str(one.status), one.output[-300:].strip()) for one in bad[:30]],
    )
    report = _common.Report(
        "fuzz_commands",
        "Damaged captures and runs: exit code 0 or 2, in time and in bounds",
        {"seed": options.seed, "processes": options.processes},
        _machine.describe_machine(),
        figures,
        {"slowest": slowest.__dict__, "largest": largest.__dict__, "bad": [one.__dict__ for one in bad]},
        (every, worst) if bad else (every,),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def make_folders(place: Path) -> dict[str, tuple[str, ...]]:
    """Undamaged captures below `place`, and a run named `run`; gives the words of `unmix-process` for each capture."""
    words = {}

    def add(name: str, layout: str, *more: str) -> Path:
        words[name] = (layout, "--data", "IN", "--output-dir", "OUT", *more)
        return place / name

    own = ("--poses", "IN/transforms.json", "--mask", "none")
    references = ("--white", "IN/white.hdr", "--dark", "IN/dark.hdr")
    captures.make_capture(add("envi", "cubes", "--poses", "IN/transforms.json"))
    captures.make_capture(add("envi-references", "cubes", *own, *references))
    captures.make_capture(
        add("npy", "cubes", *own, "--wavelengths", "450,500,550,600,650,700,750,800,850"), kind="npy"
    )
    for file_name, samples in SAMPLES.items():
        root = add(file_name, "cubes", *own, "--wavelengths", "450,550,650", "--axes", "yxb")
        root.mkdir()
        for index in range(4):
            name = f"view{index}{Path(file_name).suffix}"
            (root / name).write_bytes(samples()[0])
            if file_name.endswith(".hdr"):
                (root / f"view{index}").write_bytes(ENVI_DATA)
        captures.write_poses(root / "transforms.json", [f"view{i}" for i in range(4)], 4, 5)
    data_sets.write_nespof(add("nespof", "nespof"))
    data_sets.write_real(add("nespof-real", "nespof-real"))
    data_sets.write_unmix(add("unmix-nerf", "unmix-nerf"))
    rig_flight.write_flight(add("rig", "rig", "--poses", "IN/poses.json", "--mask", "none"), shots=3)
    rig_flight.write_poses(place / "rig" / "poses.json", shots=3)
    shutil.copytree(small_run(place / "training").run, place / "run")
    return words


def run_chunk(chunk: tuple[Path, dict[str, tuple[Command, ...]], list[tuple[str, int]], int]) -> list[Ended]:
    """Some cases, one after another."""
    place, commands, cases, seed = chunk
    torch.set_num_threads(1)  # threads don't survive a fork
    ended = []
    for name, case in cases:
        generator = random.Random(f"{name} {seed} {case}")
        with tempfile.TemporaryDirectory(prefix="unmix-fuzz-") as folder:
            damaged = Path(folder) / "in"
            shutil.copytree(place / name, damaged)
            damage(damaged, generator)
            command, words = generator.choice(commands[name])
            filled = [word.replace("IN", str(damaged)).replace("OUT", f"{folder}/out") for word in words]
            ended.append(run_case(name, case, command, filled, Path(folder) / "log"))
    return ended


def damage(folder: Path, generator: random.Random) -> None:
    """Change one file, or two."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for path in generator.sample(files, generator.choice((1, 1, 2))):
        mutate = {".json": mutate_json, ".png": mutate_png}.get(path.suffix, mutate_bytes)
        path.write_bytes(mutate([path.read_bytes()], generator))


def run_case(
    name: str, case: int, command: Callable[[list[str]], object], words: list[str], log: Path
) -> Ended:
    """Fork, run the command, and wait for it; it is stopped where it takes much too long."""
    idle = os.fork()  # a child has fewer of the libraries' pages than its parent
    if idle == 0:
        os._exit(0)
    started = os.wait4(idle, 0)[2].ru_maxrss
    child = os.fork()
    if child == 0:
        with log.open("w") as stream:
            os.dup2(stream.fileno(), 1)
            os.dup2(stream.fileno(), 2)
        status = 1
        try:
            run_command(command, words)
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else 1
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    until = time.monotonic() + 20 * LONGEST_S
    while True:
        waited, status, usage = os.wait4(child, os.WNOHANG)
        if waited:
            break
        if time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.005)
    grown = 1024 * max(0, usage.ru_maxrss - started)
    output = log.read_text(errors="replace") if log.exists() else ""
    return Ended(
        name, case, os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime, grown, output[-2000:]
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
