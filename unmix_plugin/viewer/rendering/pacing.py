"""How fine to render, and how much at once: from a measured speed to picture sizes and block sizes.

While a camera moves each picture must come soon, so it is small; once it rests, pictures of twice the height follow
until the height asked for is reached.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

MOVING_S, LONGEST_MOVING_S = 1 / 30, 0.07
"""Time for a moving picture: as on a fast device, and as on one that would otherwise show nothing but blur."""

LEAST_MOVING_PIXELS, FEWEST_PIXELS = 4096, 256
"""A moving picture has so many pixels if they take no longer than `LONGEST_MOVING_S`, and never fewer than these."""

BLOCK_S = 0.03
"""Time that a block takes: how long anything more urgent waits."""

_BLOCK_BOUNDS = (256, 1 << 17)
_FIRST_GUESS = 20_000.0
_MEMORY = 0.7


@dataclass
class Speedometer:
    """Rays a second, as measured recently."""

    rays_per_second: float = _FIRST_GUESS

    def add(self, rays: int, seconds: float) -> None:
        """Take in a measurement; short ones say less, but the least block counts still."""
        if rays <= 0 or seconds <= 0:
            return
        measured = rays / seconds
        # Geometric, since speeds of empty and of full parts of a picture differ by factors.
        self.rays_per_second = math.exp(
            _MEMORY * math.log(self.rays_per_second) + (1 - _MEMORY) * math.log(measured)
        )

    @property
    def block_rays(self) -> int:
        """Rays to render in one go."""
        low, high = _BLOCK_BOUNDS
        return int(min(max(self.rays_per_second * BLOCK_S, low), high))


def moving_height(rays_per_second: float, aspect: float, largest_height: int) -> int:
    """Rows of a picture of a moving camera."""
    pixels = max(
        rays_per_second * MOVING_S,
        min(LEAST_MOVING_PIXELS, rays_per_second * LONGEST_MOVING_S),
        FEWEST_PIXELS,
    )
    return max(1, min(int(math.sqrt(pixels / aspect)), largest_height))


def finer_height(height: int, largest_height: int) -> int | None:
    """Rows of the next picture of a camera at rest; None after the finest."""
    if height >= largest_height:
        return None
    return largest_height if 2 * height * 1.2 >= largest_height else 2 * height


def affordable_height(rays_per_second: float, seconds: float, aspect: float, largest_height: int) -> int:
    """Rows of the finest picture that takes no longer than `seconds`."""
    return max(1, min(int(math.sqrt(rays_per_second * seconds / aspect)), largest_height))
