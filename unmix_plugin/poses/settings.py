"""How poses are refined while training."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from unmix_plugin.errors import require


@dataclass(frozen=True)
class PoseConfig:
    """How poses are refined."""

    lens: Literal["fixed", "focal", "radial"] = "fixed"
    """What of the lens that all views share is refined too: nothing, its focal length, or also k1 and k2."""
    coarse_until: float = 0.3
    """Part of the training in which the levels of the field's grid join, the coarsest first: what is fine draws poses
    to the nearest likeness. Where pictures have alpha, space is carved at its end."""
    coarse_steps: int = 900
    """Steps in which they join at most: what is coarse hardly holds poses, and they drift."""
    coarsest_resolution: int = 4
    """Cells along the scene box on the coarsest level, if the field's own has more: a pose that is off by a cell still
    finds its way."""
    start: float = 0.1
    """Part of the coarse part before which poses stay: the field must show something first."""
    penalty: float = 1e-3
    """Weight of the mean squared correction."""
    roughness: float = 1.5
    """Weight of the mean squared bend (second difference between knots) of a line camera's corrections: what carries a
    camera moves smoothly, and rows that see little follow their neighbours."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        rules = {
            "coarse-until in [0, 1]": 0 <= self.coarse_until <= 1,
            "coarsest-resolution of 2 to 4096": 2 <= self.coarsest_resolution <= 4096,
            "coarse-steps of at least 0": self.coarse_steps >= 0,
            "start in [0, 1]": 0 <= self.start <= 1,
            "a penalty of 0 to 1e6": 0 <= self.penalty <= 1e6,
            "a roughness of 0 to 1e6": 0 <= self.roughness <= 1e6,
        }
        require("pose refinement", self, rules)

    def fineness(self, step: int, progress: float) -> float:
        """How much of the coarse part is over in [0, 1], after some steps and that part of the training.

        >>> PoseConfig(coarse_until=0.3, coarse_steps=900).fineness(100, 0.15)
        0.5
        """
        if progress >= self.coarse_until or step >= self.coarse_steps:
            return 1.0
        return max(progress / self.coarse_until, step / self.coarse_steps)

    def level_weights(self, num_levels: int, share: float) -> list[float]:
        """Weights in [0, 1] of a grid's levels when that share of the coarse part is over.

        >>> PoseConfig().level_weights(4, 0.25)
        [1.0, 0.853553390593, 0.0, 0.0]
        """
        joined = [min(max(1 + share * (num_levels - 1) - level, 0.0), 1.0) for level in range(num_levels)]
        return [1.0 if x == 1 else round(0.5 - 0.5 * math.cos(math.pi * x), 12) for x in joined]
