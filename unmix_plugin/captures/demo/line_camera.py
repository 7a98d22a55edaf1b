"""A line camera that is not perfect: what its detector writes for the light that comes in.

One row of an image is exposed at a time, so that every column and band of the detector has a sensitivity and a dark
current of its own, and what a column gets wrong it gets wrong in every row.

Notation: `W` columns, `B` bands, `h` rows. Light is relative to a white matt panel, 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt16

FULL_WELL = 100_000.0
"""Electrons that a pixel of the detector can hold."""
ELECTRONS_PER_COUNT = FULL_WELL / 64_000
READ_NOISE = 12.0
"""Electrons, standard deviation."""
WHITE_SHARE = 0.95
"""Share of the full well that the white panel fills in the best band and column: brighter highlights saturate."""
DARK_COUNTS = 900.0
DARK_SPREAD = 120.0
"""Standard deviation of the dark counts of columns."""
GAIN_SPREAD = 0.03
"""Standard deviation of the columns' sensitivities, as a share."""
VIGNETTING = 0.3
"""Light that the lens loses at the ends of the line, as a share."""
BAD_NOISE = 0.5
"""Noise of a noisy band as a share of the full well."""


@dataclass(frozen=True)
class BadBands:
    """Bands that measure nothing usable, by index, and whether the instrument marks them."""

    noisy_marked: int
    dead_marked: int
    noisy_unmarked: int

    @classmethod
    def of(cls, bands: int) -> BadBands:
        """The first is noisy, one is dead after a third of the `bands`, one noisy after two thirds."""
        return cls(0, bands // 3, 2 * bands // 3)

    @property
    def marked(self) -> tuple[int, int]:
        """Bands that the header marks as bad."""
        return (self.noisy_marked, self.dead_marked)

    @property
    def all(self) -> tuple[int, int, int]:
        """Every bad band."""
        return (*self.marked, self.noisy_unmarked)


@dataclass(frozen=True)
class LineCamera:
    """One detector behind one lens."""

    white_electrons: Float32[np.ndarray, "W B"]
    """What the white panel gives."""
    dark_counts: Float32[np.ndarray, "W B"]
    bad: BadBands

    def expose(
        self, light: Float32[np.ndarray, "h W B"], generator: np.random.Generator
    ) -> UInt16[np.ndarray, "h W B"]:
        """Counts for light, with shot noise and read noise; 65535 where the pixel is full."""
        electrons = light * self.white_electrons
        noise = generator.standard_normal(light.shape, dtype=np.float32)
        electrons += noise * np.sqrt(electrons + np.float32(READ_NOISE**2))
        for band in (self.bad.noisy_marked, self.bad.noisy_unmarked):
            extra = generator.standard_normal(light.shape[:2], dtype=np.float32)
            electrons[..., band] += np.float32(BAD_NOISE * FULL_WELL) * extra
        counts = self.dark_counts + electrons / np.float32(ELECTRONS_PER_COUNT)
        counts[..., self.bad.dead_marked] = 0
        return counts.round().clip(0, np.iinfo(np.uint16).max).astype(np.uint16)


def demo_line_camera(
    width: int, wavelengths_nm: Float[np.ndarray, " B"], lamp: Float[np.ndarray, " B"]
) -> LineCamera:
    """The demo's line camera.

    Args:
        width: Columns of its images.
        wavelengths_nm: Band centres.
        lamp: Power of the lamp in each band, in any unit.
    """
    generator = np.random.default_rng(8)
    bands = len(wavelengths_nm)
    # Silicon behind a grating: most sensitive in the green, a third of that at 400 nm.
    sensitivity = np.exp(-(((wavelengths_nm - 560) / 150) ** 2))
    across = np.linspace(-1, 1, width)[:, None]
    columns = (1 - VIGNETTING * across**2) * (1 + GAIN_SPREAD * generator.standard_normal((width, bands)))
    light = columns * sensitivity * lamp
    # Columns are read through two amplifiers in turn, whose offsets differ.
    dark = DARK_COUNTS + DARK_SPREAD * (
        generator.standard_normal((width, 1)) + 0.3 * generator.standard_normal((width, bands))
    )
    dark[1::2] += DARK_SPREAD
    return LineCamera(
        (WHITE_SHARE * FULL_WELL * light / light.max()).astype(np.float32),
        dark.clip(0).astype(np.float32),
        BadBands.of(bands),
    )
