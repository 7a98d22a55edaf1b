"""The processes that train one model together, each on its own rays; usually there is one.

The first process decides, writes and shows; the others follow it. Gradients are averaged in every step, so that all
take the same step from the same parameters. `start_together` starts them on one machine, as `torchrun
--nproc-per-node` does; they find each other by the environment that it, `torchrun` and Slurm scripts set.

Notation: `P` processes.
"""

from __future__ import annotations

import importlib
import os
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from types import FrameType
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, distributed, nn

from unmix_plugin.engine.configs import MOST_PROCESSES, require_in_range
from unmix_plugin.engine.machine import handled_signals
from unmix_plugin.engine.runs.config_json import flattened
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
        """Replace each gradient by its mean over the processes, in one exchange; also the means of some scalars.

        A parameter without gradient in every process keeps none.
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

    def reduce(self, values: Tensor, how: Literal["min", "max", "mean"]) -> Tensor:
        """Smallest, largest or mean value over the processes, entry by entry, in place."""
        if self.count > 1:
            operation = getattr(distributed.ReduceOp, {"min": "MIN", "max": "MAX", "mean": "SUM"}[how])
            self._call(lambda: distributed.all_reduce(values, op=operation))
            if how == "mean":
                values.div_(self.count)
        return values

    def of_first(self, values: Tensor) -> Tensor:
        """The first process's values, in place."""
        if self.count > 1:
            self._call(lambda: distributed.broadcast(values, 0))
        return values

    def announce(self, progress: float | None) -> float | None:
        """What the first process says: the progress of the step to take now, or None if training is over."""
        if self.count == 1:
            return progress
        device = "cuda" if distributed.get_backend() == "nccl" else "cpu"
        order = torch.tensor([-1.0 if progress is None else progress], dtype=torch.float64, device=device)
        found = float(self.of_first(order))
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
        failure, described = None, None
        try:
            yield
        except Exception as error:  # noqa: BLE001 - raised again below, by the first process
            failure, described = error, str(error)
            if not isinstance(error, UnmixError):
                described = traceback.format_exception_only(error)[-1].strip()
        said = self.gather(described)
        failed = [rank for rank, text in enumerate(said) if text is not None]
        if not failed:
            return
        if not self.is_first:
            raise Follower(2)
        if failure is not None:
            raise failure
        raise RunError(f"process {failed[0] + 1} of {self.count}: {said[failed[0]]}")

    def _call(self, exchange: Callable[[], object]) -> None:
        """An exchange with the others; a RunError if one of them is gone."""
        try:
            exchange()
        except RuntimeError as error:
            raise RunError(
                f"process {self.rank + 1} of {self.count} can't reach the others, one of which has ended; what was "
                f"saved before is whole: go on with --load-run ({str(error).splitlines()[0]})"
            ) from error


ALONE = Processes()
"""One process, which has nobody to talk to."""


_PATIENCE = timedelta(days=7)
"""How long processes wait for the first, which may be paused; one that ends is noticed at once."""


def processes_here() -> int:
    """Processes of this training on this machine, which share its memory."""
    return max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1"))) if _are_started() else 1


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """Context in which this process works with those that were started with it, if it was not started alone.

    Args:
        device: `auto`, `cpu` or `cuda`. On CUDA each process of a machine takes a device of its own.
    Raises:
        ConfigError: fewer devices than processes, or PyTorch lacks what they talk through; the first process of each
            machine says so.
    """
    processes = _join(device) if _are_started() else ALONE
    try:
        yield processes
    except BaseException as error:
        # Clear the local variables an error keeps: the group is among them, and its threads end with it alone.
        chained: BaseException | None = error if processes.count > 1 else None
        while chained is not None:
            traceback.clear_frames(chained.__traceback__)
            chained = chained.__cause__ or chained.__context__
        raise
    finally:
        if processes.count > 1 and distributed.is_initialized():
            distributed.destroy_process_group()


