"""The layouts by name, and what several of them use: the files that a list names, and the names of views.

A layout is a function from a folder to a `Capture`, imported when it is used.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import TypeAlias

from unmix_plugin.captures.spectral_file import Capture, ReadOptions
from unmix_plugin.errors import CaptureError, counted, name_some
from unmix_plugin.formats.files import NOT_PLAIN, safe_name
from unmix_plugin.scenes.reading.faults import find_named

_FindViews: TypeAlias = Callable[[Path, ReadOptions], Capture]
"""Finds the views below a folder; raises CaptureError where there are none or they can't be opened."""

_FUNCTIONS = {
    "cubes": "cubes:find_cubes",
    "nespof": "nespof:find_nespof",
    "nespof-real": "nespof:find_nespof_real",
    "hs-nerf": "transforms:find_hs_nerf",
    "unmix-nerf": "transforms:find_unmix_nerf",
    "nerfstudio": "transforms:find_nerfstudio",
    "rig": "rig:find_rig",
}
"""Module in this package, and the function in it."""

LAYOUTS = tuple(_FUNCTIONS)


def find_views(layout: str, root: Path, options: ReadOptions) -> Capture:
    """The views of a capture in one of `LAYOUTS`. Raises CaptureError: there is no such folder, or the layout finds no
    views in it."""
    if not root.is_dir():
        found = "is a file" if root.is_file() else "is not there"
        raise CaptureError(f"{root} {found}; give the folder of the capture with --data")
    module, function = _FUNCTIONS[layout].split(":")
    find: _FindViews = getattr(import_module(f"unmix_plugin.captures.layouts.{module}"), function)
    return find(root, options)


class FoundFiles:
    """Looks for the files of a capture and tells of all that are missing in one message."""

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()
        self._missing: list[str] = []

    def look(self, where: str, *texts: str, least_parts: int = 1) -> Path | None:
        """The first of some paths in the folder that is a file; None if none is. Paths of other systems are followed
        as `find_named` does. CaptureError where a path leaves the folder."""
        for text in texts:
            path = self._root / text
            try:
                is_inside = path.resolve().is_relative_to(self._root) and not Path(text).is_absolute()
                is_file = path.is_file()
            except (OSError, RuntimeError, ValueError) as error:
                raise CaptureError(f"{where}: {text!r} can't be followed ({error})") from error
            if is_inside and is_file:
                return path
            if found := find_named(self._root, text, least_parts):
                return found
            if not is_inside:
                raise CaptureError(f"{where}: {text!r} leaves the folder {self._root}; copy the file into it")
        return None

    def find(self, where: str, text: str, *others: str, least_parts: int = 1) -> Path | None:
        """The same; noted as missing if none is."""
        path = self.look(where, text, *others, least_parts=least_parts)
        self._missing += [] if path else [text]
        return path

    def refuse_missing(self, advice: str) -> None:
        """CaptureError if a file was missing, which names a few of them."""
        if self._missing:
            lacking = f"lacks {counted(len(self._missing), 'file')} of its views"
            raise CaptureError(f"{self._root} {lacking}: {name_some(self._missing)}; {advice}")


def view_names(texts: Sequence[str], where: str) -> list[str]:
    """Names of views from the paths of their files: the stems, or with their folders where stems repeat. Raises
    CaptureError: two paths give the same name."""
    paths = [PurePosixPath(text.replace("\\", "/")) for text in texts]
    stems = [path.name if path.suffix[1:].isdecimal() else path.stem for path in paths]
    if len(set(stems)) < len(stems):
        stems = ["_".join([*path.parent.parts, stem]) for path, stem in zip(paths, stems, strict=True)]
    names = [safe_name(re.sub(NOT_PLAIN, "_", stem).strip("._"), fallback="view") for stem in stems]
    seen: dict[str, str] = {}
    for name, text in zip(names, texts, strict=True):
        other = seen.setdefault(name.casefold(), text)
        if other is not text:
            raise CaptureError(f"{where}: {other} and {text} would both be the view '{name}'; rename one")
    return names
