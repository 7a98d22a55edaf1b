"""Light of few parameters: a lamp of a sharp and a soft part, before a sky of seven wide patches.

It is what shading can tell of a light, and what can be fitted together with materials. Radiance is relative to the
lamp's spectrum: one number of each direction.

Notation: `H x W` pixels of a map, `D` directions, `M` patches of sky, `L` parts of the lamp.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.neumatex.tracing.environment import directions_of_pixels, solid_angles

NUM_PATCHES = 7
"""M: even light, and light from both ends of each axis."""
SHARP_DEG, SOFT_DEG = 2.5, 14.0
"""Standard deviations of the lamp's parts: a bulb or the sun; a softbox or the glow about the sun."""
NUM_PARTS = 2
"""L."""
_HEIGHT = 64
"""Rows of the map."""


def sky_patches(directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n M"]:
    """Radiance of each patch of sky: even light, then the cosines to both ends of each axis."""
    both = torch.cat([directions, -directions], dim=-1).clamp(min=0)
    return torch.cat([torch.ones_like(both[..., :1]), both], dim=-1)


@dataclass(frozen=True)
class LampAndSky:
    """A light; differentiable by all its numbers."""

    towards: Float[Tensor, "3"]
    """Direction of the lamp in the world; of any length."""
    widths_deg: Float[Tensor, " L"]
    """Standard deviations of the parts of the lamp."""
    lamp: Float[Tensor, " L"]
    """What a white surface that faces the lamp reads by each part."""
    sky: Float[Tensor, " M"]
    """Radiance of each patch."""

    def radiance(self) -> Float[Tensor, "H W 1"]:
        """Of every direction, as an environment's picture."""
        directions = directions_of_pixels(_HEIGHT, 2 * _HEIGHT).to(self.sky)
        cosines = directions @ normalize(self.towards, dim=0)
        facing = cosines.clamp(min=0) * solid_angles(_HEIGHT, 2 * _HEIGHT).to(self.sky)[:, None]
        found = sky_patches(directions) @ self.sky
        for power, width in zip(self.lamp, torch.deg2rad(self.widths_deg), strict=True):
            lobe = ((cosines - 1) / width.square()).exp()
            # A white surface sends back what arrives over pi.
            found = found + power * math.pi * lobe / (lobe * facing).sum()
        return found[..., None]

    def white_facing_the_lamp(self) -> Float[Tensor, ""]:
        """What a white surface reads that faces the lamp."""
        directions = directions_of_pixels(_HEIGHT, 2 * _HEIGHT).to(self.sky)
        facing = (directions @ normalize(self.towards, dim=0)).clamp(min=0)
        facing = facing * solid_angles(_HEIGHT, 2 * _HEIGHT).to(self.sky)[:, None]
        return self.lamp.sum() + (sky_patches(directions) @ self.sky * facing).sum() / math.pi

    def to_json(self) -> dict[str, list[float]]:
        """As JSON-able values."""
        return {name: values.double().tolist() for name, values in vars(self).items()}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> LampAndSky:
        """What `to_json` wrote. Raises ValueError, KeyError, TypeError: it is something else."""
        sizes = {"towards": 3, "widths_deg": NUM_PARTS, "lamp": NUM_PARTS, "sky": NUM_PATCHES}
        found = {name: torch.tensor(values[name], dtype=torch.float32) for name in sizes}
        is_sound = all(tuple(found[name].shape) == (size,) for name, size in sizes.items())
        if not is_sound or not all(bool(each.isfinite().all()) for each in found.values()):
            raise ValueError(f"a lamp and sky needs {sizes} finite numbers")
        return LampAndSky(**found)

    def to_tensor(self) -> Float[Tensor, " n"]:
        """All numbers, one after the other."""
        return torch.cat([self.towards, self.widths_deg, self.lamp, self.sky])

    @staticmethod
    def from_tensor(numbers: Float[Tensor, " n"]) -> LampAndSky:
        """What `to_tensor` gave."""
        return LampAndSky(*numbers.split([3, NUM_PARTS, NUM_PARTS, NUM_PATCHES]))
