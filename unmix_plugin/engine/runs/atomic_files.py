"""Files that a kill, a crash or a full disk at any moment leaves whole: the old one or the new one, never a part; and
names that every system takes."""

import contextlib
import errno
import hashlib
import os
import re
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from unmix_plugin.engine.runs.replacing import drop_claim, put_in_place, temporary_name
from unmix_plugin.errors import RunError

CHUNK_BYTES = 1 << 26
"""Bytes handed to one write."""

LONGEST_PATH = 259 if os.name == "nt" else None
"""Letters of a path, where Windows has not been told to take long ones; its error is that of a missing folder."""

ADVICE = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "make room or choose another folder"),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "choose a folder that you may write to"),
    errno.EFBIG: "raise the limit of a file's size (ulimit -f), or choose a folder on another file system",
    errno.ENAMETOOLONG: "choose a shorter name",
}
_ADVICE_FOR = {os.strerror(number): f"; {advice}" for number, advice in ADVICE.items()}

NOT_PLAIN, NOT_PORTABLE = r"[^\w.+-]+", r'[\\/:*?"<>|]'
"""What a name needn't have, and what some system refuses in one."""

_DEVICES = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9\u00b9\u00b2\u00b3]) *(\..*)?", re.IGNORECASE
)
"""Names that are devices in every folder on Windows, whatever suffix follows."""

_LONGEST_NAME_BYTES = 110
"""Bytes of a name, of which encrypted file systems take 143, with the suffixes and marks that ours get."""


def safe_name(name: str, unfit: str = NOT_PLAIN, fallback: str = "unnamed") -> str:
    """A user's name as one that every system takes for a file or a folder, with any suffix of ours behind it.

    No dot or space begins or ends it, it is no device of Windows, and a long one ends with letters of its hash.

    Args:
        unfit: Pattern of what becomes `_`, beside what can't be printed; NOT_PORTABLE leaves spaces and brackets.
        fallback: Used where nothing is left of the name.

    >>> safe_name("aux.txt"), safe_name("leaf: 3. "), safe_name("leaf (3)", NOT_PORTABLE)
    ('_aux.txt', 'leaf_3', 'leaf (3)')
    """
    shown = "".join(one if one.isprintable() else "_" for one in unicodedata.normalize("NFC", name))
    plain = re.sub(unfit, "_", shown.strip(" .")).strip(" .") or fallback
    plain = f"_{plain}" if _DEVICES.fullmatch(plain) else plain
    if len(plain.encode()) <= _LONGEST_NAME_BYTES:
        return plain
    ending = hashlib.sha256(plain.encode()).hexdigest()[:8]
    return f"{plain.encode()[: _LONGEST_NAME_BYTES - 9].decode(errors='ignore')}-{ending}"


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Context that gives a temporary name in the folder of `path`, which is made; no other writer has that name, be it
    another thread that writes the same file.

    At the end of the block the file under that name is forced to disk and becomes `path`, unless something is there
    that is not ours (`replacing`). If the block fails, nothing is left of it and `path` is as it was.

    Raises:
        RunError: the folder can't be made, or the file can't get its name.
    """
    make_folder(path.parent)
    temporary = temporary_name(path)
    try:
        yield temporary
        with write_errors_as(path):
            _sync(temporary, os.O_RDWR)
            put_in_place(temporary, path)
            if os.name != "nt":  # Windows can't sync a folder, and needn't
                _sync(path.parent, os.O_RDONLY)
    except BaseException:
        with contextlib.suppress(OSError):
            drop_claim(path)
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_file(path: Path, data: bytes) -> Path:
    """Write `data` as a `whole_file`; its path. Raises RunError: the disk is full or refuses; what was there before is
    untouched."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    with whole_file(path) as temporary, write_errors_as(path):
        descriptor = os.open(temporary, flags, 0o666)
        try:
            write_all(descriptor, memoryview(data))
        finally:
            os.close(descriptor)
    return path


def write_all(descriptor: int, data: memoryview) -> None:
    """Write all bytes of `data`."""
    while len(data) > 0:
        data = data[os.write(descriptor, data[:CHUNK_BYTES]) :]


def make_folder(path: Path) -> Path:
    """The folder, made if it is not there. Raises RunError: it can't be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(
            f"can't make the folder {path}: {error.strerror or error}{_too_long(path) or '; choose another one'}"
        ) from error
    return path


@contextmanager
def write_errors_as(path: Path) -> Iterator[None]:
    """Context in which an error of the system becomes one of writing `path`, a RunError."""
    try:
        yield
    except OSError as error:
        # Windows has words of its own, in its user's language.
        known = os.strerror(error.errno) if error.errno is not None else ""
        raise cannot_write(path, known if known in _ADVICE_FOR else error.strerror or str(error)) from error


def cannot_write(path: Path, reason: str) -> RunError:
    """The error of a file that can't be written, with advice where the reason calls for some."""
    return RunError(f"can't write {path}: {reason}{_too_long(path) or _ADVICE_FOR.get(reason, '')}")


def _too_long(path: Path) -> str:
    """What to do about a path that is too long for Windows; empty for others."""
    if LONGEST_PATH is None or len(str(path.absolute())) <= LONGEST_PATH:
        return ""
    return f"; the path has more than {LONGEST_PATH} letters: choose a shorter folder, or turn on long paths"


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
