"""What a training does with poses that are corrected, step by step; nothing where they are taken as they are.

The levels of the field's grid join in the coarse part of the training, a little after whose start poses begin to move;
at its end space is carved by the corrected cameras, and line cameras are registered later. Then these learn the
scene anew: it keeps some of what it learnt from poses that were off. Frames, whose poses settle sooner, gain nothing by
that.

Notation: `X x Y x Z` cells of the occupancy grid.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.data_manager import DataManager
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.processes.processes import Processes
from unmix_plugin.field import CoefficientField, UnmixField
from unmix_plugin.losses.batch_comparison import BatchComparison
from unmix_plugin.poses.line_cameras import LineCameras
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.poses.settings import PoseConfig
from unmix_plugin.spectral.materials import Coefficients, Materials


class PoseTraining:
    """How far the refinement of poses has come."""

    def __init__(self, config: PoseConfig, poses: PoseRefinement | None) -> None:
        """`poses` is None where they are taken as they are."""
        self._config, self._poses = config, poses
        self._lines = LineCameras(() if poses is None else poses.knots.rows)
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

    def begins_anew(self, step: int, progress: float) -> bool:
        """Whether the scene is to be learnt anew: line cameras were registered to it, and it was not done before."""
        if self._poses is None or not self._lines.views or self.has_begun_anew:
            return False
        return self._config.begins_anew(step, progress) and bool(self._poses.is_found.any())

    def begin_anew(self, progress: float) -> None:
        """Note that the scene is learnt anew from that part of the training on."""
        assert self._poses is not None
        self._poses.begin_anew(progress)

    @property
    def has_begun_anew(self) -> bool:
        """Whether the scene was begun anew."""
        return self._poses is not None and self._poses.began_anew_at < 1

    def scene_progress(self, progress: float) -> float:
        """How far the scene is on its way, [0, 1], at that part of the training."""
        if self._poses is None or not self.has_begun_anew:
            return progress
        start = self._poses.began_anew_at
        return max((progress - start) / (1 - start), 0.0)

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

    def settled(self, cameras: Cameras) -> Cameras | None:
        """The corrected cameras, once, when the levels of the grid have joined."""
        if self._poses is None or self._poses.is_settled or not self._is_fine:
            return None
        return self._poses.refined(cameras)

    def settle(self) -> None:
        """Note that the scene was judged by the corrected cameras."""
        assert self._poses is not None
        self._poses.settle()

    def is_to_register(self, step: int, progress: float) -> bool:
        """Whether there are line cameras, and it is time to register them to the scene."""
        return bool(self._lines.views) and self._config.registers(step, progress)

    def register(
        self,
        data: DataManager,
        box: SceneBox,
        composite: Callable[[RayBundle], Coefficients],
        materials: Materials,
        comparison: BatchComparison,
        processes: Processes,
    ) -> None:
        """Register line cameras to the scene."""
        assert self._poses is not None
        self._lines.register(self._poses, data, box, composite, materials, comparison.through)
        self._poses.agree(processes)

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
