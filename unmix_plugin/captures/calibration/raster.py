"""Which pixels of an image are kept, and how they are averaged: cropping, then binning.

Notation: `H x W` pixels of the file, `h x w` of what is written.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class Raster:
    """A rectangle of the file's pixels, averaged in squares; what does not fill a square at its end is left out."""

    top: int
    left: int
    height: int
    """Rows of the result."""
    width: int
    """Columns of the result."""
    binning: int
    """Side of a square in pixels of the file."""

    @staticmethod
    def of(height: int, width: int, crop: tuple[int, int, int, int] | None, binning: int) -> Raster:
        """The raster of images of this size.

        Args:
            height, width: Of the file.
            crop: First row and column, height and width; None keeps all.
            binning: At least 1.
        Raises:
            ConfigError: the rectangle leaves the image, or nothing is left.
        """
        top, left, rows, columns = (0, 0, height, width) if crop is None else crop
        if min(top, left) < 0 or min(rows, columns) < 1 or top + rows > height or left + columns > width:
            raise ConfigError(
                f"--crop {top} {left} {rows} {columns} (row, column, height, width) leaves the image of {height} rows "
                f"and {width} columns"
            )
        if binning < 1 or min(rows, columns) // binning < 2:
            raise ConfigError(
                f"--bin-pixels {binning} leaves fewer than 2 x 2 of {rows} x {columns} pixels; give a smaller number"
            )
        return Raster(top, left, rows // binning, columns // binning, binning)

    @property
    def columns(self) -> slice:
        """Columns of the file."""
        return slice(self.left, self.left + self.width * self.binning)

    def file_rows(self, first: int, last: int) -> slice:
        """Rows of the file that rows `first` to `last` (excluded) of the result are made of."""
        return slice(self.top + first * self.binning, self.top + last * self.binning)

    def blocks(self, bands: int, most_values: int) -> Iterator[tuple[int, int]]:
        """First and last row (excluded) of parts of the result that are read from at most `most_values` values."""
        step = max(1, most_values // (self.width * self.binning * self.binning * bands))
        for first in range(0, self.height, step):
            yield first, min(first + step, self.height)

    def averaged(self, values: np.ndarray) -> np.ndarray:
        """Means over squares, (h * n, w * n, ...) to (h, w, ...)."""
        if self.binning == 1:
            return values
        n = self.binning
        squares = values.reshape(len(values) // n, n, values.shape[1] // n, n, *values.shape[2:])
        return squares.mean(axis=(1, 3), dtype=values.dtype)

    def any_in_square(self, marks: np.ndarray) -> np.ndarray:
        """Whether a mark is in each square, (h * n, w * n, ...) to (h, w, ...)."""
        if self.binning == 1:
            return marks
        n = self.binning
        return np.any(
            marks.reshape(len(marks) // n, n, marks.shape[1] // n, n, *marks.shape[2:]), axis=(1, 3)
        )

    def lens(self, lens: Lens) -> Lens:
        """The intrinsics of the result from those of the whole image in the file."""
        n = self.binning
        return replace(
            lens,
            width=self.width,
            height=self.height,
            focal_px=(lens.focal_px[0] / n, lens.focal_px[1] / n),
            center_px=((lens.center_px[0] - self.left) / n, (lens.center_px[1] - self.top) / n),
        )

    def lens_of_file(self, lens: Lens, height: int, width: int) -> Lens:
        """The inverse of `lens`: intrinsics of the whole image, of this size, from those of the result."""
        n = self.binning
        return replace(
            lens,
            width=width,
            height=height,
            focal_px=(lens.focal_px[0] * n, lens.focal_px[1] * n),
            center_px=(lens.center_px[0] * n + self.left, lens.center_px[1] * n + self.top),
        )
