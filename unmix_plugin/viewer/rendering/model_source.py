"""Where the viewer's model comes from: a finished run, or a training that is under way."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

from unmix_plugin.engine.model import Model
from unmix_plugin.engine.pipeline import evaluating
from unmix_plugin.engine.runs.load_run import LoadedModel, SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.averages import ParameterAverage
from unmix_plugin.engine.training.device_share import DeviceShare
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.engine.training.training_control import TrainingControl
from unmix_plugin.errors import ConfigError
from unmix_plugin.model import UnmixModel


@dataclass(frozen=True)
class ModelSource:
    """A model that is lent for moments, in which nobody changes it."""

    run: RunFolder
    """Where what the viewer writes goes."""
    scene: SceneRecord
    """Cameras and box, from the run's own record."""
    device: DeviceShare
    """Turns with training, if there is one."""
    _model: UnmixModel
    average: ParameterAverage | None = None
    """Whose values to render with, while training."""
    control: TrainingControl | None = None
    """The training under way; None for a finished run."""

    @contextmanager
    def borrowed(self, cost: float = 1.0) -> Iterator[UnmixModel]:
        """Context with the model in evaluation mode, with averaged parameters where training keeps them.

        Turns do not nest: whoever has the model must not ask for it again.

        Args:
            cost: As `DeviceShare.guest_turn` has it.
        """
        averaged = nullcontext() if self.average is None else self.average.swapped_in()
        with self.device.guest_turn(cost), evaluating(self._model), averaged:
            yield self._model

    @property
    def version(self) -> int:
        """Rises with each change of the model: training steps that it has seen."""
        return self.device.training_turns

    @property
    def is_changing(self) -> bool:
        """Whether the next picture of the same view would be another one."""
        return self.device.is_training


def source_of_run(loaded: LoadedModel) -> ModelSource:
    """The model of a finished run.

    Raises:
        ConfigError: its method does not unmix spectra.
    """
    model = unmixing_model(loaded.model, loaded.config.method_name)
    return ModelSource(loaded.run, loaded.scene, DeviceShare(), model)


def source_of_training(trainer: Trainer, scene: SceneRecord) -> ModelSource:
    """The model of a training, before or while it runs.

    Raises:
        ConfigError: its method does not unmix spectra.
    """
    model = unmixing_model(trainer.pipeline.model, trainer.config.method_name)
    control = trainer.control
    return ModelSource(trainer.run, scene, control.device, model, trainer.average, control)


def unmixing_model(model: Model, method_name: str) -> UnmixModel:
    """The model, which must be one that the viewer can show.

    Raises:
        ConfigError: its method does not unmix spectra.
    """
    if not isinstance(model, UnmixModel):
        raise ConfigError(
            f"the viewer shows runs of methods that unmix spectra; {method_name} gives a {type(model).__name__}"
        )
    return model
