"""Rotation vectors and rotation matrices.

Notation: `w` is a rotation vector: its direction is the axis, its length the angle in radians.

Source: Rodrigues' formula; see Sola et al. 2018, A micro Lie theory for state estimation in robotics, example 4.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_SMALL = 1e-6
"""Squared angle below which series replace the closed forms."""


def rotation_matrix(w: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """exp([w]x); differentiable everywhere, also at 0."""
    squared = (w * w).sum(dim=-1)[..., None, None]
    is_small = squared < _SMALL
    safe = torch.where(is_small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(is_small, 1 - squared / 6, angle.sin() / angle)
    second = torch.where(is_small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    cross = cross_matrix(w)
    return torch.eye(3, dtype=w.dtype, device=w.device) + first * cross + second * (cross @ cross)


def rotation_vector(matrix: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """The inverse of `rotation_matrix` for angles below pi."""
    skew = 0.5 * (matrix - matrix.transpose(-1, -2))
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    sine = axis.norm(dim=-1, keepdim=True)
    cosine = 0.5 * (matrix.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True) - 1)
    angle = torch.atan2(sine, cosine)
    return axis * torch.where(sine * sine < _SMALL, 1 + angle * angle / 6, angle / sine.clamp(min=1e-12))


def cross_matrix(w: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """[w]x, with which a product is the cross product by w."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
