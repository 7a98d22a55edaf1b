"""Text fields are read once typing has paused: browsers send every letter."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

WAIT_S = 0.4
"""How long typing must pause."""


class Debounced:
    """Work that waits until its events have stopped coming."""

    def __init__(self, work: Callable[[], None], clock: Callable[[], float] = time.monotonic) -> None:
        """`work` is done once, after the last event; `clock` tells seconds."""
        self._work, self._clock = work, clock
        self._due_s: float | None = None
        self._lock = threading.Lock()

    @property
    def is_waiting(self) -> bool:
        """Whether there is something left to do."""
        return self._due_s is not None

    def note(self) -> None:
        """An event came."""
        with self._lock:
            self._due_s = self._clock() + WAIT_S

    def tick(self) -> None:
        """Do the work if the last event was long enough ago; called now and then."""
        with self._lock:
            is_due = self._due_s is not None and self._clock() >= self._due_s
        if is_due:
            self.finish()

    def finish(self) -> None:
        """Do the work now if there is something left to do."""
        with self._lock:
            was_waiting, self._due_s = self._due_s is not None, None
        if was_waiting:
            self._work()
