"""Where a demo scene or a demo capture goes: what is asked of the folder, and how files get there whole."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from unmix_plugin.errors import ConfigError, SceneError


def check_bounds(what: str, numbers: Mapping[str, tuple[int, tuple[int, int]]]) -> None:
    """Refuse numbers out of bounds.

    Args:
        what: What is made, for the message.
        numbers: By name of the flag: the value and its bounds, both allowed.
    Raises:
        ConfigError: a number is out of bounds.
    """
    for name, (value, (low, high)) in numbers.items():
        if not low <= value <= high:
            raise ConfigError(f"--{name} of {what} must be {low} to {high}; found {value}")


@contextmanager
def staging_for(directory: Path, what: str, overwrite: bool) -> Iterator[Path]:
    """A temporary folder in which to build what then moves to `directory`.

    Args:
        what: What is made, for messages.
        overwrite: Whether a folder with something in it is accepted.
    Raises:
        ConfigError: a folder with something in it, or no folder at all.
        SceneError: the folder can't be written, or the disk is full.
    """
    if directory.exists() and not directory.is_dir():
        raise ConfigError(f"{directory} is a file; give a folder for {what}")
    if not overwrite and directory.is_dir() and any(directory.iterdir()):
        raise ConfigError(
            f"{directory} is not empty; choose another folder, or replace what is there with --overwrite"
        )
    try:
        with staging_beside(directory) as staging:
            yield staging
    except OSError as error:  # NumPy's own has no strerror
        raise SceneError(
            f"can't write {what} to {directory}: {error.strerror or error}; make room there or choose another folder"
        ) from error


@contextmanager
def staging_beside(directory: Path) -> Iterator[Path]:
    """A temporary folder on the same disk, so that what is built there can be renamed into place."""
    directory.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{directory.name}-", dir=directory.parent) as folder:
        yield Path(folder)


def written_once(
    target: Path,
    what: str,
    write: Callable[[Path], None],
    is_complete: Callable[[Path], bool],
    remedy: str = "set XDG_CACHE_HOME to a folder that can be written",
) -> Path:
    """A folder of a cache, written on first use and again if a file of it is missing.

    Args:
        target: The folder.
        what: What is made, for the message.
        write: Makes it in a folder that is not there yet.
        is_complete: Whether a folder holds all of it.
        remedy: What to do where the folder can't be written, for the message.
    Raises:
        SceneError: the cache can't be written.
    """
    if is_complete(target):
        return target
    try:
        with staging_beside(target) as staging:
            write(staging / target.name)
            if target.exists() and not is_complete(target):
                target.rename(staging / "incomplete")
            (staging / target.name).rename(target)
    except OSError as error:
        # Another process may have been quicker; what it wrote is as good.
        if not is_complete(target):
            raise SceneError(
                f"can't write {what} to {target}: {error.strerror or error}; {remedy}"
            ) from error
    return target
