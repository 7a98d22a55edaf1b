"""Small objects and cameras for the tests of the prior."""

import torch

from unmix_plugin.engine.geometry.cameras import Cameras


def ring(count: int, size: int, distance: float = 4.0) -> Cameras:
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
