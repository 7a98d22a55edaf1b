"""Where a fit begins: at a plain grey material, at the prior's, or at spectra of the pictures or of another run.

Mesh and light are known, so a pixel's radiance over what a white surface would send there is about its reflectance,
shadows and all. For a spectral material these spectra are unmixed one by one, and the planes are fitted to the
abundances that come out; or a run of unmix-nerf gives endmembers and abundances.

Notation: `N` points, `P` parameters, `V` views of `H x W` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor, nn
from torch.nn.functional import normalize

from unmix_plugin.engine import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.prior.observations import PosedViews
from unmix_plugin.neumatex.tracing.families import LayeredFamily, MaterialFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import SurfacePoints
from unmix_plugin.neumatex.tracing.surface import Triplane
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.unmixing.abundances import fcls
from unmix_plugin.spectral.unmixing.endmembers import EndmemberMethod, initialise_endmembers
from unmix_plugin.trained.open_run import open_run
from unmix_plugin.trained.surface import look_from_above
from unmix_plugin.trained.trained_scene import TrainedScene

_PLAIN_SPECULAR = (0.5, 0.2)
"""Roughness and specular level of a common dielectric, half rough."""
_START_RANGE = (0.05, 0.95)
"""Of parameters, away from where a sigmoid has no slope."""
_START_PLANES = 0.2
"""Of the planes' random values: texels that few pixels see keep theirs, which shows as grain."""
_START_SPREAD = 0.3
"""Of the last layer's random weights."""
_SAMPLES = 64
_DARKEST = 0.1
"""Light on a pixel, as a part of the median, below which its reflectance is noise."""
_PURE, _FEWEST_PURE = 0.02, 50
"""Part of the pixels, and how many at least, that count as purest of an endmember."""
_STEPS, _POINTS, _RATE = 200, 4096, 5e-3
_LEAST_FOUND = 0.5
"""Opacity from which a run has something at a point, and share of points at which it must."""


def start_plain(triplane: Triplane, family: MaterialFamily) -> None:
    """Make a new triplane give a plain material nearly everywhere."""
    last = triplane.readers.material_network[-1]
    assert isinstance(last, nn.Linear)
    plain, num_shares = _plain_parameters(family), triplane.readers.num_shares
    shares, others = plain[:num_shares].log(), plain[num_shares:].logit()
    with torch.no_grad():
        triplane.planes.mul_(_START_PLANES)
        last.weight.mul_(_START_SPREAD)
        if triplane.readers.others_of_shares is None:
            last.bias.copy_(torch.cat([shares, others]))
        else:
            last.bias.copy_(shares)
            triplane.readers.others_of_shares.copy_(others.expand(num_shares, -1))


def _plain_parameters(family: MaterialFamily) -> Float[Tensor, "P"]:
    """Parameters of a rough grey surface that is not metal and has no layers: from half a metal, a fit puts the colours
    of what is diffuse into what the metal reflects."""
    if isinstance(family, NeuralFamily):
        layered = torch.zeros(1, LayeredFamily.num_parameters)
        layered[0, :3], layered[0, 4:6] = 0.5, 0.5
        return family.from_layered(layered)[0].clamp(*_START_RANGE)
    if isinstance(family, SpectralFamily):
        shares = torch.full((family.num_endmembers,), 1 / family.num_endmembers)
        return torch.cat([shares, torch.tensor(_PLAIN_SPECULAR)])
    return torch.tensor([0.5, 0.5, 0.5, 0.5, 0.0]).clamp(*_START_RANGE)


