"""Writing results: formats as bytes, files that are whole or not there, and nothing overwritten by accident."""

from __future__ import annotations

import io
from collections.abc import Collection
from pathlib import Path

import numpy as np

from unmix_plugin.engine.runs.atomic_files import make_folder, write_file
from unmix_plugin.errors import ConfigError

__all__ = ["array_bytes", "make_folder", "refuse_to_overwrite", "write_file"]


def refuse_to_overwrite(paths: Collection[Path], overwrite: bool) -> None:
    """Look before anything is computed whether files would be lost.

    Raises:
        ConfigError: one of `paths` exists, and overwriting was not asked for.
    """
    existing = [path for path in paths if path.exists()]
    if existing and not overwrite:
        others = f" and {len(existing) - 1} more of its files" if len(existing) > 1 else ""
        raise ConfigError(
            f"{existing[0]}{others} exist already; give --overwrite to replace them or another --output"
        )


def array_bytes(array: np.ndarray) -> bytes:
    """An array as the bytes of an .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
