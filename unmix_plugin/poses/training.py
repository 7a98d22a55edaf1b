"""What a training does with poses that are corrected, step by step; nothing where they are taken as they are.

The levels of the field's grid join in the coarse part of the training, a little after whose start poses begin to move;
at its end space is carved by the corrected cameras.

Notation: `X x Y x Z` cells of the occupancy grid.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.processes import Processes
from unmix_plugin.field import CoefficientField, UnmixField
from unmix_plugin.losses.batch_comparison import BatchComparison
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.poses.settings import PoseConfig
from unmix_plugin.spectral.materials import Materials


@runtime_checkable
class CarvesAgain(Protocol):
    """Data with masks by which space can be carved."""

    train_cameras: Cameras

    def carved_by(self, cameras: Cameras) -> Bool[Tensor, "X Y Z"] | None:
        """Cells that may hold something, if the training views stand there; None where that is not known."""
        ...


class PoseTraining:
    """How far the refinement of poses has come."""

    def __init__(self, config: PoseConfig, poses: PoseRefinement | None) -> None:
        """`poses` is None where they are taken as they are."""
        self._config, self._poses = config, poses
        self._fineness = 0.0

    def begin(
        self, initial_data: Mapping[str, np.ndarray], box: SceneBox, pixel_size: float
    ) -> Bool[Tensor, "X Y Z"]:
        """Take in where the cameras stand, and say which cells can be reached at first: poses that are off carve away
        what is there."""
        reachable = torch.from_numpy(initial_data["reachable"])
        if self._poses is None:
            return reachable
        self._poses.begin(torch.from_numpy(initial_data["knots"]), box, pixel_size)
        return torch.ones_like(reachable)

    def begin_step(self, step: int, progress: float, field: CoefficientField) -> None:
        """Let as many levels of the field's grid join as it is time for."""
        self._fineness = self._config.fineness(step, progress)
        if isinstance(field, UnmixField) and field.level_weights is not None:
            levels = self._config.level_weights(len(field.level_weights), self._fineness)
            field.level_weights.copy_(torch.tensor(levels))

    def end_step(self) -> None:
        """Give views that lost their way their poses back."""
        if self._poses is not None:
            self._poses.undo_runaways(is_final=self._is_fine)

    def carved(self, data: object) -> Bool[Tensor, "X Y Z"] | None:
        """Once, when the levels of the grid have joined: what can't be carved away by the corrected cameras."""
        if (
            self._poses is None
            or self._poses.is_settled
            or not self._is_fine
            or not isinstance(data, CarvesAgain)
        ):
            return None
        self._poses.settle()
        return data.carved_by(self._poses.refined(data.train_cameras))

    def corrected(self, rays: RayBundle) -> RayBundle:
        """Training rays as their corrected cameras send them."""
        if self._poses is None or self._fineness < self._config.start:
            return rays
        return self._poses(rays)

    def believed(self, outputs: dict[str, Tensor], rays: RayBundle) -> dict[str, Tensor]:
        """Outputs of training rays, which shape the scene as far as their poses are believed."""
        return self._poses.believed(outputs, rays) if self._poses is not None and self._is_fine else outputs

    def observe(
        self,
        outputs: dict[str, Tensor],
        batch: dict[str, Tensor],
        comparison: BatchComparison,
        materials: Materials,
    ) -> None:
        """Note how well pixels fit, as far as it tells of their poses."""
        if self._poses is not None and "knots" in outputs:
            parts = comparison.parts(outputs, batch, materials)
            self._poses.trust.observe(*comparison.errors_of_poses(parts))

    def judge(self, processes: Processes) -> None:
        """Decide which poses are believed."""
        if self._poses is not None and self._is_fine:
            self._poses.trust.judge(processes)

    def penalty(self) -> dict[str, Float[Tensor, ""]]:
        """What large and rough corrections cost, as `poses`; nothing where none are made."""
        return {} if self._poses is None else {"poses": self._poses.penalty(self._config)}

    def figures(self) -> dict[str, Tensor]:
        """How far poses were corrected; nothing where they are not."""
        return {} if self._poses is None else self._poses.figures()

    @property
    def _is_fine(self) -> bool:
        """Whether the coarse part is over."""
        return self._fineness >= 1