def views_of(arrays: Mapping[str, np.ndarray]) -> PosedViews:
    """The views among the arrays that a data manager handed over. Raises ConfigError: there are none."""
    count = sum(name.startswith("view_") and name.endswith("_pose") for name in arrays)
    if not count:
        raise ConfigError(
            "the prior looks at views of frame cameras, and all training views are those of line cameras; choose "
            "--pipeline.model.prior none"
        )
    lights, alphas, poses, lenses = (
        [torch.from_numpy(arrays[f"view_{number}_{kind}"]) for number in range(count)]
        for kind in ("light", "alpha", "pose", "lens")
    )
    sizes = [(alpha.shape[1], alpha.shape[0]) for alpha in alphas]
    lens = torch.stack(lenses)
    cameras = Cameras.of_sizes(torch.stack(poses), lens[:, :2], lens[:, 2:4], lens[:, 4:], sizes)
    return PosedViews(cameras, lights, alphas)


@dataclass(frozen=True)
class SpectralStart:
    """Where the fit of a spectral material starts: endmembers, and what points of the surface are made of."""

    endmembers: Float[Tensor, "K B"]
    positions: Float[Tensor, "N 3"]
    abundances: Float[Tensor, "N K"]


def spectral_start(
    traced: TracedObject,
    arrays: Mapping[str, np.ndarray],
    generator: torch.Generator,
    *,
    count: int,
    method: EndmemberMethod,
    bands: Bands | None,
    from_run: Path | None,
) -> SpectralStart:
    """First endmembers, so many by this method or those of a run, and abundances where light falls on an object.

    Raises:
        SpectrumError: the pixels don't allow so many.
        ConfigError, RunError: the run to start from is unusable.
    """
    pixels, origins, directions = (
        torch.from_numpy(arrays[name]).to(traced.ray_mesh.device)
        for name in ("pixels", "pixel_origins", "pixel_directions")
    )
    found, points = traced.ray_mesh.seen(origins, directions)
    reflectance, is_lit = _apparent_reflectance(traced, points, pixels[found])
    points, reflectance = points.select(is_lit), reflectance[is_lit]
    if from_run is None:
        first = initialise_endmembers(reflectance, count, method, generator)
        purity = normalize(reflectance, dim=1) @ normalize(first, dim=1).T
        endmembers = as_bright_as_seen(first, reflectance, purity)
        abundances = fcls(reflectance, endmembers)
    else:
        run = RunMaterials(from_run, opened_run(from_run))
        first = run.reflectances(bands, arrays["lamp"], count).to(reflectance)
        abundances = run.abundances(points.positions, points.geometric_normals, arrays["world_corners"])
        endmembers = as_bright_as_seen(first, reflectance, abundances)
    return SpectralStart(endmembers, points.positions, abundances)


@torch.no_grad()
def _apparent_reflectance(
    traced: TracedObject, points: SurfacePoints, radiance: Float[Tensor, "N B"]
) -> tuple[Float[Tensor, "N B"], Bool[Tensor, " N"]]:
    """Reflectance of a diffuse base under the plain specular layer that would look so bright in direct light; and where
    enough light falls for it to mean something."""
    white, specular = (_plain_light(traced, points, base) for base in (1.0, 0.0))
    diffuse = (white - specular).clamp(min=1e-6)
    brightness = diffuse.mean(dim=1)
    is_lit = brightness > _DARKEST * brightness.median()
    return ((radiance - specular) / diffuse).clamp(min=0), is_lit


@dataclass(frozen=True)
class _Plain:
    """A surface of one material everywhere."""

    family: MaterialFamily

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        return positions.new_tensor([1.0, *_PLAIN_SPECULAR]).expand(len(positions), -1)


def _plain_light(traced: TracedObject, points: SurfacePoints, base: float) -> Float[Tensor, "N B"]:
    """What a plain material whose base reflects the same in all bands would send to the eye; direct light only."""
    device = points.positions.device
    endmember = torch.full((1, traced.environment.num_colours), base, device=device)
    plain = replace(traced, surface=_Plain(SpectralFamily(endmember)))
    return plain.light(points, _SAMPLES, 0, torch.Generator(device).manual_seed(0))


