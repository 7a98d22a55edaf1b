"""A baked material as files: textures, a textured mesh and a report.

Notation: `S x S` texels, `T` of them in charts, `C` channels.

The decoder of neural materials for other programs: GLSL that stands alone, and the same numbers as JSON.

What is special about exporting a spectral material: its look in colours, its abundances and its endmembers.

Notation: `T` texels in charts, `K` endmembers, `B` bands, `N` points, `P` parameters.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.formats.exr import write_exr
from unmix_plugin.formats.files import make_folder, rgba_png_bytes, write_file
from unmix_plugin.formats.meshes import TexturedMesh, write_textured_glb
from unmix_plugin.neumatex.export.atlas import BakedMaterial
from unmix_plugin.neumatex.export.pbr_fit import PbrFit
from unmix_plugin.neumatex.tracing import layers
from unmix_plugin.neumatex.tracing.families import SpectralFamily
from unmix_plugin.neumatex.tracing.layers import ggx_table, mean_ggx_albedo, sheen_table
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.materials import default_names
from unmix_plugin.trained.run_views import directions_to_world, positions_for_files


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


_PLACE = "//@constants"
_NUMBERS_A_LINE = 8


def shader_paths(folder: Path) -> list[Path]:
    """Files that `write_shader` makes."""
    return [folder / "decoder.glsl", folder / "decoder.json"]


def write_shader(folder: Path, family: NeuralFamily) -> list[Path]:
    """Write `decoder.glsl`, a function `reflectance` with all its numbers, and `decoder.json`, the numbers.

    Raises:
        RunError: the disk is full or refuses.
    """
    constants = _decoder_constants(family)
    text, numbers = shader_paths(make_folder(folder))
    write_file(text, _shader_text(constants).encode())
    about = (
        "numbers of decoder.glsl, by the same names; matrices row after row, tables a row for each roughness"
    )
    return [text, write_file(numbers, json.dumps({"about": about, **constants}).encode())]


def _decoder_constants(family: NeuralFamily) -> dict[str, Any]:
    """Every number that the shader needs, by its name there: ints, floats, and lists of floats."""
    linear = [*family.decoder.hidden, family.decoder.last]
    constants: dict[str, Any] = {
        "LATENTS": linear[0].weight.shape[1],
        "WIDTH": linear[0].weight.shape[0],
        "OUTPUTS": linear[2].weight.shape[0],
    }
    for index, layer in enumerate(linear):
        constants[f"WEIGHT_{index}"] = _floats(layer.weight)
        constants[f"BIAS_{index}"] = _floats(layer.bias)
    ggx, white = ggx_table(), sheen_table()
    means = mean_ggx_albedo(torch.linspace(0, 1, ggx.shape[0])[None])
    nodes = tuple(layers.DUST_NODES), tuple(layers.DUST_WEIGHTS)
    return {
        **constants,
        "LARGEST_COVER": layers.LARGEST_COVER,
        "LARGEST_SHEEN": layers.LARGEST_SHEEN,
        "LARGEST_COAT_ROUGHNESS": layers.LARGEST_COAT_ROUGHNESS,
        "LARGEST_HAZE": layers.LARGEST_HAZE,
        "LARGEST_DIELECTRIC_F0": layers.LARGEST_DIELECTRIC_F0,
        "SMALLEST_SHEEN_WIDTH": layers.SMALLEST_SHEEN_WIDTH,
        "DUST_COLOUR": list(layers.DUST_COLOUR),
        "NODES": len(nodes[0]),
        "NODE_PLACES": list(nodes[0]),
        "NODE_WEIGHTS": list(nodes[1]),
        "ROWS": ggx.shape[0],
        "COLUMNS": ggx.shape[1],
        "GGX_A": _floats(ggx[..., 0]),
        "GGX_B": _floats(ggx[..., 1]),
        "GGX_MEAN_A": _floats(means[0]),
        "GGX_MEAN_B": _floats(means[1]),
        "SHEEN": _floats(white[..., 0]),
    }


def _shader_text(constants: dict[str, Any]) -> str:
    """The shader with its constants."""
    template = files("unmix_plugin.neumatex.export").joinpath("decoder.glsl").read_text(encoding="utf-8")
    assert _PLACE in template
    declared = [_declaration(name, value) for name, value in constants.items()]
    return template.replace(_PLACE, "\n".join(declared))


def _floats(values: Tensor) -> list[float]:
    """Float32 numbers in as few digits as give them back."""
    return [float(f"{value:.9g}") for value in values.detach().float().reshape(-1).tolist()]


def _declaration(name: str, value: Any) -> str:
    if isinstance(value, int):
        return f"const int {name} = {value};"
    if isinstance(value, float):
        return f"const float {name} = {_glsl(value)};"
    if name == "DUST_COLOUR":
        return f"const vec3 {name} = vec3({', '.join(map(_glsl, value))});"
    rows = [value[start : start + _NUMBERS_A_LINE] for start in range(0, len(value), _NUMBERS_A_LINE)]
    numbers = ",\n  ".join(", ".join(map(_glsl, row)) for row in rows)
    return f"const float {name}[{len(value)}] = float[{len(value)}](\n  {numbers});"


def _glsl(value: float) -> str:
    """A number that GLSL reads as a float: with a point or an exponent."""
    text = f"{value:.9g}"
    return text if "." in text or "e" in text else f"{text}.0"


class InColours:
    """A spectral family as an eye sees it in light of a flat spectrum: the same materials in three colours."""

    num_colours = 3

    def __init__(self, family: SpectralFamily, bands: Bands) -> None:
        self._family = family
        self._matrix = rgb_matrix(bands).to(family.endmembers)
        self.num_parameters = family.num_parameters

    def evaluate(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Reflectance, 1/sr, without the cosine."""
        return (self._family.evaluate(parameters, wi, wo) @ self._matrix).clamp(min=0)

    def sample(
        self, parameters: Float[Tensor, "N P"], wo: Float[Tensor, "N 3"], uniforms: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """As of the spectral family."""
        return self._family.sample(parameters, wo, uniforms)

    def density(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, " N"]:
        """As of the spectral family."""
        return self._family.density(parameters, wi, wo)

    def base_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N 3"]:
        """Colour of the diffuse reflectance, linear, [0, 1]."""
        return (self._family.base_colour(parameters) @ self._matrix).clamp(0, 1)


def spectral_paths(folder: Path) -> list[Path]:
    """Files that `write_spectral_files` makes."""
    return [folder / name for name in ("abundances.exr", "endmembers.csv")]


def write_spectral_files(
    folder: Path, baked: BakedMaterial, family: SpectralFamily, bands: Bands
) -> list[Path]:
    """Write abundances as one texture, a channel an endmember, and the endmembers' reflectances.

    Raises:
        RunError: the disk is full or refuses.
    """
    textures, table = spectral_paths(folder)
    names = default_names(family.num_endmembers)
    shares = baked.texture(family.abundances(baked.parameters))
    # Readers get channels in the order of their names.
    channels = {f"{index:02d} {name}": shares[..., index] for index, name in enumerate(names)}
    write_exr(textures, channels, {"comments": "shares of the endmembers of endmembers.csv; linear"})
    reflectances = family.endmembers.detach().to("cpu", torch.float64).numpy()
    write_spectra_csv(table, SpectraTable(bands, names, reflectances))
    return [textures, table]
