"""What of a lamp's light reaches samples, past what stands in its way.

It is looked up in a grid of opaque cells, for two points beside the lamp's middle: the mean of both is a soft shadow,
and their difference tells training where to move the lamp.

Notation: `S` samples, `X Y Z` cells of a grid over the scene box.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.light.lamp import MovingLamp
from unmix_plugin.light.shading import Lamplight
from unmix_plugin.operators.marching import count_samples


@dataclass(frozen=True)
class ShadowDetail:
    """How sharp shadows are. Surfaces are thick while they form, and so are their shadows."""

    clear_cells: float
    """Way from a place towards the lamp, in cells, that casts no shadow: a surface would else lie in its own."""
    dark_cells: float
    """Opaque cells on the way to the lamp that leave 1 / e of its light."""
    spread: float
    """Standard deviation of the points beside the lamp's middle along each axis, in its distance."""

    @staticmethod
    def at(progress: float) -> ShadowDetail:
        """When that part of the training is over, from 0 to 1; each number changes by equal factors."""
        ends = zip(astuple(_FIRST), astuple(FINEST), strict=True)
        return ShadowDetail(*(first * (last / first) ** progress for first, last in ends))


_FIRST = ShadowDetail(clear_cells=8.0, dark_cells=5.0, spread=0.05)
FINEST = ShadowDetail(clear_cells=3.0, dark_cells=2.0, spread=0.02)
"""At the end of training, and in renders."""


def lamplight(
    lamp: MovingLamp,
    origins: Float[Tensor, "S 3"],
    positions: Float[Tensor, "S 3"],
    box: SceneBox,
    skips: UInt8[Tensor, "X Y Z"],
    detail: ShadowDetail = FINEST,
    generator: torch.Generator | None = None,
) -> Lamplight:
    """What of a lamp's light reaches samples of rays from `origins`.

    Only the visible part is differentiable in the lamp's place: shading would move it to where wrong normals want it.

    Args:
        skips: 0 in the cells of the box that cast shadows; in others what `skip_distances` says.
        detail: How sharp they are.
        generator: Draws two points beside the lamp's middle for each sample; None takes four fixed ones.
    """
    origins, positions = origins.detach(), positions.detach()
    middle = lamp.positions(origins)
    fixed, spread = middle.detach(), detail.spread * float(lamp.first_place.norm())
    towards = normalize(fixed - positions, dim=-1)
    if generator is None:
        corners = spread * positions.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
        parts = [visible_part(positions, fixed + corner, box, skips, detail) for corner in corners]
        return Lamplight(torch.stack(parts).mean(dim=0), towards)
    drawn = torch.randn(positions.shape, generator=generator, device=generator.device)
    offsets = spread * drawn.to(positions)
    one, other = (visible_part(positions, fixed + shift, box, skips, detail) for shift in (offsets, -offsets))
    # Stein's identity: the mean of these slopes is the gradient of the visible part, blurred over the points.
    slopes = ((one - other) / (2 * spread**2))[:, None] * offsets
    return Lamplight((one + other) / 2 + (slopes * (middle - fixed)).sum(dim=-1), towards)


@torch.no_grad()
def visible_part(
    positions: Float[Tensor, "S 3"],
    lamps: Float[Tensor, "S 3"],
    box: SceneBox,
    skips: UInt8[Tensor, "X Y Z"],
    detail: ShadowDetail = FINEST,
) -> Float[Tensor, "S"]:
    """Part of the light from points outside the box that the box lets through to each position."""
    towards = normalize(lamps - positions, dim=-1)
    cell = float((box.size / torch.tensor(skips.shape, device=box.size.device)).max())
    t_far = box.intersect(positions, towards)[1]
    t_near = torch.full_like(t_far, detail.clear_cells * cell)
    counts = count_samples(box.normalise(positions), towards / box.size, t_near, t_far, skips, cell)
    return torch.exp(-(counts / detail.dark_cells).square())
