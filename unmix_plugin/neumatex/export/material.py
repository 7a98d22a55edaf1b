"""A material on a mesh as files: textures, a textured mesh, all parameters, and a report of what is what.

Notation: `S x S` texels, `T` of them in charts, `C` channels, `N` points, `P` parameters, `K` endmembers, `B` bands.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.formats.exr import write_exr
from unmix_plugin.formats.files import eight_bits, make_folder, rgba_png_bytes, write_file
from unmix_plugin.formats.meshes import write_textured_glb
from unmix_plugin.neumatex.export.pbr_fit import PbrFit, fit_pbr
from unmix_plugin.neumatex.export.shader import shader_paths, write_shader
from unmix_plugin.neumatex.tracing.families import MaterialFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.neumatex.tracing.microfacet import LobeMixture
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.surface import Surface
from unmix_plugin.products.atlas import Atlas, Texels, texels_of, unwrap
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.colour.srgb import encode_srgb
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.materials import default_names
from unmix_plugin.trained.run_views import directions_to_world, positions_for_files

_TEXTURES = ("base_colour", "gltf_base_colour", "gltf_metallic_roughness")
_NEURAL_TEXTURES = ("diffuse_colour", "latents_a", "latents_b")
_COLOURS = ("red", "green", "blue")
_CHUNK_BAKING = 1 << 17


@dataclass(frozen=True)
class _BakedMaterial:
    """A surface's parameters at the texels of an atlas."""

    atlas: Atlas
    texels: Texels
    parameters: Float[Tensor, "T P"]
    """[0, 1], on the CPU."""

    def texture(self, values: Tensor) -> np.ndarray:
        """Values of texels (T, C) as a texture (S, S, C), float32, filled beyond the charts."""
        return self.texels.texture(values.detach().cpu().numpy().astype(np.float32))


@torch.no_grad()
def _bake(mesh: Mesh, surface: Surface, texture_size: int) -> _BakedMaterial:
    """Unwrap a mesh and look up the surface's parameters at each texel.

    Args:
        mesh: Model space.
        surface: Its materials.
        texture_size: Width and height of the textures, texels.
    Raises:
        ConfigError: xatlas is not installed, or the mesh does not fit into the texture.
    """
    atlas = unwrap(mesh.vertices.cpu().double().numpy(), mesh.faces.cpu().numpy(), texture_size)
    texels = texels_of(atlas, texture_size)
    faces = atlas.vertices[atlas.faces]
    positions = texels.of_corners(mesh.vertices.cpu().double().numpy(), faces)
    points = torch.from_numpy(positions).float().to(mesh.vertices.device)
    parameters = torch.cat([surface.parameters(part).cpu() for part in points.split(_CHUNK_BAKING)])
    return _BakedMaterial(atlas, texels, parameters)


@dataclass(frozen=True)
class _Texture:
    """One texture, written as a picture of 8 bits and as numbers."""

    name: str
    """Of its files."""
    values: Tensor
    """(T, 3), [0, 1]."""
    channels: tuple[str, str, str]
    """What red, green and blue are."""
    is_colour: bool
    """Whether the picture is encoded as sRGB: linear numbers stay so in it otherwise."""


def material_paths(folder: Path, family: MaterialFamily) -> list[Path]:
    """Files that `write_material` makes."""
    own = _NEURAL_TEXTURES if isinstance(family, NeuralFamily) else ()
    names = [f"{name}.{kind}" for name in (*_TEXTURES, *own) for kind in ("png", "exr")]
    names += ["parameters.exr", "material.glb", "material.json"]
    names += ["abundances.exr", "endmembers.csv"] if isinstance(family, SpectralFamily) else []
    paths = [folder / name for name in names]
    return [*paths, *shader_paths(folder)] if isinstance(family, NeuralFamily) else paths


def write_material(
    folder: Path,
    mesh: Mesh,
    surface: Surface,
    frame: Normalisation,
    texture_size: int,
    seed: int = 0,
    bands: Bands | None = None,
    metres_per_unit: float | None = None,
) -> tuple[list[Path], float]:
    """Write a material on a mesh.

    Args:
        folder: Where to write; it is made.
        mesh: Model space.
        surface: Its materials.
        frame: From the world to model space; files are in the world.
        texture_size: Width and height of the textures, texels.
        seed: Of the fit of the glTF material.
        bands: Of a spectral material.
        metres_per_unit: Of the world, to which glTF is scaled; None: unknown.
    Returns:
        The files, and the mean error of the glTF material as a part of the reflected light.
    Raises:
        ConfigError: xatlas is not installed, or the mesh does not fit into the texture.
        RunError: the disk is full or refuses.
    """
    family, baked = surface.family, _bake(mesh, surface, texture_size)
    if isinstance(family, SpectralFamily):
        family = SpectralFamily(family.endmembers.detach().cpu())  # where the baked parameters are
    seen = InColours(family, bands) if isinstance(family, SpectralFamily) and bands is not None else family
    fit = fit_pbr(seen, baked.parameters, torch.Generator().manual_seed(seed))
    textures = _textures_of(seen, baked.parameters, fit.parameters)
    written, pictures = [], {}
    for texture in textures:
        paths, pictures[texture.name] = _write_texture(folder, baked, texture)
        written += paths
    numbers = tuple(f"parameter {index}" for index in range(family.num_parameters))
    names = tuple(getattr(family, "PARAMETERS", numbers))
    about = "parameters of the material, 0 to 1, linear"
    written.append(_write_channels(folder / "parameters.exr", baked, baked.parameters, names, about))
    shown = (pictures["gltf_base_colour"], pictures["gltf_metallic_roughness"])
    extras: dict[str, Any] = {"about": "metallic-roughness approximation of a neumatex run"}
    if metres_per_unit is not None:
        extras["metres_per_unit"] = metres_per_unit
    written.append(_write_glb(folder / "material.glb", mesh, baked, frame, shown, extras))
    report = _report_bytes(baked, type(family).__name__, names, fit, textures)
    written.append(write_file(folder / "material.json", report))
    if isinstance(family, NeuralFamily):
        written += write_shader(folder, family)
    if isinstance(family, SpectralFamily) and bands is not None:
        written += _write_spectral_files(folder, baked, family, bands)
    return written, fit.mean_error


