"""What a training has of its machine: a device, memory that stays, signals, threads, and random numbers.

Randomness is a function of (seed, step), so that a resumed run draws what a straight one drew.
"""

from __future__ import annotations

import ctypes
import gc
import random
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from types import FrameType
from typing import TypeVar

import numpy as np
import torch

from unmix_plugin.errors import ConfigError


def resolve_device(name: str) -> torch.device:
    """The device that `auto`, `cpu` or `cuda` means on this machine. Raises ConfigError: CUDA was asked for and there
    is none, or the word is none of the three."""
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"--device must be auto, cpu or cuda; got {name!r}")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if torch.cuda.is_available():
        return torch.device("cuda", torch.cuda.current_device())
    cause = (
        "this PyTorch is built without CUDA: install a CUDA build (https://pytorch.org/get-started)"
        if torch.version.cuda is None
        else "PyTorch finds no usable GPU: check nvidia-smi and the driver"
    )
    raise ConfigError(f"--device cuda, but {cause}; or leave --device at auto, which takes the CPU here")


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # names of mallopt's settings in malloc.h
_KEPT_BYTES = 2**30


def keep_freed_memory() -> None:
    """Hand back to the system what is free now, and let the C library keep large blocks that are freed from now on.

    A training step frees and takes blocks of a few MB hundreds of times; by default glibc returns each, and the page
    faults of taking it again took 40 % of the time of a field evaluation on two cores. Does nothing where the C library
    is another.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        library = ctypes.CDLL("libc.so.6")
        mallopt, trim = library.mallopt, library.malloc_trim
    except (OSError, AttributeError):
        return
    gc.collect()  # what a search left behind in circles is as large as a scene's grids
    trim(0)
    mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
    mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)


@contextmanager
def handled_signals(handlers: Mapping[str, Callable[[int, FrameType | None], None]]) -> Iterator[None]:
    """Context in which these signals, by name, go to these functions; those that the system lacks are passed over."""
    known = {getattr(signal, name): handler for name, handler in handlers.items() if hasattr(signal, name)}
    before = {number: signal.signal(number, handler) for number, handler in known.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_T = TypeVar("_T")
_MOST_BESIDE = 8
"""Calls under way beside others, which may have some beside them in turn."""


def can_work_beside(device: torch.device) -> bool:
    """Whether this thread has threads to share with another one for operations on a device."""
    return device.type == "cpu" and torch.get_num_threads() > 1


@contextmanager
def working_beside(call: Callable[[], _T]) -> Iterator[Future[_T]]:
    """Context in which another thread works on a call, and each of both has half of this one's threads for its
    operations; when the context is left, the call has ended.

    Most operations of a training step or a frame are too small for PyTorch to share among threads: on two cores a
    quarter of one was in use beside the other.
    """
    threads = torch.get_num_threads() // 2

    def work() -> _T:
        with operations_shared_among(threads):
            return call()

    with operations_shared_among(threads):
        beside = _threads_beside().submit(work)
        try:
            yield beside
        finally:
            wait([beside])


@cache
def _threads_beside() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_MOST_BESIDE, thread_name_prefix="unmix-beside")


@contextmanager
def operations_shared_among(num_threads: int) -> Iterator[None]:
    """Context in which PyTorch shares the operations that this thread calls among so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(num_threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


_MASK = (1 << 64) - 1


def step_seed(seed: int, step: int, stream: int = 0) -> int:
    """A seed in [0, 2^63) for one step of one stream of randomness; nearby arguments give unrelated seeds.

    Source:
        Steele, Lea and Flood 2014, the finaliser of SplitMix64, applied once an argument.
    """
    state = 0
    for value in (seed, step, stream):
        state = ((state ^ (value & _MASK)) + 0x9E3779B97F4A7C15) & _MASK
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & _MASK
        state ^= state >> 31
    return state >> 1


def step_generator(
    seed: int, step: int, device: torch.device | str = "cpu", stream: int = 0
) -> torch.Generator:
    """A generator for one step; `stream` keeps two uses in the same step apart."""
    return torch.Generator(device=device).manual_seed(step_seed(seed, step, stream))


def seed_everything(seed: int) -> None:
    """Seed the global generators of torch, NumPy and Python, which a method's own code may use."""
    # torch.manual_seed records a call for each kind of device that is not in use, which takes longer than all of this.
    torch.default_generator.manual_seed(seed)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(seed)
    np.random.seed(step_seed(seed, 0) & 0xFFFFFFFF)  # noqa: NPY002
    random.seed(seed)
