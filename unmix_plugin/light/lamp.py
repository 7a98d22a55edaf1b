"""A lamp that moves with the camera, as seen from the object: where it is.

Where an object is turned before a fixed camera and lamp, the middle of the turntable, its axis and the camera span a
frame in which the lamp keeps its place. The frame follows from where a ray starts, so any new camera has its lamp too.

Notation: `R` rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

_PACE = 0.4
"""Shift of the lamp, in its first distance, for a change of its parameter by 1."""
LampFrame = Literal["turntable", "camera"]
LAMP_FRAMES: tuple[LampFrame, ...] = ("turntable", "camera")
Triple = tuple[float, float, float]


def moving_axes(
    origins: Float[Tensor, "R 3"], middle: Float[Tensor, "3"], axis: Float[Tensor, "3"], frame: LampFrame
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
    """Unit vectors to the right, up and towards the camera of the frame of rays that start at `origins`."""
    axis = axis.expand_as(origins)
    back = normalize(origins - middle, dim=-1)
    right = normalize(torch.linalg.cross(axis, back), dim=-1)
    if frame == "turntable":
        back = torch.linalg.cross(right, axis)
    return right, torch.linalg.cross(back, right), back


@dataclass(frozen=True)
class Lamp:
    """Where the lamp is in a scene that is turned in front of its camera, model space."""

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
        return (float(LAMP_FRAMES.index(self.frame)), *self.middle, *self.axis, *self.place)

    @staticmethod
    def of_numbers(numbers: Sequence[float]) -> Lamp:
        """The lamp of ten numbers; the axis may have any length but 0."""
        middle, axis, place = ((numbers[i], numbers[i + 1], numbers[i + 2]) for i in (1, 4, 7))
        x, y, z = (part / math.hypot(*axis) for part in axis)
        return Lamp(LAMP_FRAMES[int(numbers[0])], middle, (x, y, z), place)


class MovingLamp(nn.Module):
    """A lamp whose place training refines."""

    middle: Tensor
    axis: Tensor
    first_place: Tensor

    def __init__(self, lamp: Lamp) -> None:
        """Start where a lamp is."""
        super().__init__()
        self.frame: LampFrame = lamp.frame
        for name, values in (("middle", lamp.middle), ("axis", lamp.axis), ("first_place", lamp.place)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32))
        self.change = nn.Parameter(torch.zeros(3))

    def positions(self, origins: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        """Where the lamp stands for rays that start at `origins`."""
        right, up, back = moving_axes(origins, self.middle, self.axis, self.frame)
        place = self.first_place + _PACE * self.first_place.norm() * self.change
        return self.middle + place[0] * right + place[1] * up + place[2] * back
