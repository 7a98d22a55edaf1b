"""Pictures: which pixels see the mesh, how rays of a pixel are averaged, what is behind."""

import dataclasses
import math

import pytest
import torch
import trimesh
from torch.testing import assert_close

from tests.neumatex.simple_materials import Lambert, Uniform
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.neumatex.geometry.mesh import mesh_of
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.tracing.primary_hits import pixel_hits
from unmix_plugin.neumatex.tracing.render_view import render_view

SIZE = 48


def _camera(distance=4.0, size=SIZE):
    """One on the x axis that looks at the origin, z up."""
    pose = torch.tensor([[[0.0, 0, 1, distance], [1, 0, 0, 0], [0, 1, 0, 0]]])
    focal = torch.full((1, 2), 1.5 * size)
    return Cameras(pose, focal, torch.full((1, 2), size / 2), torch.zeros(1, 4), size, size)


def _sphere():
    sphere = trimesh.creation.icosphere(subdivisions=4)
    return RayMesh(mesh_of(torch.tensor(sphere.vertices), torch.tensor(sphere.faces)))


def test_alpha_is_the_covered_part_of_pixels():
    alpha = pixel_hits(_sphere(), _camera(), 0, subpixels=4).alpha()
    # A unit sphere at distance 4 has an outline of this radius in pixels.
    radius = 1.5 * SIZE / math.sqrt(4**2 - 1)
    assert_close(alpha.sum(), torch.tensor(math.pi * radius**2), rtol=0.005, atol=0)
    assert alpha[SIZE // 2, SIZE // 2] == 1
    assert alpha[0, 0] == 0
    assert bool(((alpha > 0) & (alpha < 1)).any())


def test_rays_of_a_pixel_are_averaged():
    hits = pixel_hits(_sphere(), _camera(), 0, subpixels=2)
    image = hits.image(torch.ones(len(hits), 3))
    assert_close(image, hits.alpha()[..., None].expand(-1, -1, 3))
    inner = hits.select(hits.pixels == SIZE // 2 * SIZE + SIZE // 2)
    assert len(inner) == 4
    assert bool((hits.pixels.diff() >= 0).all())
    assert_close(inner.to_eye.norm(dim=-1), torch.ones(4))


def test_left_and_up_are_where_they_belong():
    """Light from +z and from +y: the upper half is brighter, and the half that shows +y, on the right."""
    image = torch.zeros(16, 32, 3)
    image[:8, :, 0] = 1  # +z
    image[:, 0:16, 1] = 1  # azimuths from 0 to pi, +y
    picture, _ = render_view(
        Uniform(Lambert(), [1.0] * 3), _sphere(), Environment(image), _camera(), samples=64, bounces=0
    )
    half = SIZE // 2
    assert picture[:half, :, 0].mean() > 2 * picture[half:, :, 0].mean()
    assert picture[:, half:, 1].mean() > 2 * picture[:, :half, 1].mean()


@pytest.mark.parametrize("background", ["black", "environment"])
def test_white_sphere_in_a_white_world(background):
    picture, alpha = render_view(
        Uniform(Lambert(), [1.0] * 3),
        _sphere(),
        Environment(torch.ones(8, 16, 3)),
        _camera(),
        samples=256,
        background=background,
    )
    expected = (
        torch.ones_like(picture) if background == "environment" else alpha[..., None].expand_as(picture)
    )
    assert_close(picture.mean(), expected.mean(), atol=0.004, rtol=0)
    assert_close(picture, expected, atol=0.06, rtol=0)


def test_a_camera_that_sees_nothing_gives_black():
    away = torch.tensor([[[0.0, 0, -1, 4], [-1, 0, 0, 0], [0, 1, 0, 0]]])
    camera = dataclasses.replace(_camera(size=8), camera_to_world=away)
    picture, alpha = render_view(
        Uniform(Lambert(), [1.0] * 3), _sphere(), Environment(torch.ones(8, 16, 3)), camera
    )
    assert picture.abs().sum() + alpha.sum() == 0
