"""What can be shown of an object: outputs by name, from surface points and the light that they reflect.

Notation: `H x W` pixels, `K` rays that meet the mesh, `P` parameters, `C` colours.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.outputs import Output
from unmix_plugin.neumatex.materials.family import MaterialFamily
from unmix_plugin.neumatex.materials.pbr import PbrFamily
from unmix_plugin.neumatex.materials.spectral import SpectralFamily
from unmix_plugin.neumatex.tone.spectral import SpectralDisplay
from unmix_plugin.neumatex.tracing.primary_hits import PixelHits
from unmix_plugin.spectral.segmentation import material_ids

if TYPE_CHECKING:
    from unmix_plugin.neumatex.trained_object import TrainedObject

_CHUNK = 1 << 17
_DARKEST = 0.02
"""Base colour below which shading is not divided by it."""

_COMMON = (
    Output("rgb", "srgb", "colour", "sRGB on black, 0 to 1, with the tones of the pictures"),
    Output("linear_rgb", "linear", "colour (linear)", "linear radiance on black"),
    Output("base_colour", "linear", "base colour", "linear, 0 to 1, on black"),
)
_PBR = (
    Output("roughness", "map", "roughness", "roughness, 0 to 1", (0.0, 1.0)),
    Output("metallicity", "map", "metallicity", "metallicity, 0 to 1", (0.0, 1.0)),
)
_LATENTS = (
    Output("latents_a", "picture", "latents A", "the decoder's latents 1 to 3 as red, green, blue"),
    Output("latents_b", "picture", "latents B", "the decoder's latents 4 to 6 as red, green, blue"),
)
_SPECTRAL = (
    Output("spectral", "channels", "radiance", "radiance in every band, on black"),
    Output("reflectance", "channels", "reflectance", "diffuse reflectance in every band, 0 to 1, on black"),
    Output("abundances", "shares", "abundances", "share of each endmember, summing to opacity", (0.0, 1.0)),
    Output("segmentation", "labels", "segmentation", "endmember of the largest share; 255 where nothing is"),
    Output("roughness", "map", "roughness", "roughness of the gloss, 0 to 1", (0.0, 1.0)),
    Output(
        "specular_level", "map", "specular level", "root of what the gloss reflects straight on", (0.0, 1.0)
    ),
)
_UNCERTAINTY = Output(
    "uncertainty", "map", "uncertainty", "expected error of the material's parameters, mean", None, "magma"
)
_GEOMETRY = (
    Output("shading", "linear", "shading", "light divided by base colour, on black"),
    Output("normals", "vectors", "normals", "unit vectors in world axes, 0 where nothing is"),
    Output("depth", "map", "depth", "distance along the viewing axis in world units, 0 where nothing is"),
    Output("accumulation", "map", "opacity", "part of the pixel that the mesh covers", (0.0, 1.0)),
)


def has_latents(family: MaterialFamily) -> bool:
    """Whether parameters 3 to 8 are latents of a decoder."""
    return getattr(family, "decoder", None) is not None


def object_outputs(family: MaterialFamily, has_variance: bool) -> tuple[Output, ...]:
    """The outputs of objects with materials of a family, in the order in which they are offered."""
    own: tuple[Output, ...] = ()
    if isinstance(family, SpectralFamily):
        own = _SPECTRAL
    elif has_latents(family) or isinstance(family, PbrFamily):
        own = _LATENTS if has_latents(family) else _PBR
    return (*_COMMON, *own, *((_UNCERTAINTY,) if has_variance else ()), *_GEOMETRY)


def view_outputs(
    scene: TrainedObject, camera: Cameras, hits: PixelHits, light: Float[Tensor, "K C"]
) -> dict[str, Tensor]:
    """All outputs of a view, (H, W, ...); colours are on black, everything else is a mean over what is seen in a
    pixel."""
    alpha = hits.alpha()
    positions = hits.points.positions
    parameters = _in_chunks(scene.surface.parameters, positions, scene.surface.family.num_parameters)
    base = scene.surface.family.base_colour(parameters)
    seen = alpha[..., None].clamp(min=1e-6)

    def mean(values: Tensor) -> Tensor:
        """Of what is seen."""
        return hits.image(values) / seen

    linear = hits.image(light)
    in_colours = scene.curve.rgb if isinstance(scene.curve, SpectralDisplay) else _as_it_is
    rgb = torch.where(alpha[..., None] > 0, scene.curve(linear / seen), 0.0) * alpha[..., None]
    found = {
        "rgb": rgb,
        "linear_rgb": in_colours(linear),
        "base_colour": in_colours(hits.image(base)),
        "shading": hits.image(in_colours(light) / in_colours(base).clamp(min=_DARKEST)),
        "normals": _world_normals(scene, mean(hits.points.normals)) * (alpha > 0)[..., None],
        "depth": mean(_depths(scene, camera, positions)[:, None])[..., 0],
        "accumulation": alpha,
    }
    family = scene.surface.family
    if isinstance(family, SpectralFamily):
        shares = hits.image(family.abundances(parameters))
        found |= {"spectral": linear, "reflectance": hits.image(base), "abundances": shares}
        found["segmentation"] = material_ids(shares, alpha)
        gloss = mean(parameters[:, family.num_endmembers :])
        found["roughness"], found["specular_level"] = gloss.unbind(dim=-1)
    elif has_latents(family):
        found["latents_a"], found["latents_b"] = mean(parameters[:, 3:6]), mean(parameters[:, 6:9])
    elif isinstance(family, PbrFamily):
        found["roughness"], found["metallicity"] = mean(parameters[:, 3:5]).unbind(dim=-1)
    if scene.log_variance is not None:
        spread = (_in_chunks(scene.log_variance, positions, family.num_parameters) / 2).exp()
        found["uncertainty"] = mean(spread.mean(dim=1, keepdim=True))[..., 0]
    return found


def _as_it_is(values: Tensor) -> Tensor:
    return values


def _in_chunks(look_up, positions: Float[Tensor, "K 3"], width: int) -> Tensor:  # noqa: ANN001
    parts = [look_up(part) for part in positions.split(_CHUNK)] if len(positions) else []
    return torch.cat(parts) if parts else positions.new_zeros((0, width))


def _world_normals(scene: TrainedObject, normals: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    rotation = torch.from_numpy(scene.frame.rotation).to(normals)
    return torch.nn.functional.normalize(normals @ rotation, dim=-1)


def _depths(scene: TrainedObject, camera: Cameras, positions: Float[Tensor, "K 3"]) -> Float[Tensor, " K"]:
    """Along the viewing axis, world units."""
    pose = camera.camera_to_world[0].to(positions)
    return -((positions - pose[:, 3]) @ pose[:, 2]) / scene.frame.scale
