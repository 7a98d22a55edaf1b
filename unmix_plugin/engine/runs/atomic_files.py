"""Files that a kill, a crash or a full disk at any moment leaves whole: the old one or the new one, never a part.

The JSON files of a run have one format version for all of them, and nothing is read that no run writes.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from unmix_plugin.engine.runs.migrations import OLDEST_FORMAT, migrated
from unmix_plugin.engine.runs.replacing import (
    drop_claim,
    hash_of,
    is_ours,
    list_file,
    put_in_place,
    temporary_name,
)
from unmix_plugin.errors import RunError
from unmix_plugin.limits import DEEPEST, MOST_TABLE_BYTES, parse_json, read_bounded

_CHUNK_BYTES = 1 << 26
"""Bytes handed to one write."""

_LONGEST_PATH = 259 if os.name == "nt" else None
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
        data = data[os.write(descriptor, data[:_CHUNK_BYTES]) :]


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
    if _LONGEST_PATH is None or len(str(path.absolute())) <= _LONGEST_PATH:
        return ""
    return f"; the path has more than {_LONGEST_PATH} letters: choose a shorter folder, or turn on long paths"


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


RUN_FORMAT = 8
"""Version of everything in a run folder; raised when an older version of this package could not read it, with a step in
`migrations` that brings files of the version before to this one."""

_LARGEST_INTEGER = 2**63
_LARGEST_NUMBER = 1e18
"""Of scenes, poses and lights none comes near; what is computed from larger ones would leave float32."""


class OtherFormatError(RunError):
    """A file of a run was written by a version of this package that is too new or too old."""


def write_run_json(path: Path, values: dict[str, Any]) -> None:
    """Write `values` and the format version as readable JSON, whole or not at all, in place of a file of a run, be it
    from before lists of files were kept, or edited by hand, which the caller has read.

    Raises:
        RunError: the disk is full or refuses, or a file is there that no run wrote.
        TypeError, ValueError: a value that JSON has no form for, or a number that is not finite.
    """
    text = json.dumps({"format_version": RUN_FORMAT, **values}, indent=1, allow_nan=False)
    with write_errors_as(path):
        adopt_run_json(path)
    write_file(path, (text + "\n").encode())


def adopt_run_json(path: Path) -> None:
    """Make a file that reads as one of a run one that may be replaced and removed. Raises OSError."""
    if os.path.lexists(path) and not is_ours(path):
        with contextlib.suppress(RunError):
            read_run_json(path)
            list_file(path, hash_of(path))


def read_run_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file of a run.

    Raises:
        RunError: it is missing, cut off, or holds what no run writes.
        OtherFormatError: another version of this package wrote it.
    """
    try:
        values = read_plain_json(path)
    except FileNotFoundError as error:
        raise RunError(
            f"{path} is missing: the run is half-written or was moved in part; train again"
        ) from error
    version = values.get("format_version") if isinstance(values, dict) else None
    if type(version) is not int:
        raise RunError(f"{path} is not a file of a run: it has no format_version")
    if not OLDEST_FORMAT <= version <= RUN_FORMAT:
        age, advice = ("a newer", "update this package")
        if version < RUN_FORMAT:
            age, advice = ("an older", "train again, or use the version that trained it")
        raise OtherFormatError(
            f"{path} has format {version}, written by {age} version; this one reads formats {OLDEST_FORMAT} to "
            f"{RUN_FORMAT}: {advice}"
        )
    return migrated(values, RUN_FORMAT)


def read_plain_json(path: Path) -> Any:
    """The value in any JSON file of a run folder.

    Raises:
        FileNotFoundError: there is none.
        RunError: it is no regular file, too long, cut off, or holds what no run writes.
    """
    try:
        return parse_plain_json(read_bounded(path, MOST_TABLE_BYTES).decode("utf-8-sig"))
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RunError(f"can't read {path}: {reason}; the run is damaged") from error


def parse_plain_json(text: str) -> Any:
    """The value in a text of JSON. Raises ValueError: it is none, or holds what no run writes."""
    try:
        value = parse_json(text)
        _require_plain(value, DEEPEST)
    except RecursionError as error:
        raise ValueError(f"nested more than {DEEPEST} levels deep") from error
    return value


def _require_plain(value: Any, depth: int) -> None:
    """Refuse what Python's JSON reader accepts and no run writes."""
    if depth == 0:
        raise ValueError(f"nested more than {DEEPEST} levels deep")
    if isinstance(value, dict | list):
        for entry in [*value, *value.values()] if isinstance(value, dict) else value:
            _require_plain(entry, depth - 1)
    elif isinstance(value, str):
        os.fsencode(value)  # may become a path; raises for a lone surrogate
        if "\0" in value:
            raise ValueError(f"text with a null character: {value[:40]!r}")
    elif isinstance(value, float) and not abs(value) <= _LARGEST_NUMBER:
        raise ValueError(f"the number {value}")
    elif isinstance(value, int) and abs(value) >= _LARGEST_INTEGER:
        raise ValueError("an integer beyond 64 bits")
