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
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.formats.exr import write_exr
from unmix_plugin.formats.files import eight_bits, make_folder, rgba_png_bytes, write_file
from unmix_plugin.formats.meshes import write_textured_glb
from unmix_plugin.neumatex.export.pbr_fit import fit_pbr
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
from unmix_plugin.spectral.library.spectra_csv import write_spectra_csv
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.run_views import directions_to_world, gltf_positions, positions_for_files

_TEXTURES = ("base_colour", "gltf_base_colour", "gltf_metallic_roughness")
_NEURAL_TEXTURES = ("diffuse_colour", "latents_a", "latents_b")
_AS_IT_IS = np.array([0.0, 1.0, 0.0])
_CHUNK_BAKING = 1 << 17


@dataclass(frozen=True)
class _Baked:
    """An atlas of a mesh, and the surface's parameters at its texels."""

    atlas: Atlas
    texels: Texels
    parameters: Float[Tensor, "T P"]
    """[0, 1], on the device of the surface."""

    @staticmethod
    @torch.no_grad()
    def of(mesh: Mesh, surface: Surface, texture_size: int) -> _Baked:
        """Unwrap a mesh in model space and look up a surface's parameters at each texel."""
        vertices = mesh.vertices.cpu().double().numpy()
        atlas = unwrap(vertices, mesh.faces.cpu().numpy(), texture_size)
        texels = texels_of(atlas, texture_size)
        positions = texels.of_corners(vertices, atlas.vertices[atlas.faces])
        points = torch.from_numpy(positions).float().to(mesh.vertices.device)
        parameters = torch.cat([surface.parameters(part) for part in points.split(_CHUNK_BAKING)])
        return _Baked(atlas, texels, parameters)

    def texture(self, values: Tensor) -> np.ndarray:
        """Values of texels (T, C) as a texture (S, S, C), float32, filled beyond the charts."""
        return self.texels.texture(values.detach().cpu().numpy().astype(np.float32))

    def write_channels(self, path: Path, values: Tensor, names: Sequence[str], about: str) -> Path:
        """Write values of texels as one OpenEXR image, a channel each; readers get them in the order of their names."""
        numbers = self.texture(values)
        channels = {f"{index:02d} {name}": numbers[..., index] for index, name in enumerate(names)}
        return write_exr(path, channels, {"comments": about})


@dataclass(frozen=True)
class _Texture:
    """One texture, written as a picture of 8 bits and as numbers."""

    name: str
    """Of its files."""
    values: Tensor
    """(T, 3), [0, 1]."""
    channels: tuple[str, str, str] = ("red", "green", "blue")
    """What red, green and blue are; those of a colour are encoded as sRGB in the picture, others linear."""

    @property
    def encoding(self) -> str:
        """Of the picture."""
        return "sRGB" if self.channels[0] == "red" else "linear"

    def write(self, folder: Path, baked: _Baked) -> tuple[list[Path], bytes]:
        """Write it as PNG and as OpenEXR (float32); gives the bytes of the PNG, too."""
        base, numbers = make_folder(folder) / self.name, baked.texture(self.values)
        shown, channels = (
            encode_srgb(numbers) if self.encoding == "sRGB" else numbers,
            ", ".join(self.channels),
        )
        picture = rgba_png_bytes(eight_bits(shown), f"{self.name}: {channels}; {self.encoding}")
        planes = {name: numbers[..., index] for index, name in enumerate("RGB")}
        png = write_file(base.with_suffix(".png"), picture)
        return [
            png,
            write_exr(base.with_suffix(".exr"), planes, {"comments": f"{channels}; linear"}),
        ], picture


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
    bands: Bands | None = None,
    metres_per_unit: float | None = None,
    up: Float64[np.ndarray, "3"] = _AS_IT_IS,
) -> tuple[list[Path], float]:
    """Write a material on a mesh.

    Args:
        mesh, surface: In model space; files are in the world.
        texture_size: Width and height of the textures, texels.
        bands: Of a spectral material.
        metres_per_unit: Of the world, to which glTF is scaled; None: unknown.
        up: What is up in the world, a unit vector; the node of the glTF turns it to +y. By default nothing is turned.
    Returns:
        The files, and the mean error of the glTF material as a part of the reflected light.
    Raises:
        ConfigError: xatlas is not installed, or the mesh does not fit into the texture.
    """
    family, baked = surface.family, _Baked.of(mesh, surface, texture_size)
    seen = InColours(family, bands) if isinstance(family, SpectralFamily) and bands is not None else family
    fitted, error = fit_pbr(seen, baked.parameters, torch.Generator().manual_seed(0))
    textures = _textures_of(seen, baked.parameters, fitted)
    written, pictures = list[Path](), dict[str, bytes]()
    for texture in textures:
        paths, pictures[texture.name] = texture.write(folder, baked)
        written += paths
    about = "parameters of the material, 0 to 1, linear"
    parameters = folder / "parameters.exr"
    written.append(baked.write_channels(parameters, baked.parameters, family.PARAMETERS, about))
    extras: dict[str, Any] = {"about": "metallic-roughness approximation of a neumatex run"}
    if metres_per_unit is not None:
        extras["metres_per_unit"] = metres_per_unit
    shown = (pictures["gltf_base_colour"], pictures["gltf_metallic_roughness"])
    glb = folder / "material.glb"
    written.append(_write_glb(glb, mesh, baked.atlas, frame, pictures=shown, extras=extras, up=up))
    report = json.dumps(_report(baked, family, error, textures), indent=1)
    written.append(write_file(folder / "material.json", report.encode()))
    if isinstance(family, NeuralFamily):
        written += write_shader(folder, family)
    if isinstance(family, SpectralFamily) and bands is not None:
        about = "shares of the endmembers of endmembers.csv; linear"
        endmembers = family.endmembers.detach().cpu()
        materials = Materials(bands, endmembers, endmembers[:0]).called_by_colour()
        shares, table = family.abundances(baked.parameters), folder / "endmembers.csv"
        written.append(baked.write_channels(folder / "abundances.exr", shares, materials.names, about))
        write_spectra_csv(table, materials.table())
        written.append(table)
    return written, error


