"""The processes that train one model together, each on its own rays; usually there is one.

The first process decides, writes and shows; the others follow it. Gradients are averaged in every step, so that all
take the same step from the same parameters.

Notation: `P` processes.

How a process finds the others: by the environment that `torchrun`, Slurm scripts and `launching` set.
"""

from __future__ import annotations

import importlib
import os
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn

from unmix_plugin.engine.processes.launching import are_started
from unmix_plugin.errors import ConfigError, RunError, UnmixError

_T = TypeVar("_T")


class Follower(SystemExit):
    """Ends a process that isn't the first without a word: the first says what there is to say."""


@dataclass(frozen=True)
class Processes:
    """This process among those that train one model. Every method but `is_first` is called by all of them together."""

    rank: int = 0
    """Of this process, in [0, count)."""
    count: int = 1
    """P."""

    @property
    def is_first(self) -> bool:
        """Whether this process decides, writes and shows."""
        return self.rank == 0

    def average_gradients(
        self, parameters: Sequence[nn.Parameter], numbers: Sequence[Tensor]
    ) -> list[Tensor]:
        """Replace each gradient by its mean over the processes, in one exchange.

        A parameter without gradient in every process keeps none.

        Args:
            parameters: The same in each process.
            numbers: Scalars to average with them.
        Returns:
            The means of `numbers`, scalars.
        """
        if self.count == 1:
            return list(numbers)
        has_gradient = torch.tensor([float(p.grad is not None) for p in parameters])
        parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        scalars = torch.stack([number.detach().float() for number in numbers])
        flat = torch.cat([scalars, has_gradient.to(scalars), *(part.flatten().float() for part in parts)])
        self._call(lambda: distributed.all_reduce(flat))
        flat /= self.count
        found, reached, rest = flat.split(
            [len(numbers), len(parameters), flat.numel() - len(numbers) - len(parameters)]
        )
        sizes = [part.numel() for part in parts]
        for parameter, mean, count in zip(parameters, rest.split(sizes), reached.tolist(), strict=True):
            parameter.grad = mean.view_as(parameter).to(parameter.dtype) if count > 0 else None
        return list(found)

    def smallest(self, values: Tensor) -> Tensor:
        """Smallest value over the processes, entry by entry, in place."""
        return self._reduce(values, "MIN")

    def largest(self, values: Tensor) -> Tensor:
        """Largest value over the processes, entry by entry, in place."""
        return self._reduce(values, "MAX")

    def mean(self, values: Tensor) -> Tensor:
        """Mean over the processes, entry by entry, in place."""
        return self._reduce(values, "SUM").div_(self.count) if self.count > 1 else values

    def of_first(self, values: Tensor) -> Tensor:
        """The first process's values, in place."""
        if self.count > 1:
            self._call(lambda: distributed.broadcast(values, 0))
        return values

    def announce(self, progress: float | None) -> float | None:
        """What the first process says: the progress of the step to take now, or None if training is over."""
        if self.count == 1:
            return progress
        order = torch.tensor([-1.0 if progress is None else progress], dtype=torch.float64)
        found = float(self.of_first(order.to(self._device)))
        return None if found < 0 else found

    def gather(self, value: _T) -> list[_T]:
        """The value of each process, by rank; anything that can be pickled."""
        if self.count == 1:
            return [value]
        found: list[Any] = [None] * self.count
        self._call(lambda: distributed.all_gather_object(found, value))
        return found

    def equalise(self, tensors: Iterable[Tensor]) -> None:
        """Give each process the first one's tensors, in place."""
        for tensor in tensors if self.count > 1 else ():
            # Not all backends know booleans.
            self.of_first(tensor.view(torch.uint8) if tensor.dtype == torch.bool else tensor)

    @contextmanager
    def together(self) -> Iterator[None]:
        """Context that all processes leave well, or none: the first raises what went wrong in any of them.

        Raises:
            UnmixError: of this process, or that of another by its message.
            Follower: something went wrong, and this is not the first process.
        """
        if self.count == 1:
            yield
            return
        failure: Exception | None = None
        try:
            yield
        except Exception as error:  # noqa: BLE001 - raised again below, by the first process
            failure = error
        said = self.gather(None if failure is None else _described(failure))
        failed = [rank for rank, text in enumerate(said) if text is not None]
        if not failed:
            return
        if not self.is_first:
            raise Follower(2)
        if failure is not None:
            raise failure
        raise RunError(f"process {failed[0] + 1} of {self.count}: {said[failed[0]]}")

    @property
    def _device(self) -> torch.device:
        """Where numbers that are exchanged have to be."""
        return torch.device("cuda" if distributed.get_backend() == "nccl" else "cpu")

    def _reduce(self, values: Tensor, operation: str) -> Tensor:
        if self.count > 1:
            self._call(lambda: distributed.all_reduce(values, op=getattr(distributed.ReduceOp, operation)))
        return values

    def _call(self, exchange: Callable[[], object]) -> None:
        """An exchange with the others.

        Raises:
            RunError: one of them is gone.
        """
        try:
            exchange()
        except RuntimeError as error:
            raise RunError(
                f"process {self.rank + 1} of {self.count} can't reach the others, one of which has ended; what was "
                f"saved before is whole: go on with --load-run ({str(error).splitlines()[0]})"
            ) from error


ALONE = Processes()
"""One process, which has nobody to talk to."""


def _described(error: Exception) -> str:
    return str(error) if isinstance(error, UnmixError) else traceback.format_exception_only(error)[-1].strip()


_PATIENCE = timedelta(days=7)
"""How long processes wait for the first, which may be paused; one that ends is noticed at once."""


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


def _leave(processes: Processes) -> None:
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
        _leave(processes)


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
