"""Binary glTF 2.0 (.glb): one mesh with a colour and any other numbers a vertex.

Source: Khronos Group, glTF 2.0 specification, sections 3.7 (meshes) and 4 (GLB).

Notation: `P` vertices, `F` faces.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from unmix_plugin import __version__
from unmix_plugin.formats.files import write_file

FLOAT, UNSIGNED_INT = 5126, 5125
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def write_glb(
    path: Path,
    positions: Float32[np.ndarray, "P 3"],
    normals: Float32[np.ndarray, "P 3"],
    linear_rgb: Float32[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "F 3"],
    numbers: Mapping[str, np.ndarray],
    extras: Mapping[str, Any],
) -> Path:
    """Write a mesh.

    Args:
        path: File; its folder is made.
        positions: Of the vertices.
        normals: Unit vectors.
        linear_rgb: Colours, linear light in sRGB primaries, [0, 1], as glTF wants them.
        faces: Indices of vertices.
        numbers: More of each vertex, (P,) float32, by a name that starts with `_`.
        extras: What else the file says of the mesh, as JSON has it.
    """
    builder = GlbBuilder()
    attributes = {
        "POSITION": builder.add(positions, "VEC3", FLOAT, VERTEX_BUFFER, has_bounds=True),
        "NORMAL": builder.add(normals, "VEC3", FLOAT, VERTEX_BUFFER),
        "COLOR_0": builder.add(linear_rgb, "VEC3", FLOAT, VERTEX_BUFFER),
    }
    for name, values in numbers.items():
        attributes[name] = builder.add(values, "SCALAR", FLOAT, VERTEX_BUFFER)
    indices = builder.add(faces.astype("<u4").ravel(), "SCALAR", UNSIGNED_INT, INDEX_BUFFER)
    material = {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}
    return builder.write(path, attributes, indices, material, extras)


class GlbBuilder:
    """The binary part and what describes it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, values: np.ndarray, kind: str, component: int, target: int, has_bounds: bool = False
    ) -> int:
        """Append an array of 4-byte numbers; the index of its accessor."""
        raw = np.ascontiguousarray(values, dtype="<u4" if component == UNSIGNED_INT else "<f4").tobytes()
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw), "target": target}
        accessor = {
            "bufferView": len(self.views),
            "componentType": component,
            "count": len(values),
            "type": kind,
        }
        if has_bounds and len(values):
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.data += raw
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_file(self, content: bytes) -> int:
        """Append a file, such as a picture; the index of its view."""
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)})
        self.data += content + b"\0" * (-len(content) % 4)
        return len(self.views) - 1

    def write(
        self,
        path: Path,
        attributes: Mapping[str, int],
        indices: int,
        material: Mapping[str, Any],
        extras: Mapping[str, Any],
        **textures: Sequence[Mapping[str, Any]],
    ) -> Path:
        """Write a file of one mesh in one material.

        Args:
            path: File; its folder is made.
            attributes: Accessor of each attribute of the vertices.
            indices: Accessor of the faces.
            material: As glTF has it.
            extras: What else the file says of the mesh, as JSON has it.
            textures: What the material points to: `textures`, `samplers`, `images`.
        Raises:
            RunError: the disk is full or refuses.
        """
        primitive = {"attributes": dict(attributes), "indices": indices, "material": 0}
        content = {
            "asset": {"version": "2.0", "generator": f"unmix-nerf {__version__}"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "surface"}],
            "meshes": [{"primitives": [primitive], "extras": dict(extras)}],
            "materials": [material],
            **textures,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        return write_file(path, _container(json.dumps(content).encode(), bytes(self.data)))


def _container(text: bytes, data: bytes) -> bytes:
    """Header and two chunks, padded to multiples of four bytes."""
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), _JSON_CHUNK) + text
    chunks += struct.pack("<II", len(data), _BINARY_CHUNK) + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
