"""Videos, rendered by `unmix-render` in a process of its own."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.relighting import LightChoice
from unmix_plugin.viewer.layers.layer_settings import LayerSettings

_LAUNCH = "from unmix_plugin.commands.render import main; main()"
_LONGEST_MESSAGE = 1000
_WAIT_S = 10.0
_LINES_KEPT = 100
_PROGRESS = re.compile(r"rendering: (\d+) of ([1-9]\d*) done")


def output_of(settings: LayerSettings) -> str:
    """The output of renders that a layer shows.

    Raises:
        ConfigError: renders have no such output.
    """
    if settings.layer == "band":
        return f"band:{settings.wavelength_nm:g}nm"
    if settings.layer == "false-colour":
        return "false-colour:" + ",".join(f"{value:g}" for value in settings.false_colour_nm)
    if settings.layer == "index" and settings.index:
        return f"index:{settings.index}"
    if settings.layer == "abundance":
        return "abundances"
    if settings.layer in ("error", "index"):
        raise ConfigError(f"videos can't show the layer {settings.layer}; choose another one")
    return settings.layer


@dataclass(eq=False)
class VideoJob:
    """A video asked for by one page; its callbacks are called in a thread of its own."""

    argv: list[str]
    """Arguments of `unmix-render`."""
    folder: Path
    """Where it writes."""
    progress: Callable[[float], None]
    """Told the part that is rendered, now and then."""
    done: Callable[[Path | None, str], None]
    """Takes the video, or None and what went wrong."""
    is_cancelled: bool = False


class VideoQueue:
    """Renders videos one after another."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._lock = threading.Lock()
        self._is_stopping = False
        self._running: tuple[VideoJob, subprocess.Popen[str]] | None = None

    def start(self, job: VideoJob) -> None:
        """Render a video when those before it are done."""
        threading.Thread(target=self._run, args=(job,), name="unmix-viewer-video", daemon=True).start()

    def cancel(self, job: VideoJob) -> None:
        """Drop a video, even one that is being rendered."""
        with self._lock:
            job.is_cancelled = True
            if self._running is not None and self._running[0] is job:
                _end(self._running[1])

    def stop(self) -> None:
        """Drop all videos."""
        with self._lock:
            self._is_stopping = True
            if self._running is not None:
                _end(self._running[1])

    def _run(self, job: VideoJob) -> None:
        with self._turn:
            lines: deque[str] = deque(maxlen=_LINES_KEPT)
            with self._lock:
                process = None
                if not self._is_stopping and not job.is_cancelled:
                    process = _start(job.argv)
                    self._running = (job, process)
            if process is not None:
                _follow(process, lines, job.progress)
            with self._lock:
                self._running = None
        if process is not None and process.returncode == 0:
            job.done(next(job.folder.rglob("*.mp4"), None), "no video was written")
        elif job.is_cancelled or self._is_stopping:
            job.done(None, "cancelled")
        else:
            job.done(None, f"rendering the video failed: {''.join(lines).strip()[-_LONGEST_MESSAGE:]}")


def _start(argv: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", _LAUNCH, *argv],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def _follow(process: subprocess.Popen[str], lines: deque[str], progress: Callable[[float], None]) -> None:
    """Read what a render prints until it ends."""
    with process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if found := _PROGRESS.match(line):
                progress(int(found[1]) / int(found[2]))


def _end(process: subprocess.Popen[str]) -> None:
    """End a render, and the encoder that it started."""
    if not hasattr(os, "killpg"):  # Windows
        process.kill()
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        os.killpg(process.pid, number)
        try:
            process.wait(_WAIT_S)
            return
        except subprocess.TimeoutExpired:
            continue


def render_argv(
    run: Path,
    cameras: Path,
    output: str,
    folder: Path,
    recipe: Path | None,
    light: LightChoice = LightChoice(),  # noqa: B008 - a frozen value
) -> list[str]:
    """Arguments of `unmix-render` for a video along a camera file."""
    argv = ["--run", str(run), "--cameras", str(cameras), "--outputs", output, "--formats", "mp4"]
    argv += ["--output", str(folder), "--overwrite"]
    if recipe is not None:
        argv += ["--edits", str(recipe)]
    if light.name is not None:
        argv += ["--environment", light.name]
    numbers = {"--environment-rotation": light.rotation_deg, "--environment-exposure": light.exposure_stops}
    return [*argv, *(f"{flag}={value:g}" for flag, value in numbers.items() if value != 0)]
