"""What may be removed or replaced: files that a list of ours names with their hash. All others are somebody's.

Every folder that files are written into gets such a list, `LIST_NAME`, in the form that `sha256sum --check` reads. A
file is ours if its folder's list names it with the hash that it has now: one that somebody put there, changed, or made
a link is not, and neither is a folder with such a file in it.

All that the package removes, replaces or moves away goes through this module, except for folders that the running
process has just made for itself with `tempfile`.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from unmix_plugin.errors import ConfigError, RunError, name_some
from unmix_plugin.limits import MOST_TABLE_BYTES, read_bounded

LIST_NAME = ".unmix-nerf.sha256"
_HEADER = b"# Files that unmix-nerf wrote here. It replaces and removes no others.\n"

TEMPORARY = re.compile(r"\..+\.unmix-[0-9a-f]{16}\.tmp")
"""Names that `temporary_name` gives; nobody else takes such a one."""

_READERS_S = (0.02, 0.1, 0.5, 1.0) if os.name == "nt" else ()
"""Waits for readers of a file to be replaced: Windows lets nobody replace one that is open, as by a virus scanner."""

_CHUNK_BYTES = 1 << 22


def temporary_name(path: Path) -> Path:
    """A name beside `path` that no file has and no other writer takes, be it another thread of this process."""
    return path.with_name(f".{path.name}.unmix-{secrets.token_hex(8)}.tmp")


def remove_stale_temporaries(folder: Path) -> None:
    """Remove what writers that were killed left behind in `folder`, which the caller has locked."""
    for path in folder.glob(".*.tmp"):
        if TEMPORARY.fullmatch(path.name) and _is_regular(path):
            path.unlink(missing_ok=True)


def hash_of(path: Path) -> str:
    """SHA-256 of a file's bytes. Raises OSError."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def is_ours(path: Path) -> bool:
    """Whether `path` is a regular file that its folder's list names with the hash that it has. Raises OSError."""
    return os.path.lexists(path) and not foreign([path])


def foreign(paths: Iterable[Path]) -> list[Path]:
    """Those of `paths` where there is something that is not ours. Raises OSError."""
    lists: dict[Path, Mapping[str, set[str]]] = {}
    found = []
    for path in paths:
        if os.path.lexists(path):
            if path.parent not in lists:
                lists[path.parent] = _read_list(path.parent)
            hashes = lists[path.parent].get(path.name, ())
            if not (hashes and _is_regular(path) and hash_of(path) in hashes):
                found.append(path)
    return found


def foreign_in(folder: Path, scratch: re.Pattern[str] | None = None) -> list[Path]:
    """Everything below `folder` that is not ours, but for folders; a folder that is a link is named, not entered.

    Args:
        scratch: Paths from `folder`, with slashes, of files that are ours although no list has them.
    Raises:
        OSError: something can't be read.
    """
    return foreign(
        path
        for path in _files_below(folder)
        if scratch is None
        or not (_is_regular(path) and scratch.fullmatch(path.relative_to(folder).as_posix()))
    )


def refuse_foreign(paths: Iterable[Path], advice: str = "move it away, or choose another folder") -> None:
    """Refuse to replace what is not ours. Raises RunError: naming it; OSError."""
    if found := foreign(paths):
        raise RunError(f"{_named(found)}; {advice}")


def _named(found: list[Path]) -> str:
    """What is in the way, and why it stays."""
    what = name_some([str(path) for path in found])
    is_one = len(found) == 1
    return (
        f"{what} {'is' if is_one else 'are'} in the way: unmix-nerf did not write {'it' if is_one else 'them'}, or "
        f"{'it was' if is_one else 'they were'} changed since, and is not going to replace {'it' if is_one else 'them'}"
    )


def refuse_folder(folder: Path, scratch: re.Pattern[str] | None = None) -> None:
    """Refuse to remove or replace a folder with something in it that is not ours. Raises ConfigError: naming it."""
    if folder.is_symlink() or not folder.is_dir():
        raise ConfigError(f"{folder} is in the way and no folder of unmix-nerf; rename it")
    if found := foreign_in(folder, scratch):
        raise ConfigError(
            f"{_named(found)}; move what you want to keep out of {folder}, or rename the folder"
        )


def put_in_place(temporary: Path, path: Path) -> None:
    """Give a complete file its name, in place of one that is ours or has the same bytes.

    Raises:
        RunError: something else has the name; both files stay.
        OSError.
    """
    hashed = hash_of(temporary)
    # Twice, where somebody was quicker between look and link.
    for _ in range(2):
        if os.path.lexists(path):
            if foreign([path]) and not (_is_regular(path) and hash_of(path) == hashed):
                raise RunError(f"{_named([path])}; move it away, or choose another name")
            list_file(path, hashed)
            _replace(temporary, path)
            return
        list_file(path, hashed)
        with suppress(FileExistsError):
            _name_exclusively(temporary, path)
            return
    refuse_foreign([path])
    _replace(temporary, path)


def claim(path: Path) -> bool:
    """Make an empty file of ours, to be replaced by what is written under its name; False if the name is taken. Raises
    OSError."""
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except FileExistsError:
        return False
    list_file(path, hashlib.sha256().hexdigest())
    return True


def drop_claim(path: Path) -> None:
    """Remove a file of ours that nothing was written into. Raises OSError."""
    if _is_regular(path) and path.stat().st_size == 0:
        remove(path)


