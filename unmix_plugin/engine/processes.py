"""The processes that train one model together, each on its own rays; usually there is one.

The first process decides, writes and shows; the others follow it. Gradients are averaged in every step, so that all
take the same step from the same parameters. `start_together` starts them on one machine, as `torchrun
--nproc-per-node` does; they find each other by the environment that it, `torchrun` and Slurm scripts set.

Notation: `P` processes.
"""

from __future__ import annotations

import importlib
import ipaddress
import os
import pickle
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

from unmix_plugin.engine.children import child_command
from unmix_plugin.engine.configs import MOST_PROCESSES, MachineConfig
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
        self._exchange(distributed.all_reduce, flat)
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
            self._exchange(distributed.all_reduce, values, op=operation)
            if how == "mean":
                values.div_(self.count)
        return values

    def of_first(self, values: Tensor) -> Tensor:
        """The first process's values, in place."""
        if self.count > 1:
            self._exchange(distributed.broadcast, values, src=0)
        return values

    def announce(self, progress: float | None) -> float | None:
        """What the first process says: the progress of the step to take now, or None if training is over."""
        if self.count == 1:
            return progress
        sent = [-1.0 if progress is None else progress]
        order = torch.tensor(sent, dtype=torch.float64, device=_device_of_exchanges())
        found = float(self.of_first(order))
        return None if found < 0 else found

    def gather(self, value: _T) -> list[_T]:
        """The value of each process, by rank; anything that can be pickled."""
        if self.count == 1:
            return [value]
        data = torch.frombuffer(bytearray(pickle.dumps(value)), dtype=torch.uint8).to(_device_of_exchanges())
        sizes = [torch.zeros(1, dtype=torch.int64, device=data.device) for _ in range(self.count)]
        self._exchange(distributed.all_gather, sizes, sizes[0].new_tensor([len(data)]))
        longest = int(torch.cat(sizes).max())
        padded = torch.cat([data, data.new_zeros(longest - len(data))])
        parts = [torch.empty_like(padded) for _ in range(self.count)]
        self._exchange(distributed.all_gather, parts, padded)
        return [
            pickle.loads(part[: int(size)].cpu().numpy().tobytes())
            for part, size in zip(parts, sizes, strict=True)
        ]

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
        messages = self.gather(described)
        failed = [rank for rank, text in enumerate(messages) if text is not None]
        if not failed:
            return
        if not self.is_first:
            raise Follower(2)
        if failure is not None:
            raise failure
        raise RunError(f"process {failed[0] + 1} of {self.count}: {messages[failed[0]]}")

    def _exchange(self, operation: Callable[..., Any], *values: Any, **options: Any) -> None:
        """An exchange with the others, which Python's handlers of signals interrupt; a RunError if one of them is
        gone."""
        try:
            work = operation(*values, **options, async_op=True)
            # One long wait would be deaf to signals until all others are there.
            while distributed.get_backend() == "gloo" and not work.is_completed():
                try:
                    work.wait(_LOOK)
                except RuntimeError:  # noqa: PERF203 - not yet
                    if work.is_completed():
                        raise
            work.wait()
        except RuntimeError as error:
            raise RunError(
                f"process {self.rank + 1} of {self.count} can't reach the others, one of which has ended; what was "
                f"saved before is whole: go on with --load-run ({str(error).splitlines()[0]})"
            ) from error


ALONE = Processes()
"""One process, which has nobody to talk to."""


_PATIENCE = timedelta(days=7)
"""How long processes wait for the first, which may be paused; one that ends is noticed at once."""
_LOOK = timedelta(seconds=1)
"""After which a wait looks whether a signal came."""
_MEETING_S, _SILENT_S = 600.0, 5.0
"""How long processes wait for each other to start, and how long they do so without a word."""


def _device_of_exchanges() -> str:
    return "cuda" if distributed.get_backend() == "nccl" else "cpu"


