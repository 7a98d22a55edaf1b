"""Frames are orthonormal and right-handed, and turn directions there and back."""

import torch
from torch.testing import assert_close

from tests.neumatex.materials.hemisphere import numbers
from unmix_plugin.neumatex.materials.shading_frame import frames, to_local, to_world

NORMALS = torch.nn.functional.normalize(
    torch.cat([numbers(200, 3) - 0.5, torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])]),
    dim=-1,
)
DIRECTIONS = torch.nn.functional.normalize(numbers(len(NORMALS), 3, seed=9) - 0.5, dim=-1)


def test_frames_are_rotations():
    found = frames(NORMALS)
    assert_close(found @ found.mT, torch.eye(3).expand_as(found), atol=1e-5, rtol=0)
    assert_close(torch.linalg.det(found), torch.ones(len(found)), atol=1e-5, rtol=0)


def test_the_normal_is_the_z_axis():
    assert_close(to_local(frames(NORMALS), NORMALS)[:, 2], torch.ones(len(NORMALS)))
    assert_close(to_world(frames(NORMALS), torch.tensor([[0.0, 0.0, 1.0]]).expand_as(NORMALS)), NORMALS)


def test_to_world_undoes_to_local():
    turned = to_world(frames(NORMALS), to_local(frames(NORMALS), DIRECTIONS))
    assert_close(turned, DIRECTIONS, atol=1e-5, rtol=0)
