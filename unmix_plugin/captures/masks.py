"""Matter and background of each view: from files, or from a background that is white or black.

The border of the views tells how bright the background is and how much it varies; a threshold between it and the rest
follows from that. Specks are then removed and small holes are filled.

Notation: `H x W` pixels, `B` bands; values in [0, 1] as they are written.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.errors import CaptureError

Background = Literal["white", "black"]

SMALL_SHARE = 5e-4
"""Specks and holes smaller than this share of the picture are removed."""
DEVIATIONS = 6.0
"""Standard deviations of the background's noise between its level and the threshold."""
LEAST_DISTANCE = 0.02
"""Between level and threshold, as a share of the brightest pixels; JPEG and shading vary a background by about this."""
LEAST_WHITE, MOST_BLACK = 0.5, 0.2
"""Level of a white or black background, as a share of the brightest pixels."""


@dataclass(frozen=True)
class BackgroundRule:
    """Which pixels are background."""

    kind: Background
    threshold: float
    """Background is at least this bright in every band (white), or at most this bright in the mean (black)."""
    level: float
    """Median of the border."""
    deviation: float
    """Robust standard deviation of the border."""

    def matter(self, values: Float32[np.ndarray, "h W B"]) -> Bool[np.ndarray, "h W"]:
        """Pixels that are not background."""
        brightness = background_brightness(self.kind, values)
        return brightness < self.threshold if self.kind == "white" else brightness > self.threshold


def background_brightness(kind: Background, values: Float32[np.ndarray, "*pixels B"]) -> np.ndarray:
    """What tells background from matter: white is bright in every band, black is dark in the mean."""
    return values.min(axis=-1) if kind == "white" else values.mean(axis=-1)


def find_background(kind: Background, border: Float32[np.ndarray, "N B"], brightest: float) -> BackgroundRule:
    """The rule that fits pixels at the border of the views.

    Args:
        kind: What the background is said to be.
        border: Spectra at the border of all views.
        brightest: A high percentile of what the kind is judged by, over whole views.
    Raises:
        CaptureError: most of the border is not white or black.
    """
    brightness = background_brightness(kind, border)
    level = float(np.median(brightness))
    deviation = 1.4826 * float(np.median(np.abs(brightness - level)))
    distance = max(DEVIATIONS * deviation, LEAST_DISTANCE * brightest)
    share = level / brightest if brightest > 0 else 0.0
    if (kind == "white" and share < LEAST_WHITE) or (kind == "black" and share > MOST_BLACK):
        expected = f"more than {LEAST_WHITE:.0%}" if kind == "white" else f"less than {MOST_BLACK:.0%}"
        raise CaptureError(
            f"--mask {kind}: the border of the views is at {share:.0%} of the brightest pixels; expected {expected}, "
            "as the background should reach to the border: choose another --mask"
        )
    threshold = level - distance if kind == "white" else level + distance
    return BackgroundRule(kind, threshold, level, deviation)


@dataclass(frozen=True)
class CleanMask:
    """A mask without specks and small holes, and what was changed."""

    matter: Bool[np.ndarray, "H W"]
    specks: int
    holes: int
    """Numbers of connected parts."""


def clean(matter: Bool[np.ndarray, "H W"]) -> CleanMask:
    """Remove specks, then fill holes, each connected by edges and smaller than `SMALL_SHARE` of the picture.

    >>> mask = np.zeros((100, 100), bool)
    >>> mask[20:80, 20:80] = True
    >>> mask[40, 40] = False
    >>> mask[5, 5] = True
    >>> done = clean(mask)
    >>> int(done.matter.sum()), done.specks, done.holes
    (3600, 1, 1)
    """
    smallest = max(4, round(SMALL_SHARE * matter.size))
    kept, specks = _without_small(matter, smallest)
    background, holes = _without_small(~kept, smallest)
    return CleanMask(~background, specks, holes)


def _without_small(mask: Bool[np.ndarray, "H W"], smallest: int) -> tuple[Bool[np.ndarray, "H W"], int]:
    from scipy import ndimage

    parts = np.empty(mask.shape, np.int32)
    ndimage.label(mask, output=parts)
    sizes = np.bincount(parts.ravel())
    is_small = sizes < smallest
    is_small[0] = False
    return mask & ~is_small[parts], int(is_small.sum())
