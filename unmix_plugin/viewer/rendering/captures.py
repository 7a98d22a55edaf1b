"""What leaves the viewer: spectra of the view, and videos, rendered by `unmix-render` in a process of its own.

Notation: `H x W` pixels, `B` bands.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from unmix_plugin.engine.children import child_command
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.look import Look
from unmix_plugin.formats.exr import write_spectral_exr
from unmix_plugin.formats.video import OWN_GROUP
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.model_scene import LightChoice
from unmix_plugin.trained.protocol import RenderedView
from unmix_plugin.trained.trained_scene import material_view

SIDE_BOUNDS = (16, 8192)
"""Least and greatest width and height of a picture."""

_MOST_PIXELS = 1 << 25
_LARGEST_SPECTRA_BYTES = 1 << 29


def check_size(width: int, height: int, num_bands: int | None = None) -> None:
    """Refuse with a ConfigError pictures that would take too much memory, by the bands of which spectra are kept."""
    most, what = _MOST_PIXELS, "pictures"
    if num_bands is not None:
        most, what = min(most, _LARGEST_SPECTRA_BYTES // (4 * num_bands)), "spectra"
    if width * height > most:
        raise ConfigError(
            f"{width} x {height} pixels are too many for {what} in the viewer; choose at most {most / 1e6:.1f} "
            "million, or render with unmix-render"
        )


Strip = tuple[Float32[np.ndarray, "h W B"], Float32[np.ndarray, "h W 3"], Float32[np.ndarray, "h W"]]


def strip_of_spectra(frame: RenderedView) -> Strip:
    """Spectra, linear RGB and coverage of a strip of `h` rows."""
    seen = material_view(frame)
    assert seen is not None
    linear_rgb = seen.materials.through(seen.coefficients, rgb_matrix(seen.materials.bands))
    return seen["spectral"].cpu().numpy(), linear_rgb.cpu().numpy(), seen.coverage.cpu().numpy()


def joined_strips(strips: Iterable[Sequence[np.ndarray]], height: int) -> list[np.ndarray]:
    """Arrays of a whole picture, filled while its strips come from top to bottom, so that it is held once."""
    whole: list[np.ndarray] = []
    first = 0
    for strip in strips:
        whole = whole or [np.empty((height, *part.shape[1:]), part.dtype) for part in strip]
        for array, part in zip(whole, strip, strict=True):
            array[first : first + len(part)] = part
        first += len(strip[0])
    return whole


def write_spectra(path: Path, picture: Sequence[np.ndarray], materials: Materials) -> Path:
    """Write spectra of these materials, as `strip_of_spectra` has them, as a spectral EXR; a RunError if the disk is
    full or refuses."""
    spectra, linear_rgb, coverage = picture
    about = f"{materials.quantity} on black, 1 = full scale"
    return write_spectral_exr(path, spectra, materials.bands, linear_rgb, coverage, about, materials.quantity)


_LONGEST_MESSAGE, _LINES_KEPT = 1000, 100
_WAIT_S = 10.0
_PROGRESS = re.compile(r"rendering: (\d+) of ([1-9]\d*) done")


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
    process: subprocess.Popen[str] | None = None
    """While it is rendered."""


class VideoQueue:
    """Renders videos one after another."""

    def __init__(self) -> None:
        self._turn, self._lock = threading.Lock(), threading.Lock()
        self._jobs: dict[VideoJob, threading.Thread] = {}
        self._is_stopping = False

    @property
    def is_busy(self) -> bool:
        """Whether a video is being rendered, or waits for that."""
        return bool(self._jobs)

    def start(self, job: VideoJob) -> None:
        """Render a video when those before it are done."""
        thread = threading.Thread(target=self._run, args=(job,), name="unmix-viewer-video", daemon=True)
        self._jobs[job] = thread
        thread.start()

    def cancel(self, job: VideoJob) -> None:
        """Drop a video, even one that is being rendered."""
        with self._lock:
            job.is_cancelled = True
            if job.process is not None:
                _end(job.process)

    def stop(self) -> None:
        """Drop all videos, also those that are asked for from now on, and wait until they are told so."""
        self._is_stopping = True
        jobs = self._jobs.copy()
        for job in jobs:
            self.cancel(job)
        for thread in jobs.values():
            thread.join(_WAIT_S)

    def _run(self, job: VideoJob) -> None:
        lines: deque[str] = deque(maxlen=_LINES_KEPT)
        with self._turn:
            with self._lock:
                job.is_cancelled |= self._is_stopping
                try:
                    process = job.process = None if job.is_cancelled else _begin(job.argv)
                except OSError as error:
                    process = None
                    lines.append(str(error))
            if process is not None:
                with process:
                    for line in process.stdout or ():
                        lines.append(line)
                        if found := _PROGRESS.match(line):
                            job.progress(int(found[1]) / int(found[2]))
            with self._lock:
                job.process = None
        if process is not None and process.returncode == 0:
            job.done(next(job.folder.rglob("*.mp4"), None), "no video was written")
        elif job.is_cancelled:
            job.done(None, "cancelled")
        else:
            job.done(None, f"rendering the video failed: {''.join(lines).strip()[-_LONGEST_MESSAGE:]}")
        del self._jobs[job]


def _begin(argv: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        child_command("unmix_plugin.commands.render", argv),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        env={**os.environ, "PYTHONIOENCODING": "utf-8"},
        start_new_session=True,
        creationflags=OWN_GROUP,
    )


def _end(process: subprocess.Popen[str]) -> None:
    """End a render, and the encoder that it started."""
    if not hasattr(os, "killpg"):  # Windows
        process.kill()
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):  # it has just ended by itself
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_WAIT_S)
            return


def render_argv(
    run: Path,
    cameras: Path,
    output: str,
    look: Look,
    folder: Path,
    recipe: Path | None,
    light: LightChoice = LightChoice(),  # noqa: B008 - a frozen value
) -> list[str]:
    """Arguments of `unmix-render` for a video along a camera file, which shows an output as a page does."""
    argv = ["--run", str(run), "--cameras", str(cameras), "--outputs", output, "--formats", "mp4"]
    argv += ["--output", str(folder), "--overwrite", *look_argv(look)]
    if recipe is not None:
        argv += ["--edits", str(recipe)]
    if light.name is not None:
        argv += ["--environment", light.name]
    numbers = {"--environment-rotation": light.rotation_deg, "--environment-exposure": light.exposure_stops}
    return [*argv, *(f"{flag}={value:g}" for flag, value in numbers.items() if value != 0)]


def look_argv(look: Look) -> list[str]:
    """A look as arguments of `unmix-render`, which reads the same numbers from them."""
    argv = []
    for one in fields(Look):
        value, flag = getattr(look, one.name), f"--{one.name.replace('_', '-')}"
        if value == one.default:
            continue
        if one.name == "mixed":
            argv.append(flag)
        elif isinstance(value, tuple):
            argv += [flag, *(np.format_float_positional(end) for end in value)]
        else:
            argv.append(f"{flag}={np.format_float_positional(value) if isinstance(value, float) else value}")
    return argv