@dataclass(frozen=True)
class _Place:
    """Which of several processes this one is, and where they meet."""

    rank: int
    count: int
    local_rank: int
    local_count: int
    address: str
    port: int


def _started() -> _Place | None:
    """What the environment says of this process, as `start_together`, `torchrun` and Slurm scripts set it; None for one
    that was started alone. Raises ConfigError: half of it is missing, or is no number."""
    names = ("RANK", "MASTER_ADDR", "MASTER_PORT")
    if os.environ.get("WORLD_SIZE") is None or (count := _number_in("WORLD_SIZE", 1, MOST_PROCESSES)) == 1:
        return None
    if missing := [name for name in names if not os.environ.get(name)]:
        raise ConfigError(
            f"WORLD_SIZE is {count}, as if this were one of {count} processes, but {' and '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'} not set; set {' and '.join(missing)}, start with torchrun or "
            "--num-devices, or unset WORLD_SIZE"
        )
    local_count = _number_in("LOCAL_WORLD_SIZE", 1, count) if "LOCAL_WORLD_SIZE" in os.environ else 1
    return _Place(
        _number_in("RANK", 0, count - 1),
        count,
        _number_in("LOCAL_RANK", 0, local_count - 1) if "LOCAL_RANK" in os.environ else 0,
        local_count,
        os.environ["MASTER_ADDR"],
        _number_in("MASTER_PORT", 1, 65535),
    )


def _number_in(name: str, low: int, high: int) -> int:
    """The number in a variable of the environment, in these bounds. Raises ConfigError."""
    text = os.environ[name]
    try:
        number = int(text)
    except ValueError:
        number = None
    if number is None or not low <= number <= high:
        raise ConfigError(
            f"{name} is {text!r} in the environment; expected a number from {low} to {high}, or none of "
            "WORLD_SIZE, RANK, MASTER_ADDR and MASTER_PORT for a process alone"
        )
    return number


def processes_here() -> int:
    """Processes of this training on this machine, which share its memory. Raises ConfigError: the environment says half
    of it."""
    place = _started()
    return 1 if place is None else place.local_count


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """Context in which this process works with those that were started with it, if it was not started alone.

    Args:
        device: `auto`, `cpu` or `cuda`. On CUDA each process of a machine takes a device of its own.
    Raises:
        ConfigError: fewer devices than processes, PyTorch lacks what they talk through, or the environment says half
            of what they need; the first process of each machine says so.
        RunError: the others don't come.
    """
    place = _started()
    processes = ALONE if place is None else _join(place, device)
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


def _join(place: _Place, device: str) -> Processes:
    is_cuda = device == "cuda" or (device == "auto" and torch.cuda.is_available())
    backend, found, fault = "nccl" if is_cuda else "gloo", torch.cuda.device_count(), None
    if is_cuda and place.local_count > found:
        fault = f"{place.local_count} processes on this machine, which has {found} CUDA devices"
    elif not distributed.is_available() or not getattr(distributed, f"is_{backend}_available")():
        fault = (
            f"this PyTorch is built without {backend}, through which processes talk: install another build, or train "
            "with one process"
        )
    if fault is not None:
        raise Follower(2) if place.local_rank > 0 else ConfigError(fault)
    if is_cuda:
        torch.cuda.set_device(place.local_rank)
    # Imported later it would keep the group in defaults of its functions, and the group's threads would live on when
    # Python ends, which aborts the process where one of them then lets go of a tensor.
    importlib.import_module("torch.distributed.nn")
    store = _meet(place)
    distributed.init_process_group(
        backend, store=store, rank=place.rank, world_size=place.count, timeout=_PATIENCE
    )
    return Processes(place.rank, place.count)


