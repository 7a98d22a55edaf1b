"""OpenEXR images: named channels of one size, losslessly compressed, with attributes.

Notation: `H x W` pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from unmix_plugin.engine.runs.atomic_files import cannot_write, whole_file


def write_exr(path: Path, channels: Mapping[str, np.ndarray], attributes: Mapping[str, str | float]) -> Path:
    """Write channels (H, W) of float32, float16 or uint32 as one scanline image, ZIP compressed.

    A dot in a channel's name parts layers. Readers get the channels in the order of their names.

    """
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **attributes}
    # The library reads memory row after row whatever an array's strides: other layouts would be written wrong.
    pixels = {name: np.ascontiguousarray(channel) for name, channel in channels.items()}
    with whole_file(path) as temporary:
        try:
            OpenEXR.File(header, pixels).write(str(temporary))
        except (OSError, RuntimeError) as error:
            raise cannot_write(path, _reason(error)) from error
    return path


def layer_names(layer: str, channels: Sequence[str]) -> list[str]:
    """Names of the channels of a layer; dots in them become `_`, since a dot parts layers."""
    return [f"{layer}.{channel.replace('.', '_')}" for channel in channels]


def _reason(error: Exception) -> str:
    """What the library says after the file's (temporary) name."""
    return str(error).rpartition('". ')[2].strip().rstrip(".")
