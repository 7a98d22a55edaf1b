"""Which bytes lead a reader to code that no others reached, and does any of them make it fail?

    pip install atheris
    python benchmarks/fuzz_guided.py --reader "ENVI header" --minutes 10

Guided by coverage: atheris keeps every input that reaches new code and damages it further. A case that takes 5 s, that
takes 1 GB, or that ends in an exception the reader doesn't promise, stops the search and is kept; it then becomes a
sample in `tests/fuzz` or a test of its reader. `fuzz.py` needs nothing but Python and judges all readers.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import _common
import tyro

sys.path.insert(0, str(_common.REPOSITORY))  # for the harness, which lies with the tests


READING = (
    "captures",
    "formats",
    "limits",
    "scenes.reading",
    "editing",
    "spectral.maps",
    "viewer.connections",
)
"""Parts of the package whose branches guide the search: readers."""


@dataclass(frozen=True)
class Options:
    """Search one reader for faults."""

    reader: str
    """Name in `tests/fuzz/readers.py`."""
    minutes: float = 10.0
    """How long."""
    findings: Path = Path()
    """Folder for inputs that are faults."""


def main(options: Options) -> None:
    """Search until the time is up or a fault is found; the process ends with it."""
    atheris: Any = import_module("atheris")  # installed by those who search

    with atheris.instrument_imports(include=[f"unmix_plugin.{part}" for part in READING]):
        from tests.fuzz.fuzzing import prepare
        from tests.fuzz.readers import READERS

        reader = READERS[options.reader]()
    folder = Path(tempfile.mkdtemp(prefix="unmix-fuzz-"))
    (folder / "corpus").mkdir()
    (folder / "case").mkdir()
    for index, sample in enumerate(reader.samples):
        (folder / "corpus" / str(index)).write_bytes(sample)
    path = prepare(reader, folder / "case")

    def read(data: Any) -> None:
        path.unlink(missing_ok=True)
        path.write_bytes(data)
        try:
            reader.read(path)
        except reader.allowed:
            return

    bounds = [f"-max_total_time={round(60 * options.minutes)}", "-timeout=5", "-malloc_limit_mb=1000"]
    where = [f"-artifact_prefix={options.findings.resolve()}/", str(folder / "corpus")]
    atheris.Setup([sys.argv[0], "-rss_limit_mb=3000", "-max_len=65536", *bounds, *where], read)
    atheris.Fuzz()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
