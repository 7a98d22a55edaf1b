"""What others may see of a training that is under way in another thread, and what they may ask of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from unmix_plugin.engine.training.device_share import DeviceShare
from unmix_plugin.engine.training.progress import TrainingStatus

_STATUS_INTERVAL_S = 0.25


class TrainingControl:
    """Joins a trainer with whoever watches it. Everything asked for happens between two steps."""

    def __init__(self, device: DeviceShare | None = None) -> None:
        """
        Args:
            device: Turns with others that compute on the same device; None for turns of its own.
        """
        self.device = device or DeviceShare()
        self.status: TrainingStatus | None = None
        """How far training has come, renewed a few times a second; None before the first step."""
        self.is_stop_requested = False
        """Whether training is to end as after Ctrl-C: the step is saved and the run can be resumed."""
        self._status_at = 0.0
        self._save_requested = threading.Event()
        self._resumed = threading.Event()
        self._resumed.set()
        self._is_running = False

    @property
    def is_running(self) -> bool:
        """Whether the training loop has begun and not ended; true while paused."""
        return self._is_running

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
        self.device.is_training = self._is_running
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
        self._is_running = True
        self.device.is_training = not self.is_paused
        try:
            yield
        finally:
            self._is_running = False
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
    def is_status_due(self) -> bool:
        """Whether it is time for the trainer to renew `status`."""
        return time.monotonic() - self._status_at >= _STATUS_INTERVAL_S

    def show(self, status: TrainingStatus) -> None:
        """Renew `status`."""
        self._status_at = time.monotonic()
        self.status = status
