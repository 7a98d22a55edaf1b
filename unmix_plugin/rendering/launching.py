"""Where Warp kernels are launched from torch tensors: one call for CUDA and for CPU threads.

A kernel's first parameter is the index of its first work item. On CUDA the whole range is one launch on torch's
current stream. Warp's CPU launches are serial but release the interpreter lock, so there the range is cut into parts
that run on a thread pool; parts must not write to the same address, which is why callers name the unit that may be cut.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any

import torch

_SMALLEST_PART = 512
"""Work items under which a part costs more to hand over than to run."""


@cache
def warp() -> Any:
    """The Warp package, initialised quietly at first use: importing it takes longer than most commands need."""
    import warp as wp

    settings: Any = wp.config
    settings.quiet = True
    settings.log_level = getattr(wp, "LOG_ERROR", None)
    # Without a GPU the native library warns on standard error that there is no driver.
    with nullcontext() if torch.cuda.is_available() else _standard_error_closed():
        wp.init()
    return wp


@contextmanager
def _standard_error_closed() -> Iterator[None]:
    """What native code writes to standard error is dropped."""
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:  # noqa: PTH123 - a device, not a path
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


@cache
def _pool(num_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads, thread_name_prefix="unmix-kernel")


def launch(kernel: Any, size: int, arguments: Sequence[Any], device: torch.device, unit: int = 1) -> None:
    """Run `kernel(first, *arguments)` for `size` work items.

    Args:
        kernel: Warp kernel whose first parameter is an int offset to be added to `wp.tid()`.
        size: Number of work items; zero launches nothing.
        arguments: Remaining parameters: Warp arrays and numbers.
        device: Torch device of the arrays.
        unit: Work items that must stay in one CPU part, since they may write to the same address.
    """
    if size == 0:
        return
    wp = warp()
    if device.type == "cuda":
        stream = wp.stream_from_torch(torch.cuda.current_stream(device))
        wp.launch(kernel, dim=size, inputs=[0, *arguments], stream=stream)
        return
    threads = min(torch.get_num_threads(), os.cpu_count() or 1)
    part = unit if unit > 1 else max(_SMALLEST_PART, -(-size // threads))
    # Packing parameters and loading modules is not thread-safe in Warp, running a packed launch is.
    commands = [
        wp.launch(
            kernel, dim=min(part, size - first), inputs=[first, *arguments], device="cpu", record_cmd=True
        )
        for first in range(0, size, part)
    ]
    if threads == 1 or len(commands) == 1:
        for command in commands:
            command.launch()
    else:
        list(_pool(threads).map(lambda command: command.launch(), commands))


def as_warp(tensor: torch.Tensor, dtype: Any = None) -> Any:
    """A Warp view of a contiguous tensor's memory, without its gradient (Warp must never own torch's)."""
    return warp().from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


@cache
def vector_type(length: int, dtype: torch.dtype) -> Any:
    """Warp's vector of `length` numbers of a torch floating-point type."""
    wp = warp()
    return wp.types.vector(length, wp.dtype_from_torch(dtype))