def list_file(path: Path, hashed: str) -> None:
    """Name a file with its hash in its folder's list, before it gets its name. Raises RunError: the list's name is
    somebody's; OSError."""
    at = path.parent / LIST_NAME
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    descriptor = os.open(at, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
    try:
        state = os.fstat(descriptor)
        if not stat.S_ISREG(state.st_mode) or (state.st_size and os.read(descriptor, 1) != _HEADER[:1]):
            raise RunError(f"{at} is no list of unmix-nerf; move it away")
        line = f"{hashed}  ".encode() + os.fsencode(path.name) + b"\n"
        start = b"" if state.st_size else _HEADER
        if state.st_size:
            os.lseek(descriptor, -1, os.SEEK_END)
            start = b"" if os.read(descriptor, 1) == b"\n" else b"\n"  # cut short by a full disk
        if os.write(descriptor, start + line) < len(start + line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(at))
    finally:
        os.close(descriptor)


def remove(*paths: Path) -> list[Path]:
    """Remove those of `paths` that are ours.

    Returns:
        The others that are there: they stay.
    Raises:
        OSError.
    """
    stay = foreign(paths)
    for path in paths:
        if path not in stay:
            path.unlink(missing_ok=True)
    return stay


def remove_folder(folder: Path, scratch: re.Pattern[str] | None = None) -> list[Path]:
    """Remove what is ours below `folder`, and folders that are empty then; `scratch` as `foreign_in` takes it.

    Returns:
        What is not ours, and stays with its folders.
    Raises:
        OSError.
    """
    if folder.is_symlink() or not folder.is_dir():
        return [folder] if os.path.lexists(folder) else []
    stay = foreign_in(folder, scratch)
    kept = {*stay}
    for path in [*_files_below(folder)]:
        if path not in kept:
            path.unlink(missing_ok=True)
    for parent, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):
            of_list = Path(parent, LIST_NAME)
            if [*Path(parent).iterdir()] == [of_list] and _is_list(of_list):
                of_list.unlink()
            Path(parent).rmdir()
    return stay


def move_aside(path: Path, word: str) -> Path:
    """Give a file or folder a name beside its own that nothing has; the new path. Raises OSError."""
    aside = path.with_name(f"{path.name}.{word}-{secrets.token_hex(4)}")
    path.rename(aside)
    return aside


def move_files(built: Path, folder: Path, last: str) -> None:
    """Move the files of a folder that this process has built into another, in place of what is ours there.

    What is ours of an earlier set, and not built again, is removed from the folders that the new one has. The file
    `last` goes first and comes last, so that the set is whole or not there.

    Raises:
        RunError: files of others have the names; nothing has been moved.
        OSError.
    """
    files = sorted(path.relative_to(built) for path in _files_below(built))
    folders = sorted({folder / file.parent for file in files})
    links = [
        one for one in folders if one != folder and (one.is_symlink() or (one.exists() and not one.is_dir()))
    ]
    refuse_foreign([*(folder / file for file in files), *links])
    for one in sorted({folder, *folders}):
        one.mkdir(exist_ok=True)
    remove(folder / last)
    for one in folders:
        listed = _read_list(one)
        remove(*(one / name for name in listed if (one / name).relative_to(folder) not in files))
    for file in sorted(files, key=lambda file: file == Path(last)):
        put_in_place(built / file, folder / file)


def require_apart(replaced: Iterable[Path], read: Iterable[tuple[str, Path]]) -> None:
    """Refuse to replace folders in which something lies that is read.

    Paths are compared as what they lead to: by links, or by another spelling, a folder is still the same.

    Args:
        read: What is read, each with the words for it, such as its flag.
    Raises:
        ConfigError: naming both.
    """
    there = [folder for folder in replaced if folder.exists()]
    for what, path in read:
        resolved = path.resolve()
        around = [one for one in (resolved, *resolved.parents) if one.exists()] if path.exists() else []
        for folder in there:
            if any(one.samefile(folder) for one in around):
                raise ConfigError(
                    f"{what} {path} lies in {folder}, which would be replaced; choose another --output-dir"
                )


def _files_below(folder: Path) -> Iterator[Path]:
    """All that is below a folder and is no folder, or a link to one; not the lists."""
    for parent, folders, files in os.walk(folder):
        for name in sorted(folders):
            if Path(parent, name).is_symlink():
                yield Path(parent, name)
        for name in sorted(files):
            if name != LIST_NAME or not _is_list(Path(parent, name)):
                yield Path(parent, name)


def _is_list(path: Path) -> bool:
    """Whether a file is a list of ours, which has nothing in it but hashes and names."""
    with suppress(OSError):
        return _is_regular(path) and read_bounded(path, MOST_TABLE_BYTES).startswith(_HEADER[:1])
    return False


def _is_regular(path: Path) -> bool:
    """Whether a path is a file itself, not by a link."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


def _read_list(folder: Path) -> Mapping[str, set[str]]:
    """By name of a file of ours the hashes that it had."""
    found: dict[str, set[str]] = {}
    if _is_regular(folder / LIST_NAME):
        for line in read_bounded(folder / LIST_NAME, MOST_TABLE_BYTES).split(b"\n"):
            hashed, parted, name = line.partition(b"  ")
            if parted and len(hashed) == 64:
                found.setdefault(os.fsdecode(name), set()).add(hashed.decode("ascii", "replace"))
    return found


def _name_exclusively(temporary: Path, path: Path) -> None:
    """Give a file a name that nothing has. Raises FileExistsError."""
    if os.name == "nt":  # whose rename replaces nothing
        temporary.rename(path)
        return
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without second names
        temporary.rename(path)
    else:
        temporary.unlink()


def _replace(temporary: Path, path: Path) -> None:
    """Give a file its name, also where somebody who reads the old one has to be waited for."""
    for seconds in _READERS_S:
        with suppress(PermissionError):
            temporary.replace(path)
            return
        time.sleep(seconds)
    temporary.replace(path)
