"""The product `material`: everything that others need to use a trained material."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.products.product import Job, RunProduct

if TYPE_CHECKING:
    from unmix_plugin.neumatex.export.files import Texture
    from unmix_plugin.neumatex.tracing.families import MaterialFamily
    from unmix_plugin.neumatex.tracing.mesh import Mesh
    from unmix_plugin.neumatex.tracing.surface import Surface
    from unmix_plugin.scenes.scene import Normalisation
    from unmix_plugin.spectral.bands import Bands


_SIZES = (16, 8192)


@dataclass(frozen=True)
class MaterialProduct(RunProduct):
    """The material on the mesh: material.glb, a glTF with its nearest metallic-roughness material; textures of base
    colour, roughness, metallicity and latents as PNG and EXR; parameters.exr, all parameters; decoder.glsl and
    decoder.json, with which other programs can use the latents; material.json, which says what is what."""

    name = "material"

    texture_size: int = 1024
    """Width and height of the textures, texels."""

    def write(self, job: Job) -> list[Path]:
        """Unwrap, bake, fit, write."""
        from unmix_plugin.neumatex.fit.trained_object import TrainedObject

        scene = job.loaded.scene
        assert isinstance(scene, TrainedObject)  # what else has another method and is refused before
        _require_texture_size(self.texture_size)
        job.claim(material_paths(job.folder, scene.surface.family))
        with job.working("unwrapping the mesh and baking its material"):
            written, error = write_material(
                job.folder, scene.mesh, scene.surface, scene.frame, self.texture_size, bands=scene.bands
            )
        job.say(
            f"the glTF material differs from the trained one by {100 * error:.1f} % of the reflected light"
        )
        return written


def _require_texture_size(texture_size: int) -> None:
    """Refuse impossible sizes.

    Raises:
        ConfigError: too small or too large.
    """
    low, high = _SIZES
    if not low <= texture_size <= high:
        raise ConfigError(f"--texture-size is {texture_size}; choose {low} to {high} texels")


def material_paths(folder: Path, family: MaterialFamily) -> list[Path]:
    """Files that `write_material` makes."""
    from unmix_plugin.neumatex.export.files import shader_paths, spectral_paths, texture_paths
    from unmix_plugin.neumatex.tracing.families import SpectralFamily
    from unmix_plugin.neumatex.tracing.neural import NeuralFamily

    names = ["base_colour", "gltf_base_colour", "gltf_metallic_roughness"]
    single = [folder / name for name in ("parameters.exr", "material.glb", "material.json")]
    if isinstance(family, SpectralFamily):
        return [*texture_paths(folder, names), *single, *spectral_paths(folder)]
    if not isinstance(family, NeuralFamily):
        return [*texture_paths(folder, names), *single]
    return [
        *texture_paths(folder, [*names, "diffuse_colour", "latents_a", "latents_b"]),
        *single,
        *shader_paths(folder),
    ]


def write_material(
    folder: Path,
    mesh: Mesh,
    surface: Surface,
    frame: Normalisation,
    texture_size: int,
    seed: int = 0,
    bands: Bands | None = None,
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
    Returns:
        The files, and the mean error of the glTF material as a part of the reflected light.
    Raises:
        ConfigError: xatlas is not installed, or the mesh does not fit into the texture.
        RunError: the disk is full or refuses.
    """
    from unmix_plugin.formats.files import write_file
    from unmix_plugin.neumatex.export import files
    from unmix_plugin.neumatex.export.atlas import bake
    from unmix_plugin.neumatex.export.files import InColours, write_shader, write_spectral_files
    from unmix_plugin.neumatex.export.pbr_fit import fit_pbr
    from unmix_plugin.neumatex.tracing.families import SpectralFamily
    from unmix_plugin.neumatex.tracing.neural import NeuralFamily

    family, baked = surface.family, bake(mesh, surface, texture_size)
    seen = family
    if isinstance(family, SpectralFamily) and bands is not None:
        family = SpectralFamily(family.endmembers.detach().cpu())  # where the baked parameters are
        seen = InColours(family, bands)
    fit = fit_pbr(seen, baked.parameters, torch.Generator().manual_seed(seed))
    textures = _textures_of(seen, baked.parameters, fit.parameters)
    written, pictures = [], {}
    for texture in textures:
        paths, pictures[texture.name] = files.write_texture(folder, baked, texture)
        written += paths
    names = _parameter_names(family)
    written.append(files.write_parameters(folder / "parameters.exr", baked, names))
    shown = (pictures["gltf_base_colour"], pictures["gltf_metallic_roughness"])
    written.append(files.write_material_glb(folder / "material.glb", mesh, baked, frame, shown))
    report = files.report_bytes(baked, type(family).__name__, names, fit, textures)
    written.append(write_file(folder / "material.json", report))
    if isinstance(family, NeuralFamily):
        written += write_shader(folder, family)
    if isinstance(family, SpectralFamily) and bands is not None:
        written += write_spectral_files(folder, baked, family, bands)
    return written, fit.mean_error


def _parameter_names(family: MaterialFamily) -> tuple[str, ...]:
    """What each parameter of a family is."""
    numbers = tuple(f"parameter {index}" for index in range(family.num_parameters))
    return tuple(getattr(family, "PARAMETERS", numbers))


def _textures_of(
    family: MaterialFamily, parameters: Float[Tensor, "T P"], fitted: Float[Tensor, "T 5"]
) -> list[Texture]:
    """The textures of a material and of its glTF approximation."""
    from unmix_plugin.neumatex.export.files import Texture
    from unmix_plugin.neumatex.tracing.neural import NeuralFamily

    roughness, metallicity = fitted[:, 3], fitted[:, 4]
    unused = torch.ones_like(roughness)  # red may hold occlusion: nothing is hidden
    colours = ("red", "green", "blue")
    textures = [
        Texture("base_colour", family.base_colour(parameters), colours, True),
        Texture("gltf_base_colour", fitted[:, :3], colours, True),
        Texture(
            "gltf_metallic_roughness",
            torch.stack([unused, roughness, metallicity], dim=1),
            ("1", "roughness", "metallicity"),
            False,
        ),
    ]
    if isinstance(family, NeuralFamily):
        textures.append(Texture("diffuse_colour", family.diffuse_colour(parameters), colours, True))
        for letter, first in (("a", 0), ("b", 3)):
            channels = (f"latent {first + 1}", f"latent {first + 2}", f"latent {first + 3}")
            values = parameters[:, 3 + first : 6 + first]
            textures.append(Texture(f"latents_{letter}", values, channels, False))
    return textures
