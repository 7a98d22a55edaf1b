"""Pictures in which features are found: 8 bits, stretched, with local contrast, made from spectral cubes.

Notation: `H x W` pixels, `B` bands.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Shaped, UInt8

ReadRows = Callable[[slice], Shaped[np.ndarray, "h W B"]]
"""Some rows of a cube, all bands."""

_PERCENTILES = (1.0, 99.5)
_GAMMA = 0.5
"""Values are light; shadows need the room that eyes, and detectors made for photographs, expect."""
_LOCAL_CONTRAST = 0.02
_TILES = 8
"""A side is cut into so many tiles, each with a contrast of its own."""
_ROWS = 64
"""Read at once."""


def contrast_picture(
    read_rows: ReadRows,
    size: tuple[int, int],
    weights: Float[np.ndarray, " B"],
    valid: Bool[np.ndarray, "H W"] | None = None,
) -> UInt8[np.ndarray, "H W"]:
    """A picture of a cube that is never in memory as a whole.

    Args:
        read_rows: The cube, calibrated or not.
        size: H, W.
        weights: Of bands in the mean; 0 leaves a band out. Use the same for all views, so that they look alike.
        valid: Pixels that count for the stretch; others become black. Pixels that are not finite never count.
    """
    height, width = size
    mean = np.empty((height, width), np.float32)
    used = np.flatnonzero(weights)
    for start in range(0, height, _ROWS):
        rows = slice(start, min(start + _ROWS, height))
        mean[rows] = read_rows(rows)[..., used].astype(np.float32) @ weights[used].astype(np.float32)
    return stretch(mean, valid)


def stretch(
    values: Float32[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"] | None = None
) -> UInt8[np.ndarray, "H W"]:
    """Values between two percentiles as a picture with local contrast; black where they don't count."""
    from skimage.exposure import equalize_adapthist

    counts = np.isfinite(values) if valid is None else valid & np.isfinite(values)
    if not counts.any():
        return np.zeros(values.shape, np.uint8)
    low, high = np.percentile(values[counts], _PERCENTILES)
    if high <= low:
        return np.where(counts, np.uint8(128), np.uint8(0))
    level = np.clip((np.where(counts, values, low) - low) / (high - low), 0.0, 1.0) ** _GAMMA
    tile = [max(side // _TILES, 1) for side in values.shape]
    local = equalize_adapthist(level, kernel_size=tile, clip_limit=_LOCAL_CONTRAST)
    return np.where(counts, np.round(255.0 * local), 0.0).astype(np.uint8)


def mean_weights(good: Bool[np.ndarray, " B"]) -> Float64[np.ndarray, " B"]:
    """Weights that average the good bands; all of them if none is good."""
    weights = good.astype(np.float64) if good.any() else np.ones(len(good))
    return weights / weights.sum()


def without_rim(mask: Bool[np.ndarray, "H W"], pixels: int) -> Bool[np.ndarray, "H W"]:
    """A mask of matter without its rim, whose features belong to the silhouette and not to the surface."""
    from scipy.ndimage import binary_erosion

    return binary_erosion(mask, iterations=pixels) if pixels > 0 else mask
