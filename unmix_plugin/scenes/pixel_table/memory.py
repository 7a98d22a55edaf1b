"""Whether pixels fit in memory."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.pixel_table.block import PixelBlock

_GIB = 2**30


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


def require_memory(blocks: tuple[PixelBlock, ...], device: torch.device) -> None:
    """Refuse pixels that a device has no room for.

    Raises:
        ConfigError: they don't fit.
    """
    needed = sum(block.num_bytes for block in blocks)
    available = available_bytes(device)
    if available is None or needed <= available:
        return
    what = " and ".join(block.description for block in blocks)
    smaller = (
        ", store the cubes as float16, which halves them" if any(b.value_bytes == 4 for b in blocks) else ""
    )
    raise ConfigError(
        f"the training pixels don't fit in memory: {what} need {needed / _GIB:.1f} GiB on {device}, "
        f"{available / _GIB:.1f} GiB are available; train on fewer views, bin pixels or bands{smaller}, or use a "
        "machine with more memory"
    )
