"""Files that were written, read with other people's readers."""

from __future__ import annotations

import gc
import warnings
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import trimesh


def loaded_mesh(path: Path) -> Any:
    """A file of any format as one mesh of trimesh, its vertices as they are in the file."""
    return trimesh.load(path, process=False, force="mesh")


def read_video(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Frames (F, H, W, 3) uint8, and what the file says of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # the reader leaves pipes open until it is collected
        reader: Any = imageio.get_reader(path, "ffmpeg")
        with reader:
            frames = [frame for frame in reader]  # noqa: C416 - list() would ask for its length, which is infinite
            facts = reader.get_meta_data()
        del reader
        gc.collect()
    return np.stack(frames), facts
