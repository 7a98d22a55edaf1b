"""Where Warp kernels are launched from torch tensors: one call for CUDA and for CPU threads.

A kernel's first three parameters are `first`, `end` and `stride`: thread i works on the items `first + i`,
`first + i + stride`, ... below `end`. On CUDA the whole range is one launch on torch's current stream, where each item
has a thread. On a CPU a Warp launch is one loop that enters the kernel again for each of Warp's threads; so there the
range is cut into parts, each a launch of one thread that walks its items itself, which lets the compiler take out of
the loop what they share. Launches release the interpreter lock and parts run on a thread pool; two parts must not write
to the same address, which is why a caller may say where the range is cut.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from copy import copy
from dataclasses import dataclass
from functools import cache
from threading import Lock
from typing import Any

import torch

_SMALLEST_PART = 512
"""Work items under which a part costs more to hand over than to run."""
_PARTS_PER_THREAD = 2
"""Parts are smaller than a thread's share, so that a thread that the machine holds up leaves its work to the others."""

_KERNELS_BYTES = 1 << 22
"""Room that a folder of compiled kernels needs to be worth keeping."""

_RECORDED: dict[Any, Any] = {}
"""A launch of each kernel on a CPU, without its arguments."""
_LOADING = Lock()
_PACKING = Lock()
"""Packing parameters and loading modules is not thread-safe in Warp, running a packed launch is."""


@cache
def warp() -> Any:
    """The Warp package, initialised quietly at first use: importing it takes longer than most commands need."""
    import warp as wp

    settings: Any = wp.config
    settings.quiet = True
    settings.log_level = getattr(wp, "LOG_ERROR", None)
    # Without a GPU the native library warns on standard error that there is no driver. Two threads may need Warp first:
    # each would take the other's closed standard error for its own, and the process had none from then on.
    with _LOADING, nullcontext() if torch.cuda.is_available() else _standard_error_closed():
        is_kept = _is_initialised(wp)
        if not is_kept:
            settings.kernel_cache_dir = tempfile.mkdtemp(prefix="unmix-kernels-")
            atexit.register(shutil.rmtree, settings.kernel_cache_dir, ignore_errors=True)
            wp.init()
    if not is_kept:
        sys.stderr.write(
            "Warp's folder of compiled kernels can't be written, so they are compiled anew for this command; name one "
            "that can in the environment variable WARP_CACHE_PATH\n"
        )
    return wp


def _is_initialised(wp: Any) -> bool:
    """Initialise Warp; False if its cache of kernels can't be written: no home folder, a read-only one, a full disk."""
    is_named = os.environ.get("WARP_CACHE_PATH") or os.environ.get("XDG_CACHE_HOME")
    if not is_named and os.path.expanduser("~") == "~":  # noqa: PTH111 - which Warp would take for a folder's name
        return False
    try:
        wp.init()
        with tempfile.TemporaryFile(dir=wp.config.kernel_cache_dir) as file:
            file.write(bytes(_KERNELS_BYTES))
            file.flush()
            return True
    except OSError:
        return False


@contextmanager
def _standard_error_closed() -> Iterator[None]:
    """What native code writes to standard error is dropped."""
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:  # noqa: PTH123 - a device, not a path
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


@dataclass(frozen=True)
class KernelArray:
    """The memory of a tensor as a kernel takes it."""

    descriptor: Any
    """Warp's description of the memory; it keeps the tensor alive."""
    annotation: Any
    """Warp's type of the array."""


def as_warp(tensor: torch.Tensor, dtype: Any = None) -> KernelArray:
    """A tensor's memory without its gradient, since Warp must never own torch's; with a vector `dtype` its last axis is
    contiguous and has the vector's length."""
    wp = warp()
    plain = tensor.detach()
    is_vector = dtype is not None and hasattr(dtype, "_shape_")
    dtype = wp.dtype_from_torch(tensor.dtype) if dtype is None else dtype
    descriptor = wp.from_torch(plain, dtype=dtype, requires_grad=False, return_ctype=True)
    return KernelArray(descriptor, _array_type(dtype, tensor.dim() - is_vector))


