"""From a path written in transforms.json to a file that may be opened."""

from __future__ import annotations

import hashlib
from pathlib import Path

from unmix_plugin.scenes.reading.faults import Faults

HASH_BLOCK_BYTES = 1 << 20


def resolve_path(
    root: Path, text: str, allow_outside: bool | None, where: str, faults: Faults
) -> Path | None:
    """Find the file a scene names; None and a noted fault if it is missing, no plain file, or out of bounds.

    A path is out of bounds if it is absolute or if it leads out of the scene folder, be it by `..` or through a
    symbolic link. Such a path is followed with `allow_outside`; None is for those who can't be asked to, to whom the
    setting is not named.
    """
    path = root / text
    try:
        inside = path.resolve().is_relative_to(root.resolve()) and not Path(text).is_absolute()
        is_file = path.is_file()
    except (OSError, RuntimeError, ValueError) as error:  # a name too long, a loop of links, a zero byte
        faults.add(
            where,
            f"{text!r} cannot be followed ({type(error).__name__}); expected a file in the scene folder",
        )
        return None
    if not inside and not allow_outside:
        or_allow = (
            "" if allow_outside is None else ", or allow it with allow_outside_paths if you trust this scene"
        )
        faults.add(where, f"{text!r} leaves the scene folder; copy the file into it{or_allow}")
        return None
    if not is_file:
        found = "is not a plain file" if path.exists() else "is missing"
        faults.add(where, f"{text!r} {found}; add the file or drop the entry")
        return None
    return path


def sha256_of(path: Path) -> str:
    """SHA-256 of a file of any size, read in small blocks."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(HASH_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()
