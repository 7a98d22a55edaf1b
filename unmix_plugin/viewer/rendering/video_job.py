"""Videos, rendered by `unmix-render` in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.layers.layer_settings import LayerSettings

_LAUNCH = "from unmix_plugin.commands.render import main; main()"
_LONGEST_MESSAGE = 1000
_OUTPUTS = (
    "rgb",
    "abundances",
    "segmentation",
    "confidence",
    "diffuse",
    "specular",
    "pca",
    "depth",
    "accumulation",
)
_WAIT_S = 10.0


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
    if settings.layer in _OUTPUTS:
        return settings.layer
    raise ConfigError(f"videos can't show the layer {settings.layer}; choose another one")


class VideoJob:
    """At most one render at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._lock = threading.Lock()

    @property
    def is_running(self) -> bool:
        """Whether a video is being rendered."""
        return self._process is not None and self._process.poll() is None

    def start(self, words: list[str], folder: Path, done: Callable[[str], None]) -> None:
        """Begin to render.

        Args:
            words: Of `unmix-render`.
            folder: Where it writes.
            done: Told the end, in a thread of its own.
        Raises:
            ConfigError: another video is being rendered.
        """
        with self._lock:
            if self.is_running:
                raise ConfigError("a video is being rendered already; wait until it is done")
            self._process = process = subprocess.Popen(
                [sys.executable, "-c", _LAUNCH, *words],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
        threading.Thread(target=_wait, args=(process, folder, done), daemon=True).start()

    def stop(self) -> None:
        """End a render under way."""
        with self._lock:
            if self._process is not None and self._process.poll() is None:
                _end(self._process)


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


def render_words(run: Path, cameras: Path, output: str, folder: Path, recipe: Path | None) -> list[str]:
    """Words of `unmix-render` for a video along a camera file."""
    words = ["--run", str(run), "--cameras", str(cameras), "--outputs", output, "--formats", "mp4"]
    words += ["--output", str(folder), "--overwrite"]
    return words if recipe is None else [*words, "--edits", str(recipe)]


def _wait(process: subprocess.Popen[str], folder: Path, done: Callable[[str], None]) -> None:
    output, _ = process.communicate()
    if process.returncode == 0:
        done(f"the video is in {folder}")
    else:
        done(f"rendering the video failed: {output.strip()[-_LONGEST_MESSAGE:]}")