def declare(kernel: Any, *arrays: tuple[Any, int]) -> None:
    """Have a generic kernel compiled together with the others of its module: for each that Warp meets later it compiles
    all of the module anew, which takes a second.

    Args:
        arrays: The type of a number or vector, and the number of axes, of each argument.
    """
    with _PACKING:
        _specialised(kernel, tuple(_array_type(dtype, ndim) for dtype, ndim in arrays))


def launch(
    kernel: Any,
    size: int,
    arguments: Sequence[KernelArray | torch.Tensor | float | int],
    device: torch.device,
    cpu_part: int | None = None,
) -> None:
    """Run `kernel(first, end, stride, *arguments)` so that each of `size` work items is done once.

    Args:
        arguments: Numbers and arrays on `device`, as tensors or as `as_warp` gives them.
        cpu_part: Work items of a part on a CPU, where those that write to the same address must be in one part; None
            if the range may be cut anywhere.
    """
    if size == 0:
        return
    wp = warp()
    taken = [as_warp(x) if isinstance(x, torch.Tensor) else x for x in arguments]
    types = tuple(x.annotation if isinstance(x, KernelArray) else type(x) for x in taken)
    values = [x.descriptor if isinstance(x, KernelArray) else x for x in taken]
    if device.type == "cuda":
        with _PACKING:
            stream = wp.stream_from_torch(torch.cuda.current_stream(device))
            wp.launch(_specialised(kernel, types), dim=size, inputs=[0, size, size, *values], stream=stream)
        return
    threads = min(torch.get_num_threads(), _num_cores())
    part = cpu_part or max(_SMALLEST_PART, -(-size // (_PARTS_PER_THREAD * threads)))
    with _PACKING:
        concrete = _specialised(kernel, types)
        recorded = _RECORDED.get(concrete)
        if recorded is None:
            inputs = [0, size, 1, *values]
            recorded = wp.launch(concrete, dim=1, inputs=inputs, device="cpu", record_cmd=True)
            recorded.params, recorded.fwd_args = recorded.params[:1], None
            _RECORDED[concrete] = recorded

    # A launch of each range of work items, as one was recorded: Warp takes ten times as long to make each anew.
    kinds = [argument.type for argument in recorded.kernel.adj.args]
    bound = kinds[0]._type_
    shared = [
        kind._type_(x) if isinstance(x, float | int) else x for kind, x in zip(kinds[3:], values, strict=True)
    ]
    commands = []
    for begin in range(0, size, part):
        command = copy(recorded)
        command.params = [
            *recorded.params,
            bound(begin),
            bound(min(begin + part, size)),
            bound(1),
            *shared,
        ]
        commands.append(command)

    # This thread runs them, and others that have nothing else to do: one iterator for all, whose steps the interpreter
    # doesn't interrupt, so that each is taken once.
    remaining = iter(commands)

    def work() -> None:
        for command in remaining:
            command.launch()

    helpers = [_pool(threads - 1).submit(work) for _ in range(min(threads, len(commands)) - 1)]
    work()
    for helper in helpers:
        if not helper.cancel():
            helper.result()


@cache
def _num_cores() -> int:
    """Cores of the machine: asking the system takes as long as a short launch."""
    return os.cpu_count() or 1


@cache
def _pool(num_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads, thread_name_prefix="unmix-kernel")


@cache
def _specialised(kernel: Any, types: tuple[Any, ...]) -> Any:
    """The kernel for arguments of these types: found once, since Warp would infer them at each launch of a part."""
    return warp().overload(kernel, [int, int, int, *types]) if kernel.is_generic else kernel


@cache
def _array_type(dtype: Any, ndim: int) -> Any:
    return warp().array(dtype=dtype, ndim=ndim)


@cache
def vector_type(length: int, dtype: torch.dtype) -> Any:
    """Warp's vector of `length` numbers of a torch floating-point type."""
    wp = warp()
    return wp.types.vector(length, wp.dtype_from_torch(dtype))
