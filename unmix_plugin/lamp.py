"""A lamp that moves with the camera, as seen from the object: where it stands, and what of a scene it reaches.

Where an object is turned before a fixed camera and lamp, the middle of the turntable, its axis and the camera span a
frame in which the lamp keeps its place. The frame follows from where a ray starts, so any new camera has its lamp too.
What stands between a sample and the lamp is looked up in a grid of opaque cells, for two points beside the lamp's
middle: the mean of both is a soft shadow, and their difference tells training where to move the lamp.

Notation: `R` rays, `S` samples, `X Y Z` cells of a grid over the scene box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import normalize

from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.rendering.marching import count_samples

CLEAR_CELLS = 8.0
"""Way from a place towards the lamp, in cells, that casts no shadow: surfaces are as thick as that while they form."""
DARK_CELLS = 5.0
"""Opaque cells on the way to the lamp that leave 1 / e of its light."""
_SPREAD = 0.05
"""Standard deviation of the points beside the lamp's middle along each axis, in its distance."""
_PACE = 0.4
"""Shift of the lamp, in its first distance, for a change of its parameter by 1."""
SHADOW_LOGIT = 2.0
"""What a shadow takes off the logit of brightness before training learns it for each place."""
LampFrame = Literal["turntable", "camera"]
_FRAMES: tuple[LampFrame, ...] = ("turntable", "camera")
NUM_LAMP_NUMBERS = 10
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Lamp:
    """Where the lamp stands of a scene that is turned before its camera, model space."""

    frame: LampFrame
    """Whether the lamp only turns about the axis with the camera, or also goes up and down with it."""
    middle: Triple
    """A point on the axis that cameras look at."""
    axis: Triple
    """Unit vector upwards along the axis."""
    place: Triple
    """From the middle: to the camera's right, up (along the axis in a turntable's frame), and towards the camera."""

    def numbers(self) -> tuple[float, ...]:
        """Ten numbers: 0 for a turntable's frame or 1 for the camera's, then the three points."""
        return (float(_FRAMES.index(self.frame)), *self.middle, *self.axis, *self.place)

    @staticmethod
    def of_numbers(numbers: Sequence[float]) -> Lamp:
        """The lamp of ten numbers."""
        middle, axis, place = ((numbers[i], numbers[i + 1], numbers[i + 2]) for i in (1, 4, 7))
        return Lamp(_FRAMES[int(numbers[0])], middle, axis, place)


class MovingLamp(nn.Module):
    """A lamp whose place training refines."""

    middle: Tensor
    axis: Tensor
    first_place: Tensor

    def __init__(self, lamp: Lamp) -> None:
        """
        Args:
            lamp: Where training starts.
        """
        super().__init__()
        self.frame: LampFrame = lamp.frame
        for name, values in (("middle", lamp.middle), ("axis", lamp.axis), ("first_place", lamp.place)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32))
        self.change = nn.Parameter(torch.zeros(3))

    def positions(self, origins: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        """Where the lamp stands for rays that start at `origins`."""
        axis = self.axis.expand_as(origins)
        back = normalize(origins - self.middle, dim=-1)
        right = normalize(torch.linalg.cross(axis, back), dim=-1)
        if self.frame == "turntable":
            back = torch.linalg.cross(right, axis)
        up = torch.linalg.cross(back, right)
        place = self.first_place + _PACE * self.first_place.norm() * self.change
        return self.middle + place[0] * right + place[1] * up + place[2] * back


def lamp_visibility(
    lamp: MovingLamp,
    origins: Float[Tensor, "S 3"],
    positions: Float[Tensor, "S 3"],
    box: SceneBox,
    opaque: UInt8[Tensor, "X Y Z"],
    generator: torch.Generator | None = None,
) -> Float[Tensor, "S"]:
    """Part of the lamp's light that reaches samples of rays from `origins`, [0, 1]; differentiable in the lamp's place.

    Args:
        opaque: Cells of the box that cast shadows.
        generator: Draws two points beside the lamp's middle for each sample; None takes four fixed ones.
    """
    origins, positions = origins.detach(), positions.detach()
    middle = lamp.positions(origins)
    fixed, spread = middle.detach(), _SPREAD * float(lamp.first_place.norm())
    if generator is None:
        corners = spread * positions.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
        parts = [visible_part(positions, fixed + corner, box, opaque) for corner in corners]
        return torch.stack(parts).mean(dim=0)
    drawn = torch.randn(positions.shape, generator=generator, device=generator.device)
    offsets = spread * drawn.to(positions)
    one, other = (visible_part(positions, fixed + shift, box, opaque) for shift in (offsets, -offsets))
    # Stein's identity: the mean of these slopes is the gradient of the visible part, blurred over the points.
    slopes = ((one - other) / (2 * spread**2))[:, None] * offsets
    return (one + other) / 2 + (slopes * (middle - fixed)).sum(dim=-1)


@torch.no_grad()
def visible_part(
    positions: Float[Tensor, "S 3"],
    lamps: Float[Tensor, "S 3"],
    box: SceneBox,
    opaque: UInt8[Tensor, "X Y Z"],
    clear_cells: float = CLEAR_CELLS,
    dark_cells: float = DARK_CELLS,
) -> Float[Tensor, "S"]:
    """Part of the light from points outside the box that the opaque cells of the box let through to each position."""
    towards = normalize(lamps - positions, dim=-1)
    cell = float((box.size / torch.tensor(opaque.shape, device=box.size.device)).max())
    t_far = box.intersect(positions, towards)[1]
    t_near = torch.full_like(t_far, clear_cells * cell)
    counts = count_samples(box.normalise(positions), towards / box.size, t_near, t_far, opaque, cell)
    return torch.exp(-(counts / dark_cells).square())
