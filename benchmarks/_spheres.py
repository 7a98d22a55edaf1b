"""Pictures of a sphere of one material, seen from afar under lights and environments: no rays are needed.

Notation: `S` pixels of the sphere, `F` families. Light is linear RGB; pictures are AgX.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from unmix_plugin.neumatex.tracing.built_in_lights import built_in_environment
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import MaterialFamily
from unmix_plugin.neumatex.tracing.microfacet import frames, to_local, to_world
from unmix_plugin.spectral.colour.conversion import agx

ENVIRONMENTS = ("studio", "window-room", "overcast", "sunset")
_DIRECTIONAL = ((0.5, -0.7, 0.6, 2.5), (-0.9, -0.3, 0.2, 0.8), (0.2, 0.9, 0.5, 1.5))
"""Direction and irradiance of distant point lights, as one light setting of its own."""


@dataclass(frozen=True)
class Sphere:
    """Pixels of a sphere seen from -y, z up."""

    size: int
    inside: Tensor
    """Pixels of the picture that the sphere covers, (size^2)."""
    frames: Tensor
    eyes: Tensor
    """Towards the camera in the local frames, (S 3)."""


def sphere(size: int) -> Sphere:
    """A sphere that fills a picture of size x size pixels."""
    steps = (torch.arange(size) + 0.5) / size * 2 - 1
    z, x = torch.cartesian_prod(-steps, steps).unbind(-1)
    inside = x * x + z * z < 0.99
    x, z = x[inside], z[inside]
    normals = torch.stack([x, -torch.sqrt(1 - x * x - z * z), z], -1)
    basis = frames(normals)
    return Sphere(size, inside, basis, to_local(basis, torch.tensor([0.0, -1.0, 0.0]).expand_as(normals)))


def environments() -> list[Environment]:
    """The light that spheres are seen in."""
    return [built_in_environment(name, height=64) for name in ENVIRONMENTS]


def under_point_lights(family: MaterialFamily, material: Tensor, on: Sphere) -> Tensor:
    """Light from each pixel, (S 3)."""
    total = torch.zeros(len(on.eyes), 3)
    rows = material.expand(len(on.eyes), -1)
    for *direction, irradiance in _DIRECTIONAL:
        towards = torch.nn.functional.normalize(torch.tensor(direction), dim=0)
        wi = to_local(on.frames, towards.expand(len(on.eyes), 3))
        total = total + irradiance * wi[:, 2:].clamp_min(0) * family.evaluate(rows, wi, on.eyes)
    return total


def under_environment(
    families: list[tuple[MaterialFamily, Tensor]], light: Environment, on: Sphere, samples: int, seed: int
) -> list[Tensor]:
    """Light from each pixel for every family's material, (S 3) each, all from the same directions.

    The directions are drawn from the environment and from every family in turn; the balance heuristic weighs them.
    """
    eyes, basis = on.eyes.repeat(samples, 1), on.frames.repeat(samples, 1, 1)
    generator = torch.Generator().manual_seed(seed)
    materials = [material.detach().expand(len(eyes), -1) for _, material in families]
    drawn = []
    for (family, _), material in zip(families, materials, strict=True):
        drawn.append(family.sample(material, eyes, torch.rand(len(eyes), 3, generator=generator)))
    drawn.append(to_local(basis, light.sample(torch.rand(len(eyes), 2, generator=generator))[0]))
    wi = torch.cat(drawn)
    times = len(drawn)
    eyes, world = eyes.repeat(times, 1), to_world(basis.repeat(times, 1, 1), wi)
    density = light.density(world)
    for (family, _), material in zip(families, materials, strict=True):
        density = density + family.density(material.repeat(times, 1), wi, eyes)
    arriving = light.radiance(world) * (wi[:, 2].clamp_min(0) / density)[:, None]
    pixels = len(on.eyes)
    return [
        (family.evaluate(material.expand(len(wi), -1), wi, eyes) * arriving).reshape(-1, pixels, 3).sum(0)
        / samples
        for family, material in families
    ]


def picture(light: Tensor) -> Tensor:
    """What is compared: AgX of linear light, [0, 1]."""
    return agx(light).clamp(0, 1)


def psnr(a: Tensor, b: Tensor) -> float:
    """Peak signal to noise in dB of two pictures."""
    return -10 * math.log10(max(float((picture(a) - picture(b)).square().mean()), 1e-10))
