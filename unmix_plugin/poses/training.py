"""What a training does with poses that are corrected, step by step.

The levels of the field's grid join in the coarse part of the training, a little after whose start poses begin to move;
at its end space is carved by the corrected cameras.

Notation: `X x Y x Z` cells of the occupancy grid, `N` rays, `M` knots of all views.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.engine.model import DataManager
from unmix_plugin.engine.processes import Processes
from unmix_plugin.field import CoefficientField, GridField
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.settings import PoseConfig


@runtime_checkable
class _CarvesAgain(Protocol):
    """Data with masks by which space can be carved."""

    def carved_by(self, cameras: Cameras) -> Bool[Tensor, "X Y Z"] | None:
        """Cells that may hold something, if the training views stand there; None where that is not known."""
        ...


@dataclass(frozen=True)
class CorrectedRays:
    """Training rays as their corrected cameras send them, and the corrections, computed once a step."""

    rays: RayBundle
    steps: Float[Tensor, "M 6"] | None = None
    """`PoseRefinement.free_steps`; None where poses are taken as they are."""
    knots: Int[Tensor, "N"] | None = None
    """Nearest to each ray; None while the grid is coarse."""
    weights: Float[Tensor, "N"] | None = None
    """By which rays shape the scene: less where their pose is an outlier."""


def fineness(config: PoseConfig, step: int, progress: float) -> float:
    """How much of the coarse part is over in [0, 1], after some steps and that part of the training.

    >>> fineness(PoseConfig(coarse_until=0.3, coarse_steps=900), 100, 0.15)
    0.5
    """
    if progress >= config.coarse_until or step >= config.coarse_steps:
        return 1.0
    return max(progress / config.coarse_until, step / config.coarse_steps)


def level_weights(num_levels: int, part: float) -> list[float]:
    """Weights in [0, 1] of a grid's levels when that part of the coarse training is over.

    >>> level_weights(4, 0.25)
    [1.0, 0.853553390593, 0.0, 0.0]
    """
    joined = [min(max(1 + part * (num_levels - 1) - level, 0.0), 1.0) for level in range(num_levels)]
    return [1.0 if x == 1 else round(0.5 - 0.5 * math.cos(math.pi * x), 12) for x in joined]


class PoseTraining:
    """How far the refinement of poses has come."""

    def __init__(self, config: PoseConfig, poses: PoseRefinement) -> None:
        self._config, self._poses = config, poses
        self._cameras: Cameras | None = None
        self._is_carved = False
        self._fineness = 0.0

    def begin_step(self, step: int, progress: float, field: CoefficientField) -> None:
        """Let as many levels of the field's grid join as it is time for."""
        self._fineness = fineness(self._config, step, progress)
        if isinstance(field, GridField) and field.level_weights is not None:
            levels = level_weights(len(field.level_weights), self._fineness)
            field.level_weights.copy_(torch.tensor(levels))

    def end_step(self) -> None:
        """Give views that lost their way their poses back."""
        self._poses.restore_best(is_final=self._is_fine)

    def between_steps(self, data: DataManager) -> Bool[Tensor, "X Y Z"] | None:
        """Know the cameras; and once, when the levels of the grid have joined, what these can't carve away."""
        if self._cameras is None:
            self._cameras = data.train_cameras.to(self._poses.steps.device)
            self._is_carved = bool(self._poses.carved)  # once: reading it from a GPU takes time
        if self._is_carved or not self._is_fine or not isinstance(data, _CarvesAgain):
            return None
        self._is_carved = True
        self._poses.carved.fill_(True)
        return data.carved_by(self._poses.refined(data.train_cameras))

    def corrected(self, rays: RayBundle) -> CorrectedRays:
        """Training rays as their corrected cameras send them."""
        steps = self._poses.free_steps()
        if self._fineness < self._config.start:
            return CorrectedRays(rays, steps)
        knots = self._poses.nearest_knots(rays)
        weights = self._poses.robust.weights[knots]
        moved = self._poses(rays, self._cameras, steps, 1 / weights)
        return CorrectedRays(moved, steps, knots, weights) if self._is_fine else CorrectedRays(moved, steps)

    def update_weights(self, processes: Processes) -> None:
        """Decide which poses are outliers."""
        if self._is_fine:
            self._poses.robust.judge(processes)

    @property
    def _is_fine(self) -> bool:
        """Whether the coarse part is over."""
        return self._fineness >= 1
