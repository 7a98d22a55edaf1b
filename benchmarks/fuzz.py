"""Does any damaged file make a reader fail in a way that it doesn't promise?

    python benchmarks/fuzz.py --cases 1000000

Cases are shared evenly among the readers of `tests/fuzz/readers.py`: valid samples with damage, each read, and each
either accepted or refused with the error that the reader promises. A seed and a case's number reproduce its bytes.
A million take about ten minutes on two cores. With `--minutes` it ends when the time
is up and reports the cases it did.
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import _common
import _machine
import tyro

sys.path.insert(0, str(_common.REPOSITORY))  # for the harness, which lies with the tests

from tests.fuzz.fuzzing import Outcome, fuzz
from tests.fuzz.readers import READERS

CHUNK = 500
"""Cases that a process does in one go."""
SLOWEST_S, MOST_BYTES = 5.0, 10**9
"""What no single case may take."""


@dataclass(frozen=True)
class Options:
    """Read damaged files, many of them."""

    cases: int = 1_000_000
    """Among all readers."""
    seed: int = 1
    """Of the damage; the tests use 0."""
    processes: int = 2
    """At a time."""
    minutes: float | None = None
    """When to stop early."""
    results: Path | None = None
    """Folder for fuzz.json and fuzz.md; None: beside the benchmarks."""
    quick: bool = False
    """A hundred cases a reader."""


def main(options: Options) -> None:
    """Fuzz every reader, publish."""
    machine = _machine.describe_machine()
    started = time.perf_counter()
    until = None if options.minutes is None else time.time() + 60.0 * options.minutes
    cases = 100 * len(READERS) if options.quick else options.cases
    outcomes = run(cases, options.seed, options.processes, until)
    seconds = time.perf_counter() - started
    done = sum(outcome.cases for outcome in outcomes.values())
    setting = {
        "cases asked for": cases,
        "seed": options.seed,
        "processes": options.processes,
        "seconds": round(seconds),
    }
    report = _common.Report(
        "fuzz",
        "Damaged files: read, or refused with the error that the reader promises",
        setting,
        machine,
        judge(outcomes, cases, done),
        {name: asdict(outcome) for name, outcome in outcomes.items()},
        tables(outcomes),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def run(cases: int, seed: int, processes: int, until: float | None) -> dict[str, Outcome]:
    """The outcome of each reader, its chunks taken in turn with those of the others."""
    each = -(-cases // len(READERS))
    chunks = [
        (name, seed, first, min(first + CHUNK, each), until)
        for first in range(0, each, CHUNK)
        for name in READERS
    ]
    outcomes = {name: Outcome() for name in READERS}
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for (name, *_), outcome in zip(chunks, pool.map(run_chunk, chunks), strict=True):
            outcomes[name] = joined(outcomes[name], outcome)
    return outcomes


def run_chunk(chunk: tuple[str, int, int, int, float | None]) -> Outcome:
    """Some cases of one reader; none once the time is up."""
    name, seed, first, last, until = chunk
    if until is not None and time.time() > until:
        return Outcome()
    warnings.simplefilter("error")
    # A library may end the process, and the harness with it: so each chunk has one of its own, on systems with `fork`.
    receiver, sender = get_context("fork").Pipe(duplex=False)
    with tempfile.TemporaryDirectory(prefix="unmix-fuzz-") as folder:
        child = get_context("fork").Process(target=_send, args=(sender, name, folder, seed, first, last))
        child.start()
        sender.close()
        try:
            return receiver.recv()
        except EOFError:
            child.join()
            ended = f"the process ended with {child.exitcode} in one of the cases {first} to {last - 1}"
            return Outcome(last - first, foreign=[(first, ended)])
        finally:
            child.join()


def _send(sender: Connection, name: str, folder: str, seed: int, first: int, last: int) -> None:
    sender.send(fuzz(name, Path(folder), seed, range(first, last)))


def joined(a: Outcome, b: Outcome) -> Outcome:
    """Both together."""
    slowest = a if a.slowest_s >= b.slowest_s else b
    largest = a if a.most_bytes >= b.most_bytes else b
    return Outcome(
        a.cases + b.cases,
        a.accepted + b.accepted,
        slowest.slowest_s,
        slowest.slowest_case,
        largest.most_bytes,
        largest.largest_case,
        a.foreign + b.foreign,
    )


def judge(outcomes: dict[str, Outcome], cases: int, done: int) -> list[_common.Figure]:
    """Foreign exceptions, the slowest case, and how many cases there were."""
    foreign = sum(len(outcome.foreign) for outcome in outcomes.values())
    slowest = max(outcome.slowest_s for outcome in outcomes.values())
    largest = max(outcome.most_bytes for outcome in outcomes.values())
    return [
        _common.Limit(0, is_upper=True).judge("exceptions that no reader promises", foreign),
        _common.Limit(SLOWEST_S, is_upper=True, unit=" s").judge("slowest case", slowest),
        _common.Limit(MOST_BYTES / 1e6, is_upper=True, unit=" MB").judge("memory of a case", largest / 1e6),
        _common.Limit(cases).judge("cases", done),
    ]


def tables(outcomes: dict[str, Outcome]) -> tuple[_common.DetailTable, ...]:
    """Every reader, and the first foreign exceptions if there are any."""
    rows = [
        (
            *(name, str(o.cases), str(o.accepted), f"{o.slowest_s:.3f}", str(o.slowest_case)),
            *(f"{o.most_bytes / 1e6:.0f}", str(len(o.foreign))),
        )
        for name, o in outcomes.items()
    ]
    headers = ("reader", "cases", "accepted", "slowest, s", "slowest case", "most MB", "foreign exceptions")
    found = [(name, str(case), error) for name, o in outcomes.items() for case, error in o.foreign[:10]]
    every = _common.DetailTable("Every reader", headers, rows)
    return (
        (every, _common.DetailTable("Foreign exceptions", ("reader", "case", "error"), found))
        if found
        else (every,)
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
