"""A baked material as files: textures, a textured mesh and a report.

Notation: `S x S` texels, `T` of them in charts, `C` channels.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unmix_plugin.formats.exr import write_exr
from unmix_plugin.formats.files import make_folder, write_file
from unmix_plugin.formats.png import rgba_png_bytes
from unmix_plugin.formats.textured_glb import TexturedMesh, write_textured_glb
from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.material_export.baking import BakedMaterial
from unmix_plugin.neumatex.material_export.pbr_fit import PbrFit
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.trained.world_frame import directions_to_world, positions_for_files


@dataclass(frozen=True)
class Texture:
    """One texture, written as a picture of 8 bits and as numbers."""

    name: str
    """Of its files."""
    values: Tensor
    """(T, 3), [0, 1]."""
    channels: tuple[str, str, str]
    """What red, green and blue are."""
    is_colour: bool
    """Whether the picture is encoded as sRGB: linear numbers stay so in it otherwise."""


def texture_paths(folder: Path, names: Sequence[str]) -> list[Path]:
    """Files of textures by their names."""
    return [folder / f"{name}.{suffix}" for name in names for suffix in ("png", "exr")]


def write_texture(folder: Path, baked: BakedMaterial, texture: Texture) -> tuple[list[Path], bytes]:
    """Write a texture as PNG and as OpenEXR (float32).

    Returns:
        The files, and the bytes of the PNG.
    Raises:
        RunError: the disk is full or refuses.
    """
    picture_path, numbers_path = texture_paths(make_folder(folder), [texture.name])
    numbers = baked.texture(texture.values)
    shown = linear_to_srgb(torch.from_numpy(numbers)).numpy() if texture.is_colour else numbers
    encoding = "sRGB" if texture.is_colour else "linear"
    description = f"{texture.name}: {', '.join(texture.channels)}; {encoding}"
    picture = rgba_png_bytes(np.round(255 * shown.clip(0, 1)).astype(np.uint8), description)
    write_file(picture_path, picture)
    channels = {name: numbers[..., index] for index, name in enumerate("RGB")}
    write_exr(numbers_path, channels, {"comments": f"{', '.join(texture.channels)}; linear"})
    return [picture_path, numbers_path], picture


def write_parameters(path: Path, baked: BakedMaterial, names: Sequence[str]) -> Path:
    """Write all parameters of a material as one OpenEXR image, a channel each.

    Raises:
        RunError: the disk is full or refuses.
    """
    numbers = baked.texture(baked.parameters)
    # Readers get channels in the order of their names.
    channels = {f"{index:02d} {name}": numbers[..., index] for index, name in enumerate(names)}
    return write_exr(path, channels, {"comments": "parameters of the material, 0 to 1, linear"})


def write_material_glb(
    path: Path, mesh: Mesh, baked: BakedMaterial, frame: Normalisation, pictures: tuple[bytes, bytes]
) -> Path:
    """Write the mesh in world coordinates with base colour (sRGB) and metallic-roughness pictures.

    Raises:
        RunError: the disk is full or refuses.
    """
    chosen = baked.atlas.vertices
    world = positions_for_files(frame.to_world(mesh.vertices.cpu().double().numpy()))[chosen]
    extras: dict[str, Any] = {"about": "metallic-roughness approximation of a neumatex run"}
    if world.dtype == np.float64:  # glTF has float32 only
        extras["offset"] = np.round(world.mean(axis=0)).tolist()
        world = world - extras["offset"]
    normals = directions_to_world(frame, mesh.normals.cpu().double().numpy())[chosen]
    textured = TexturedMesh(
        world.astype(np.float32),
        normals.astype(np.float32),
        baked.atlas.uv,
        baked.atlas.faces,
        *pictures,
    )
    return write_textured_glb(path, textured, extras)


def report_bytes(
    baked: BakedMaterial, family_name: str, names: Sequence[str], fit: PbrFit, textures: Sequence[Texture]
) -> bytes:
    """What the other files are, as JSON."""
    content = {
        "version": 1,
        "texture_size": baked.texels.size,
        "texels_in_charts": len(baked.texels.places),
        "triangles": len(baked.atlas.faces),
        "vertices": len(baked.atlas.uv),
        "family": family_name,
        "parameters": list(names),
        "texture_coordinates": "u to the right, v downwards, as in glTF: the first row of a picture is v = 0",
        "textures": {
            one.name: {
                "png": f"8 bits, {'sRGB' if one.is_colour else 'linear'}",
                "exr": "float32, linear",
                "channels": list(one.channels),
                "mean": [round(value, 6) for value in one.values.double().mean(dim=0).tolist()],
            }
            for one in textures
        },
        "gltf": {
            "model": "metallic-roughness (glTF 2.0, appendix B)",
            "mean_error_of_reflected_light": round(fit.mean_error, 6),
        },
    }
    return json.dumps(content, indent=1).encode()
