"""What one file of a stranger may cost, asked before anything of it is decoded: one set of bounds for all readers.

A file may lie about itself, lead nowhere (a pipe that nobody writes to), or hold far more than its size says.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
import zipfile
from pathlib import Path
from typing import Any, BinaryIO, NoReturn
from xml.etree import ElementTree

from unmix_plugin.errors import UnmixError

MOST_PARTS = 4096
"""Parts of one file: members of an archive, pages, groups, variables. Instruments write some hundred bands as pages."""

MOST_BANDS = 1 << 16
"""Of an image or spectrum; spectrometers of any kind have some thousand."""

MOST_ITEMS = 1 << 20
"""Of one list in a text."""

DEEPEST = 32
"""Levels of parts within parts."""

MOST_TEXT_BYTES = 1 << 24
"""Bytes of a text that is read whole: headers, lists of poses, settings, records."""

MOST_TABLE_BYTES = 1 << 28
"""Bytes of a text or table that has an entry for each view, row or point."""

GREATEST_PX = 1e9
"""Of focal lengths and principal points; beyond, and below its inverse, float32 loses what is projected."""

_PARSED_BYTES = 10**9
"""That the values of a text may take. Small texts aren't counted."""

_BYTES_OF = {"{": 200, "[": 80, ",": 60}
"""What Python takes for the value that a letter of JSON stands for, at most."""

_MOST_TAGS = 1 << 21
"""Of one XML text, opening and closing ones."""

FREE_BYTES = 1 << 28
"""Decoded bytes that any file may have, however small it is."""

MOST_RATIO = 100
"""Decoded bytes a stored byte of larger ones. Spectra compress by less than ten; masks by more, but these are small."""

_ZIP_END_BYTES, _ZIP_ENTRY_BYTES = 1 << 17, 512
"""Where an archive says how long its list of members is; the longest that is usual for one."""

_LARGEST_ARRAY = 1 << 46
"""Bytes beyond which a size is no size but damage."""


def refuse(path: Path, found: str, expected: str, kind: type[UnmixError]) -> NoReturn:
    """The one message of a file that asks for too much. Raises UnmixError: of this kind, always."""
    raise kind(f"{path}: {found}; expected {expected}: the file is damaged, or not made by an instrument")


def allow_parts(path: Path, number: int, noun: str, kind: type[UnmixError], most: int | None = None) -> None:
    """Ask before parts are read one after the other, or anything is made for each of them. Raises UnmixError: of this
    kind: there are more than `most`, or than `MOST_PARTS`."""
    most = MOST_PARTS if most is None else most
    if number > most:
        refuse(path, f"{number} {noun}", f"at most {most}", kind)


def allow_depth(path: Path, levels: int, kind: type[UnmixError]) -> None:
    """Ask before parts within parts are read. Raises UnmixError: of this kind: they lie too deep."""
    if levels > DEEPEST:
        refuse(path, f"parts in parts, {levels} levels deep", f"at most {DEEPEST}", kind)


