"""The measured pixels of some views in memory, as small as they were stored.

Cubes of 8 or 16 bits stay as they are in their files and become float32 when pixels are drawn: half or a quarter of the
memory for the same numbers. Cubes of other types are kept as float32.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.scene import Scene

COMPACT_TYPES = ("f2", "u1", "i1", "i2", "u2")
"""Of NumPy, at most half as large as float32."""
_GIB = 2**30


class PixelStore:
    """All pixels of some views, view after view, row after row."""

    alpha: Float[Tensor, "pixels"]
    """Opacity in [0, 1]; 1 where the scene has no alpha."""
    valid: Bool[Tensor, "pixels"]
    """Pixels that count, on the CPU."""

    def __init__(self, scene: Scene, device: torch.device, views: tuple[int, ...]) -> None:
        """Read the pixels.

        Raises:
            ConfigError: they don't fit in the memory of the device; nothing was read.
        """
        types = {scene.stored_type(view) for view in views}
        kind = types.pop() if len(types) == 1 else "f4"
        self._is_compact = kind in COMPACT_TYPES
        self._is_unsigned = kind == "u2"  # PyTorch can't index these, but the same bits as int16
        self._scale = scene.options.value_scale
        kept = np.dtype("i2" if self._is_unsigned else kind if self._is_compact else "f4")
        bands, num_pixels = len(scene.wavelengths_nm), scene.cameras.height * scene.cameras.width
        _require_memory(scene, len(views), kept, device)
        blank = torch.from_numpy(np.empty(0, kept))
        self._values = torch.empty(len(views), num_pixels, bands, dtype=blank.dtype, device=device)
        self.alpha = torch.ones(len(views), num_pixels, device=device)
        self.valid = torch.empty(len(views), num_pixels, dtype=torch.bool)
        for row, view in enumerate(views):
            values = scene.stored_cube(view) if self._is_compact else scene.cube(view)
            self._values[row] = torch.from_numpy(values.reshape(num_pixels, bands).view(kept))
            self.valid[row] = torch.from_numpy(scene.valid_mask(view)).flatten()
            opacity = scene.alpha(view)
            if opacity is not None:
                self.alpha[row] = torch.from_numpy(opacity).flatten()
        self._values, self.alpha = self._values.flatten(0, 1), self.alpha.flatten()
        self.valid = self.valid.flatten()

    def __len__(self) -> int:
        return len(self._values)

    def spectra(self, pixels: Int[Tensor, " R"]) -> Float[Tensor, "R B"]:
        """Spectra of some pixels in [0, 1], the numbers of `Scene.cube`; only of valid ones."""
        values = self._values[pixels]
        if not self._is_compact:
            return values
        if self._is_unsigned:
            values = values.to(torch.int32) & 0xFFFF
        values = values.float()
        return (values if self._scale is None else values / self._scale).clamp(0.0, 1.0)


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


def _require_memory(scene: Scene, views: int, kept: np.dtype, device: torch.device) -> None:
    height, width, bands = scene.cameras.height, scene.cameras.width, len(scene.wavelengths_nm)
    needed = views * height * width * (bands * kept.itemsize + 5)
    available = available_bytes(device)
    if available is None or needed <= available:
        return
    smaller = "" if kept.itemsize < 4 else ", store the cubes as float16, which halves them"
    raise ConfigError(
        f"the training pixels don't fit in memory: {views} views x {height} x {width} pixels x {bands} bands x "
        f"{kept.itemsize} bytes need {needed / _GIB:.1f} GiB on {device}, {available / _GIB:.1f} GiB are available; "
        f"train on fewer views, bin pixels or bands{smaller}, or use a machine with more memory"
    )
