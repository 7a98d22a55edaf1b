"""How loss and PSNR went, in a bounded number of points."""

from __future__ import annotations

import threading

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.training.progress import TrainingStatus

_MOST_POINTS = 400


class TrainingCurve:
    """Points of a training, thinned evenly as they become many."""

    def __init__(self) -> None:
        self._points: list[TrainingStatus] = []
        self._stride = 1
        self._seen = 0
        self._lock = threading.Lock()

    def add(self, status: TrainingStatus | None) -> None:
        """Take in a status, if it is one later than the last."""
        with self._lock:
            if status is None or (self._points and status.step <= self._points[-1].step):
                return
            if self._seen % self._stride == 0:
                self._points.append(status)
            self._seen += 1
            if len(self._points) > _MOST_POINTS:
                self._points = self._points[::2]
                self._stride *= 2

    def line(self, name: str) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
        """Steps, and `loss` or `psnr` of the points; none where one has no such value."""
        with self._lock:
            points = list(self._points)
        found = [getattr(point, name) for point in points]
        if None in found:
            return np.zeros(0), np.zeros(0)
        return np.array([float(point.step) for point in points]), np.array(found, dtype=np.float64)
