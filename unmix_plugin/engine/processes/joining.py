"""How a process finds the others: by the environment that `torchrun`, Slurm scripts and `launching` set."""

from __future__ import annotations

import importlib
import os
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
from torch import distributed

from unmix_plugin.engine.processes.processes import ALONE, Follower, Processes
from unmix_plugin.errors import ConfigError

_PATIENCE = timedelta(days=7)
"""How long processes wait for the first, which may be paused; one that ends is noticed at once."""


def are_started() -> bool:
    """Whether this process was started as one of several."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and "RANK" in os.environ


def processes_here() -> int:
    """Processes of this training on this machine, which share its memory."""
    return max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1"))) if are_started() else 1


def join(device: str) -> Processes:
    """This process among the others, all of which call this; alone where it was not started as one of several.

    Args:
        device: `auto`, `cpu` or `cuda`. On CUDA each process of a machine takes a device of its own.
    Raises:
        ConfigError: fewer devices than processes, or PyTorch lacks what they talk through; the first process of each
            machine says so.
    """
    if not are_started():
        return ALONE
    rank, count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    is_cuda = device == "cuda" or (device == "auto" and torch.cuda.is_available())
    backend = "nccl" if is_cuda else "gloo"
    try:
        if is_cuda:
            _take_device(local_rank, processes_here())
        _require_backend(backend)
    except ConfigError:
        if local_rank > 0:
            raise Follower(2) from None
        raise
    # Imported later it would keep the group in defaults of its functions, and the group's threads would live on when
    # Python ends, which aborts the process where one of them then lets go of a tensor.
    importlib.import_module("torch.distributed.nn")
    distributed.init_process_group(backend, timeout=_PATIENCE)
    return Processes(rank, count)


def leave(processes: Processes) -> None:
    """End what `join` began."""
    if processes.count > 1 and distributed.is_initialized():
        distributed.destroy_process_group()


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """Context in which this process works with those that were started with it.

    Args:
        device: As `join` takes it.
    Raises:
        ConfigError: as `join`.
    """
    processes = join(device)
    try:
        yield processes
    except BaseException as error:
        if processes.count > 1:
            _let_go(error)
        raise
    finally:
        leave(processes)


def require_equal_settings(processes: Processes, settings: Mapping[str, Any]) -> None:
    """Refuse processes that were started with different settings.

    Args:
        settings: Whatever has to be the same everywhere, as JSON has it.
    Raises:
        ConfigError: in the first process, with the settings that differ.
        Follower: in the others.
    """
    told = processes.gather({**_flat(settings), "torch": torch.__version__})
    for rank, other in enumerate(told):
        names = told[0].keys() | other.keys()
        different = sorted(name for name in names if told[0].get(name) != other.get(name))
        if different and processes.is_first:
            name = different[0]
            raise ConfigError(
                f"process {rank + 1} of {processes.count} has {name} {other.get(name)}, the first has "
                f"{told[0].get(name)}; start all with the same arguments and packages"
            )
        if different:
            raise Follower(2)


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found.update(
            _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
        )
    return found


def _let_go(error: BaseException | None) -> None:
    """Clear the local variables an error keeps: the group is among them, and its threads end with it alone."""
    while error is not None:
        traceback.clear_frames(error.__traceback__)
        error = error.__cause__ or error.__context__


def _take_device(local_rank: int, processes: int) -> None:
    found = torch.cuda.device_count()
    if processes > found:
        raise ConfigError(f"{processes} processes on this machine, which has {found} CUDA devices")
    torch.cuda.set_device(local_rank)


def _require_backend(backend: str) -> None:
    has_it = {"nccl": distributed.is_nccl_available, "gloo": distributed.is_gloo_available}[backend]
    if not distributed.is_available() or not has_it():
        raise ConfigError(
            f"this PyTorch is built without {backend}, through which processes talk: install another build, or train "
            "with one process"
        )
