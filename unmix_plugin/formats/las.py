"""Points as LAS 1.4 or compressed as LAZ, with any further number of each as an extra dimension.

Coordinates are whole numbers times a scale, of which a part in a thousand million of the extent is kept. Needs the
package laspy, and lazrs for LAZ.

Source: ASPRS, LAS 1.4 R15, point data record format 7 and extra bytes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

import numpy as np

from unmix_plugin.errors import ConfigError, install_hint
from unmix_plugin.formats.files import whole_file, write_errors_as

_POINTS_WITH_COLOURS, _VERSION = 7, "1.4"
_LONGEST_NAME, _LONGEST_RECORD = 31, 65_535
_EXACT = 1e-9
"""Of the extent."""
_COLOURS = ("red", "green", "blue")
_POSITION = ("x", "y", "z")


def require_laspy(is_compressed: bool) -> None:
    """Refuse before anything is computed what can't be written. Raises ConfigError: a package is missing."""
    try:
        for package in ("laspy", "lazrs") if is_compressed else ("laspy",):
            import_module(package)
    except ImportError as error:
        raise ConfigError(
            f"the package laspy or lazrs isn't installed ({error}): {install_hint('las')}"
        ) from error


def write_las(path: Path, columns: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> None:
    """Write points; `path` ends in .las or .laz, and an older file is replaced when the new one is complete.

    Args:
        columns: `x`, `y`, `z`; `red`, `green`, `blue` (uint8); and numbers by names of at most 31 letters.
        comments: Kept in a record of their own.
    """
    import laspy

    position = np.stack([columns[axis].astype(np.float64) for axis in _POSITION], axis=1)
    header = laspy.LasHeader(point_format=_POINTS_WITH_COLOURS, version=_VERSION)
    extent = float(np.ptp(position, axis=0).max(initial=0.0)) or 1.0
    header.scales = np.full(3, 10.0 ** math.ceil(math.log10(extent * _EXACT)))
    header.offsets = np.floor(position.min(axis=0))
    header.generating_software = "unmix-nerf"
    others = [name for name in columns if name not in (*_POSITION, *_COLOURS)]
    header.add_extra_dims([laspy.ExtraBytesParams(_name(name), columns[name].dtype) for name in others])
    text = "\n".join(comments).encode()[:_LONGEST_RECORD]
    header.vlrs.append(laspy.VLR("unmix-nerf", 1, "what the numbers are", text))
    points = laspy.LasData(header)
    points.x, points.y, points.z = position.T
    for name in _COLOURS:
        setattr(points, name, columns[name].astype(np.uint16) * 257)
    for name in others:
        points[_name(name)] = columns[name]
    with whole_file(path) as temporary, write_errors_as(path), temporary.open("xb") as file:
        points.write(file, do_compress=path.suffix.lower() == ".laz")


def _name(name: str) -> str:
    """At most as long as the format takes; what tells names apart stands at their ends."""
    return name if len(name.encode()) <= _LONGEST_NAME else f"{name[:12]}__{name[-17:]}"
