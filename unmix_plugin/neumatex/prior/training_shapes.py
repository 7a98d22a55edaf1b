"""Shapes for the training of priors: blobs, rings, boxes, bars and groups of them."""

import math

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.neumatex.geometry.mesh import Mesh, mesh_of
from unmix_plugin.neumatex.prior.training_materials import SmoothNoise


def random_mesh(generator: torch.Generator) -> Mesh:
    """One object in model space: one to three parts of different kinds, which may run into each other."""
    count = 1 + int(torch.multinomial(torch.tensor([0.6, 0.25, 0.15]), 1, generator=generator))
    vertices, faces, first = [], [], 0
    for _ in range(count):
        part = _random_part(generator)
        points = torch.from_numpy(np.asarray(part.vertices, dtype=np.float32))
        turned = _deformed(points, generator) @ _random_rotation(generator).T
        shift = torch.zeros(3) if count == 1 else 0.9 * (torch.rand(3, generator=generator) - 0.5)
        vertices.append(turned + shift)
        faces.append(torch.from_numpy(np.asarray(part.faces, dtype=np.int32)) + first)
        first += len(points)
    mesh = mesh_of(torch.cat(vertices), torch.cat(faces).int())
    return mesh.transformed(*mesh.to_model_space())


def random_eyes(count: int, generator: torch.Generator) -> Float[Tensor, "V 3"]:
    """Cameras around an object, more at middle heights than at the poles."""
    turn = 2 * math.pi * torch.rand((), generator=generator)
    azimuth = (
        turn + 2 * math.pi * (torch.arange(count) + 0.6 * torch.rand(count, generator=generator)) / count
    )
    height = -0.5 + 1.4 * torch.rand(count, generator=generator)
    flat = (1 - height.square()).sqrt()
    distance = 3.0 + 2.0 * torch.rand((), generator=generator)
    return distance * torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), height], dim=-1)


def _random_part(generator: torch.Generator) -> trimesh.Trimesh:
    kind = int(torch.randint(6, (), generator=generator))
    a, b = (float(value) for value in torch.rand(2, generator=generator))
    if kind == 0:
        return trimesh.creation.torus(1.0, 0.2 + 0.4 * a, major_sections=64, minor_sections=32)
    if kind == 1:
        return _subdivided(trimesh.creation.box((1.0, 0.4 + a, 0.4 + b)))
    if kind == 2:
        return _subdivided(trimesh.creation.cylinder(0.3 + 0.7 * a, 0.3 + 1.7 * b, sections=32))
    if kind == 3:
        return trimesh.creation.capsule(0.3 + 1.7 * a, 0.4 + 0.4 * b, count=[32, 24])
    return trimesh.creation.icosphere(subdivisions=4)


def _subdivided(part: trimesh.Trimesh) -> trimesh.Trimesh:
    """Corners of a part are split first, so that each side keeps its own normal."""
    split = trimesh.Trimesh(part.vertices[part.faces.reshape(-1)], _triples(len(part.faces)), process=False)
    points, faces, *_ = trimesh.remesh.subdivide_to_size(split.vertices, split.faces, 0.25)
    return trimesh.Trimesh(points, faces, process=False)


def _triples(count: int) -> Int[np.ndarray, "F 3"]:
    return np.arange(3 * count).reshape(-1, 3)


def _deformed(points: Tensor, generator: torch.Generator) -> Tensor:
    """Waves pushed through a part and unequal stretching, each more or less strong."""
    strength = 0.35 * float(torch.rand((), generator=generator)) ** 2
    scale = 1.0 + 3.0 * float(torch.rand((), generator=generator))
    waved = points + strength * SmoothNoise.draw(3, scale, generator)(points)
    return waved * (0.5 + torch.rand(3, generator=generator))


def _random_rotation(generator: torch.Generator) -> Tensor:
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
    return rotation * torch.linalg.det(rotation)
