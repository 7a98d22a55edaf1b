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
    register_from: float = 0.6
    """Part of the training after which line cameras are registered to the scene row by row; 1 leaves them to
    gradients, which move poses and scene together until then."""
    register_every: float = 0.1
    """Part of the training after which they are registered anew."""
    register_steps: int = 100
    """Steps after which they are registered anew at the earliest: it takes as long as hundreds of steps."""
    anew_from: float = 0.6
    """Part of the training after which line cameras, once registered, learn the scene anew, since it keeps some of what
    it learnt from poses that were off; 1: never."""

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
            "register-from in [0, 1]": 0 <= self.register_from <= 1,
            "register-every in [0.001, 1]": 0.001 <= self.register_every <= 1,
            "register-steps of at least 1": self.register_steps >= 1,
            "anew-from in [0, 1]": 0 <= self.anew_from <= 1,
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

    def begins_anew(self, step: int, progress: float) -> bool:
        """Whether the scene is to be learnt anew before a step, unless that was done before.

        Registration takes its time: where it took more than half of what was left, a new scene would come too late.
        """
        first = max(self.anew_from, self.register_from)
        is_enough_left = 1 - progress >= 0.5 * (1 - first)
        return first <= progress < 1 and is_enough_left and self.fineness(step, progress) >= 1

    def registers(self, step: int, progress: float) -> bool:
        """Whether line cameras are registered before a step, at that part of the training; not before `coarse_steps`,
        when a scene shows little.

        >>> config = PoseConfig(coarse_steps=100, register_from=0.2, register_every=0.1)
        >>> [step for step in range(1000) if config.registers(step, step / 1000)]
        [200, 300, 400, 500, 600, 700, 800, 900]
        """
        if step < max(self.coarse_steps, 1) or self.fineness(step, progress) < 1:
            return False
        every = max(self.register_every, self.register_steps * progress / step)
        rounds, before = (
            math.floor((part - self.register_from) / every + 1e-9)
            for part in (progress, progress * (step - 1) / step)
        )
        return rounds >= 0 and rounds > before

    def level_weights(self, num_levels: int, share: float) -> list[float]:
        """Weights in [0, 1] of a grid's levels when that share of the coarse part is over.

        >>> PoseConfig().level_weights(4, 0.25)
        [1.0, 0.853553390593, 0.0, 0.0]
        """
        joined = [min(max(1 + share * (num_levels - 1) - level, 0.0), 1.0) for level in range(num_levels)]
        return [1.0 if x == 1 else round(0.5 - 0.5 * math.cos(math.pi * x), 12) for x in joined]
