"""Checkpoints: all that training goes on from, as safetensors beside a JSON record with their hash.

`step-NNNNNN.json` is written last, so a checkpoint exists if and only if its record does; and it counts as complete
only if the tensors' SHA-256 is the record's. The tensors are those of parameters, optimiser and average.
"""

import errno
import hashlib
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import safetensors.torch
from msgspec import Meta
from safetensors import SafetensorError
from torch import Tensor, nn

from unmix_plugin.engine.runs.atomic_files import whole_file
from unmix_plugin.engine.runs.replacing import (
    hash_of,
    list_file,
    move_aside,
    remove,
    remove_stale_temporaries,
)
from unmix_plugin.engine.runs.run_folder import checkpoint_steps
from unmix_plugin.engine.runs.run_json import OtherFormatError, adopt_run_json, read_run_json, write_run_json
from unmix_plugin.engine.training.optimizers import Adam, ParameterAverage
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.limits import read_bounded

_MOST_BYTES = 1 << 33
"""Of a checkpoint's tensors; the largest grids that settings allow take some gigabytes with the optimiser's state."""
_JUDGED_TOGETHER = 1 << 20
"""Numbers of a tensor: to ask all of a large one at once takes its memory several times."""
MODEL, _OPTIMIZER, AVERAGE = "model/", "optimizer/", "average/"


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds."""

    step: int
    """Training steps done."""
    tensors: dict[str, Tensor]
    """Tensors on the CPU."""
    record: dict[str, Any]
    """What was saved beside them, and `format_version`, `step`, `sha256`."""
    damaged: tuple[str, ...] = ()
    """Newer checkpoints that were passed over, each with the reason."""


def save_checkpoint(
    folder: Path, step: int, tensors: Mapping[str, Tensor], record: Mapping[str, Any], keep: int = 2
) -> Path:
    """Save tensors and what JSON can hold after so many training steps, then remove all but this checkpoint and the
    `keep - 1` complete ones before it.

    Returns:
        The path of the record.
    Raises:
        RunError: a tensor has values that are not finite, or the disk is full or refuses; the checkpoints from before
            are as they were.
    """
    require_sound(tensors)
    tensors_path, record_path = folder / f"step-{step:06d}.safetensors", folder / f"step-{step:06d}.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_stale_temporaries(folder)
        _remove_orphans(folder)
        separate = _separate(tensors)
        is_there = record_path.exists() and tensors_path.exists()
        if not is_there or tensors_path.read_bytes() != safetensors.torch.save(separate):
            _remove(record_path, tensors_path)  # of a damaged one: never a record beside other tensors
            with whole_file(tensors_path) as temporary:
                _write_tensors(temporary, separate)
        sha256 = hash_of(tensors_path)
        write_run_json(record_path, {**record, "step": step, "sha256": sha256})
        _remove_others(folder, step, keep)
    except OSError as error:
        raise RunError(f"can't write to {folder}: {error.strerror or error}") from error
    except RunError:
        _remove_orphans(folder)
        raise
    return record_path


def _write_tensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write a file of tensors from where they lie in memory. Raises OSError: the disk is full or refuses."""
    num_bytes = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
    try:
        safetensors.torch.save_file(tensors, path)
    except SafetensorError as error:
        written = path.stat().st_size if path.exists() else 0
        if shutil.disk_usage(path.parent).free < num_bytes - written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
        raise OSError(errno.EIO, str(error)) from error


def newest_complete_checkpoint(folder: Path) -> Checkpoint:
    """The newest checkpoint whose tensors have the hash that its record says.

    Raises:
        RunError: there is none.
        OtherFormatError: another version of this package wrote a record.
    """
    damaged: list[str] = []
    for step in checkpoint_steps(folder):
        stem = f"step-{step:06d}"
        try:
            record = read_run_json(folder / f"{stem}.json")
            data = read_bounded(folder / f"{stem}.safetensors", _MOST_BYTES)
            if hashlib.sha256(data).hexdigest() != record.get("sha256"):
                raise RunError("the tensors do not have the hash of the record")
            tensors = safetensors.torch.load(data)
            require_sound(tensors)
            return Checkpoint(step, tensors, record, tuple(damaged))
        except OtherFormatError:
            raise
        except (OSError, RunError, SafetensorError, ValueError, KeyError, RuntimeError) as error:
            damaged.append(f"{stem}: {error}")
    reason = "training ended before the first was saved"
    if damaged:
        reason = f"the files there are damaged or cut short ({damaged[0]}); copy the run again, or train anew"
    raise RunError(f"no complete checkpoint in {folder}: {reason}")


def require_sound(tensors: Mapping[str, Tensor]) -> None:
    """Refuse what no training goes on from, and no run is shown from. Raises RunError: a tensor has values that are not
    finite."""
    for name, tensor in tensors.items():
        is_small = tensor.is_floating_point() and tensor.element_size() == 1  # of which torch can't ask it
        for values in tensor.detach().reshape(-1).split(_JUDGED_TOGETHER):
            values = values.float() if is_small else values
            # What a model keeps beside its parameters may be infinite.
            is_sound = values.isnan().logical_not() if name.startswith(MODEL) else values.isfinite()
            if not is_sound.all():
                raise RunError(f"{name} has values that are not finite")


