"""How much memory pixels take, and how much of them to hold."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from unmix_plugin.engine.processes.joining import processes_here
from unmix_plugin.scenes.pixel_table.block import PixelBlock

_GIB = 2**30
_USABLE_SHARE = 0.8
"""Of the memory that is left."""
_LARGEST_POOL = 2**30
"""Of pixels on disk; more in memory would not be drawn from more evenly."""


def available_bytes(device: torch.device) -> int | None:
    """Memory that a device has left, as far as the system says; None where it doesn't."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration):
        names = getattr(os, "sysconf_names", {})
        if not {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= names.keys():
            return None
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:  # a container may have less than its machine
        group = Path("/sys/fs/cgroup")
        limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
    except (OSError, ValueError):
        return free
    return min(free, max(0, limit - used))


def budget_bytes(device: torch.device, memory_gb: float | None) -> int | None:
    """Memory that pixels may take; None where nothing limits it.

    Args:
        memory_gb: In GiB; None: most of what the device has left.
    """
    if memory_gb is not None:
        return int(memory_gb * _GIB)
    available = available_bytes(device)
    if available is not None and device.type == "cpu":
        available //= processes_here()
    return None if available is None else int(_USABLE_SHARE * available)


def pool_bytes(budget: int, memory_gb: float | None) -> int:
    """How much of pixels on disk to hold at a time; arguments as above."""
    return budget if memory_gb is not None else min(_LARGEST_POOL, budget)


def describe_pool(blocks: tuple[PixelBlock, ...]) -> str:
    """What stays on disk, in words."""
    held = sum(block.pool.num_bytes for block in blocks if block.pool is not None)
    what, needed = " and ".join(block.description for block in blocks), sum(b.num_bytes for b in blocks)
    return (
        f"the training pixels stay on disk: {what} are {needed / _GIB:.3g} GiB; {held / _GIB:.3g} GiB of them are in "
        "memory at a time, and others are read while training goes on (memory-gb)"
    )
