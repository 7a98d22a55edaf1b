"""A line camera that sweeps over a textured disc whose pictures are known exactly."""

from __future__ import annotations

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.poses.line_registration.swept_view import SweptView, columns_compared, rays_through

ROWS = 64
_WIDTH, _FOCAL_PX, _HEIGHT = 48, 60.0, 2.0
_SWEEP = 2.0
RADIUS = 0.8


def show(rays: RayBundle) -> Float[Tensor, "R 3"]:
    """Two smooth textures and the opacity of a disc at z = 0."""
    along = -rays.origins[:, 2] / rays.directions[:, 2]
    x, y = (rays.origins + along[:, None] * rays.directions)[:, :2].T
    opacity = ((RADIUS - torch.stack([x, y]).norm(dim=0)) * 40).sigmoid()
    first = 0.5 + 0.25 * torch.sin(9 * x) * torch.cos(7 * y) + 0.15 * torch.sin(5 * x + 4 * y)
    second = 0.5 + 0.3 * torch.cos(8 * y - 3 * x)
    return torch.stack([first * opacity, second * opacity, opacity], dim=1)


def swept(true_steps: Float64[Tensor, "n 6"] | None = None) -> SweptView:
    """A sweep down the y axis, measured from where `true_steps` lead; None: from where its poses say."""
    heights = torch.arange(ROWS) + 0.5
    poses = torch.eye(3, 4).repeat(ROWS, 1, 1)
    poses[:, 1, 3] = _SWEEP * (0.5 - heights / ROWS)
    poses[:, 2, 3] = _HEIGHT
    camera = Cameras(
        poses[ROWS // 2, None],
        torch.full((1, 2), _FOCAL_PX),
        torch.tensor([[_WIDTH / 2, ROWS / 2]]),
        torch.zeros(1, 4),
        _WIDTH,
        ROWS,
        key_poses=KeyPoses(poses, heights, (ROWS,)),
    )
    columns = columns_compared(_WIDTH, ROWS, 10**6)
    rays = rays_through(camera, 0, columns)
    empty = torch.zeros(ROWS, _WIDTH, 3)
    counts = torch.ones(ROWS, _WIDTH, 1)
    view = SweptView(rays, empty, counts, heights, ROWS, _HEIGHT, 1 / _FOCAL_PX, show, has_opacity=True)
    steps = torch.zeros(view.num_knots, 6).double() if true_steps is None else true_steps
    view.wanted.copy_(view.shown(view.at_rows(steps)[None], slice(0, ROWS))[0])
    return view


def wobble(size_px: float) -> Float64[Tensor, "n 6"]:
    """Turns about the camera's x and y axes, waves of that size."""
    view = swept()
    place = torch.linspace(0, 1, view.num_knots).double()
    steps = torch.zeros(view.num_knots, 6).double()
    steps[:, 0] = size_px * view.pixel * torch.sin(7 * place)
    steps[:, 1] = size_px * view.pixel * torch.cos(9 * place)
    return steps


def error(view: SweptView, steps: Float64[Tensor, "n 6"]) -> float:
    """Root mean squared, of all pixels."""
    found = view.residuals(view.at_rows(steps)[None], slice(0, ROWS))
    return float(found.square().mean().sqrt())
