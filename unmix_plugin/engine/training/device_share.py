"""Turns on one device: training and a guest that also computes on it, in a stated proportion, neither starved."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

SHARE_BOUNDS = (0.05, 0.9)
"""Least and greatest share of a guest."""

_LARGEST_CREDIT_S = 0.25
"""What a guest that was idle may take at once before the proportion holds again."""


class DeviceShare:
    """Lets training and others compute by turns, so that they never meet on the device or in the weights.

    Turns do not nest.

    While training runs, each second of it earns the guest share / (1 - share) seconds of credit. A guest with credit
    goes before the next training step, one without waits. Before training runs, and while it is paused, a guest needs
    no credit, and a turn of training is the next after the guest's turn under way.
    """

    def __init__(self, guest_share: float = 0.3) -> None:
        """Start with nobody computing.

        Args:
            guest_share: Part of the device's time that the guest may take while training runs.
        """
        self._turn = threading.Condition()
        self._owner: int | None = None
        self._is_training = False
        self._num_waiting = 0
        self._is_training_waiting = False
        self._was_guests_turn = False
        self._credit_s = _LARGEST_CREDIT_S
        self.guest_share = guest_share
        self.training_turns = 0
        """Turns that training has had."""

    @property
    def guest_share(self) -> float:
        """Part of the device's time that the guest may take while training runs, within `SHARE_BOUNDS`."""
        return self._guest_share

    @guest_share.setter
    def guest_share(self, share: float) -> None:
        low, high = SHARE_BOUNDS
        self._guest_share = min(max(low, share), high)  # in this order NaN becomes the least

    @property
    def is_training(self) -> bool:
        """Whether the guest has to share."""
        return self._is_training

    @is_training.setter
    def is_training(self, value: bool) -> None:
        with self._turn:
            self._is_training = value
            self._turn.notify_all()

    @contextmanager
    def training_turn(self) -> Iterator[None]:
        """Context in which training has the device; earns the guest credit."""
        with self._turn:
            self._refuse_nesting()
            self._is_training_waiting = True
            try:
                self._turn.wait_for(lambda: self._owner is None and not self._guest_goes_first)
            finally:
                self._is_training_waiting = False
            self._owner = threading.get_ident()
            self._was_guests_turn = False
        started = time.perf_counter()
        try:
            yield
        finally:
            self.training_turns += 1
            self._release((time.perf_counter() - started) * self._guest_share / (1 - self._guest_share))

    @contextmanager
    def guest_turn(self, cost: float = 1.0) -> Iterator[None]:
        """Context in which the guest has the device.

        Args:
            cost: Seconds of credit that a second takes; more than 1 for work that may wait.
        """
        with self._turn:
            self._refuse_nesting()
            self._num_waiting += 1
            try:
                self._turn.wait_for(
                    lambda: self._owner is None and self.guest_may_go and not self._training_goes_first
                )
            finally:
                self._num_waiting -= 1
            self._owner = threading.get_ident()
            self._was_guests_turn = True
        started = time.perf_counter()
        try:
            yield
        finally:
            self._release(-cost * (time.perf_counter() - started))

    def charge(self, seconds: float) -> None:
        """Count time that the guest computed outside its turns, on processors that training could have used."""
        with self._turn:
            if self._is_training:
                self._credit_s -= seconds

    @property
    def guest_may_go(self) -> bool:
        """Whether the guest need not wait for credit."""
        return not self._is_training or self._credit_s > 0

    @property
    def _guest_goes_first(self) -> bool:
        return self._num_waiting > 0 and self.guest_may_go and not self._training_goes_first

    @property
    def _training_goes_first(self) -> bool:
        return self._is_training_waiting and self._was_guests_turn and not self._is_training

    def _refuse_nesting(self) -> None:
        """A thread that has the device would wait for itself forever."""
        if self._owner == threading.get_ident():
            raise RuntimeError("this thread has the device already: turns do not nest")

    def _release(self, credit_s: float) -> None:
        with self._turn:
            self._owner = None
            if self._is_training:
                self._credit_s = min(self._credit_s + credit_s, _LARGEST_CREDIT_S)
            self._turn.notify_all()
