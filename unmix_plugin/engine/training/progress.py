"""Showing how training goes: a live bar on a terminal, a plain line every few seconds elsewhere."""

import time
from dataclasses import dataclass
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn


@dataclass(frozen=True)
class TrainingStatus:
    """What is shown."""

    step: int
    """Steps done."""
    seconds: float
    """Seconds of training."""
    progress: float
    """Fraction of the training done, [0, 1]."""
    loss: float
    """Of the last step."""
    psnr: float | None
    """Of the last training batch, dB, where the model has such a metric."""
    rays_per_second: float
    """Training rays a second of training."""

    @property
    def seconds_left(self) -> float | None:
        """Time to the end at the speed so far; None before the first step."""
        return self.seconds * (1.0 - self.progress) / self.progress if self.progress > 0 else None

    def __str__(self) -> str:
        psnr = "" if self.psnr is None else f"  psnr {self.psnr:.2f} dB"
        left = "" if self.seconds_left is None else f"  {_clock(self.seconds_left)} left"
        return (
            f"step {self.step}  {100 * self.progress:3.0f} %  loss {self.loss:.3g}{psnr}"
            f"  {_count(self.rays_per_second)} rays/s{left}"
        )


class ProgressDisplay:
    """Context that shows `TrainingStatus` values on a console."""

    def __init__(
        self, console: Console, plain_interval_s: float = 5.0, live_interval_s: float = 0.25
    ) -> None:
        """Choose the display.

        Args:
            console: Where to show.
            plain_interval_s: Seconds between lines where the console is no terminal.
            live_interval_s: Seconds between refreshes where it is one.
        """
        self.console = console
        self.interval_s = live_interval_s if console.is_terminal else plain_interval_s
        self._bar: Progress | None = None
        self._shown_at = time.monotonic()

    def __enter__(self) -> "ProgressDisplay":
        if self.console.is_terminal:
            # No refresh thread of its own: it would take time from the training threads.
            columns = (BarColumn(bar_width=24), TextColumn("{task.description}"))
            self._bar = Progress(*columns, console=self.console, auto_refresh=False)
            self._bar.add_task("starting", total=1.0)
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    @property
    def is_due(self) -> bool:
        """Whether it is time for the next `show`."""
        return time.monotonic() - self._shown_at >= self.interval_s

    def show(self, status: TrainingStatus) -> None:
        """Show `status` now."""
        self._shown_at = time.monotonic()
        if self._bar is None:
            self.message(str(status))
            return
        self._bar.update(
            self._bar.task_ids[0], completed=status.progress, description=str(status), refresh=True
        )

    def message(self, text: str) -> None:
        """Print a line that stays."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _count(number: float) -> str:
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.1f}{unit}"
    return f"{number:.0f}"
