"""The interface of a model: from rays to outputs, losses, metrics and pictures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn

from unmix_plugin.engine.configs import ModelConfig
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.outputs import Output
from unmix_plugin.engine.processes.processes import ALONE, Processes
from unmix_plugin.engine.training.callbacks import TrainingCallback
from unmix_plugin.errors import ConfigError

if TYPE_CHECKING:
    from unmix_plugin.engine.data_manager import DataManager

TrainOutputs: TypeAlias = tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]
"""Outputs, losses and metrics of one batch."""


class Model(nn.Module, ABC):
    """A scene representation with its renderer.

    The config, the scene box and the metadata alone give a model its modules and the shape of every parameter and
    buffer; the checkpoint gives the values. So a run folder renders without the data it was trained on.
    """

    outputs: tuple[Output, ...] = ()
    """What `get_outputs_for_camera` gives that can be shown. `accumulation` (opacity) and `ray_distance` (model units)
    have the meaning that they have everywhere."""

    def __init__(self, config: ModelConfig, *, scene_box: SceneBox, metadata: Mapping[str, Any]) -> None:
        """Keep the arguments, then call `populate_modules`."""
        super().__init__()
        self.config = config
        self.scene_box = scene_box
        self.metadata = metadata
        self.generator: torch.Generator | None = None
        """Source of every random draw of a training step, on the model's device, seeded by the trainer from (seed,
        step); None is torch's global one."""
        self.processes: Processes = ALONE
        """That train this model together. `next_num_rays` says what this one should have, a `count`-th of the rays of a
        step; what is learnt without gradients is made equal by the model itself."""
        self.populate_modules()

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    @abstractmethod
    def populate_modules(self) -> None:
        """Make the modules, parameters and buffers, their shapes from `config`, `scene_box` and `metadata` only."""

    def initialise(self, initial_data: Mapping[str, np.ndarray], generator: torch.Generator) -> None:
        """Fill parameters and buffers from the data manager's `initial_data`; called once when a run starts, after
        the move to the device, and never when one is loaded. `generator` is on the CPU."""

    def between_steps(self, step: int, progress: float, data: DataManager) -> Collection[str]:
        """Learn what single batches don't tell, say from whole views or from cameras that were corrected. Called
        without gradients before each training step, after the callbacks.

        Args:
            step, progress: As a `TrainingCallback` takes them.
            data: What is trained on.
        Returns:
            Names of parameter groups that were reset: the optimiser and the average of the parameters forget what they
            were. Usually none.
        """
        return ()

    @abstractmethod
    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters to train, by the name of the optimizer config that they use."""

    @abstractmethod
    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        """What is seen along the rays: tensors with one row a ray, and any others that losses or metrics use."""

    def forward(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        """`get_outputs`."""
        return self.get_outputs(ray_bundle)

    @abstractmethod
    def get_loss_dict(
        self,
        outputs: dict[str, Tensor],
        batch: dict[str, Tensor],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """Scalar losses, already weighted; training minimises their sum."""

    def get_metrics_dict(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Scalars worth following in training; `psnr` (dB) is shown in the progress display."""
        return {}

    def get_train_loss_dict(self, ray_bundle: RayBundle, batch: dict[str, Tensor]) -> TrainOutputs:
        """Outputs, losses and metrics of a training batch; a model that shares work between them writes this anew.

        The outputs go to `num_samples` and `next_num_rays` alone.
        """
        outputs = self(ray_bundle)
        metrics = self.get_metrics_dict(outputs, batch)
        losses = self.get_loss_dict(outputs, batch, metrics)
        with torch.no_grad():
            self.observe(outputs, batch)
        return outputs, losses, metrics

    @abstractmethod
    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics of one whole image, nan where there is no truth; pictures of it (height, width, 3) in sRGB [0, 1]."""

    @torch.no_grad()
    def evaluate_image(
        self, camera: Cameras, batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Render a view as `get_evaluation_outputs` does, and measure it: `get_image_metrics_and_images`."""
        return self.get_image_metrics_and_images(self.get_evaluation_outputs(camera, batch), batch)

    @torch.no_grad()
    def get_evaluation_outputs(self, camera: Cameras, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """What is measured of a view: `get_outputs_for_camera`; a model whose images need more than a camera, such as
        another light that the batch holds, renders them itself here."""
        return self.get_outputs_for_camera(camera)

    def warnings(self) -> list[str]:
        """What a user should know of the model on this scene before a training."""
        return []

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Functions to call around each step."""
        return []

    def observe(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> None:
        """Learn from a training batch what is not learnt by gradients; called after each step's losses, without
        gradients. `get_outputs` and `get_loss_dict` change nothing in the model."""

    def num_samples(self, outputs: dict[str, Tensor]) -> int:
        """Field samples behind `outputs`, for the log; 0 where a model does not count."""
        return 0

    def next_num_rays(self, outputs: dict[str, Tensor], current: int) -> int | None:
        """Rays that the next step should have, given the outputs of one with `current` rays; None leaves it."""
        return None

    def warm_up(self) -> None:
        """Compile and allocate what the first step needs, before the training clock starts; changes no parameter,
        no buffer."""

    @torch.no_grad()
    def get_outputs_for_camera(
        self, camera: Cameras, outputs: Collection[str] | None = None
    ) -> dict[str, Tensor]:
        """Render a whole image, chunk by chunk.

        Args:
            camera: One camera.
            outputs: Names to keep; None keeps every output that has one row a ray.
        Returns:
            Tensors (height, width, ...).
        Raises:
            ConfigError: a name that `get_outputs` does not give.
        """
        ray_bundle = camera.to(self.device).image_rays(0)
        chunk = self.config.eval_num_rays_per_chunk
        parts = [
            self._ray_outputs(ray_bundle[i : i + chunk], outputs) for i in range(0, len(ray_bundle), chunk)
        ]
        names = [name for name in parts[0] if all(name in part for part in parts)]
        return {
            name: torch.cat([part[name] for part in parts]).unflatten(0, (camera.height, camera.width))
            for name in names
        }

    def _ray_outputs(self, ray_bundle: RayBundle, names: Collection[str] | None) -> dict[str, Tensor]:
        found = {
            name: value
            for name, value in self.get_outputs(ray_bundle).items()
            if value.ndim > 0 and value.shape[0] == len(ray_bundle)
        }
        unknown = sorted(set(names or ()) - set(found))
        if unknown:
            raise ConfigError(
                f"this model has no output {', '.join(unknown)}; it has {', '.join(sorted(found))}"
            )
        return {name: value for name, value in found.items() if names is None or name in names}
