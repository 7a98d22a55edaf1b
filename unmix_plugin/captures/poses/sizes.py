"""Sizes of pictures, for sources that give angles of view but no sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TypeAlias

Size: TypeAlias = tuple[int, int]
"""Width, height in pixels."""


@dataclass(frozen=True)
class PictureSizes:
    """Where the size of a picture is looked up: among given ones, then in the file itself."""

    given: Mapping[str, Size] = field(default_factory=dict)
    """By name, file name or stem."""
    folder: Path | None = None
    """Where names of files start."""

    def of(self, name: str) -> Size | None:
        """Size of a picture; None if nothing tells it."""
        path = PurePosixPath(name.replace("\\", "/"))
        for key in (name, path.name, path.stem):
            if key in self.given:
                return self.given[key]
        if len(set(self.given.values())) == 1:
            return next(iter(self.given.values()))
        return self._from_file(name)

    def _from_file(self, name: str) -> Size | None:
        from PIL import Image

        if self.folder is None:
            return None
        try:
            with Image.open(self.folder / name) as picture:
                return picture.size
        except (OSError, ValueError, Image.DecompressionBombError):
            return None