def _are_started() -> bool:
    """Whether this process was started as one of several."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and "RANK" in os.environ


def _join(device: str) -> Processes:
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    is_cuda = device == "cuda" or (device == "auto" and torch.cuda.is_available())
    backend, found, fault = "nccl" if is_cuda else "gloo", torch.cuda.device_count(), None
    if is_cuda and processes_here() > found:
        fault = f"{processes_here()} processes on this machine, which has {found} CUDA devices"
    elif not distributed.is_available() or not getattr(distributed, f"is_{backend}_available")():
        fault = (
            f"this PyTorch is built without {backend}, through which processes talk: install another build, or train "
            "with one process"
        )
    if fault is not None:
        raise Follower(2) if local_rank > 0 else ConfigError(fault)
    if is_cuda:
        torch.cuda.set_device(local_rank)
    # Imported later it would keep the group in defaults of its functions, and the group's threads would live on when
    # Python ends, which aborts the process where one of them then lets go of a tensor.
    importlib.import_module("torch.distributed.nn")
    distributed.init_process_group(backend, timeout=_PATIENCE)
    return Processes(int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]))


def require_equal_settings(processes: Processes, settings: Mapping[str, Any]) -> None:
    """Refuse processes that were started with different settings, as `together` does."""
    first, *others = processes.gather({**flattened(settings), "torch": torch.__version__})
    with processes.together():
        for number, other in enumerate(others, start=2):
            for name in sorted(first.keys() | other.keys()):
                if first.get(name) != other.get(name):
                    raise ConfigError(
                        f"process {number} of {processes.count} has {name} {other.get(name)}, the first has "
                        f"{first.get(name)}; start all with the same arguments and packages"
                    )


_GRACE_SECONDS = 10.0
"""For the processes that are left to say what is wrong and to save, once one has ended."""


def start_together(module: str, argv: Sequence[str], count: int) -> None:
    """Run a command in several processes and end this one, unless it is one of them or one is enough.

    Args:
        module, argv: Run as `python -m module argv`; only the first process's output is shown.
        count: Processes asked for.
    Raises:
        ConfigError: fewer than one.
        RunError: a process was killed; by then all have ended.
        SystemExit: the processes have ended; their exit code.
    """
    require_in_range("num-devices", count, 1, MOST_PROCESSES)
    if count > 1 and not _are_started():
        sys.exit(_run_processes(module, argv, count))


def _run_processes(module: str, argv: Sequence[str], count: int) -> int:
    """Run `python -m module argv` in processes that find each other; the exit code of the first, which alone speaks."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    shared = {
        **({"USE_LIBUV": "0"} if sys.platform == "win32" else {}),  # PyTorch is built without it there
        "OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // count)),
        **os.environ,
        "WORLD_SIZE": str(count),
        "LOCAL_WORLD_SIZE": str(count),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    workers = [
        subprocess.Popen(
            [sys.executable, "-m", module, *argv],
            env={**shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=None if rank == 0 else subprocess.DEVNULL,
        )
        for rank in range(count)
    ]
    codes: list[int | None] = [None] * count

    def forward(number: int, _frame: FrameType | None) -> None:
        with suppress(OSError):
            workers[0].send_signal(number)

    # Ctrl-C reaches all processes of a terminal by itself.
    handlers = {"SIGTERM": forward, "SIGHUP": forward, "SIGINT": lambda *_: None}
    try:
        with handled_signals(handlers):
            while workers[0].poll() is None and not any(worker.poll() for worker in workers):
                time.sleep(0.05)
            deadline = time.monotonic() + _GRACE_SECONDS
            for rank, worker in enumerate(workers):
                with suppress(subprocess.TimeoutExpired):
                    codes[rank] = worker.wait(max(0.0, deadline - time.monotonic()))
    finally:
        for worker in workers:
            with suppress(OSError):
                worker.kill()
    first = codes[0]
    if first is not None and (first > 0 or not any(codes)):
        return first
    rank = next(rank for rank, code in enumerate(codes) if code)
    raise RunError(
        f"process {rank + 1} of {count} ended with exit code {codes[rank]}, and with it all others. Checkpoints saved "
        "before are whole: go on with --load-run"
    )
