"""Reflectances with closed forms, directions, meshes, rays, cameras and a trained object without a training."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from tests.factories.views import BOX, ring
from unmix_plugin.engine.runs.scene_record import SceneRecord
from unmix_plugin.neumatex.fit.tone import tone_curve
from unmix_plugin.neumatex.fit.trained_object import TrainedObject
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import LayeredFamily, MaterialFamily, PbrFamily
from unmix_plugin.neumatex.tracing.mesh import Mesh, mesh_of
from unmix_plugin.neumatex.tracing.microfacet import cosine_directions
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.run_views import recorded_views


def unit(vectors):
    return torch.nn.functional.normalize(vectors, dim=-1)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


class Lambert(MaterialFamily):
    """Albedo in three colours."""

    num_parameters = 3
    num_colours = 3

    def evaluate(self, parameters, wi, wo):
        above = (wi[:, 2:] > 0) & (wo[:, 2:] > 0)
        return torch.where(above, parameters / math.pi, 0.0)

    def sample(self, parameters, wo, uniforms):
        return cosine_directions(uniforms[:, :2].T).T

    def density(self, parameters, wi, wo):
        return wi[:, 2].clamp(min=0.0) / math.pi

    def base_colour(self, parameters):
        return parameters


class Glossy(MaterialFamily):
    """Lambert, and a Phong lobe of exponent 1 + 60 p about the mirrored direction; parameters albedo, strength, p."""

    num_parameters = 5
    num_colours = 3

    def _lobe(self, parameters, wi, wo):
        exponent = 1 + 60 * parameters[:, 4]
        mirrored = wo * torch.tensor([-1.0, -1.0, 1.0])
        cosine = (wi * mirrored).sum(dim=-1).clamp(min=1e-6)
        return (exponent + 1) / (2 * math.pi) * cosine**exponent

    def evaluate(self, parameters, wi, wo):
        above = (wi[:, 2:] > 0) & (wo[:, 2:] > 0)
        lobe = parameters[:, 3] * self._lobe(parameters, wi, wo)
        return torch.where(above, parameters[:, :3] / math.pi + lobe[:, None], 0.0)

    def sample(self, parameters, wo, uniforms):
        cosine = uniforms[:, 1] ** (1 / (2 + 60 * parameters[:, 4]))
        sine, azimuth = (1 - cosine**2).clamp(min=0).sqrt(), 2 * math.pi * uniforms[:, 0]
        mirrored = wo * torch.tensor([-1.0, -1.0, 1.0])
        first = unit(torch.linalg.cross(mirrored, torch.tensor([0.3, 0.5, -0.8]).expand_as(mirrored)))
        second = torch.linalg.cross(mirrored, first)
        aside = azimuth.cos()[:, None] * first + azimuth.sin()[:, None] * second
        lobe = cosine[:, None] * mirrored + sine[:, None] * aside
        return torch.where(uniforms[:, 2:] < 0.5, lobe, cosine_directions(uniforms[:, :2].T).T)

    def density(self, parameters, wi, wo):
        return 0.5 * wi[:, 2].clamp(min=0.0) / math.pi + 0.5 * self._lobe(parameters, wi, wo)

    def base_colour(self, parameters):
        return parameters[:, :3]


class Uniform:
    """One material everywhere."""

    def __init__(self, family, values):
        self.family = family
        self.values = torch.as_tensor(values, dtype=torch.float32)

    def parameters(self, positions):
        return self.values.expand(len(positions), -1)


@dataclass(frozen=True)
class WavySurface:
    """Parameters that change smoothly over space, each in its own rhythm."""

    family: MaterialFamily

    def parameters(self, positions: Tensor) -> Tensor:
        index = torch.arange(self.family.num_parameters, device=positions.device)
        waves = torch.stack([(1.3 + index).sin(), (2.1 * index).cos(), (0.7 + 3.3 * index).sin()]) * 3
        return 0.5 + 0.45 * (positions @ waves.to(positions) + index).sin()


PBR, LAYERED = WavySurface(PbrFamily()), WavySurface(LayeredFamily())


def wide_parameters(number: int, num_parameters: int, seed: int = 0) -> Tensor:
    """Random parameters, a quarter of them at 0 or 1."""
    drawn, ends = torch.rand(2, number, num_parameters, generator=generator(seed))
    return torch.where(ends < 0.125, 0.0, torch.where(ends > 0.875, 1.0, drawn))


def eye_directions(number: int, seed: int = 1, lowest: float = 0.05) -> Tensor:
    """Above the surface, cosines from `lowest` to 1."""
    shares, turns = torch.rand(2, number, generator=generator(seed))
    z, angle = lowest + (1 - lowest) * shares, 2 * math.pi * turns
    sine = torch.sqrt(1 - z * z)
    return torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z], -1)


def numbers(rows: int, columns: int, seed: int = 2) -> Tensor:
    """Uniform random numbers."""
    return torch.rand(rows, columns, generator=generator(seed))


def spherical_grid(rings: int) -> tuple[Tensor, Tensor]:
    """Directions over the whole sphere, as many on a ring as there are rings, and their solid angles."""
    steps = (torch.arange(rings, dtype=torch.float64) + 0.5) / rings
    z, angle = torch.cartesian_prod(1 - 2 * steps, 2 * math.pi * steps).unbind(-1)
    sine = torch.sqrt(1 - z * z)
    directions = torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z], -1).float()
    return directions, torch.full((len(directions),), 4 * math.pi / len(directions))


def mesh_from(*shapes: Any) -> Mesh:
    """Shapes of trimesh as one mesh."""
    shape: Any = trimesh.util.concatenate(shapes)
    return mesh_of(torch.as_tensor(np.array(shape.vertices)), torch.as_tensor(np.array(shape.faces)))


def ball(subdivisions: int = 3) -> Mesh:
    """The unit sphere."""
    return mesh_from(trimesh.creation.icosphere(subdivisions=subdivisions))


def knot() -> Mesh:
    """A torus in [-1, 1]^3."""
    return mesh_from(trimesh.creation.torus(0.7, 0.3, major_sections=48, minor_sections=24))


CAMERAS = ring()
RECORD = SceneRecord(BOX, {}, CAMERAS, CAMERAS[[1, 3]], {})
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FRAME = Normalisation(TURN, np.zeros(3), 0.5)


def uneven_light():
    """Bright on the side of +x, dark elsewhere."""
    image = torch.full((8, 16, 3), 0.05)
    image[2:6, 7:9] = 8.0
    return Environment(image)


def make_object(**settings):
    return TrainedObject(
        RayMesh(ball(2).transformed(0.6, torch.zeros(3))),
        PBR,
        uneven_light(),
        FRAME,
        recorded_views(RECORD),
        BOX,
        tone_curve("srgb"),
        lambda positions: positions.new_full((len(positions), 5), -4.0),
        samples=16,
        **settings,
    )
