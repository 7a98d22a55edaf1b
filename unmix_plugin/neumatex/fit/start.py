"""A mesh's materials as the path tracer reads them: a family, and the triplane that holds its parameters.

What a prior said of an object's material, kept while the object is fitted.

Notation: `N` points, `P` parameters, `V` views of `H x W` pixels.

Endmembers and abundances of a run of unmix-nerf, as a start for materials on a mesh.

Notation: `N` points, `B` bands, `K` endmembers.

Where the fit of a spectral material starts: endmember reflectances, and their shares at points of the mesh.

Mesh and light are known, so a pixel's radiance over what a white surface would send there is about its reflectance,
shadows and all. Those spectra are unmixed one by one, and the planes are fitted to the shares that come out.

Notation: `M` pixels of training views, `N` points, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor, nn

from unmix_plugin.engine import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.fit.settings import MaterialName
from unmix_plugin.neumatex.prior.observations import PosedViews
from unmix_plugin.neumatex.tracing.families import (
    NUM_GLOSS,
    LayeredFamily,
    MaterialFamily,
    PbrFamily,
    SpectralFamily,
)
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.path_tracer import SeenPoints, TracedObject
from unmix_plugin.neumatex.tracing.surface import Triplane
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.unmixing.abundances import fcls
from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels, initialise_endmembers
from unmix_plugin.spectral.unmixing.num_materials import propose_num_materials
from unmix_plugin.trained.open_run import open_run
from unmix_plugin.trained.surface import look_from_above
from unmix_plugin.trained.trained_scene import TrainedScene

if TYPE_CHECKING:
    from unmix_plugin.neumatex.fit.model import NeumatexModel
    from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig


PLAIN_GLOSS = (0.5, 0.2)
"""Roughness and specular level of a common dielectric, half rough."""
_START_RANGE = (0.05, 0.95)
"""Of parameters, away from where a sigmoid has no slope."""
_START_PLANES = 0.2
"""Of the planes' random values: texels that few pixels see keep theirs, which shows as grain."""
_START_SPREAD = 0.3
"""Of the last layer's random weights."""


@dataclass(frozen=True)
class TriplaneSurface:
    """Materials of a family, their parameters looked up in a triplane; see `surface.Surface`."""

    family: MaterialFamily
    triplane: Triplane

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters at points of model space, (0, 1)."""
        return self.triplane.parameters_at(positions)


def material_family(
    name: MaterialName,
    endmembers: Float[Tensor, "K B"] | None = None,
    gains: Float[Tensor, " K"] | None = None,
) -> MaterialFamily:
    """The family of that name; the neural one with the shipped decoder, the spectral one with these endmembers and
    gains.

    Raises:
        ConfigError: the shipped decoder can't be read.
    """
    if endmembers is not None:
        return SpectralFamily(endmembers, gains)
    families: dict[MaterialName, type] = {"neural": NeuralFamily, "pbr": PbrFamily}
    return families[name]()


def _plain_parameters(family: MaterialFamily) -> Float[Tensor, "P"]:
    """Parameters of a rough grey surface that is not metal and has no layers: where a fit without a prior starts.

    From the middle of all parameters, which is half a metal, a fit puts the colours of what is diffuse into what the
    metal reflects.
    """
    if isinstance(family, NeuralFamily):
        layered = torch.zeros(1, LayeredFamily.num_parameters)
        layered[0, :3], layered[0, 4:6] = 0.5, 0.5
        return family.from_layered(layered)[0].clamp(*_START_RANGE)
    if isinstance(family, SpectralFamily):
        shares = torch.full((family.num_endmembers,), 1 / family.num_endmembers)
        return torch.cat([shares, torch.tensor(PLAIN_GLOSS)])
    return torch.tensor([0.5, 0.5, 0.5, 0.5, 0.0]).clamp(*_START_RANGE)


def start_plain(triplane: Triplane, family: MaterialFamily) -> None:
    """Make a new triplane give the plain material nearly everywhere."""
    network = next(part for name, part in triplane.named_modules() if name.endswith("material_network"))
    *_, last = network.children()
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        triplane.planes.mul_(_START_PLANES)
        last.weight.mul_(_START_SPREAD)
        plain = _plain_parameters(family)
        raw = plain.logit()
        if triplane.num_shares:
            raw[: triplane.num_shares] = plain[: triplane.num_shares].log()
        last.bias.copy_(raw)


def frozen_parts(family: MaterialFamily) -> dict[str, nn.Module]:
    """Networks of a family by name, which have to be on the model's device and stay as they are."""
    parts = {name: getattr(family, name, None) for name in ("decoder", "encoder")}
    return {name: part.requires_grad_(False) for name, part in parts.items() if isinstance(part, nn.Module)}


