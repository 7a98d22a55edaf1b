"""Reflectances with closed forms, directions, meshes, cameras and a trained object without a training."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from tests.viewer.view_factory import BOX, ring
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.runs.scene_record import SceneRecord
from unmix_plugin.neumatex.fit.tone import tone_curve
from unmix_plugin.neumatex.fit.trained_object import TrainedObject
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import LayeredFamily, MaterialFamily, PbrFamily
from unmix_plugin.neumatex.tracing.mesh import Mesh, mesh_of
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.run_views import recorded_views


def unit(vectors):
    return torch.nn.functional.normalize(vectors, dim=-1)


def cosine_directions(uniforms):
    azimuth, radius = 2 * math.pi * uniforms[:, 0], uniforms[:, 1].sqrt()
    z = (1 - uniforms[:, 1]).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=-1)


class Lambert(MaterialFamily):
    """Albedo in three colours."""

    num_parameters = 3
    num_colours = 3

    def evaluate(self, parameters, wi, wo):
        above = (wi[:, 2:] > 0) & (wo[:, 2:] > 0)
        return torch.where(above, parameters / math.pi, 0.0)

    def sample(self, parameters, wo, uniforms):
        return cosine_directions(uniforms)

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
        lobe = cosine[:, None] * mirrored + sine[:, None] * (
            azimuth.cos()[:, None] * first + azimuth.sin()[:, None] * second
        )
        return torch.where(uniforms[:, 2:] < 0.5, lobe, cosine_directions(uniforms[:, :2]))

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


def wide_parameters(number: int, num_parameters: int, seed: int = 0) -> Tensor:
    """Random parameters, a quarter of them at 0 or 1."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(number, num_parameters, generator=generator)
    ends = torch.rand(number, num_parameters, generator=generator)
    return torch.where(ends < 0.125, 0.0, torch.where(ends > 0.875, 1.0, drawn))


def eye_directions(number: int, seed: int = 1, lowest: float = 0.05) -> Tensor:
    """Above the surface, cosines from `lowest` to 1."""
    generator = torch.Generator().manual_seed(seed)
    z = lowest + (1 - lowest) * torch.rand(number, generator=generator)
    angle = 2 * math.pi * torch.rand(number, generator=generator)
    sine = torch.sqrt(1 - z * z)
    return torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z], -1)


def numbers(rows: int, columns: int, seed: int = 2) -> Tensor:
    """Uniform random numbers."""
    return torch.rand(rows, columns, generator=torch.Generator().manual_seed(seed))


def spherical_grid(rings: int, spokes: int) -> tuple[Tensor, Tensor]:
    """Directions over the whole sphere and their solid angles."""
    z = 1 - 2 * (torch.arange(rings, dtype=torch.float64) + 0.5) / rings
    angle = 2 * math.pi * (torch.arange(spokes, dtype=torch.float64) + 0.5) / spokes
    z, angle = torch.cartesian_prod(z, angle).unbind(-1)
    sine = torch.sqrt(1 - z * z)
    directions = torch.stack([sine * torch.cos(angle), sine * torch.sin(angle), z], -1).float()
    return directions, torch.full((len(directions),), 4 * math.pi / len(directions))


@dataclass(frozen=True)
class WavySurface:
    """Parameters that change smoothly over space, each in its own rhythm."""

    family: MaterialFamily

    def parameters(self, positions: Tensor) -> Tensor:
        index = torch.arange(self.family.num_parameters, device=positions.device)
        waves = torch.stack([(1.3 + index).sin(), (2.1 * index).cos(), (0.7 + 3.3 * index).sin()]) * 3
        return 0.5 + 0.45 * (positions @ waves.to(positions) + index).sin()


PBR, LAYERED = WavySurface(PbrFamily()), WavySurface(LayeredFamily())


def ball(subdivisions: int = 3) -> Mesh:
    """The unit sphere."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return mesh_of(torch.as_tensor(np.array(shape.vertices)), torch.as_tensor(np.array(shape.faces)))


def knot() -> Mesh:
    """A torus in [-1, 1]^3."""
    shape = trimesh.creation.torus(0.7, 0.3, major_sections=48, minor_sections=24)
    return mesh_of(torch.as_tensor(np.array(shape.vertices)), torch.as_tensor(np.array(shape.faces)))


def ring_cameras(count: int, size: int, distance: float = 4.0) -> Cameras:
    """Cameras around the z axis that look at the origin, slightly from above."""
    angles = torch.arange(count) * (2 * torch.pi / count)
    back = torch.stack([angles.cos(), angles.sin(), torch.full_like(angles, 0.4)], dim=-1)
    back = torch.nn.functional.normalize(back, dim=-1)
    right = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]).expand_as(back), back)
    right = torch.nn.functional.normalize(right, dim=-1)
    up = torch.linalg.cross(back, right)
    poses = torch.stack([right, up, back, distance * back], dim=-1)
    focal = torch.full((count, 2), 1.4 * size)
    return Cameras(poses, focal, torch.full((count, 2), size / 2), torch.zeros(count, 4), size, size)


CAMERAS = ring()
RECORD = SceneRecord(BOX, {}, CAMERAS, CAMERAS[[1, 3]], {})
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FRAME = Normalisation(TURN, np.zeros(3), 0.5)


def uneven_light():
    """Bright on the side of +x, dark elsewhere."""
    image = torch.full((8, 16, 3), 0.05)
    image[2:6, 7:9] = 8.0
    return Environment(image)


def make_object(light=None, surface=PBR, **settings):
    torch.manual_seed(0)
    return TrainedObject(
        RayMesh(ball(2).transformed(0.6, torch.zeros(3))),
        surface,
        uneven_light() if light is None else light,
        FRAME,
        recorded_views(RECORD),
        BOX,
        tone_curve("srgb"),
        lambda positions: positions.new_full((len(positions), 5), -4.0),
        samples=16,
        **settings,
    )
