"""Everything that training goes on from, as named tensors: parameters, optimiser, average, data manager."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from unmix_plugin.engine.data_manager import DataManager
from unmix_plugin.engine.instantiate import require_in_range
from unmix_plugin.engine.runs.config_json import config_from_json
from unmix_plugin.engine.training.averages import ParameterAverage
from unmix_plugin.errors import ConfigError, RunError

MODEL, OPTIMIZER, AVERAGE, DATAMANAGER = "model/", "optimizer/", "average/", "datamanager/"


@dataclass(frozen=True)
class TrainingRecord:
    """What a checkpoint says in JSON beside its tensors; at the end of training, `training.json`."""

    steps: int
    """Training steps done."""
    train_seconds: float
    """Seconds of training alone."""
    total_rays: int
    """Rays of all training steps."""
    skipped_steps: int
    """Steps without an update, since loss or gradient was not finite."""
    num_rays: int
    """Rays of the next step."""
    average_updates: int
    """Updates of the average of the parameters."""
    progress: float
    """Fraction of the training done, [0, 1]."""
    learning_rates: dict[str, float]
    """Learning rates of the last step, by parameter group."""

    def __post_init__(self) -> None:
        """Refuse numbers that no training counts.

        Raises:
            ConfigError: one is negative, or there are no rays.
        """
        for name in ("steps", "train_seconds", "total_rays", "skipped_steps", "average_updates"):
            require_in_range(name, getattr(self, name), 0, 2**62)
        require_in_range("num_rays", self.num_rays, 1, 2**30)

    @property
    def train_rays_per_second(self) -> float:
        """Rays a second of training; 0 before the first step."""
        return self.total_rays / self.train_seconds if self.train_seconds > 0 else 0.0

    def to_json(self) -> dict[str, Any]:
        """All of it, and `train_rays_per_second`."""
        return {**asdict(self), "train_rays_per_second": self.train_rays_per_second}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> "TrainingRecord":
        """What `to_json` wrote, further entries ignored.

        Raises:
            RunError: an entry is missing, of another type, or negative.
        """
        known = {name: values.get(name) for name in TrainingRecord.__dataclass_fields__}
        try:
            return config_from_json(known, TrainingRecord(0, 0.0, 0, 0, 1, 0, 0.0, {}), "the record")
        except ConfigError as error:
            raise RunError(f"the checkpoint is damaged: {error}") from error


def collect_tensors(
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    average: ParameterAverage | None,
    datamanager: DataManager,
) -> dict[str, Tensor]:
    """The tensors of a checkpoint by name; they share memory with what is trained."""
    names = {id(param): name for name, param in model.named_parameters()}
    tensors = {MODEL + name: value for name, value in model.state_dict().items()}
    for param, state in optimizer.state.items():
        for key, value in state.items():
            tensors[f"{OPTIMIZER}{names[id(param)]}/{key}"] = value
    if average is not None:
        tensors.update({AVERAGE + name: value for name, value in average.state_dict().items()})
    tensors.update({DATAMANAGER + name: value for name, value in datamanager.state_dict().items()})
    return tensors


def restore_training(
    tensors: Mapping[str, Tensor],
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    datamanager: DataManager,
) -> None:
    """Restore what `collect_tensors` gave, but for the average.

    Raises:
        RunError: the tensors do not fit the model.
    """
    restore_model(tensors, model, averaged=False)
    params = dict(model.named_parameters())
    optimizer.state.clear()
    for name, value in part(tensors, OPTIMIZER).items():
        owner, _, key = name.rpartition("/")
        if owner not in params or (value.ndim > 0 and value.shape != params[owner].shape):
            raise RunError(f"the checkpoint is damaged: its optimiser state {name} fits no parameter")
        # Cloned: on the CPU `to` returns its argument, and the optimiser writes into its state.
        optimizer.state[params[owner]][key] = value.to(params[owner].device).clone()
    datamanager.load_state_dict(part(tensors, DATAMANAGER))


def restore_model(tensors: Mapping[str, Tensor], model: nn.Module, averaged: bool) -> None:
    """Give the model its values, with `averaged` those of the moving average where there is one.

    Raises:
        RunError: the tensors do not fit the model.
    """
    values = {**part(tensors, MODEL), **(part(tensors, AVERAGE) if averaged else {})}
    try:
        model.load_state_dict(values)
    except RuntimeError as error:
        raise RunError(
            f"the checkpoint does not fit the model that the run's config and scene describe: {error}"
        ) from error


def part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with `prefix`, without it."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