class PriorAnchor(nn.Module):
    """The prior's material and its log-variance, neither of which changes."""

    def __init__(self, triplane: Triplane) -> None:
        """
        Args:
            triplane: Is copied by `adopt` later; gives the shapes.
        """
        super().__init__()
        self.triplane = triplane.requires_grad_(False)

    @torch.no_grad()
    def adopt(self, triplane: Triplane) -> None:
        """Keep what a triplane holds now."""
        self.triplane.load_state_dict(triplane.state_dict())

    def distance(
        self, parameters: Float[Tensor, "N P"], positions: Float[Tensor, "N 3"]
    ) -> Float[Tensor, ""]:
        """Squared distance of parameters from the prior's, each over its expected squared error; mean over the points
        of the sum over the parameters."""
        with torch.no_grad():
            expected = self.triplane.parameters_at(positions)
            precision = (-self.triplane.log_variance(positions)).exp()
        return ((parameters - expected).square() * precision).sum(dim=-1).mean()


def views_of(arrays: Mapping[str, np.ndarray]) -> PosedViews:
    """The views of `view_arrays`."""
    count = sum(name.startswith("view_") and name.endswith("_pose") for name in arrays)
    kinds = {
        kind: [torch.from_numpy(arrays[f"view_{number}_{kind}"]) for number in range(count)]
        for kind in ("light", "alpha", "pose", "lens")
    }
    lenses = torch.stack(kinds["lens"])
    sizes = [(alpha.shape[1], alpha.shape[0]) for alpha in kinds["alpha"]]
    cameras = Cameras.of_sizes(
        torch.stack(kinds["pose"]), lenses[:, :2], lenses[:, 2:4], lenses[:, 4:], sizes
    )
    return PosedViews(cameras, kinds["light"], kinds["alpha"])


_LEAST_FOUND = 0.5
"""Share of points at which the run must have something."""


