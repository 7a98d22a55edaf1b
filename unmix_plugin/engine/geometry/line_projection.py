"""Which row of a line camera sees a point: the one whose line passes through it.

Notation: `P` points, `y` height in the image in pixels.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.key_poses import KeyPoses

_MOST_STRIPES = 400
"""Stripes of the image that are looked through for a point; within one, points move evenly in the camera's axes."""

_CHUNK = 1 << 14
"""Points looked up at once."""


def project_by_row(
    points: Float[Tensor, "P 3"], keys: KeyPoses, num_rows: int
) -> tuple[Float[Tensor, " P"], Float[Tensor, "P 3"]]:
    """The height at which each point is first seen, and where it lies in the camera's axes then.

    Args:
        keys: Of one line camera.
        num_rows: Rows of its image.
    Returns:
        y in [0, num_rows], and positions in the camera's axes; a point that no row sees has z = 1, behind the camera.
    """
    num_stripes = min(num_rows, _MOST_STRIPES)
    heights = torch.linspace(0, num_rows, num_stripes + 1, device=points.device)
    poses = keys.at(torch.zeros_like(heights, dtype=torch.int64), heights)
    stripes, found = _first_stripes(points, poses)
    seen = found.nonzero()[:, 0]
    start, end = (_local(points[seen], poses[stripes[seen] + side]) for side in (0, 1))
    change = end[:, 1] - start[:, 1]
    share = torch.where(change == 0, 0.5, -start[:, 1] / torch.where(change == 0, 1.0, change)).clamp(0, 1)
    y, local = torch.zeros_like(points[:, 0]), torch.ones_like(points)
    y[seen] = (stripes[seen] + share) * (num_rows / num_stripes)
    local[seen] = start + share[:, None] * (end - start)
    return y, local


def _first_stripes(
    points: Float[Tensor, "P 3"], poses: Float[Tensor, "n 3 4"]
) -> tuple[Int[Tensor, " P"], Bool[Tensor, " P"]]:
    """The first stripe between neighbouring poses that passes over each point, and whether there is one."""
    stripes = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    # One product gives each point's coordinate in each pose; a chunk of points keeps it small. Poses lie along the
    # first axis, so that comparing neighbours takes whole rows of memory.
    up, back = (
        (poses[:, :, axis], (poses[:, :, 3] * poses[:, :, axis]).sum(dim=1, keepdim=True)) for axis in (1, 2)
    )
    count = len(poses) - 1
    left = torch.arange(count, 0, -1, dtype=torch.int16, device=points.device)[:, None]
    for first in range(0, len(points), _CHUNK):
        chosen = points[first : first + _CHUNK].T.contiguous()
        is_above, is_before = up[0] @ chosen > up[1], back[0] @ chosen < back[1]
        passes = (is_above[1:] ^ is_above[:-1]) & is_before[1:] & is_before[:-1]
        stripes[first : first + _CHUNK] = count - (passes * left).amax(dim=0).long()
    return stripes.clamp(max=count - 1), stripes < count


def _local(points: Float[Tensor, "P 3"], poses: Float[Tensor, "P 3 4"]) -> Float[Tensor, "P 3"]:
    """Points in the axes of their poses."""
    return torch.einsum("pi,pij->pj", points - poses[:, :, 3], poses[:, :, :3])