def _meet(place: _Place) -> Any:
    """The store through which processes find each other, once all of them are there.

    On one machine it listens on the loopback interface alone: it has no password. Where a cluster's address is given it
    listens there, and says so.
    """
    stores: Any = distributed  # which its types don't name
    is_local = _is_loopback(place.address)
    if is_local:
        for name in ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME"):
            os.environ.setdefault(name, "lo0" if sys.platform == "darwin" else "lo")
    is_of_torchrun = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    is_host = place.rank == 0 and not is_of_torchrun
    where, deadline = f"{place.address}:{place.port}", time.monotonic() + _MEETING_S
    patience = timedelta(seconds=_MEETING_S)
    listening = None
    if is_host:
        if not is_local:
            _tell(f"listening at {where} for {place.count} processes, open to all who reach that network")
        if os.name != "nt":  # where the store takes no socket of others
            listening = _listen(place)
    else:
        _wait_until(
            lambda: _answers(place), deadline, f"the first of {place.count} processes at {where}", place
        )
    tcp = stores.TCPStore(
        place.address, place.port, place.count, is_host, patience, False, master_listen_fd=listening
    )
    store = stores.PrefixStore(f"unmix-nerf/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", tcp)
    store.add("arrived", 1)
    _wait_until(
        lambda: store.add("arrived", 0) >= place.count,
        deadline,
        f"all {place.count} processes at {where}",
        place,
    )
    return store


def _listen(place: _Place) -> int:
    """A socket that listens at the address given, or where the machine knows no such one, everywhere. Raises RunError:
    the port is taken."""
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        try:
            listening.bind((place.address, place.port))
        except OSError:
            if _is_loopback(place.address):
                raise
            listening.bind(("", place.port))
        listening.listen()
    except OSError as error:
        listening.close()
        raise RunError(
            f"can't listen at {place.address}:{place.port}: {error.strerror or error}; choose another MASTER_PORT"
        ) from error
    return listening.detach()


def _is_loopback(address: str) -> bool:
    """Whether an address is reached from this machine alone."""
    try:
        return ipaddress.ip_address(socket.gethostbyname(address)).is_loopback
    except (OSError, ValueError):
        return False


def _answers(place: _Place) -> bool:
    """Whether somebody listens where processes meet."""
    try:
        socket.create_connection((place.address, place.port), timeout=2.0).close()
    except OSError:
        return False
    return True


def _wait_until(is_so: Callable[[], bool], deadline: float, what: str, place: _Place) -> None:
    """Look again and again, which signals interrupt; the first process of a machine says what it waits for. Raises
    RunError: it is past the deadline."""
    started, is_announced = time.monotonic(), False
    while not is_so():
        now = time.monotonic()
        if now > deadline:
            raise RunError(f"waited {_MEETING_S / 60:.0f} minutes for {what}; have all of them been started?")
        if not is_announced and now - started > _SILENT_S and place.local_rank == 0:
            is_announced = True
            _tell(f"waiting for {what}, at most {_MEETING_S / 60:.0f} minutes ...")
        time.sleep(0.05)


def _tell(line: str) -> None:
    with suppress(OSError):
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()


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
        module, argv: Run as `child_command` says; only the first process's output is shown.
        count: Processes asked for.
    Raises:
        ConfigError: fewer than one.
        RunError: a process was killed; by then all have ended.
        SystemExit: the processes have ended; their exit code.
    """
    MachineConfig(count)  # which refuses too many
    if count > 1 and _started() is None:
        sys.exit(run_processes(module, argv, count))


def run_processes(module: str, argv: Sequence[str], count: int) -> int:
    """Run a module in processes that find each other; the exit code of the first, which alone speaks."""
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
            child_command(module, argv),
            env={**shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=None if rank == 0 else subprocess.DEVNULL,
        )
        for rank in range(count)
    ]
    codes: list[int | None] = [None] * count

    def forward(number: int, _frame: FrameType | None) -> None:
        with suppress(OSError):
            workers[0].send_signal(number)

    # Ctrl-C reaches all processes of a terminal by itself, so that the first gets it twice, which it takes for once.
    handlers = {"SIGTERM": forward, "SIGHUP": forward, "SIGINT": forward}
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
