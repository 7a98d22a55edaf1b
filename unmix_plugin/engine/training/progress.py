"""Showing how training goes: a live bar on a terminal, a plain line every few seconds elsewhere."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

_BAR_WIDTH, _WIDTH_WITH_BAR = 24, 100


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
    """Loss of the last step."""
    psnr: float | None
    """PSNR of the last training batch, dB, where the model has such a metric."""
    rays_per_second: float
    """Training rays a second of training."""

    @property
    def seconds_left(self) -> float | None:
        """Time to the end at the speed so far; None before the first step."""
        return self.seconds * (1.0 - self.progress) / self.progress if self.progress > 0 else None

    def __str__(self) -> str:
        return self.fitted(1000)

    def fitted(self, width: int) -> str:
        """The status in at most `width` characters, where dropping all but step, percentage and time left will do."""
        psnr = "" if self.psnr is None else f"  psnr {self.psnr:.2f} dB"
        left = "" if self.seconds_left is None else f"  {_clock(self.seconds_left)} left"
        speed, loss = f"  {_count(self.rays_per_second)} rays/s", f"  loss {self.loss:.3g}"
        text = ""
        for parts in ((loss, psnr, speed), (loss, psnr), (psnr,), ()):
            text = f"step {self.step}  {100 * self.progress:3.0f} %{''.join(parts)}{left}"
            if len(text) <= width:
                break
        return text


class ProgressConsole(Console):
    """Standard output that drops what it gets once its reader has gone, where rich would end the process."""

    is_closed = False
    """Whether that has happened; training then stops as after Ctrl-C."""

    def on_broken_pipe(self) -> None:
        """Drop everything from now on."""
        self.is_closed = self.quiet = True


class ProgressDisplay:
    """Context that shows `TrainingStatus` values on a console."""

    def __init__(
        self, console: Console, plain_interval_s: float = 5.0, live_interval_s: float = 0.25
    ) -> None:
        """Choose the display.

        Args:
            console: Where to show.
            plain_interval_s: Seconds between lines where the console is not a terminal.
            live_interval_s: Seconds between refreshes where it is one.
        """
        self.console = console
        self.interval_s = live_interval_s if console.is_terminal else plain_interval_s
        self._bar: Progress | None = None
        self._shown_at = time.monotonic()

    def __enter__(self) -> "ProgressDisplay":
        if self.console.is_terminal:
            # No refresh thread of its own: it would take time from the training threads.
            bar = [BarColumn(bar_width=_BAR_WIDTH)] if self.console.width >= _WIDTH_WITH_BAR else []
            self._bar = Progress(
                *bar, TextColumn("{task.description}"), console=self.console, auto_refresh=False
            )
            self._bar.add_task("starting", total=1.0)
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._bar is not None:
            with self._noting_a_closed_console():
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
        width = self.console.width - (_BAR_WIDTH + 1 if len(self._bar.columns) > 1 else 0)
        text = status.fitted(width)
        with self._noting_a_closed_console():
            self._bar.update(self._bar.task_ids[0], completed=status.progress, description=text, refresh=True)

    def message(self, text: str) -> None:
        """Print a line that stays."""
        with self._noting_a_closed_console():
            self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    @property
    def is_closed(self) -> bool:
        """Whether nobody reads what is shown any more."""
        return isinstance(self.console, ProgressConsole) and self.console.is_closed

    @contextmanager
    def _noting_a_closed_console(self) -> Iterator[None]:
        try:
            yield
        except OSError:  # the terminal is gone
            if not isinstance(self.console, ProgressConsole):
                raise
            self.console.on_broken_pipe()


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _count(number: float) -> str:
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.1f}{unit}"
    return f"{number:.0f}"
