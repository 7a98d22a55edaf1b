"""What commands share: which run they are about, and what they show while they work."""

from __future__ import annotations

import os
import shlex
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.printing import cleaned, tell
from unmix_plugin.engine.runs.run_folder import newest_run
from unmix_plugin.errors import ConfigError

if TYPE_CHECKING:
    from unmix_plugin.engine.model import DataManager
    from unmix_plugin.scenes.scene import Scene


_IS_WINDOWS = os.name == "nt"


def shell_line(*words: object) -> str:
    """A command to paste: shells of Windows take double quotes alone."""
    texts = [str(word) for word in words]
    return subprocess.list2cmdline(texts) if _IS_WINDOWS else shlex.join(texts)


def chosen_run(run: Path | None, output_dir: Path | None) -> Path:
    """The run folder named, or the newest under `output_dir`, which is then printed; None: where training writes.

    Raises:
        ConfigError: a run is named, and a folder to look for one, which would do nothing.
        RunError: none was named and there is none.
    """
    if run is not None:
        refuse_to_look(output_dir)
        return run
    newest = newest_run(output_dir or TrainerConfig.output_dir).path
    tell(f"newest run: {newest}")
    return newest


def refuse_to_look(output_dir: Path | None) -> None:
    """Refuse a folder to look for the newest run in, where runs are named. Raises ConfigError."""
    if output_dir is not None:
        raise ConfigError(
            f"--output-dir {output_dir} is where the newest run is looked for, and a run is named: leave one of them "
            "out. The folder to write to is --output, of commands that have it"
        )


def spectral_scene(datamanager: DataManager) -> Scene | None:
    """The spectral scene that a data manager serves; None where it serves something else."""
    from unmix_plugin.scenes.scene import Scene

    scene = getattr(datamanager, "scene", None)
    return scene if isinstance(scene, Scene) else None


ItemT = TypeVar("ItemT")

_PLAIN_INTERVAL_S = 5.0
_COMPILING_INTERVAL_S = 0.2


class CommandConsole(Console):
    """Standard output without what would steer a terminal from a name, whose broken pipe is an exception like any other
    file's: rich would end the process."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """What is printed."""
        return cleaned(super().render(renderable, options))

    def on_broken_pipe(self) -> None:
        """Raise it."""
        raise


@contextmanager
def working(console: Console, doing: str) -> Iterator[None]:
    """Context that shows that something of unknown length is under way; a plain line where there is no terminal."""
    if not console.is_terminal:
        say(console, f"{doing} ...")
        yield
        return
    with console.status(doing):
        yield


@contextmanager
def announce_kernel_compilation(console: Console) -> Iterator[None]:
    """Context that says so if the kernels it needs are not in Warp's cache, as happens once on a machine."""
    from unmix_plugin.operators.launching import warp

    cache, is_over = Path(warp().config.kernel_cache_dir), threading.Event()
    known = set(cache.glob("*"))

    def watch() -> None:
        while not is_over.wait(_COMPILING_INTERVAL_S):
            if not known.issuperset(cache.glob("*")):
                say(console, "compiling kernels (once on a machine) ...")
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        is_over.set()
        watcher.join()


def follow(console: Console, doing: str, items: Sequence[ItemT]) -> Iterator[ItemT]:
    """The items, with a bar that shows how many are done; a plain line every few seconds without a terminal."""
    if console.is_terminal:
        from rich.progress import track

        yield from track(items, doing, console=console, transient=True)
        return
    printed_at = time.monotonic()
    for done, item in enumerate(items):
        if done == 0 or time.monotonic() - printed_at >= _PLAIN_INTERVAL_S:
            say(console, f"{doing}: {done} of {len(items)} done")
            printed_at = time.monotonic()
        yield item


def say(console: Console, text: str) -> None:
    """A line as it is: not wrapped, nothing in it taken for markup."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)
