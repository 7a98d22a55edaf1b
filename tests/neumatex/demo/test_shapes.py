"""Procedural meshes: closed, in model space, with normals that point out."""

import pytest
import torch
import trimesh
from torch.testing import assert_close

from unmix_plugin.neumatex.demo.noise import Noise
from unmix_plugin.neumatex.demo.shapes import SHAPES, demo_mesh


@pytest.mark.parametrize("seed", range(len(SHAPES)))
def test_shapes_are_closed_and_face_outwards(seed):
    mesh = demo_mesh(seed, resolution=32)
    solid = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    assert solid.is_watertight
    assert solid.volume > 0.1
    a, b, c = mesh.corners().unbind(dim=1)
    geometric = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    agreement = (geometric * mesh.normals[mesh.faces[:, 0].long()]).sum(dim=-1)
    assert (agreement > 0.5).float().mean() > 0.95
    assert_close(mesh.vertices.abs().max(), torch.tensor(1.0))
    assert_close(mesh.vertices.max(dim=0).values, -mesh.vertices.min(dim=0).values, atol=1e-5, rtol=0)


def test_a_seed_repeats_and_another_differs():
    first, again, other = (demo_mesh(seed, resolution=24) for seed in (0, 0, len(SHAPES)))
    assert torch.equal(first.vertices, again.vertices)
    assert first.vertices.shape != other.vertices.shape


def test_noise_has_unit_variance():
    import numpy as np

    noise = Noise.draw(np.random.default_rng(0), 5.0)
    values = noise.at(20 * torch.rand(50_000, 3, generator=torch.Generator().manual_seed(0)))
    assert_close(values.mean(), torch.tensor(0.0), atol=0.05, rtol=0)
    assert_close(values.std(), torch.tensor(1.0), atol=0.05, rtol=0)
