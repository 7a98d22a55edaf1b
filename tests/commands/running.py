"""Running commands in this process, as their console scripts do."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest
from PIL import Image

from unmix_plugin.commands.entry import run_command

SMALL_METHOD = [
    "--pipeline.model.samples-per-step=2000",
    "--pipeline.model.field.log2-rows-per-level=10",
    "--pipeline.model.field.cells-per-pixel=1.0",
    "--pipeline.model.field.hidden-width=16",
    "--pipeline.datamanager.grid-resolution=32",
    "--device=cpu",
]
"""Options that make `unmix-nerf` train in a moment."""


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    status: int
    out: str
    err: str

    @property
    def last_line(self) -> str:
        return self.out.splitlines()[-1]


def run(command: Callable[[list[str]], object], *words: object, out: io.StringIO | None = None) -> Ended:
    """Run a command with its words to its exit; `out`, if given, takes its standard output for a thread to read."""
    out, err = out or io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        run_command(command, [str(word) for word in words])
    status = stop.value.code
    assert isinstance(status, int)
    return Ended(status, out.getvalue(), err.getvalue())


def done(command: Callable[[list[str]], object], *words: object) -> Ended:
    """Run a command that must succeed."""
    ended = run(command, *words)
    assert ended.status == 0, ended.err
    return ended


def refused(command: Callable[[list[str]], object], *words: object) -> str:
    """The message, in one line, of a command that must refuse its words."""
    ended = run(command, *words)
    assert (ended.status, "Traceback" in ended.err) == (2, False), ended.err
    return " ".join(ended.err.split())


def run_of(ended: Ended) -> Path:
    """The run folder that training named last."""
    return Path(ended.last_line.removeprefix("run: "))


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture that can be decoded to its end."""
    with Image.open(path) as picture:
        picture.load()
        return picture.size
