"""Who may do what while a training is under way: turns on the device, what other threads see and ask, and signals."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import FrameType
from typing import Literal

from unmix_plugin.engine.training.progress import TrainingStatus

SHARE_BOUNDS = (0.05, 0.9)
"""Least and greatest share of a viewer."""

_LARGEST_CREDIT_S = 0.25
"""What a viewer that was idle may take at once before the proportion holds again."""


class DeviceLock:
    """Lets training and others compute by turns, so that they never meet on the device or in the weights.

    Turns do not nest, and viewers have theirs in the order in which they asked.

    While training runs, each second of it earns the viewer share / (1 - share) seconds of credit. A viewer with credit
    goes before the next training step, one without waits. Before training runs, and while it is paused, a viewer needs
    no credit, and a turn of training is the next after the viewer's turn under way.
    """

    def __init__(self, viewing_share: float = 0.3) -> None:
        """Start with nobody computing.

        Args:
            viewing_share: Part of the device's time that the viewer may take while training runs.
        """
        self._turn = threading.Condition()
        self._owner: int | None = None
        self._is_training = False
        self._waiting: dict[str, list[object]] = {"training": [], "viewer": []}
        self._last = "training"
        self._credit_s = _LARGEST_CREDIT_S
        self.viewing_share = viewing_share
        self.training_turns = 0
        """Turns that training has had."""

    @property
    def viewing_share(self) -> float:
        """Part of the device's time that the viewer may take while training runs, within `SHARE_BOUNDS`."""
        return self._viewing_share

    @viewing_share.setter
    def viewing_share(self, share: float) -> None:
        low, high = SHARE_BOUNDS
        self._viewing_share = min(max(low, share), high)  # in this order NaN becomes the least

    @property
    def is_training(self) -> bool:
        """Whether the viewer has to share."""
        return self._is_training

    @is_training.setter
    def is_training(self, value: bool) -> None:
        with self._turn:
            self._is_training = value
            self._turn.notify_all()

    @contextmanager
    def training_turn(self) -> Iterator[None]:
        """Context in which training has the device; earns the viewer credit."""
        earned_a_second = self._viewing_share / (1 - self._viewing_share)
        with self._turn_of("training", lambda: not self._viewing_goes_first, earned_a_second):
            try:
                yield
            finally:
                self.training_turns += 1

    def viewing_turn(self, cost: float = 1.0) -> AbstractContextManager[None]:
        """Context in which the viewer has the device.

        Args:
            cost: Seconds of credit that a second takes; more than 1 for work that may wait.
        """
        return self._turn_of("viewer", lambda: self.viewing_may_go and not self._training_goes_first, -cost)

    def charge(self, seconds: float) -> None:
        """Count time that the viewer computed outside its turns, on processors that training could have used."""
        with self._turn:
            self._earn(-seconds)

    def num_waiting(self, who: Literal["training", "viewer"]) -> int:
        """How many threads wait for their turn."""
        return len(self._waiting[who])

    @property
    def viewing_may_go(self) -> bool:
        """Whether the viewer need not wait for credit."""
        return not self._is_training or self._credit_s > 0

    @property
    def _viewing_goes_first(self) -> bool:
        return self.num_waiting("viewer") > 0 and self.viewing_may_go and not self._training_goes_first

    @property
    def _training_goes_first(self) -> bool:
        return self.num_waiting("training") > 0 and self._last == "viewer" and not self._is_training

    @contextmanager
    def _turn_of(
        self, who: Literal["training", "viewer"], may_go: Callable[[], bool], credit_a_second: float
    ) -> Iterator[None]:
        with self._turn:
            if self._owner == threading.get_ident():
                raise RuntimeError("this thread has the device already: turns do not nest")
            queue, place = self._waiting[who], object()
            queue.append(place)
            try:
                self._turn.wait_for(lambda: self._owner is None and queue[0] is place and may_go())
            finally:
                queue.remove(place)
                self._turn.notify_all()
            self._owner, self._last = threading.get_ident(), who
        started = time.perf_counter()
        try:
            yield
        finally:
            with self._turn:
                self._owner = None
                self._earn(credit_a_second * (time.perf_counter() - started))
                self._turn.notify_all()

    def _earn(self, credit_s: float) -> None:
        if self._is_training:
            self._credit_s = min(self._credit_s + credit_s, _LARGEST_CREDIT_S)


