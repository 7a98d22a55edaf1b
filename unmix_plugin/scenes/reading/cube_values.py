"""One pass over the values of a cube: what is out of range, how often, and which scale would mend it.

Values are judged after the division by `value_scale`. Cubes are read a few rows at a time, so that a cube of any size
takes little memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unmix_plugin.scenes.reading.arrays import map_array

BLOCK_VALUES = 1 << 20
"""Values looked at together; 4 MiB as float32."""
EXCESS_SHARE = 0.01
"""Share of values above 1 that is still taken for saturated highlights when no scale was given."""
EXCESS_VALUE = 10.0
"""Greatest value that is still taken for a highlight when no scale was given."""
EXCESS_SHARE_SCALED = 0.5
"""Share of values above 1 at which a scale that was given must be wrong."""
INTEGER_SCALES = (255.0, 10000.0, 65535.0)
"""8 bits, reflectance x 10000, 16 bits."""
FLOAT_SCALES = (100.0, *INTEGER_SCALES)
"""Per cent, or integers kept as floats."""


@dataclass(frozen=True)
class CubeValues:
    """What one cube holds; counts are of single values unless they say pixels."""

    num_values: int
    num_pixels: int
    is_integer: bool
    greatest: float
    """Greatest finite value as stored, before any division; 0 if there is none."""
    num_nan: int
    num_infinite: int
    num_negative: int
    num_invalid_pixels: int
    """Pixels with a NaN, infinite or negative value in any band."""
    num_above_one: int
    """Finite values above 1 after the division."""


def measure_cube(path: Path, value_scale: float | None) -> CubeValues:
    """Read every value of a checked (H, W, B) cube once."""
    cube = map_array(path)
    height, width, bands = cube.shape
    rows = max(1, BLOCK_VALUES // max(1, width * bands))
    totals = np.zeros(5, dtype=np.int64)
    greatest = 0.0
    for first in range(0, height, rows):
        with np.errstate(over="ignore"):  # a float64 beyond float32 becomes infinite and is counted as such
            stored = np.asarray(cube[first : first + rows], dtype=np.float32)
        block = stored if value_scale is None else stored / np.float32(value_scale)
        low, high = float(block.min()), float(block.max())
        if low >= 0.0 and high <= 1.0:  # false with any NaN; most blocks of a sound scene end here
            greatest = max(greatest, float(stored.max()))
            continue
        finite = np.isfinite(block)
        negative = block < 0.0
        invalid = (~finite | negative).any(axis=-1)
        totals += (
            np.isnan(block).sum(),
            np.isinf(block).sum(),
            (negative & finite).sum(),
            invalid.sum(),
            ((block > 1.0) & finite).sum(),
        )
        greatest = max(greatest, float(stored.max(where=finite, initial=0.0)))
    nan, infinite, negative_count, invalid_count, above = (int(total) for total in totals)
    return CubeValues(
        num_values=cube.size,
        num_pixels=height * width,
        is_integer=cube.dtype.kind in "iu",
        greatest=greatest,
        num_nan=nan,
        num_infinite=infinite,
        num_negative=negative_count,
        num_invalid_pixels=invalid_count,
        num_above_one=above,
    )


def is_far_out_of_range(values: CubeValues, value_scale: float | None) -> bool:
    """Whether a cube's values cannot be meant as [0, 1].

    Saturated highlights above 1 are common and are clipped; a cube that is above 1 in more than a few places, or by
    far, was stored in other units.
    """
    share = values.num_above_one / values.num_values
    if value_scale is None:
        return share > EXCESS_SHARE or values.greatest > EXCESS_VALUE
    return share > EXCESS_SHARE_SCALED


def propose_scale(greatest: float, is_integer: bool) -> float:
    """The `value_scale` that most likely brings stored values up to `greatest` into [0, 1].

    >>> propose_scale(243.0, True), propose_scale(4000.0, True), propose_scale(40000.0, True)
    (255.0, 10000.0, 65535.0)
    >>> propose_scale(87.0, False), propose_scale(3.14, False)
    (100.0, 3.2)
    """
    for scale in INTEGER_SCALES if is_integer else FLOAT_SCALES:
        if greatest <= scale and (is_integer or greatest > EXCESS_VALUE):
            return scale
    digits = int(np.floor(np.log10(max(greatest, 1e-30)))) - 1
    return float(np.round(np.ceil(greatest / 10.0**digits) * 10.0**digits, max(0, -digits)))
