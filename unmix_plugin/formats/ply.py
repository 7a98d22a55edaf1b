"""PLY: points or meshes with any number of properties a vertex, binary, little-endian.

Notation: `P` vertices, `F` faces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

from unmix_plugin.formats.files import write_file

_TYPES = {"float32": "float", "float64": "double", "uint8": "uchar", "int32": "int"}


def write_ply(
    path: Path,
    vertices: Mapping[str, np.ndarray],
    faces: Int[np.ndarray, "F 3"] | None = None,
    comments: Sequence[str] = (),
) -> Path:
    """Write vertices and, if given, triangles.

    Args:
        path: File; its folder is made.
        vertices: Properties by name (x, y, z, nx, ny, nz, red, green, blue have a known meaning), each (P,) of float32,
            float64, uint8 or int32.
        faces: Indices of vertices.
        comments: Lines of the header.
    Raises:
        KeyError: a property of another type.
    """
    count = len(next(iter(vertices.values())))
    table = np.empty(
        count, dtype=[(name, values.dtype.newbyteorder("<")) for name, values in vertices.items()]
    )
    for name, values in vertices.items():
        table[name] = values
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {' '.join(line.split())}" for line in comments]
    header += [f"element vertex {count}"]
    header += [f"property {_TYPES[values.dtype.name]} {name}" for name, values in vertices.items()]
    body = table.tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        rows = np.empty(len(faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
        rows["count"], rows["indices"] = 3, faces
        body += rows.tobytes()
    return write_file(path, "\n".join([*header, "end_header", ""]).encode("ascii", "replace") + body)
