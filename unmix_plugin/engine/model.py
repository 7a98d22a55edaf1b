"""What a method is made of: a data manager, a model, usually a field, and what they want done around each step.

A data manager joins data on disk and training: rays with what was measured along them. A field says what is at a
position and how it looks from a direction. A model leads from rays to outputs, losses, metrics and pictures.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.engine.configs import DataManagerConfig, ModelConfig
from unmix_plugin.engine.decisions import Decision
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.outputs import Output
from unmix_plugin.engine.processes import ALONE, Processes
from unmix_plugin.errors import ConfigError


class DataManager(ABC):
    """Reads one scene and serves batches of it: dictionaries of tensors with one row a ray (`next_train`), or with
    leading axes (height, width) for a whole image (`eval_image`).

    Sampling is a pure function of (seed, step): a step makes its own generator with `step_generator(seed, step)`, so
    that a resumed run sees the batches of a straight one.
    """

    train_cameras: Cameras
    """Cameras of the training views, model space."""
    eval_cameras: Cameras
    """Cameras of the evaluation views, model space."""
    scene_box: SceneBox
    """What the scene fits in, model space."""

    def __init__(self, config: DataManagerConfig, *, data: Path, device: torch.device, seed: int = 0) -> None:
        """Keep what every data manager needs; subclasses then read `data` and set cameras and scene box, or raise
        `SceneError`."""
        self.config, self.data, self.device, self.seed = config, data, device, seed

    @abstractmethod
    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Rays of training step `step` and what was measured along them."""

    @abstractmethod
    def eval_image(self, index: int) -> tuple[Cameras, dict[str, Tensor]]:
        """Camera (one) and whole image of evaluation view `index`."""

    @abstractmethod
    def get_train_rays_per_batch(self) -> int:
        """Rays that the next training batch will have."""

    @abstractmethod
    def set_train_rays_per_batch(self, num_rays: int) -> None:
        """Let the next training batches have `num_rays` rays."""

    @property
    def num_eval_images(self) -> int:
        """Number of images to evaluate on: the evaluation views, and after them others that a method may have, such as
        the same object under another light."""
        return len(self.eval_cameras)

    def eval_name(self, index: int) -> str:
        """Name of evaluation image `index`, unique and fit for file names."""
        summary = self.summary()
        frames, indices = summary.get("frames"), summary.get("eval_indices")
        if isinstance(frames, list) and isinstance(indices, list) and index < len(indices):
            return str(frames[indices[index]])
        return f"eval_{index:03d}"

    def metadata(self) -> dict[str, Any]:
        """What gives the model its shape beyond its config (say, a number of channels); kept in the run folder as JSON.

        Only dictionaries with string keys, lists, strings, finite numbers, booleans and None. Arrays that fill
        parameters belong in `initial_data`.
        """
        return {}

    def initial_data(self) -> Mapping[str, np.ndarray]:
        """Arrays from which a new model takes its first parameter values; read once when a run starts, never when
        one is loaded, since by then the values are in the checkpoint."""
        return {}

    def summary(self) -> dict[str, Any]:
        """What a person or a later command may ask about the scene (splits, normalisation, hashes); JSON like
        `metadata`, kept in the run folder."""
        return {}

    @classmethod  # noqa: B027
    def check_record(cls, metadata: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Refuse a `metadata` or `summary` read from a run folder that this class can't have written.

        Raises:
            KeyError, TypeError, ValueError, ConfigError: what is missing or wrong.
        """

    def reasons(self) -> list[str]:
        """What was decided by the data, and why, in words; asked once, when a new run starts."""
        return []

    def decisions(self) -> list[Decision]:
        """The same with evidence and what was tried against each; asked once, when a new run starts."""
        return []

    def warnings(self) -> list[str]:
        """What looks wrong with the data though it can be trained on; asked once, when a new run starts."""
        return []

    def identity(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        """What of a `summary` makes it this scene and no other: compared, numbers with a tolerance, when a run is
        resumed or evaluated."""
        return {}

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Functions to call around each step."""
        return []


TrainOutputs: TypeAlias = tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]
"""Outputs, losses and metrics of one batch. Outputs are what the model itself makes use of; losses may be a plugin's
own: the training step checks that they are tensors, and names the plugin if they are not."""


