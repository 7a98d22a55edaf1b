"""Starting several processes of one command on this machine, as `torchrun --nproc-per-node` does."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

from unmix_plugin.engine.configs import MOST_PROCESSES, require_in_range
from unmix_plugin.errors import RunError

_GRACE_SECONDS = 10.0
"""For the processes that are left to say what is wrong and to save, once one has ended."""


def start_together(module: str, argv: Sequence[str], count: int) -> None:
    """Run a command in several processes and end this one, unless it is one of them or one is enough.

    Args:
        module, argv: As `run_processes` takes them.
        count: Processes asked for.
    Raises:
        ConfigError: fewer than one.
        SystemExit: the processes have ended; their exit code.
    """
    require_in_range("num-devices", count, 1, MOST_PROCESSES)
    if count > 1 and not are_started():
        sys.exit(run_processes(module, argv, count))


def are_started() -> bool:
    """Whether this process was started as one of several."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and "RANK" in os.environ


def run_processes(module: str, argv: Sequence[str], count: int) -> int:
    """Run `python -m module argv` in `count` processes that find each other; only the first one's output is shown.

    Returns:
        Exit code of the first process, which has said what went wrong if anything did.
    Raises:
        RunError: a process was killed; by then all have ended.
    """
    port = _free_port()
    threads = max(1, (os.cpu_count() or 1) // count)
    workers = [_start(module, argv, rank, count, port, threads) for rank in range(count)]
    try:
        with _forwarded_signals(workers[0]):
            _wait_for_the_end(workers)
            deadline = time.monotonic() + _GRACE_SECONDS
            codes = [_wait_until(worker, deadline) for worker in workers]
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


def _start(
    module: str, argv: Sequence[str], rank: int, count: int, port: int, threads: int
) -> subprocess.Popen[bytes]:
    environment = {
        "OMP_NUM_THREADS": str(threads),
        **os.environ,
        "RANK": str(rank),
        "LOCAL_RANK": str(rank),
        "WORLD_SIZE": str(count),
        "LOCAL_WORLD_SIZE": str(count),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    quiet = None if rank == 0 else subprocess.DEVNULL
    return subprocess.Popen([sys.executable, "-m", module, *argv], env=environment, stdout=quiet)


def _wait_for_the_end(workers: Sequence[subprocess.Popen[bytes]]) -> None:
    """Until the first process has ended, or another has failed."""
    while workers[0].poll() is None and not any(worker.poll() for worker in workers):
        time.sleep(0.05)


def _wait_until(worker: subprocess.Popen[bytes], deadline: float) -> int | None:
    try:
        return worker.wait(max(0.0, deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
        return None


@contextmanager
def _forwarded_signals(first: subprocess.Popen[bytes]) -> Iterator[None]:
    """Context in which the first process gets the signals of this one; Ctrl-C reaches all of a terminal by itself."""

    def forward(number: int, _frame: FrameType | None) -> None:
        with suppress(OSError):
            first.send_signal(number)

    def ignore(_number: int, _frame: FrameType | None) -> None:
        return

    handlers = {"SIGTERM": forward, "SIGHUP": forward, "SIGINT": ignore}
    before = {
        getattr(signal, name): signal.signal(getattr(signal, name), handler)
        for name, handler in handlers.items()
        if hasattr(signal, name)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
