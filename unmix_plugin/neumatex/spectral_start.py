"""Where the fit of a spectral material starts: endmember reflectances, and their shares at points of the mesh.

Mesh and light are known, so a pixel's radiance over what a white surface would send there is about its reflectance,
shadows and all. Those spectra are unmixed one by one, and the planes are fitted to the shares that come out.

Notation: `M` pixels of training views, `N` points, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine import step_generator
from unmix_plugin.neumatex.material_surface import PLAIN_GLOSS, start_plain
from unmix_plugin.neumatex.materials.family import MaterialFamily
from unmix_plugin.neumatex.materials.spectral import NUM_GLOSS, SpectralFamily
from unmix_plugin.neumatex.run_start import RunMaterials
from unmix_plugin.neumatex.scene.object_scene import ObjectScene
from unmix_plugin.neumatex.scene.pixel_list import PixelList
from unmix_plugin.neumatex.traced_object import SeenPoints, TracedObject
from unmix_plugin.neumatex.triplane import Triplane
from unmix_plugin.spectral.unmixing.abundances import fcls
from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels, initialise_endmembers
from unmix_plugin.spectral.unmixing.num_materials import propose_num_materials

if TYPE_CHECKING:
    from unmix_plugin.engine import Cameras
    from unmix_plugin.neumatex.model import NeumatexModel
    from unmix_plugin.neumatex.model_settings import NeumatexModelConfig

NUM_PIXELS = 20_000
_STREAM = 7
_USUAL_ENDMEMBERS = 6
_SAMPLES = 64
_DARKEST = 0.1
"""Light on a pixel, as a part of the median, below which its reflectance is noise."""
_PURE, _FEWEST_PURE = 0.02, 50
"""Part of the pixels, and how many at least, that count as purest of an endmember."""
_STEPS, _POINTS, _RATE = 200, 4096, 5e-3


def pixel_arrays(scene: ObjectScene, cameras: Cameras, pixels: PixelList, seed: int) -> dict[str, np.ndarray]:
    """Rays and spectra of some pixels of the training views, the lamp, and where the world is, as arrays by name."""
    assert scene.lamp is not None
    drawn = pixels.draw(NUM_PIXELS, step_generator(seed, 0, stream=_STREAM))
    rays = cameras.generate_rays(drawn.views, drawn.places)
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    return {
        "pixels": drawn.numbers.numpy(),
        "pixel_origins": rays.origins.numpy(),
        "pixel_directions": rays.directions.numpy(),
        "lamp": scene.lamp,
        "world_corners": scene.frame.to_world(corners),
    }


def resolved_num_endmembers(
    config: NeumatexModelConfig, arrays: Mapping[str, np.ndarray], generator: torch.Generator
) -> tuple[int, str]:
    """K where the settings leave it open, and why.

    Raises:
        SpectrumError: no pixel is neither dark nor saturated.
        ConfigError, RunError: the run to start from is unusable.
    """
    if "lamp" not in arrays:  # pictures in colours, which the model refuses
        return _USUAL_ENDMEMBERS, ""
    if config.from_run is not None:
        return RunMaterials.open(config.from_run).num_endmembers, ""
    if config.num_endmembers is None:
        return min(_USUAL_ENDMEMBERS, len(arrays["lamp"])), ""
    pixels = drop_uninformative_pixels(torch.from_numpy(arrays["pixels"] / arrays["lamp"]).float())
    count = propose_num_materials(pixels, generator)
    return count.number, count.evidence()


@dataclass(frozen=True)
class SeenPixels:
    """Pixels that are lit well enough to tell reflectance."""

    positions: Float[Tensor, "N 3"]
    normals: Float[Tensor, "N 3"]
    reflectance: Float[Tensor, "N B"]


def start_spectral(
    model: NeumatexModel, arrays: Mapping[str, np.ndarray], generator: torch.Generator
) -> None:
    """Give a new model its first endmembers and abundances.

    Raises:
        SpectrumError: the pixels don't allow so many endmembers.
        ConfigError, RunError: the run to start from is unusable.
    """
    assert model.endmembers is not None
    found = _seen_pixels(model, arrays)
    start = _from_pixels if model.config.from_run is None else _from_run
    endmembers, shares = start(model, found, arrays, generator)
    model.endmembers.copy_(endmembers)
    start_plain(model.triplane, model.family)
    fit_shares(model.triplane, found.positions, shares, generator)


def _from_pixels(
    model: NeumatexModel, found: SeenPixels, _: Mapping[str, np.ndarray], generator: torch.Generator
) -> tuple[Float[Tensor, "K B"], Float[Tensor, "N K"]]:
    """Endmembers and abundances by unmixing the pixels' reflectances."""
    pixels = found.reflectance
    count = model.family.num_parameters - NUM_GLOSS
    first = initialise_endmembers(pixels, count, model.config.endmember_init, generator)
    unit = torch.nn.functional.normalize
    endmembers = as_bright(first, pixels, unit(pixels, dim=1) @ unit(first, dim=1).T)
    return endmembers, fcls(pixels, endmembers)