class Model(nn.Module, ABC):
    """A scene representation with its renderer.

    The config, the scene box and the metadata alone give a model its modules and the shape of every parameter and
    buffer; the checkpoint gives the values. So a run folder renders without the data it was trained on.
    """

    batches_at_once: int = 1
    """How many batches of a step a CPU with several threads may work on at once, 1 or 2. Of 2, each is the work of half
    of the threads on a shallow copy of the model with half of the rays and a `generator` of its own; so
    `get_train_loss_dict` must change nothing that the copies share, and leave what it learns without gradients to
    `update`."""
    outputs: tuple[Output, ...] = ()
    """What `get_outputs_for_camera` gives that can be shown. `accumulation` (opacity) and `ray_distance` (model units)
    have the meaning that they have everywhere."""

    def __init__(self, config: ModelConfig, *, scene_box: SceneBox, metadata: Mapping[str, Any]) -> None:
        """Keep the arguments, then call `populate_modules`."""
        super().__init__()
        self.config, self.scene_box, self.metadata = config, scene_box, metadata
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

    def frozen_parameters(self, averages: Mapping[str, Tensor] | None) -> dict[int, nn.Parameter]:
        """Copies of the parameters without gradients, by the parameters' ids, as `copy.deepcopy` takes them; of
        `averages`, by the parameters' names, where there are any."""
        values = dict(averages or {})
        return {
            id(param): nn.Parameter(values.get(name, param).detach().clone(), requires_grad=False)
            for name, param in self.named_parameters()
        }

    @property
    def rays_per_chunk(self) -> int:
        """Rays of a whole image under way at once."""
        chosen = self.config.eval_num_rays_per_chunk
        return chosen if chosen != "auto" else 32_768 if self.device.type == "cpu" else 131_072

    @abstractmethod
    def populate_modules(self) -> None:
        """Make the modules, parameters and buffers, their shapes from `config`, `scene_box` and `metadata` only."""

    @classmethod
    def check_tensors(cls, metadata: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
        """Refuse, before a model is made, metadata for which it would take far more memory than the tensors of a
        checkpoint, by their names in `state_dict`. Raises ValueError."""

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

    def get_loss_dict(
        self,
        outputs: dict[str, Tensor],
        batch: dict[str, Tensor],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """Scalar losses, already weighted; training minimises their sum. Only a model that writes `get_train_loss_dict`
        anew does without.

        Raises:
            ConfigError: the model has neither.
        """
        raise ConfigError(f"{type(self).__name__} has neither get_loss_dict nor get_train_loss_dict")

    def get_metrics_dict(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Scalars worth following in training; `psnr` (dB) is shown in the progress display."""
        return {}

    def get_train_loss_dict(self, ray_bundle: RayBundle, batch: dict[str, Tensor]) -> TrainOutputs:
        """Outputs, losses and metrics of a training batch; a model that shares work between them writes this anew.

        The outputs go to `num_samples` and `update` alone.
        """
        outputs = self(ray_bundle)
        metrics = self.get_metrics_dict(outputs, batch)
        return outputs, self.get_loss_dict(outputs, batch, metrics), metrics

    def update(self, outputs: dict[str, Any]) -> None:
        """Learn from the outputs of a batch what has no gradient. Called without gradients for each batch of a step in
        turn, once all gradients are known and before the optimiser's update."""

    @abstractmethod
    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics of one whole image, nan where there is no truth; pictures of it (height, width, 3) in sRGB [0, 1]."""

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

    def num_samples(self, outputs: dict[str, Any]) -> int:
        """Field samples behind `outputs`, for the log; 0 where a model does not count."""
        return 0

    def next_num_rays(self, num_samples: int, current: int) -> int | None:
        """Rays that the next step should have, given the samples of one with `current` rays; None leaves it."""
        return None

    def warm_up(self) -> None:
        """Compile and allocate what the first step needs, before the training clock starts; changes no parameter,
        no buffer."""

    def write_results(self, folder: Path) -> None:
        """Write what people read of a trained model into its run's folder; called when training has ended, with the
        averaged parameters. Usually nothing.

        Raises:
            RunError: the disk is full or refuses.
        """

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
        rays, chunk = camera.to(self.device).image_rays(0), self.rays_per_chunk
        parts = [self._ray_outputs(rays[i : i + chunk], outputs) for i in range(0, len(rays), chunk)]
        names = [name for name in parts[0] if all(name in part for part in parts)]
        size = (camera.height, camera.width)
        return {name: torch.cat([part[name] for part in parts]).unflatten(0, size) for name in names}

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


class Field(nn.Module, ABC):
    """A function of space with parameters."""

    @abstractmethod
    def get_density(self, positions: Float[Tensor, "*samples 3"]) -> tuple[Float[Tensor, "*samples"], Tensor]:
        """Density (per scene unit, >= 0) at `positions` in model space, and features for `get_outputs`."""

    @abstractmethod
    def get_outputs(
        self,
        positions: Float[Tensor, "*samples 3"],
        directions: Float[Tensor, "*samples 3"],
        features: Tensor,
    ) -> dict[str, Tensor]:
        """What the field says at `positions` seen along unit `directions`, given the features of `get_density`."""

    def forward(
        self, positions: Float[Tensor, "*samples 3"], directions: Float[Tensor, "*samples 3"]
    ) -> tuple[Float[Tensor, "*samples"], dict[str, Tensor]]:
        """Densities and outputs."""
        densities, features = self.get_density(positions)
        return densities, self.get_outputs(positions, directions, features)


class TrainingCallbackLocation(Enum):
    """When a callback runs."""

    BEFORE_TRAIN_ITERATION = "before"
    """Before the rays of the step are drawn."""
    AFTER_TRAIN_ITERATION = "after"
    """After the optimiser's update, also when a step was skipped for a non-finite loss or gradient."""


@dataclass(frozen=True)
class TrainingCallback:
    """One function and the place in the step at which the trainer calls it."""

    where: TrainingCallbackLocation
    """Before or after the update."""
    func: Callable[[int, float], None]
    """Called with the step (0 for the first) and the training progress in [0, 1]: the fraction used up of whichever
    limit, steps or seconds, is nearer its end."""
