"""Meshes, read with other people's readers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import trimesh


def loaded_mesh(path: Path) -> Any:
    """A file of any format as one mesh of trimesh, its vertices as they are in the file."""
    return trimesh.load(path, process=False, force="mesh")