@dataclass(frozen=True)
class _RunMaterials:
    """What a run says of materials."""

    path: Path
    scene: TrainedScene

    @staticmethod
    def open(path: Path) -> _RunMaterials:
        """Of a run folder; it is read once.

        Raises:
            RunError: the run is missing or damaged.
            ConfigError: its method does not unmix spectra.
        """
        return _RunMaterials(path, _scene(path))

    @property
    def num_endmembers(self) -> int:
        """K."""
        return len(self.scene.materials.endmembers)

    def reflectances(
        self, bands: Bands | None, lamp: Float64[np.ndarray, " B"], count: int
    ) -> Float[Tensor, "K B"]:
        """Endmembers over the light that they were seen in, of any brightness.

        Args:
            bands: That the run must have.
            lamp: For a run that does not know its light.
            count: How many endmembers it must have.
        Raises:
            ConfigError: other bands, or another number of endmembers.
        """
        materials = self.scene.materials
        if bands is None or materials.bands != bands:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has {materials.bands}, the pictures {bands}; they must be "
                "the same"
            )
        if self.num_endmembers != count:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has {self.num_endmembers} endmembers, num-endmembers is "
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
        Raises:
            ConfigError: the run has nothing at most of the points.
        """
        origin, axes = world_corners[0], world_corners[1:] - world_corners[0]
        world = positions.cpu().double().numpy() @ axes + origin
        outwards = normals.cpu().double().numpy() @ axes @ self.scene.frame.rotation.T
        found, _ = look_from_above(
            self.scene,
            torch.from_numpy(self.scene.frame.to_model(world)).float(),
            torch.nn.functional.normalize(torch.from_numpy(outwards).float(), dim=1),
        )
        total = found.sum(dim=1, keepdim=True)
        share = float((total > _LEAST_FOUND).float().mean())
        if share < _LEAST_FOUND:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has something at {share:.0%} of the mesh's surface only; give "
                "a run of the same object in the same world"
            )
        usual = torch.full_like(found, 1 / found.shape[1])
        return torch.where(total > _LEAST_FOUND, found / total.clamp(min=1e-6), usual).to(positions)


@lru_cache(maxsize=1)
def _scene(path: Path) -> TrainedScene:
    return open_run(path, "cpu")


_USUAL_ENDMEMBERS = 6
_SAMPLES = 64
_DARKEST = 0.1
"""Light on a pixel, as a part of the median, below which its reflectance is noise."""
_PURE, _FEWEST_PURE = 0.02, 50
"""Part of the pixels, and how many at least, that count as purest of an endmember."""
_STEPS, _POINTS, _RATE = 200, 4096, 5e-3


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
        return _RunMaterials.open(config.from_run).num_endmembers, ""
    if config.num_endmembers is None:
        return min(_USUAL_ENDMEMBERS, len(arrays["lamp"])), ""
    pixels = drop_uninformative_pixels(torch.from_numpy(arrays["pixels"] / arrays["lamp"]).float())
    count = propose_num_materials(pixels, generator)
    return count.number, count.evidence()


@dataclass(frozen=True)
class _SeenPixels:
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
    _fit_shares(model.triplane, found.positions, shares, generator)


def _from_pixels(
    model: NeumatexModel, found: _SeenPixels, _: Mapping[str, np.ndarray], generator: torch.Generator
) -> tuple[Float[Tensor, "K B"], Float[Tensor, "N K"]]:
    """Endmembers and abundances by unmixing the pixels' reflectances."""
    pixels = found.reflectance
    count = model.family.num_parameters - NUM_GLOSS
    first = initialise_endmembers(pixels, count, model.config.endmember_init, generator)
    unit = torch.nn.functional.normalize
    endmembers = _as_bright(first, pixels, unit(pixels, dim=1) @ unit(first, dim=1).T)
    return endmembers, fcls(pixels, endmembers)


def _from_run(
    model: NeumatexModel, found: _SeenPixels, arrays: Mapping[str, np.ndarray], _: torch.Generator
) -> tuple[Float[Tensor, "K B"], Float[Tensor, "N K"]]:
    """Endmembers and abundances of a run of unmix-nerf."""
    assert model.config.from_run is not None
    run = _RunMaterials.open(model.config.from_run)
    count = model.family.num_parameters - NUM_GLOSS
    first = run.reflectances(model.record.bands, arrays["lamp"], count).to(found.reflectance)
    shares = run.abundances(found.positions, found.normals, arrays["world_corners"])
    return _as_bright(first, found.reflectance, shares), shares


def _as_bright(
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


def _seen_pixels(model: NeumatexModel, arrays: Mapping[str, np.ndarray]) -> _SeenPixels:
    device = model.device
    pixels, origins, directions = (
        torch.from_numpy(arrays[name]).to(device) for name in ("pixels", "pixel_origins", "pixel_directions")
    )
    seen = model.traced.seen(origins, directions)
    reflectance, is_lit = _apparent_reflectance(model.traced, seen, pixels[seen.found])
    return _SeenPixels(
        seen.points.positions[is_lit], seen.points.geometric_normals[is_lit], reflectance[is_lit]
    )


@torch.no_grad()
def _apparent_reflectance(
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


def _fit_shares(
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