def _separate(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Contiguous tensors on the CPU that share no memory, as safetensors wants them."""
    separate: dict[str, Tensor] = {}
    seen: set[int] = set()
    for name, tensor in tensors.items():
        copy = tensor.detach().cpu().contiguous()
        storage = copy.untyped_storage().data_ptr()
        separate[name] = copy.clone() if storage in seen else copy
        seen.add(storage)
    return separate


def _remove_orphans(folder: Path) -> None:
    """Remove tensors without a record: their writer was stopped before the checkpoint was one."""
    for path in folder.glob("step-*.safetensors"):
        if not path.with_suffix(".json").exists():
            remove(path)


def _remove_others(folder: Path, step: int, keep: int) -> None:
    """Remove old checkpoints, and any newer than `step`: training went on from before them, so they are damaged."""
    steps = checkpoint_steps(folder)
    kept = [other for other in steps if other <= step][:keep]
    for other in set(steps) - set(kept):
        _remove(folder / f"step-{other:06d}.json", folder / f"step-{other:06d}.safetensors")


def _remove(record_path: Path, tensors_path: Path) -> None:
    """Remove a checkpoint, the record first: there is never a record without its tensors. What is damaged, or not ours,
    gets another name."""
    if record_path.is_file() and tensors_path.is_file():
        with suppress(RunError):
            if hash_of(tensors_path) == read_run_json(record_path).get("sha256"):
                list_file(tensors_path, hash_of(tensors_path))
    adopt_run_json(record_path)
    for path in (record_path, tensors_path):
        for other in remove(path):
            move_aside(other, "damaged")


_Count = Annotated[int, Meta(ge=0, le=2**62)]


@dataclass(frozen=True)
class TrainingRecord:
    """What a checkpoint says in JSON beside its tensors; at the end of training, `training.json`."""

    steps: _Count
    """Training steps done."""
    train_seconds: Annotated[float, Meta(ge=0)]
    """Seconds of training alone."""
    total_rays: _Count
    """Rays of all training steps."""
    skipped_steps: _Count
    """Steps without an update, since loss or gradient was not finite."""
    num_rays: Annotated[int, Meta(ge=1, le=2**30)]
    """Rays of the next step."""
    average_updates: _Count
    """Updates of the average of the parameters."""
    progress: float
    """Fraction of the training done, [0, 1]."""
    learning_rates: dict[str, float]
    """Learning rates of the last step, by parameter group."""

    @property
    def train_rays_per_second(self) -> float:
        """Rays a second of training; 0 before the first step."""
        return self.total_rays / self.train_seconds if self.train_seconds > 0 else 0.0

    def to_json(self) -> dict[str, Any]:
        """All of it, and `train_rays_per_second`."""
        return {**asdict(self), "train_rays_per_second": self.train_rays_per_second}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> "TrainingRecord":
        """What `to_json` wrote, further entries ignored. Raises RunError: an entry is missing, of another type, or
        negative."""
        try:
            return msgspec.convert(dict(values), TrainingRecord)
        except (msgspec.ValidationError, ConfigError) as error:
            raise RunError(f"the checkpoint is damaged: its record: {error}") from error


def collect_tensors(model: nn.Module, optimizer: Adam, average: ParameterAverage | None) -> dict[str, Tensor]:
    """The tensors of a checkpoint by name; they share memory with what is trained."""
    names = {id(param): name for name, param in model.named_parameters()}
    tensors = {MODEL + name: value for name, value in model.state_dict().items()}
    for param, state in optimizer.state.items():
        for key, value in state.items():
            tensors[f"{_OPTIMIZER}{names[id(param)]}/{key}"] = value
    if average is not None:
        tensors.update({AVERAGE + name: value for name, value in average.values.items()})
    return tensors


def restore_training(tensors: Mapping[str, Tensor], model: nn.Module, optimizer: Adam) -> None:
    """Restore what `collect_tensors` gave, but for the average. Raises RunError: the tensors do not fit the model."""
    restore_model(tensors, model, averaged=False)
    params = dict(model.named_parameters())
    optimizer.state.clear()
    for name, value in part(tensors, _OPTIMIZER).items():
        owner, _, key = name.rpartition("/")
        if owner not in params or (value.ndim > 0 and value.shape != params[owner].shape):
            raise RunError(f"the checkpoint is damaged: its optimiser state {name} fits no parameter")
        # Cloned: on the CPU `to` returns its argument, and the optimiser writes into its state.
        optimizer.state[params[owner]][key] = value.to(params[owner].device).clone()


def restore_model(tensors: Mapping[str, Tensor], model: nn.Module, averaged: bool) -> None:
    """Give the model its values, with `averaged` those of the moving average where there is one. Raises RunError: the
    tensors do not fit the model."""
    try:
        model.load_state_dict(part(tensors, MODEL))
        # After all of them: a parameter that modules share has several names, and an average under one.
        model.load_state_dict(part(tensors, AVERAGE) if averaged else {}, strict=False)
    except RuntimeError as error:
        raise RunError(
            "the checkpoint does not fit the model that config and scene describe: leave out settings that differ from "
            f"the run's, or train anew ({str(error).partition(chr(10))[2].strip() or error})"
        ) from error
    for name, param in model.named_parameters():
        if not param.isfinite().all():
            raise RunError(f"the checkpoint is damaged: {name} has values that are not finite; train again")


def part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with `prefix`, without it."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
