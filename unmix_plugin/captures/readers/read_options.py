"""What a user adds to a file that doesn't say enough of itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float64

Axes: TypeAlias = Literal["yxb", "byx", "ybx", "xyb", "bxy", "xby"]
"""What the axes of an array are, the slowest first: y rows, x columns, b bands."""


@dataclass(frozen=True)
class ReadOptions:
    """Facts that override what a file says."""

    dataset: str | None = None
    """Variable or data set to take from a file that holds several."""
    wavelengths_nm: Float64[np.ndarray, " B"] | None = None
    """Band centres in nm, in the order of the file."""
    axes: Axes | None = None
    """Order of the axes in formats that don't fix it: NumPy, MATLAB, HDF5, torch, pages of a TIFF."""
    size: tuple[int, int] | None = None
    """Rows and columns of an image that is stored as a list of pixels, column after column as MATLAB writes it."""
