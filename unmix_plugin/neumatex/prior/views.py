"""Posed pictures of an object, as a prior wants them.

Notation: `V` views of `H` x `W` pixels. Cameras are in model space, where the mesh lies in [-1, 1]^3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras


@dataclass(frozen=True)
class PosedViews:
    """Pictures with their cameras; sizes may differ."""

    cameras: Cameras
    """V of them, in model space."""
    pictures: Sequence[Float[Tensor, "H W 3"]]
    """Linear radiance in the unit of the environment, not multiplied by alpha; a tone curve is undone before."""
    alphas: Sequence[Float[Tensor, "H W"]]
    """1 where the object is, 0 beside it; observations below 0.9 are not used."""

    def __post_init__(self) -> None:
        counts = (len(self.cameras), len(self.pictures), len(self.alphas))
        if len(set(counts)) > 1 or counts[0] == 0:
            raise ValueError(
                "PosedViews needs as many pictures and alphas as cameras, at least one; got "
                f"{counts[1]} pictures and {counts[2]} alphas for {counts[0]} cameras"
            )

    def __getitem__(self, indices: list[int]) -> PosedViews:
        """Some of the views, in the order asked for."""
        chosen = [self.pictures[index] for index in indices], [self.alphas[index] for index in indices]
        return PosedViews(self.cameras[indices], *chosen)


def well_spread(positions: Float[Tensor, "V 3"], count: int) -> list[int]:
    """Which cameras to take: the first, then always the one that is farthest in direction from all taken.

    Args:
        positions: Of the cameras, model space; directions are from the origin.
        count: How many at most.
    Returns:
        Distinct indices, in increasing order.
    """
    directions = torch.nn.functional.normalize(positions, dim=-1)
    chosen = [0]
    nearest = directions @ directions[0]
    while len(chosen) < min(count, len(positions)):
        nearest[chosen] = torch.inf
        chosen.append(int(nearest.argmin()))
        nearest = torch.maximum(nearest, directions @ directions[chosen[-1]])
    return sorted(chosen)
