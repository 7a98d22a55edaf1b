"""How far training has come: how that is shown, and what is written down of it.

A terminal has a live bar, other outputs a plain line every few seconds; metrics become JSON lines (and TensorBoard
files, where it is installed), events a log.
"""

from __future__ import annotations

import importlib.util
import json
import math
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, Progress, TextColumn
from rich.segment import Segment

from unmix_plugin.engine.printing import cleaned, terminal_text
from unmix_plugin.engine.runs.atomic_files import cannot_write, write_file
from unmix_plugin.engine.runs.replacing import hash_of, list_file, move_aside
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.run_json import parse_plain_json
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.limits import MOST_TABLE_BYTES, read_bounded, regular_file

if TYPE_CHECKING:
    from torch import Tensor


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
        remaining = "" if self.seconds_left is None else f"  {_clock(self.seconds_left)} left"
        speed, loss = f"  {_count(self.rays_per_second)} rays/s", f"  loss {self.loss:.3g}"
        text = ""
        for parts in ((loss, psnr, speed), (loss, psnr), (psnr,), ()):
            text = f"step {self.step}  {100 * self.progress:3.0f} %{''.join(parts)}{remaining}"
            if len(text) <= width:
                break
        return text


class ProgressConsole(Console):
    """Standard output that drops what it gets once its reader has gone, where rich would end the process."""

    is_closed = False
    """Whether that has happened; training then stops as after Ctrl-C."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """What is printed, without what would steer a terminal from a name."""
        return cleaned(super().render(renderable, options))

    def on_broken_pipe(self) -> None:
        """Drop everything from now on."""
        self.is_closed = self.quiet = True


class ProgressDisplay:
    """Context that shows `TrainingStatus` values on a console."""

    def __init__(
        self, console: Console, plain_interval_s: float = 5.0, live_interval_s: float = 0.25
    ) -> None:
        """Seconds between plain lines, and between refreshes where the console is a terminal."""
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

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            with self._noting_a_closed_console():
                self._bar.stop()

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


class MetricsWriter:
    """Appends to `metrics.jsonl` and, if the package is installed, to TensorBoard's files in `tensorboard/`."""

    def __init__(self, run: RunFolder, resumed_step: int = 0) -> None:
        """Go on after step `resumed_step`; what a stopped run wrote beyond it is cut off. Raises RunError."""
        self._path = run.metrics_path
        keep_lines_until(self._path, resumed_step)
        self._board = _tensorboard(run.path / "tensorboard", resumed_step)

    def write(
        self, step: int, seconds: float, split: Literal["train", "eval_all"], values: Mapping[str, float]
    ) -> None:
        """One line, of a training batch or of all evaluation views; numbers that are not finite become null. Raises
        ConfigError: a metric has the name of what says where the line belongs."""
        line = {"step": step, "seconds": round(seconds, 3), "split": split}
        if taken := sorted(line.keys() & values.keys()):
            raise ConfigError(f"no metric of a model may be called {', '.join(taken)}: give it another name")
        finite = {name: value if math.isfinite(value) else None for name, value in values.items()}
        _append(self._path, json.dumps({**line, **finite}))
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(f"{split}/{name}", value, step)

    def write_images(self, step: int, images: Mapping[str, Tensor]) -> None:
        """Pictures (height, width, 3) in [0, 1], for TensorBoard only."""
        if self._board is not None:
            for name, image in images.items():
                self._board.add_image(f"eval/{name}", image.detach().float().cpu(), step, dataformats="HWC")

    def close(self) -> None:
        """Finish TensorBoard's file."""
        if self._board is not None:
            self._board.close()


def write_event(run: RunFolder, text: str) -> None:
    """Append a dated line to `run.log`. Raises RunError: it can't be written."""
    _append(run.log_path, f"{datetime.now(timezone.utc).isoformat(timespec='seconds')} {terminal_text(text)}")


def _append(path: Path, line: str) -> None:
    try:
        with open(path, "a", encoding="utf-8", errors="backslashreplace", opener=regular_file) as file:
            file.write(line + "\n")
    except OSError as error:
        raise RunError(
            f"can't write {path}: {error.strerror or error}; checkpoints saved before are whole"
        ) from error


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Lines of a run's `metrics.jsonl`, each with its `step`; those that a killed run left incomplete are passed over.
    Raises RunError: it is no regular file, or longer than a training writes."""
    return [record for line in _lines(path) if (record := _record(line)) is not None]


def _lines(path: Path) -> list[bytes]:
    try:
        return read_bounded(path, MOST_TABLE_BYTES).removeprefix(b"\xef\xbb\xbf").splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RunError(f"can't read {path}: {error.strerror or error}; the run is damaged") from error


def _record(line: bytes) -> dict[str, Any] | None:
    """The object in a line; None where it is not one that `MetricsWriter` wrote."""
    try:
        record = parse_plain_json(line.decode())
    except ValueError:
        return None
    is_known = isinstance(record, dict) and type(record.get("step")) is int
    numbers = [value for key, value in record.items() if key != "split"] if is_known else []
    is_known = is_known and all(value is None or type(value) in (int, float) for value in numbers)
    return record if is_known else None


def keep_lines_until(path: Path, step: int) -> None:
    """Rewrite a JSON-lines file without later steps' lines and without one cut off by a kill. One with lines that no
    run writes gets another name."""
    if not path.exists():
        return
    lines = _lines(path)
    records = [_record(line) for line in lines]
    if None in records[:-1]:
        move_aside(path, "damaged")
    else:
        list_file(path, hash_of(path))  # lines were appended since it was listed, if it ever was
    pairs = zip(lines, records, strict=True)
    kept = [line for line, record in pairs if record is not None and record["step"] <= step]
    write_file(path, b"".join(line + b"\n" for line in kept))


def _tensorboard(folder: Path, resumed_step: int) -> Any | None:
    """TensorBoard's writer; None where the package is not installed."""
    if importlib.util.find_spec("tensorboard") is None:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a third party's deprecations are not our user's concern
        from torch.utils.tensorboard import SummaryWriter

        try:
            return SummaryWriter(str(folder), purge_step=resumed_step + 1 if resumed_step else None)
        except OSError as error:
            raise cannot_write(folder, error.strerror or str(error)) from error