def _textures_of(
    family: MaterialFamily, parameters: Float[Tensor, "T P"], fitted: Float[Tensor, "T 5"]
) -> list[_Texture]:
    """The textures of a material and of its glTF approximation."""
    roughness, metallicity = fitted[:, 3], fitted[:, 4]
    unused = torch.ones_like(roughness)  # red may hold occlusion: nothing is hidden
    surface = torch.stack([unused, roughness, metallicity], dim=1)
    textures = [
        _Texture("base_colour", family.base_colour(parameters), _COLOURS, True),
        _Texture("gltf_base_colour", fitted[:, :3], _COLOURS, True),
        _Texture("gltf_metallic_roughness", surface, ("1", "roughness", "metallicity"), False),
    ]
    if isinstance(family, NeuralFamily):
        textures.append(_Texture("diffuse_colour", family.diffuse_colour(parameters), _COLOURS, True))
        for letter, first in (("a", 0), ("b", 3)):
            channels = (f"latent {first + 1}", f"latent {first + 2}", f"latent {first + 3}")
            values = parameters[:, 3 + first : 6 + first]
            textures.append(_Texture(f"latents_{letter}", values, channels, False))
    return textures


def _write_texture(folder: Path, baked: _BakedMaterial, texture: _Texture) -> tuple[list[Path], bytes]:
    """Write a texture as PNG and as OpenEXR (float32); gives the bytes of the PNG, too."""
    base = make_folder(folder) / texture.name
    numbers = baked.texture(texture.values)
    shown = encode_srgb(numbers) if texture.is_colour else numbers
    channels = ", ".join(texture.channels)
    description = f"{texture.name}: {channels}; {'sRGB' if texture.is_colour else 'linear'}"
    picture = rgba_png_bytes(eight_bits(shown), description)
    written = write_file(base.with_suffix(".png"), picture)
    planes = {name: numbers[..., index] for index, name in enumerate("RGB")}
    return [
        written,
        write_exr(base.with_suffix(".exr"), planes, {"comments": f"{channels}; linear"}),
    ], picture


def _write_channels(
    path: Path, baked: _BakedMaterial, values: Tensor, names: Sequence[str], about: str
) -> Path:
    """Numbers of texels as one OpenEXR image, a channel each; readers get channels in the order of their names."""
    numbers = baked.texture(values)
    channels = {f"{index:02d} {name}": numbers[..., index] for index, name in enumerate(names)}
    return write_exr(path, channels, {"comments": about})


def _write_glb(
    path: Path,
    mesh: Mesh,
    baked: _BakedMaterial,
    frame: Normalisation,
    pictures: tuple[bytes, bytes],
    extras: dict[str, Any],
) -> Path:
    """Write the mesh in world coordinates with base colour (sRGB) and metallic-roughness pictures."""
    chosen = baked.atlas.vertices
    world = positions_for_files(frame.to_world(mesh.vertices.cpu().double().numpy()))[chosen]
    if world.dtype == np.float64:  # glTF has float32 only
        extras = {**extras, "offset": np.round(world.mean(axis=0)).tolist()}
        world = world - extras["offset"]
    normals = directions_to_world(frame, mesh.normals.cpu().double().numpy())[chosen]
    geometry = (world.astype(np.float32), normals.astype(np.float32), baked.atlas.uv, baked.atlas.faces)
    return write_textured_glb(path, *geometry, *pictures, extras)


def _report_bytes(
    baked: _BakedMaterial, family_name: str, names: Sequence[str], fit: PbrFit, textures: Sequence[_Texture]
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


class InColours(MaterialFamily):
    """A spectral family as an eye sees it in light of a flat spectrum: the same materials in three colours."""

    num_colours = 3

    def __init__(self, family: SpectralFamily, bands: Bands) -> None:
        self._family = family
        self._matrix = rgb_matrix(bands).to(family.endmembers)
        self.num_parameters = family.num_parameters

    def _mixture(self, parameters: Tensor, wo: Tensor) -> LobeMixture:
        return self._family._mixture(parameters, wo)

    def evaluate(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        return (self._family.evaluate(parameters, wi, wo) @ self._matrix).clamp(min=0)

    def base_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N 3"]:
        return (self._family.base_colour(parameters) @ self._matrix).clamp(0, 1)


def _write_spectral_files(
    folder: Path, baked: _BakedMaterial, family: SpectralFamily, bands: Bands
) -> list[Path]:
    """Write abundances as one texture, a channel an endmember, and the endmembers' reflectances."""
    textures, table = folder / "abundances.exr", folder / "endmembers.csv"
    names = default_names(family.num_endmembers)
    about = "shares of the endmembers of endmembers.csv; linear"
    _write_channels(textures, baked, family.abundances(baked.parameters), names, about)
    reflectances = family.endmembers.detach().to("cpu", torch.float64).numpy()
    write_spectra_csv(table, SpectraTable(bands, names, reflectances))
    return [textures, table]
