"""One pass over a cube's file: its hash, which pixels are out of range, and which scale would bring them in.

Values are judged after the division by `value_scale`. Cubes are read a few rows at a time, so that a cube of any size
takes little memory.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.scenes.reading.arrays import map_array

BLOCK_VALUES = 1 << 20
"""Values looked at together; 4 MiB as float32."""
EXCESS_SHARE = 0.01
"""Share of values above 1 that is still taken for saturated highlights when no scale was given; also share of values
far below 0 that a cube with noise around black may have."""
EXCESS_VALUE = 10.0
"""Greatest value that is still taken for a highlight when no scale was given."""
NOISE = 0.1
"""Negative values above minus this may be noise around black."""
EXCESS_SHARE_SCALED = 0.5
"""Share of values above 1 at which a scale that was given must be wrong."""
SENSOR_BITS = (8, 10, 12, 14, 16)
"""Of cameras; the greatest number of each stands for 1."""
REFLECTANCE_SCALE = 10000.0
"""Of reflectances kept as integers, as satellites deliver them."""
FLOAT_SCALES = (100.0, 255.0, REFLECTANCE_SCALE, 65535.0)
"""Per cent, or integers kept as floats."""

InvalidPixels = Literal["refuse", "mask", "clip"]


@dataclass(frozen=True)
class CubeValues:
    """What one cube holds; counts are of single values unless they say pixels."""

    sha256: str
    """Of the whole file."""
    num_values: int
    num_pixels: int
    is_integer: bool
    greatest: float
    """Greatest finite value as stored, before any division; 0 if there is none."""
    least: float
    """Least finite value after the division; 0 if none is negative."""
    num_nan: int
    num_infinite: int
    num_negative: int
    num_far_negative: int
    """Of these, how many are further below 0 than noise around black."""
    num_above_one: int
    """Finite values above 1 after the division."""
    invalid: Bool[np.ndarray, "H W"] | None
    """Pixels with a NaN, infinite or (unless they are clipped) negative value in any band; None if there is none."""

    @property
    def is_noise(self) -> bool:
        """Whether what is negative may be noise around black."""
        return self.num_far_negative <= EXCESS_SHARE * self.num_values

    @property
    def num_invalid_pixels(self) -> int:
        """How many pixels are invalid."""
        return 0 if self.invalid is None else int(self.invalid.sum())


def measure_cube(path: Path, value_scale: float | None, invalid_pixels: InvalidPixels) -> CubeValues:
    """Read a checked (H, W, B) cube once."""
    cube = map_array(path)
    height, width, bands = cube.shape
    rows = max(1, BLOCK_VALUES // max(1, width * bands))
    digest, is_in_file_order = hashlib.sha256(), cube.flags.c_contiguous
    head, end = (cube.offset, cube.offset + cube.nbytes) if is_in_file_order else (-1, 0)  # type: ignore[attr-defined]
    digest.update(_read_bytes(path, 0, head))
    totals = np.zeros(5, dtype=np.int64)
    greatest, least = 0.0, 0.0
    invalid = np.zeros((height, width), bool)
    for first in range(0, height, rows):
        raw = cube[first : first + rows]
        if is_in_file_order:
            digest.update(raw.view(np.uint8).data)
        with np.errstate(over="ignore"):  # a float64 beyond float32 becomes infinite and is counted as such
            stored = np.asarray(raw, dtype=np.float32)
            block = stored if value_scale is None else stored / np.float32(value_scale)
        low, high = float(block.min()), float(block.max())
        if low >= 0.0 and high <= 1.0:  # false with any NaN; most blocks of a sound scene end here
            greatest = max(greatest, float(stored.max()))
            continue
        finite = np.isfinite(block)
        totals += _odd_values(block, finite)
        invalid[first : first + rows] = find_invalid(block, invalid_pixels)
        greatest = max(greatest, float(stored.max(where=finite, initial=0.0)))
        least = min(least, float(block.min(where=finite, initial=0.0)))
    if is_in_file_order:
        digest.update(_read_bytes(path, end))
    return CubeValues(
        digest.hexdigest(),
        cube.size,
        height * width,
        cube.dtype.kind in "iu",
        greatest,
        least,
        *(int(total) for total in totals),
        invalid=invalid if invalid.any() else None,
    )


def _read_bytes(path: Path, start: int, count: int = -1) -> bytes:
    with path.open("rb") as file:
        file.seek(start)
        return file.read(count)


def _odd_values(
    block: Float32[np.ndarray, "h W B"], finite: Bool[np.ndarray, "h W B"]
) -> tuple[np.int64, ...]:
    """Values that are NaN, infinite, negative, further below 0 than noise, and above 1."""
    return (
        np.isnan(block).sum(),
        np.isinf(block).sum(),
        ((block < 0.0) & finite).sum(),
        ((block < -NOISE) & finite).sum(),
        ((block > 1.0) & finite).sum(),
    )


def read_cube(
    path: Path,
    value_scale: float | None,
    invalid_pixels: InvalidPixels,
    part: tuple[slice | np.ndarray, ...] = (),
) -> Float32[np.ndarray, "*pixels B"]:
    """Spectra in [0, 1]: divided by the scale, values above 1 clipped as a saturated sensor does, unusable pixels 0.

    Args:
        part: What to read, as NumPy indexes it; all by default.
    """
    values = _read_scaled(path, value_scale, part)
    if invalid_pixels != "refuse":
        values[find_invalid(values, invalid_pixels)] = 0.0
    return np.clip(values, 0.0, 1.0, out=values)


def read_invalid(
    path: Path, value_scale: float | None, invalid_pixels: InvalidPixels
) -> Bool[np.ndarray, "H W"]:
    """`find_invalid` of a file."""
    return find_invalid(_read_scaled(path, value_scale), invalid_pixels)


def _read_scaled(
    path: Path, value_scale: float | None, part: tuple[slice | np.ndarray, ...] = ()
) -> Float32[np.ndarray, "*pixels B"]:
    with np.errstate(over="ignore"):  # a float64 beyond float32 is infinite, hence invalid
        values = np.array(map_array(path)[part], dtype=np.float32, order="C")
    return values if value_scale is None else np.divide(values, np.float32(value_scale), out=values)


def find_invalid(values: np.ndarray, invalid_pixels: InvalidPixels) -> Bool[np.ndarray, "*pixels"]:
    """Pixels of (..., B) values, already divided, that can't be used: NaN, infinite or negative in some band.

    With `clip` negative values count as 0 and don't make a pixel invalid.
    """
    sound = np.isfinite(values)
    return ~np.all(sound if invalid_pixels == "clip" else sound & (values >= 0.0), axis=-1)


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

    >>> [propose_scale(greatest, True) for greatest in (243.0, 4000.0, 9100.0, 12000.0, 40000.0)]
    [255.0, 4095.0, 10000.0, 16383.0, 65535.0]
    >>> propose_scale(87.0, False), propose_scale(3.14, False)
    (100.0, 3.2)
    """
    for scale in _integer_scales() if is_integer else FLOAT_SCALES:
        if greatest <= scale and (is_integer or greatest > EXCESS_VALUE):
            return scale
    digits = int(np.floor(np.log10(max(greatest, 1e-30)))) - 1
    return float(np.round(np.ceil(greatest / 10.0**digits) * 10.0**digits, max(0, -digits)))


def describe_scale(scale: float) -> str:
    """What a scale stands for, for messages; empty for one that nothing is known of.

    >>> describe_scale(4095.0), describe_scale(3.2)
    (' (12 bits; reflectances times 10000 need 10000)', '')
    """
    bits = {float(2**bits - 1): bits for bits in SENSOR_BITS}.get(scale)
    if bits is None:
        return " (reflectances times 10000; 14 bits need 16383)" if scale == REFLECTANCE_SCALE else ""
    return f" ({bits} bits{'; reflectances times 10000 need 10000' if 8 < bits < 16 else ''})"


def _integer_scales() -> list[float]:
    return sorted([float(2**bits - 1) for bits in SENSOR_BITS] + [REFLECTANCE_SCALE])