def as_bright_as_seen(
    spectra: Float[Tensor, "K B"], pixels: Float[Tensor, "N B"], purity: Float[Tensor, "N K"]
) -> Float[Tensor, "K B"]:
    """Spectra of the same shape, each as bright as the purest of its pixels: in known light a pixel is as bright as its
    material, but one that shows others, too, is as bright as the mixture."""
    count = min(len(pixels), max(_FEWEST_PURE, round(_PURE * len(pixels))))
    purest = purity.topk(count, dim=0).indices
    brightness = pixels.norm(dim=1)[purest].median(dim=0).values
    bright = normalize(spectra, dim=1) * brightness[:, None]
    return bright / bright.amax(dim=1, keepdim=True).clamp(min=1)


def fit_abundances(triplane: Triplane, start: SpectralStart, generator: torch.Generator) -> None:
    """Fit planes and networks to abundances at points; the other parameters stay where they are."""
    positions, abundances = start.positions, start.abundances
    fitted = copy.deepcopy(triplane).requires_grad_(True)
    with torch.no_grad():
        others = triplane.parameters_at(positions)[:, triplane.readers.num_shares :]
    optimiser = torch.optim.Adam(fitted.parameters(), lr=_RATE)
    with torch.enable_grad():
        for _ in range(_STEPS):
            chosen = torch.randint(len(positions), (_POINTS,), generator=generator).to(positions.device)
            found, kept = fitted.parameters_at(positions[chosen]).tensor_split([abundances.shape[1]], dim=1)
            distance = -(abundances[chosen] * found.clamp(min=1e-6).log()).sum(dim=1).mean()
            kept = (kept - others[chosen]).square().sum(dim=1).mean()
            optimiser.zero_grad()
            (distance + kept).backward()
            optimiser.step()
    triplane.load_state_dict(fitted.state_dict())


@lru_cache(maxsize=1)
def opened_run(path: Path) -> TrainedScene:
    """The scene of a run folder, which is read once."""
    return open_run(path, "cpu")


@dataclass(frozen=True)
class RunMaterials:
    """What a run of unmix-nerf says of materials."""

    path: Path
    scene: TrainedScene

    def reflectances(
        self, bands: Bands | None, lamp: Float64[np.ndarray, " B"], count: int
    ) -> Float[Tensor, "K B"]:
        """Endmembers over the light that they were seen in, of any brightness; `lamp` is for a run that does not know
        it. Raises ConfigError: the run has other bands, or another number of endmembers."""
        materials = self.scene.materials
        if bands is None or materials.bands != bands:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has {materials.bands}, the pictures {bands}; they must be "
                "the same"
            )
        if len(materials.endmembers) != count:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has {len(materials.endmembers)} endmembers, num-endmembers is "
                f"{count}; leave it out"
            )
        light = torch.from_numpy(lamp).float() if materials.light is None else materials.light.cpu()
        return materials.endmembers.detach().cpu() / light.clamp(min=1e-3)

    def abundances(
        self,
        positions: Float[Tensor, "N 3"],
        normals: Float[Tensor, "N 3"],
        world_corners: Float64[np.ndarray, "4 3"],
    ) -> Float[Tensor, "N K"]:
        """Abundances at surface points, summing to 1; equal ones where the run has nothing.

        Args:
            positions, normals: In the mesh's model space.
            world_corners: Where its origin and the ends of its unit vectors are in the world.
        """
        frame = self.scene.frame
        origin, axes = world_corners[0], world_corners[1:] - world_corners[0]
        world = positions.cpu().double().numpy() @ axes + origin
        outwards = normals.cpu().double().numpy() @ axes @ frame.rotation.T
        there = torch.from_numpy(frame.to_model(world)).float()
        found, _ = look_from_above(self.scene, there, normalize(torch.from_numpy(outwards).float(), dim=1))
        total = found.sum(dim=1, keepdim=True)
        share = float((total > _LEAST_FOUND).float().mean())
        if share < _LEAST_FOUND:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has something at {share:.0%} of the mesh's surface only; give "
                "a run of the same object in the same world"
            )
        usual = torch.full_like(found, 1 / found.shape[1])
        return torch.where(total > _LEAST_FOUND, found / total.clamp(min=1e-6), usual).to(positions)