def open_zip(path: Path, kind: type[UnmixError]) -> zipfile.ZipFile:
    """Open an archive, of which the list of members is read whole. Raises UnmixError: of this kind: it has too many
    members. zipfile.BadZipFile: it is no archive."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(max(0, size - _ZIP_END_BYTES))
        tail = file.read()
    at = tail.rfind(b"PK\x05\x06")
    if at >= 0 and len(tail) - at >= 22:
        number = int.from_bytes(tail[at + 10 : at + 12], "little")
        listed = int.from_bytes(tail[at + 12 : at + 16], "little")
        long = tail.rfind(b"PK\x06\x06", 0, at)
        is_long = number == 0xFFFF or 0xFFFFFFFF in (
            listed,
            int.from_bytes(tail[at + 16 : at + 20], "little"),
        )
        if is_long and long >= 0:
            number = int.from_bytes(tail[long + 32 : long + 40], "little")
            listed = int.from_bytes(tail[long + 40 : long + 48], "little")
        allow_parts(path, max(number, listed // _ZIP_ENTRY_BYTES), "members", kind)
    return zipfile.ZipFile(path)


def allow_decoded(path: Path, decoded: int, kind: type[UnmixError], stored: int | None = None) -> None:
    """Ask before something compressed is decoded to so many bytes; stored in so many, by default those of the whole
    file. Raises UnmixError: of this kind: it is small in the file and huge in memory."""
    size = path.stat().st_size if stored is None else stored
    if decoded > _LARGEST_ARRAY or decoded > max(FREE_BYTES, MOST_RATIO * size):
        refuse(
            path,
            f"{size:,} bytes decode to {decoded:,}",
            f"at most {FREE_BYTES:,}, or {MOST_RATIO} times what is stored",
            kind,
        )


_LEFT_FREE_BYTES = 1 << 28
"""Of a disk, beside what is decoded on it."""


def has_scratch_room(folder: Path, needed: int) -> bool:
    """Whether so many bytes can be decoded on the disk of a folder."""
    return shutil.disk_usage(folder).free >= needed + _LEFT_FREE_BYTES


def allow_scratch(path: Path, needed: int, folder: Path, kind: type[UnmixError]) -> None:
    """Ask before a file is decoded on the disk of a folder. Raises UnmixError: of this kind: the disk has no room."""
    if not has_scratch_room(folder, needed):
        free = shutil.disk_usage(folder).free
        raise kind(
            f"{path}: {needed:,} bytes are needed to decode it in {folder}, of which {free:,} are free; name a larger "
            "disk in TMPDIR, or write the file uncompressed"
        )


def regular_file(path: str, flags: int) -> int:
    """An `opener` for `open` of files that are ones: opening a pipe or a device may wait for ever. Raises OSError: it
    can't be opened, or is no regular file."""
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(None, "is no regular file", str(path))
    return descriptor


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading, if it is a regular one. Raises OSError."""
    return open(path, "rb", opener=regular_file)


def read_bounded(path: Path, most: int = MOST_TEXT_BYTES) -> bytes:
    """All bytes of a regular file that is read whole. Raises OSError: it can't be read, is no regular file, or has more
    than `most` bytes."""
    with open(path, "rb", opener=regular_file) as file:
        size = os.fstat(file.fileno()).st_size
        data = b"" if size > most else file.read(most + 1)
    if size > most or len(data) > most:
        raise OSError(None, f"has {max(size, len(data)):,} bytes, and {most:,} at most are read", str(path))
    return data


class UnreadableJsonError(ValueError):
    """A file holds no JSON; the text says why, and follows the file's name."""


def read_json(path: Path) -> Any:
    """The value in a JSON file. Raises UnreadableJsonError: it is not in UTF-8 or UTF-16, not JSON, nested too deeply,
    or has text that is not Unicode. Raises OSError: it can't be read, or is too long."""
    data = read_bounded(path, MOST_TABLE_BYTES)
    if not data.strip(b"\xef\xbb\xbf\t\r\n "):
        raise UnreadableJsonError("is empty; expected JSON")
    try:
        is_utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff")
        content = parse_json(data.decode("utf-16" if is_utf16 else "utf-8-sig"))
        json.dumps(content, ensure_ascii=False).encode()  # fails on lone surrogates, which no name can hold
    except json.JSONDecodeError as error:
        at = f"line {error.lineno}, column {error.colno}"
        raise UnreadableJsonError(f"is not valid JSON ({error.msg} at {at}); was it cut short?") from error
    except (UnicodeError, RecursionError) as error:  # the latter in dumps
        raise UnreadableJsonError(f"is not readable as JSON ({type(error).__name__})") from error
    except ValueError as error:  # far too many values, or too deep; numbers of thousands of digits
        raise UnreadableJsonError(f"is not readable as JSON ({str(error).partition(';')[0]})") from error
    return content


def parse_json(text: str) -> Any:
    """The value in a text of JSON. Raises ValueError: it is none, gives a key twice with different values, of which
    nobody knows the right one, is nested too deeply, or has so many values that they would take far more memory than
    the text."""
    if len(text) > MOST_TEXT_BYTES:
        needed = sum(text.count(letter) * size for letter, size in _BYTES_OF.items())
        if needed > _PARSED_BYTES:
            raise ValueError(
                f"its values would take up to {needed:,} bytes, and at most {_PARSED_BYTES:,} are read"
            )
    try:
        return json.loads(text, object_pairs_hook=_each_once)
    except RecursionError as error:
        raise ValueError("nested far too deeply") from error


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of these keys and values."""
    found = dict(pairs)
    if len(found) < len(pairs):
        for key, value in pairs:
            if repr(found[key]) != repr(value):  # NaN is like NaN, and 1 is not like true
                raise ValueError(f"{key[:40]!r} is there twice, with different values")
    return found


def parse_xml(data: bytes | str) -> ElementTree.Element:
    """The root of an XML text. Raises ValueError: it is damaged, or declares entities, which can grow without end."""
    # UTF-16 has zeros between letters.
    found = data.encode() if isinstance(data, str) else data.replace(b"\0", b"")
    if b"<!DOCTYPE" in found or b"<!ENTITY" in found:
        raise ValueError("it declares a DOCTYPE or entities")
    if (tags := found.count(b"<")) > _MOST_TAGS:
        raise ValueError(f"it has {tags:,} tags; at most {_MOST_TAGS:,} are read")
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError) as error:  # LookupError: an unknown encoding
        raise ValueError(str(error)) from error
