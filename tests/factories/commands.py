"""Commands run here or in a process of their own, pages that look at them, and the browser if there is one."""

from __future__ import annotations

import importlib.util
import io
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest
from PIL import Image

from tests.factories.viewer_page import Page
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


START_S = 90.0


class Started:
    """A command in a process of its own, its output read line by line."""

    def __init__(self, command, *words):
        # A test run in the background of a script inherits an ignored SIGINT, which Python would leave ignored.
        launch = (
            "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
            f"from unmix_plugin.commands import scripts; scripts.{command}()"
        )
        argv = [sys.executable, "-c", launch, *map(str, words)]
        none, pipe, joined = subprocess.DEVNULL, subprocess.PIPE, subprocess.STDOUT
        self.process = subprocess.Popen(argv, stdin=none, stdout=pipe, stderr=joined, text=True)
        self.lines = []
        self._changed = threading.Condition()
        self._has_ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self.lines.append(line.rstrip())
                self._changed.notify_all()
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def wait_for_line(self, pattern):
        def found():
            return next((match for line in self.lines if (match := re.search(pattern, line))), None)

        with self._changed:
            self._changed.wait_for(lambda: found() or self._has_ended, START_S)
            match = found()
        assert match is not None, self.lines
        return match

    @property
    def address(self):
        """Of the viewer's websocket."""
        return "ws://" + self.wait_for_line(r"viewer: http://(\S+)")[1]

    def end(self):
        status = self.process.wait(START_S)
        self._reader.join(10)
        return status


@contextmanager
def started(command, *words):
    """A command that is not left behind."""
    one = Started(command, *words)
    try:
        yield one
    finally:
        if one.process.poll() is None:
            one.process.kill()
        one.end()
        assert one.process.stdout is not None
        one.process.stdout.close()


def visited(visit, command, *words):
    """How a command ended that ran in this process, while `visit(printed)` in a thread looked at its pages.

    `printed(pattern)` waits for such a line; `visit` is what ends the command.
    """
    out, is_over, failures = io.StringIO(), threading.Event(), []

    def printed(pattern):
        until = time.monotonic() + START_S
        while (match := re.search(pattern, out.getvalue())) is None:
            assert time.monotonic() < until, out.getvalue()
            time.sleep(0.01)
        return match

    def visit_and_note_failures():
        try:
            visit(printed)
        except BaseException as error:  # noqa: BLE001 - raised again below, once the command has ended
            failures.append(error)
            if not is_over.is_set():
                signal.raise_signal(signal.SIGINT)

    visitor = threading.Thread(target=visit_and_note_failures)
    visitor.start()
    ended = run(command, *words, out=out)
    is_over.set()
    visitor.join(START_S)
    if failures:
        raise failures[0]
    return ended


def address(printed):
    """Of the websocket of a viewer."""
    return "ws://" + printed(r"viewer: http://(\S+)")[1]


@contextmanager
def looking(address):
    """A page with its first picture."""
    with Page(address) as page:
        page.look_from(0.3)
        page.wait_until(lambda: bool(page.pictures), START_S)
        yield page


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
HAS_BROWSER = CHROMIUM is not None and importlib.util.find_spec("playwright") is not None
NEEDS_BROWSER = pytest.mark.skipif(not HAS_BROWSER, reason="needs playwright and the program chromium")