def _from_run(
    model: NeumatexModel, found: SeenPixels, arrays: Mapping[str, np.ndarray], _: torch.Generator
) -> tuple[Float[Tensor, "K B"], Float[Tensor, "N K"]]:
    """Endmembers and abundances of a run of unmix-nerf."""
    assert model.config.from_run is not None
    run = RunMaterials.open(model.config.from_run)
    count = model.family.num_parameters - NUM_GLOSS
    first = run.reflectances(model.record.bands, arrays["lamp"], count).to(found.reflectance)
    shares = run.abundances(found.positions, found.normals, arrays["world_corners"])
    return as_bright(first, found.reflectance, shares), shares


def as_bright(
    spectra: Float[Tensor, "K B"], pixels: Float[Tensor, "N B"], purity: Float[Tensor, "N K"]
) -> Float[Tensor, "K B"]:
    """Spectra of the same shape, each as bright as the purest of its pixels: in known light a pixel is as bright as its
    material, but one that shows others, too, is as bright as the mixture.

    Args:
        purity: The larger, the more a pixel is of an endmember alone.
    """
    count = min(len(pixels), max(_FEWEST_PURE, round(_PURE * len(pixels))))
    purest = purity.topk(count, dim=0).indices
    brightness = pixels.norm(dim=1)[purest].median(dim=0).values
    bright = torch.nn.functional.normalize(spectra, dim=1) * brightness[:, None]
    return bright / bright.amax(dim=1, keepdim=True).clamp(min=1)


def _seen_pixels(model: NeumatexModel, arrays: Mapping[str, np.ndarray]) -> SeenPixels:
    device = model.device
    pixels, origins, directions = (
        torch.from_numpy(arrays[name]).to(device) for name in ("pixels", "pixel_origins", "pixel_directions")
    )
    seen = model.traced.seen(origins, directions)
    reflectance, is_lit = apparent_reflectance(model.traced, seen, pixels[seen.found])
    return SeenPixels(
        seen.points.positions[is_lit], seen.points.geometric_normals[is_lit], reflectance[is_lit]
    )


@torch.no_grad()
def apparent_reflectance(
    traced: TracedObject, seen: SeenPoints, radiance: Float[Tensor, "N B"]
) -> tuple[Float[Tensor, "N B"], Bool[Tensor, " N"]]:
    """Reflectance of a diffuse base under the plain gloss that would look so bright in direct light; and where enough
    light falls for it to mean something."""
    white, gloss = (_plain_light(traced, seen, base) for base in (1.0, 0.0))
    diffuse = (white - gloss).clamp(min=1e-6)
    brightness = diffuse.mean(dim=1)
    is_lit = brightness > _DARKEST * brightness.median()
    return ((radiance - gloss) / diffuse).clamp(min=0), is_lit


@dataclass(frozen=True)
class _Plain:
    """One material everywhere."""

    family: MaterialFamily

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        return positions.new_tensor([1.0, *PLAIN_GLOSS]).expand(len(positions), -1)


def _plain_light(traced: TracedObject, seen: SeenPoints, base: float) -> Float[Tensor, "N B"]:
    """What a plain material whose base reflects the same in all bands would send to the eye; direct light only."""
    endmember = torch.full((1, traced.environment.num_colours), base, device=seen.to_eye.device)
    plain = TracedObject(traced.ray_mesh, traced.environment, _Plain(SpectralFamily(endmember)))
    generator = torch.Generator(seen.to_eye.device).manual_seed(0)
    return plain.light(seen, _SAMPLES, 0, generator)


def fit_shares(
    triplane: Triplane,
    positions: Float[Tensor, "N 3"],
    shares: Float[Tensor, "N K"],
    generator: torch.Generator,
) -> None:
    """Fit planes and networks to shares at points; the other parameters stay where they are."""
    parameters = list(triplane.parameters())
    trained = [parameter.requires_grad for parameter in parameters]
    triplane.requires_grad_(True)
    with torch.no_grad():
        others = triplane.parameters_at(positions)[:, triplane.num_shares :]
    optimiser = torch.optim.Adam(parameters, lr=_RATE)
    with torch.enable_grad():
        for _ in range(_STEPS):
            chosen = torch.randint(len(positions), (_POINTS,), generator=generator).to(positions.device)
            found = triplane.parameters_at(positions[chosen])
            logarithms = found[:, : triplane.num_shares].clamp(min=1e-6).log()
            distance = -(shares[chosen] * logarithms).sum(dim=1).mean()
            kept = (found[:, triplane.num_shares :] - others[chosen]).square().sum(dim=1).mean()
            optimiser.zero_grad()
            (distance + kept).backward()
            optimiser.step()
    for parameter, was_trained in zip(parameters, trained, strict=True):
        parameter.requires_grad_(was_trained)
        parameter.grad = None
