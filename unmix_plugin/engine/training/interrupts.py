"""Stopping between two steps when asked to, so that what is saved is a whole step."""

import signal
import threading
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any


class Interrupted(Exception):  # noqa: N818
    """Training was stopped on request; the run can be resumed."""

    def __init__(self, run: Path, step: int | None) -> None:
        super().__init__(f"stopped; {'no checkpoint' if step is None else f'step {step}'} is saved in {run}")
        self.run = run
        """The run folder."""
        self.step = step
        """Step of the newest checkpoint, from which `load_config(run)` resumes; None if there is none."""


class StopSignals:
    """Context in which Ctrl-C, SIGTERM or SIGHUP is only noted, and a second one raises KeyboardInterrupt.

    A lost terminal often sends SIGHUP twice, so that a second one of these changes nothing; under nohup it stays
    ignored. In a thread that is not the main one signals can't be caught, and nothing is ever noted.
    """

    SIGNALS = tuple(
        getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
    )

    def __init__(self) -> None:
        self.requested = False
        """Whether a stop was asked for."""
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():
            self._previous = {
                number: signal.signal(number, self._note)
                for number in self.SIGNALS
                if number.name != "SIGHUP" or signal.getsignal(number) is not signal.SIG_IGN
            }
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested and signal.Signals(number).name != "SIGHUP":
            raise KeyboardInterrupt
        self.requested = True
