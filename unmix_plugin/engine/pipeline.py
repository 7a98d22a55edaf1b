"""A data manager and a model, joined: what one training or evaluation step computes."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from unmix_plugin.engine.configs import PipelineConfig
from unmix_plugin.engine.decisions import Decision, settled_settings
from unmix_plugin.engine.machine import seed_everything, step_generator, step_seed
from unmix_plugin.engine.model import DataManager, Model, TrainOutputs

_MODEL_STREAM = 1
"""Stream of randomness of the model's own draws in a step; data managers draw from stream 0."""
_PROCESS_STREAM = 2
"""From which the other processes of a training take their seeds."""
_BATCH_STREAM = 3
"""From which the other batches of a step take their seeds."""


class Pipeline(nn.Module):
    """Data manager and model. Only the model has parameters."""

    def __init__(self, config: PipelineConfig, *, data: Path, device: torch.device, seed: int = 0) -> None:
        """Read the scene, then make the model for it, with parameters not yet initialised from the scene.

        `decisions` lists what settings that were `auto` became, and `reasons` says why.

        Raises:
            SceneError: the scene is missing or malformed.
            ConfigError: the model does not fit the scene.
        """
        super().__init__()
        self._config = config
        self.datamanager: DataManager = config.datamanager.setup(data=data, device=device, seed=seed)
        self.seed = seed
        model_config, self.reasons = config.model.resolve_auto(
            self.datamanager.initial_data, torch.Generator().manual_seed(seed)
        )
        self.decisions: list[Decision] = list(settled_settings(config.model, model_config, "pipeline.model"))
        self.model: Model = model_config.setup(
            scene_box=self.datamanager.scene_box, metadata=self.datamanager.metadata()
        ).to(device)

    @property
    def config(self) -> PipelineConfig:
        """The settings as the data manager and the model have settled them: what was `auto` and follows from the scene
        is a value."""
        return replace(self._config, datamanager=self.datamanager.config, model=self.model.config)

    def initialise(self) -> None:
        """Let the model of a new run take its first values from the scene; what the data manager decided joins
        `decisions` and `reasons`, and all warnings join the latter."""
        with torch.no_grad():
            self.model.initialise(self.datamanager.initial_data(), torch.Generator().manual_seed(self.seed))
        self.reasons = "\n".join(filter(None, [*self.datamanager.reasons(), self.reasons]))
        self.decisions = [*self.datamanager.decisions(), *self.decisions]
        self.warn(*self.datamanager.warnings(), *self.model.warnings())

    def warn(self, *warnings: str) -> None:
        """Let warnings join `reasons`, a line each."""
        self.reasons = "\n".join(filter(None, [self.reasons, *(f"warning: {one}" for one in warnings)]))

    def draw_as(self, rank: int) -> None:
        """Draw the rays of process number `rank` from now on; those of the first are the ones of a single process."""
        if rank > 0:
            self.seed = self.datamanager.seed = step_seed(self.seed, rank, _PROCESS_STREAM)

    def seed_step(self, step: int) -> None:
        """Make everything that the model draws in training step `step` a function of (seed, step)."""
        self.model.generator = step_generator(self.seed, step, self.datamanager.device, _MODEL_STREAM)
        # For what takes no generator, such as dropout or NumPy.
        seed_everything(step_seed(self.seed, step, _MODEL_STREAM))

    def train_batches(self, step: int, count: int = 1) -> Iterator[Callable[[], TrainOutputs]]:
        """The batches of training step `step`, each with its part of the rays, drawn when asked for; calls give
        their outputs, losses and metrics. What several batches draw is not what a single one would."""
        if count == 1:
            yield partial(self.model.get_train_loss_dict, *self.datamanager.next_train(step))
            return
        data, num_rays = self.datamanager, self.datamanager.get_train_rays_per_batch()
        for batch in range(count):
            model, seed = copy(self.model), step_seed(self.seed, batch, _BATCH_STREAM)
            model.generator = step_generator(seed, step, data.device, _MODEL_STREAM)
            data.seed = seed
            data.set_train_rays_per_batch(num_rays // count)
            try:
                drawn = data.next_train(step)
            finally:
                data.seed = self.seed
                data.set_train_rays_per_batch(num_rays)
            yield partial(model.get_train_loss_dict, *drawn)

    @torch.no_grad()
    def evaluate_images(self) -> Iterator[tuple[str, dict[str, float], dict[str, Tensor]]]:
        """For each evaluation image its name, metrics and pictures; the model is in evaluation mode meanwhile."""
        for index in range(self.datamanager.num_eval_images):
            camera, batch = self.datamanager.eval_image(index)
            with evaluating(self.model):
                outputs = self.model.get_evaluation_outputs(camera, batch)
                metrics, pictures = self.model.get_image_metrics_and_images(outputs, batch)
            yield self.datamanager.eval_name(index), metrics, pictures

    def get_average_eval_image_metrics_and_images(self) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics averaged over all evaluation images, each over those that have it, and pictures of the first."""
        found, pictures = [], dict[str, Tensor]()
        for _, metrics, images in self.evaluate_images():
            found.append(metrics)
            pictures = pictures or images
        return average_metrics(found), pictures


def average_metrics(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Metrics by name, each averaged over the images that have it; nan where all that have it are nan."""
    names = dict.fromkeys(name for metrics in found for name in metrics)
    values = {name: [float(metrics[name]) for metrics in found if name in metrics] for name in names}
    known = {name: [value for value in numbers if not math.isnan(value)] for name, numbers in values.items()}
    return {name: sum(numbers) / len(numbers) if numbers else math.nan for name, numbers in known.items()}


@contextmanager
def evaluating(module: nn.Module) -> Iterator[None]:
    """Context in which `module` is in evaluation mode; afterwards it is in the mode it was in."""
    was_training = module.training
    module.eval()
    try:
        yield
    finally:
        module.train(was_training)