_STATUS_INTERVAL_S = 0.25


class TrainingControl:
    """Joins a trainer with whoever watches it. Everything asked for happens between two steps."""

    def __init__(self) -> None:
        self.device = DeviceLock()
        """Turns with others that compute on the same device."""
        self.status: TrainingStatus | None = None
        """How far training has come, renewed a few times a second; None before the first step."""
        self.is_stop_requested = False
        """Whether training is to end as after Ctrl-C: the step is saved and the run can be resumed."""
        self._status_at = 0.0
        self._save_requested = threading.Event()
        self._resumed = threading.Event()
        self._resumed.set()
        self.is_running = False
        """Whether the training loop has begun and not ended; true while paused."""

    @property
    def is_paused(self) -> bool:
        """Whether training waits for `resume`."""
        return not self._resumed.is_set()

    def pause(self) -> None:
        """Let training wait after the step under way; paused time does not count as training."""
        self._resumed.clear()
        self.device.is_training = False

    def resume(self) -> None:
        """Let a paused training go on."""
        self.device.is_training = self.is_running
        self._resumed.set()

    def request_stop(self) -> None:
        """End training after the step under way, also a paused one."""
        self.is_stop_requested = True

    def request_save(self) -> None:
        """Have a checkpoint saved after the step under way."""
        self._save_requested.set()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Context of the training loop, entered by the trainer."""
        self.is_running = True
        self.device.is_training = not self.is_paused
        try:
            yield
        finally:
            self.is_running = False
            self.device.is_training = False

    def wait_while_paused(self) -> bool:
        """Wait for `resume`, but at most 0.1 s; whether a save is asked for."""
        self._resumed.wait(0.1)
        return self.take_save_request()

    def take_save_request(self) -> bool:
        """Whether a save was asked for since this was last called."""
        asked = self._save_requested.is_set()
        if asked:
            self._save_requested.clear()
        return asked

    @property
    def is_due(self) -> bool:
        """Whether it is time for the trainer to renew `status`."""
        return time.monotonic() - self._status_at >= _STATUS_INTERVAL_S

    def show(self, status: TrainingStatus) -> None:
        """Renew `status`."""
        self._status_at = time.monotonic()
        self.status = status


class Interrupted(Exception):  # noqa: N818
    """Training was stopped on request; the run can be resumed."""

    def __init__(self, run: Path, step: int | None, signal_number: int | None) -> None:
        super().__init__(f"stopped; {'no checkpoint' if step is None else f'step {step}'} is saved in {run}")
        self.signal_number = signal_number
        """The signal that asked for it; None where none did."""
        self.run = run
        """The run folder."""
        self.step = step
        """Step of the newest checkpoint, from which `load_config(run)` resumes; None if there is none."""


_SAME_SIGNAL_S = 0.3
"""Within which signals are one that came by two ways."""


@contextmanager
def stop_signals(noted: list[int]) -> Iterator[None]:
    """Context in which Ctrl-C, SIGTERM or SIGHUP is only noted in the list, and a second one raises KeyboardInterrupt.

    A lost terminal often sends SIGHUP twice, so that a second one of these changes nothing; under nohup it stays
    ignored. Of Ctrl-C a terminal and the process that started this one as one of several both tell, so that for those
    what comes at once counts once. In a thread that is not the main one signals can't be caught, and nothing is ever
    noted.
    """
    noted_at, same_s = 0.0, _SAME_SIGNAL_S if "WORLD_SIZE" in os.environ else 0.0

    def note(number: int, _frame: FrameType | None) -> None:
        nonlocal noted_at
        is_second = bool(noted) and time.monotonic() - noted_at >= same_s
        if is_second and signal.Signals(number).name != "SIGHUP":
            raise KeyboardInterrupt
        if not noted:
            noted.append(number)
            noted_at = time.monotonic()

    from unmix_plugin.engine.machine import handled_signals  # which imports torch: help of commands must not

    names = ["SIGINT", "SIGTERM", "SIGHUP"] if threading.current_thread() is threading.main_thread() else []
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN and names:
        names.remove("SIGHUP")
    with handled_signals(dict.fromkeys(names, note)):
        yield
