"""Feed damaged inputs to a reader, and keep what it should not have done."""

from __future__ import annotations

import random
import time
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tests.factories.systems import most_memory
from tests.fuzz.mutation import Reader
from tests.fuzz.readers import READERS


@dataclass
class Outcome:
    """What many cases of one reader came to."""

    cases: int = 0
    accepted: int = 0
    """Cases that were read without an error."""
    slowest_s: float = 0.0
    """Processor time, which other work on the machine leaves alone."""
    slowest_case: int = 0
    most_bytes: int = 0
    """By which the process grew in one case."""
    largest_case: int = 0
    foreign: list[tuple[int, str]] = field(default_factory=list)
    """Case and error of each exception that the reader does not promise."""


def case_bytes(name: str, reader: Reader, seed: int, case: int) -> bytes:
    """The input of a case; one and the same for a seed, on every machine."""
    generator = random.Random(zlib.crc32(f"{name} {seed} {case}".encode()))
    return reader.mutate(reader.samples, generator)


def prepare(reader: Reader, folder: Path) -> Path:
    """Write what lies beside the input of a reader; gives the path of the input."""
    for companion, data in reader.companions:
        (folder / companion).parent.mkdir(exist_ok=True)
        (folder / companion).write_bytes(data)
    return folder / reader.file_name


_DOUBTFUL_S = 2.0
"""Processor time from which on a case is timed once more: a virtual machine that stood still counts that as work."""


def fuzz(name: str, folder: Path, seed: int, cases: range) -> Outcome:
    """Run cases of a reader, by their numbers, in an empty folder."""
    reader = READERS[name]()
    path, outcome = prepare(reader, folder), Outcome()
    for case in cases:
        path.unlink(missing_ok=True)  # some file systems flush a file that is truncated and written again
        path.write_bytes(case_bytes(name, reader, seed, case))
        size, started = most_memory(), time.process_time()
        try:
            reader.read(path)
            outcome.accepted += 1
        except reader.allowed:
            pass
        except Exception as error:  # noqa: BLE001 - any other exception is what fuzzing looks for
            outcome.foreign.append((case, f"{type(error).__name__}: {error}"))
        seconds = time.process_time() - started
        if seconds > _DOUBTFUL_S:
            started = time.process_time()
            with suppress(Exception):
                reader.read(path)
            seconds = min(seconds, time.process_time() - started)
        if seconds > outcome.slowest_s:
            outcome.slowest_s, outcome.slowest_case = seconds, case
        if (grown := most_memory() - size) > outcome.most_bytes:
            outcome.most_bytes, outcome.largest_case = grown, case
        outcome.cases += 1
    return outcome
