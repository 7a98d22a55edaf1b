"""Binary glTF 2.0 (.glb) of a mesh with the textures of a metallic-roughness material.

Source: Khronos Group, glTF 2.0 specification, sections 3.7 (meshes), 3.9 (materials) and appendix B.

Notation: `P` vertices, `F` faces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from unmix_plugin.formats.glb import (
    FLOAT,
    INDEX_BUFFER,
    UNSIGNED_INT,
    VERTEX_BUFFER,
    GlbBuilder,
)

_LINEAR, _LINEAR_MIPMAPS, _CLAMP = 9729, 9987, 33071


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with texture coordinates, and the pictures that these point into."""

    positions: Float32[np.ndarray, "P 3"]
    normals: Float32[np.ndarray, "P 3"]
    """Unit vectors."""
    uv: Float32[np.ndarray, "P 2"]
    """u to the right, v downwards."""
    faces: Int[np.ndarray, "F 3"]
    base_colour_png: bytes
    """sRGB."""
    metallic_roughness_png: bytes
    """Linear: green is roughness, blue metallicity."""


def write_textured_glb(path: Path, mesh: TexturedMesh, extras: Mapping[str, Any]) -> Path:
    """Write a mesh with its material, pictures included.

    Args:
        path: File; its folder is made.
        mesh: What to write.
        extras: What else the file says of the mesh, as JSON has it.
    Raises:
        RunError: the disk is full or refuses.
    """
    builder = GlbBuilder()
    attributes = {
        "POSITION": builder.add(mesh.positions, "VEC3", FLOAT, VERTEX_BUFFER, has_bounds=True),
        "NORMAL": builder.add(mesh.normals, "VEC3", FLOAT, VERTEX_BUFFER),
        "TEXCOORD_0": builder.add(mesh.uv, "VEC2", FLOAT, VERTEX_BUFFER),
    }
    indices = builder.add(mesh.faces.astype("<u4").ravel(), "SCALAR", UNSIGNED_INT, INDEX_BUFFER)
    images = [
        {"name": name, "mimeType": "image/png", "bufferView": builder.add_file(content)}
        for name, content in (
            ("base_colour", mesh.base_colour_png),
            ("metallic_roughness", mesh.metallic_roughness_png),
        )
    ]
    sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}
    return builder.write(
        path,
        attributes,
        indices,
        _MATERIAL,
        extras,
        textures=[{"sampler": 0, "source": 0}, {"sampler": 0, "source": 1}],
        samplers=[sampler],
        images=images,
    )


_MATERIAL = {
    "name": "material",
    "doubleSided": True,
    "pbrMetallicRoughness": {
        "baseColorTexture": {"index": 0},
        "metallicRoughnessTexture": {"index": 1},
        "metallicFactor": 1.0,
        "roughnessFactor": 1.0,
    },
}
