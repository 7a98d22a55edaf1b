"""How far training has come, and when it ends: by steps, by seconds of training, or by whichever is first."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Where training ends."""

    max_steps: int | None
    """Steps; None: no such limit."""
    max_seconds: float | None
    """Seconds of training; None: no such limit."""

    def progress(self, step: int, seconds: float) -> float:
        """Fraction in [0, 1] used up of the limit that is nearer its end; 0 without limits."""
        parts = [
            1.0 if limit <= 0 else spent / limit
            for spent, limit in ((step, self.max_steps), (seconds, self.max_seconds))
            if limit is not None
        ]
        return min(1.0, max(parts, default=0.0))

    def reached(self, step: int, seconds: float) -> bool:
        """Whether training is over."""
        return self.progress(step, seconds) >= 1.0


class TrainingClock:
    """Counts the seconds spent in training steps and nothing else."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds

    @contextmanager
    def running(self) -> Iterator[None]:
        """Context whose time counts."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds += time.perf_counter() - started
