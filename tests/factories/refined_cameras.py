"""Cameras whose poses are refined, for tests."""

from dataclasses import replace

import torch

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses, rotation_matrix
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.poses.knots import Knots
from unmix_plugin.poses.refinement import PoseRefinement

WIDTH, HEIGHT = 12, 40
MIDDLE = torch.tensor([0.1, -0.2, 0.3])


def box_around(middle: torch.Tensor, half: float = 3.0) -> SceneBox:
    return SceneBox(torch.stack([middle - half, middle + half]))


def cameras() -> Cameras:
    """Two frame cameras and between them a line camera, all looking at the origin from around it."""
    turns = torch.tensor([[0.0, 0.2, 0.0], [0.1, 2.0, 0.0], [-0.3, -2.1, 0.2]])
    rotations = rotation_matrix(turns)
    poses = torch.cat([rotations, 4.0 * rotations[:, :, 2:]], dim=-1)
    ends = poses[[1, 1]].clone()
    ends[:, :, 3] += torch.tensor([[1.0], [-1.0]]) * poses[1, :, 1]
    keys = KeyPoses(torch.cat([poses[:1], ends, poses[2:]]), torch.tensor([0.5, 0.5, 39.5, 0.5]), (1, 2, 1))
    focal, center = torch.full((3, 2), 20.0), torch.tensor([[6.0, 20.0]]).repeat(3, 1)
    return Cameras(poses, focal, center, torch.zeros(3, 4), WIDTH, HEIGHT, key_poses=keys)


def line_camera() -> Cameras:
    """The line camera alone, with a lens that bends."""
    return replace(cameras()[1], distortion=torch.tensor([[0.1, -0.02, 0.001, 0.002]]))


def refinement(lens: str = "fixed", size: float = 0.04, pixel_size: float = 0.1) -> PoseRefinement:
    own, knots = cameras(), Knots.of(cameras())
    found = PoseRefinement(knots.rows, lens)  # type: ignore[arg-type]
    found.begin(knots.positions(own), box_around(MIDDLE), pixel_size)
    with torch.no_grad():
        found.steps.copy_(size * torch.randn(found.steps.shape, generator=torch.Generator().manual_seed(1)))
        count = {"fixed": 0, "focal": 1, "radial": 3}[lens]
        found.lens.steps[:count] = torch.tensor([0.05, -0.08, 0.03])[:count]
    return found


def corrections(poses: PoseRefinement) -> torch.Tensor:
    """By how much the cameras are turned and moved at the knots."""
    return (poses.free_steps() * poses.scale[:, None]).detach()


def some_pixels(view: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(view)
    coords = torch.rand(50, 2, generator=generator) * torch.tensor([WIDTH, HEIGHT])
    return torch.full((50,), view), coords
