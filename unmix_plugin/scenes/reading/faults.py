"""Every fault of a scene collected, so that a user mends all in one go and not one per start; and the paths that a
scene names, of unknown origin, which may be followed."""

from __future__ import annotations

import re
import time
import unicodedata
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from unmix_plugin.errors import SceneError, UnmixError, name_some
from unmix_plugin.scenes.messages import Message

FILE_NAME = "transforms.json"
MAX_LISTED = 20
"""Faults written out in one message; the rest is counted."""


class Faults:
    """What is wrong with one scene, in the order found; the same fault in many places is reported once."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._places: dict[str, list[str]] = {}
        self.noted = 0
        """How often a fault was noted so far, repetitions included."""

    @property
    def file(self) -> str:
        """How messages call the file of cameras as a whole: transforms.json of a folder, or the root that is a file."""
        return str(self._root) if self._root.suffix == ".json" else FILE_NAME

    def add(self, where: str, message: str) -> None:
        """Note a fault that has no code.

        Args:
            where: File, frame or key that has it.
            message: What was found against what was expected, and what to do.
        """
        self.noted += 1
        places = self._places.setdefault(message, [])
        if where not in places:
            places.append(where)

    def note(self, where: str, message: Message, /, **values: Any) -> None:
        """Note a fault by its code; a reader returns this None in place of a value."""
        self.add(where, message.sentence(**values))

    def raise_if_any(self, kind: type[UnmixError] = SceneError) -> None:
        """End here if anything is wrong. Raises an error of this kind: faults were noted; its message lists them."""
        lines = [
            message if places == [str(self._root)] else f"{name_some(places)}: {message}"
            for message, places in self._places.items()
        ]
        if len(lines) == 1:
            raise kind(f"{self._root}: {lines[0]}")
        listed = [f"  {number}. {line}" for number, line in enumerate(lines[:MAX_LISTED], start=1)]
        if len(lines) > MAX_LISTED:
            listed.append(f"  and {len(lines) - MAX_LISTED} more")
        if lines:
            raise kind("\n".join([f"{self._root}: {len(lines)} faults in the scene", *listed]))


_MOST_FOLDERS = 32
"""In a path; each is where it may go on in another folder."""
_DRIVE = re.compile(r"[A-Za-z]:/")


def find_named(root: Path, text: str, least_parts: int = 1) -> Path | None:
    """The file in a folder that a text of another system names; None if there is none.

    Backslashes part folders; of an absolute path of another machine its tail is tried, the longest first; `%20` is a
    space; upper and lower case, and how umlauts are composed, need not be the same.

    Args:
        least_parts: Of a tail. With 2 a mask is never looked for by its bare name, which a picture may have too.
    """
    path = text.replace("\\", "/").removeprefix("file://")
    parts = [part for part in path.split("/") if part not in ("", ".")]
    if len(parts) > _MOST_FOLDERS:
        return None
    is_absolute = path.startswith("/") or _DRIVE.match(path) is not None
    tails = [parts[start:] for start in range(1, len(parts) - least_parts + 1)] if is_absolute else []
    candidates = [parts, *tails]
    candidates += [[unquote(part) for part in tail] for tail in candidates if "%" in text]
    for candidate in candidates:
        with suppress(OSError, RuntimeError, ValueError):
            found = _in_any_case(root, candidate)
            if found is not None and found.is_file() and found.resolve().is_relative_to(root.resolve()):
                return found
    return None


def _in_any_case(root: Path, parts: list[str]) -> Path | None:
    """The path in a folder, its names in any case; None where one is missing or fits several."""
    path = root
    for part in parts:
        if not (path / part).exists() and part != "..":
            if not path.is_dir():
                return None
            changed = path.stat().st_mtime_ns
            # A folder may change twice within one tick of its clock: what was just written is listed anew.
            is_settled = time.time_ns() - changed > _SETTLED_NS
            listed = _listed(path, changed) if is_settled else _listed.__wrapped__(path, changed)
            alike = listed.get(_plain(part), [])
            if len(alike) != 1:
                return None
            part = alike[0]
        path = path / part
    return path


_SETTLED_NS = 2_000_000_000
"""After its last change, from when on a folder's listing is kept."""


@lru_cache(maxsize=32)
def _listed(folder: Path, _: int) -> dict[str, list[str]]:
    """Names in a folder by what they are in any case; one listing serves thousands of frames."""
    listed: dict[str, list[str]] = {}
    for entry in folder.iterdir():
        listed.setdefault(_plain(entry.name), []).append(entry.name)
    return listed


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def resolve_path(
    root: Path, text: str, allow_outside: bool | None, where: str, faults: Faults, least_parts: int = 1
) -> Path | None:
    """Find the file a scene names; None and a noted fault if it is missing, no plain file, or out of bounds.

    A path is out of bounds if it is absolute or if it leads out of the scene folder, be it by `..` or through a
    symbolic link. Such a path is followed with `allow_outside`; None is for those who can't be asked to, to whom the
    setting is not named. Paths of other systems are followed as `find_named` does.
    """
    path = root / text
    try:
        inside = path.resolve().is_relative_to(root.resolve()) and not Path(text).is_absolute()
        is_file = path.is_file()
    except (OSError, RuntimeError, ValueError) as error:  # a name too long, a loop of links, a zero byte
        return faults.note(where, Message.PATH_UNFOLLOWED, path=text, reason=type(error).__name__)
    if is_file and (inside or allow_outside):
        return path
    if found := find_named(root, text, least_parts):
        return found
    if not inside and not allow_outside:
        or_allow = ", or allow it with --allow-outside-paths if you trust this scene"
        advice = f"copy the file into it{'' if allow_outside is None else or_allow}"
        return faults.note(where, Message.PATH_OUTSIDE, path=text, advice=advice)
    return faults.note(where, Message.PATH_NO_FILE if path.exists() else Message.PATH_MISSING, path=text)
