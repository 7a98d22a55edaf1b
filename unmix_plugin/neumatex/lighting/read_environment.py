"""Environment maps from OpenEXR and Radiance files, checked.

Notation: `H x W` pixels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from unmix_plugin.errors import SceneError, counted
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.lighting.radiance_hdr import read_hdr

SUFFIXES = (".exr", ".hdr")
"""Formats that are read."""


def read_environment(path: Path, rotation_deg: float = 0.0, exposure_stops: float = 0.0) -> Environment:
    """The light of a latitude-longitude picture.

    Args:
        path: A .exr file with channels R, G, B (or Y), or a .hdr file; twice as wide as high.
        rotation_deg: Turns the light about +z, counter-clockwise seen from above.
        exposure_stops: Radiance is the picture's times 2 to this power.
    Raises:
        SceneError: the file is missing, damaged or of another kind, or has NaN, infinite or negative values, no light
            at all, or another aspect.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such environment map")
    readers = {".exr": _read_exr, ".hdr": read_hdr}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise SceneError(f"{path}: is not an environment map; convert it to one of {', '.join(SUFFIXES)}")
    image = reader(path)
    check_environment(path, image)
    return Environment(torch.from_numpy(np.ascontiguousarray(image)), rotation_deg, exposure_stops)


def _read_exr(path: Path) -> np.ndarray:
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:
        raise SceneError(f"{path}: can't be read as OpenEXR; copy or export it again") from error
    names = next((names for names in (("R", "G", "B"), ("Y", "Y", "Y")) if set(names) <= set(channels)), None)
    if names is None:
        raise SceneError(f"{path}: has channels {', '.join(channels)}; an environment map needs R, G and B")
    return np.stack([channels[name].astype(np.float32) for name in names], axis=-1)


def check_environment(path: Path, image: np.ndarray) -> None:
    height, width = image.shape[:2]
    if width != 2 * height:
        raise SceneError(
            f"{path}: is {width} x {height} pixels; a latitude-longitude map is twice as wide as high, so crop or "
            "convert it"
        )
    for fault, where in {
        "a value that is not finite": ~np.isfinite(image).all(axis=-1),
        "a negative value": (image < 0).any(axis=-1),
    }.items():
        if where.any():
            row, column = (int(index[0]) for index in np.nonzero(where))
            values = image[row, column].tolist()
            raise SceneError(
                f"{path}: has {fault} in {counted(int(where.sum()), 'pixel')}, first in row {row}, column {column}: "
                f"{values}; repair the picture"
            )
    if not (image > 0).any():
        raise SceneError(
            f"{path}: is black everywhere, so nothing would be lit; choose another environment map"
        )