def _textures_of(
    family: MaterialFamily, parameters: Float[Tensor, "T P"], fitted: Float[Tensor, "T 5"]
) -> list[_Texture]:
    """The textures of a material and of its glTF approximation."""
    unused = torch.ones_like(fitted[:, :1])  # red may hold occlusion: nothing is hidden
    textures = [
        _Texture("base_colour", family.base_colour(parameters)),
        _Texture("gltf_base_colour", fitted[:, :3]),
        _Texture(
            "gltf_metallic_roughness",
            torch.cat([unused, fitted[:, 3:]], dim=1),
            ("1", "roughness", "metallicity"),
        ),
    ]
    if isinstance(family, NeuralFamily):
        diffuse, *latents = parameters.split(3, dim=1)
        textures += [
            _Texture("diffuse_colour", diffuse),
            _Texture("latents_a", latents[0], ("latent 1", "latent 2", "latent 3")),
            _Texture("latents_b", latents[1], ("latent 4", "latent 5", "latent 6")),
        ]
    return textures


def _write_glb(
    path: Path,
    mesh: Mesh,
    atlas: Atlas,
    frame: Normalisation,
    *,
    pictures: tuple[bytes, bytes],
    extras: dict[str, Any],
    up: Float64[np.ndarray, "3"],
) -> Path:
    """Write the mesh in world coordinates with base colour (sRGB) and metallic-roughness pictures."""
    world = positions_for_files(frame.to_world(mesh.vertices.cpu().double().numpy()))[atlas.vertices]
    positions, offset = gltf_positions(world)
    normals = directions_to_world(frame, mesh.normals.cpu().double().numpy())[atlas.vertices]
    geometry = (positions, normals.astype(np.float32), atlas.uv, atlas.faces)
    return write_textured_glb(path, *geometry, *pictures, {**extras, **offset}, up)


def _report(
    baked: _Baked, family: MaterialFamily, error: float, textures: Sequence[_Texture]
) -> dict[str, Any]:
    """What the other files are."""
    return {
        "version": 1,
        "texture_size": baked.texels.size,
        "texels_in_charts": len(baked.texels.places),
        "triangles": len(baked.atlas.faces),
        "vertices": len(baked.atlas.uv),
        "family": type(family).__name__,
        "parameters": list(family.PARAMETERS),
        "texture_coordinates": "u to the right, v downwards, as in glTF: the first row of a picture is v = 0",
        "textures": {
            one.name: {
                "png": f"8 bits, {one.encoding}",
                "exr": "float32, linear",
                "channels": list(one.channels),
                "mean": [round(value, 6) for value in one.values.double().mean(dim=0).tolist()],
            }
            for one in textures
        },
        "gltf": {
            "model": "metallic-roughness (glTF 2.0, appendix B)",
            "mean_error_of_reflected_light": round(error, 6),
        },
    }


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
