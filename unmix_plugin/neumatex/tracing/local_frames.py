"""Frames about surface normals, in which reflectances are evaluated.

Source: Duff et al. 2017, Building an Orthonormal Basis, Revisited, JCGT 6(1).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class LocalFrames:
    """Right-handed axes, of which the third is the normal."""

    first: Float[Tensor, "M 3"]
    second: Float[Tensor, "M 3"]
    normals: Float[Tensor, "M 3"]

    @staticmethod
    def about(normals: Float[Tensor, "M 3"]) -> LocalFrames:
        """Axes that depend on unit normals alone."""
        x, y, z = normals.unbind(dim=-1)
        sign = torch.where(z < 0, -1.0, 1.0)
        a = -1 / (sign + z)
        b = x * y * a
        first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
        second = torch.stack([b, sign + y * y * a, -y], dim=-1)
        return LocalFrames(first, second, normals)

    def select(self, rows: Tensor) -> LocalFrames:
        """Some of the frames."""
        return LocalFrames(self.first[rows], self.second[rows], self.normals[rows])

    def to_local(self, vectors: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """World vectors in the frames."""
        axes = (self.first, self.second, self.normals)
        return torch.stack([(vectors * axis).sum(dim=-1) for axis in axes], dim=-1)

    def to_world(self, vectors: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """Vectors of the frames in the world, the inverse of `to_local`."""
        x, y, z = vectors[:, :1], vectors[:, 1:2], vectors[:, 2:]
        return x * self.first + y * self.second + z * self.normals
