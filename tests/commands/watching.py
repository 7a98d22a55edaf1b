"""Commands with a viewer: started in a process of their own or in this one, and pages that look at them."""

import io
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

from tests.commands.running import run
from tests.viewer_page import Page

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
