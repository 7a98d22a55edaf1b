"""PLY: points or meshes with any number of properties a vertex, binary, little-endian.

Notation: `P` vertices, `F` faces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int, UInt8

from unmix_plugin.formats.files import write_file

_TYPES = {"float32": "float", "float64": "double", "uint8": "uchar", "int32": "int"}
_READ_TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_READ_TYPES |= {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"}
_READ_TYPES |= {"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"}


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


def read_ply_points(
    path: Path,
) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None]:
    """Positions and, if there are any, colours of the vertices of a PLY, binary or text.

    Raises:
        ValueError: it is not a PLY, is cut short, or its vertices are not numbers x, y, z.
        OSError: it can't be read.
    """
    data = path.read_bytes()
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("no PLY header")
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    start = data.find(b"\n", end) + 1
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
    kinds = [line[1] for line in lines if line[:1] == ["format"] and len(line) > 1]
    elements = [index for index, line in enumerate(lines) if line[:1] == ["element"]]
    if not kinds or kinds[0] not in order or not elements or lines[elements[0]][1:2] != ["vertex"]:
        raise ValueError("its format is unknown, or vertices are not its first element")
    count = int(lines[elements[0]][2])
    stop = elements[1] if len(elements) > 1 else len(lines)
    named = [line for line in lines[elements[0] + 1 : stop] if line[:1] == ["property"]]
    if any(len(line) != 3 or line[1] not in _READ_TYPES for line in named):
        raise ValueError("a vertex has properties that are not plain numbers")
    names = [line[2] for line in named]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise ValueError("vertices have no x, y, z")
    dtype = np.dtype([(line[2], (order[kinds[0]] or "<") + _READ_TYPES[line[1]]) for line in named])
    body = data[start:]
    if kinds[0] == "ascii":
        numbers = np.array(body.split()[: count * len(names)], dtype=np.float64).reshape(-1, len(names))
        table = {name: numbers[:, index] for index, name in enumerate(names)}
    else:
        body = body[: max(count, 0) * dtype.itemsize]
        numbers = np.frombuffer(body[: len(body) // dtype.itemsize * dtype.itemsize], dtype)
        table = {name: numbers[name] for name in names}
    if len(numbers) != count:
        raise ValueError(f"{len(numbers)} vertices; its header promises {count}")
    positions = np.column_stack([table[axis].astype(np.float64) for axis in "xyz"])
    if not {"red", "green", "blue"} <= set(names):
        return positions, None
    return positions, np.column_stack([table[name].astype(np.uint8) for name in ("red", "green", "blue")])
