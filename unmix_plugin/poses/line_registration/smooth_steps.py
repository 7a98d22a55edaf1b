"""Steps of rows that follow each other smoothly, and the banded equations of their least squares.

What carries a line camera moves smoothly: the second difference between knots is small (`BEND_PX`), so what no row
tells of goes on straight, and the first difference is not large (`DRIFT_PX`), so it does not go far.

Notation: `n` knots; a step has 6 numbers, so there are 6 n unknowns, coupled over 4 knots in a row.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float64

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

BEND_PX = 1.0
DRIFT_PX = 2.0
SIZE_PX = 100.0
"""Standard deviations in pixels: of the bend at a knot, of the drift from a knot to the next, and of a step."""
_NUMBERS = 6
_BANDWIDTH = 4 * _NUMBERS - 1


class SmoothPrior:
    """What steps cost that are rough or large."""

    def __init__(self, num_knots: int, pixel: float) -> None:
        """`pixel` is its angle in radians."""
        from scipy.sparse import identity

        drifts, bends = (_differences(num_knots, order) for order in (1, 2))
        total = (
            (bends.T @ bends) / BEND_PX**2
            + (drifts.T @ drifts) / DRIFT_PX**2
            + identity(num_knots) / SIZE_PX**2
        )
        self.matrix = (total / pixel**2).tocsr()

    def slope(self, steps: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 6"]:
        """Half of the gradient of `cost`."""
        return np.asarray(self.matrix @ steps)

    def cost(self, steps: Float64[np.ndarray, "n 6"]) -> float:
        """Sum of squares, each over its variance."""
        return float((steps * self.slope(steps)).sum())

    def smoothest(
        self, steps: Float64[np.ndarray, "n 6"], is_free: Bool[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n 6"]:
        """Steps that cost least among those that differ at the free knots alone."""
        from scipy.sparse.linalg import spsolve

        found = steps.copy()
        if not is_free.any():
            return found
        found[is_free] = 0.0
        own = self.matrix[is_free][:, is_free].tocsc()
        found[is_free] = -spsolve(own, self.slope(found)[is_free]).reshape(-1, _NUMBERS)
        return found

    def add_to(self, blocks: Float64[np.ndarray, "4 n 6 6"]) -> None:
        """Add it to normal equations: block (d, a) couples knot a with knot a + d."""
        for apart in range(min(3, self.matrix.shape[0])):
            diagonal = self.matrix.diagonal(apart)
            blocks[apart, : len(diagonal)] += diagonal[:, None, None] * np.eye(_NUMBERS)


def _differences(num_knots: int, order: int) -> csr_matrix:
    """The matrix that takes differences between neighbours so many times."""
    from scipy.sparse import csr_matrix, identity

    found = csr_matrix(identity(num_knots))
    for _ in range(min(order, num_knots - 1)):
        found = found[1:] - found[:-1]
    return found if order < num_knots else found[:0]


def solve_banded(
    blocks: Float64[np.ndarray, "4 n 6 6"], pull: Float64[np.ndarray, "n 6"], damping: float
) -> Float64[np.ndarray, "n 6"]:
    """Solution of normal equations whose diagonal is larger by a share (Levenberg-Marquardt).

    Args:
        blocks: Lower half: row numbers of block (d, a) are those of knot a + d, columns those of knot a.
        pull: Right-hand side.
        damping: The share.
    """
    from scipy.linalg import solveh_banded

    num_knots = blocks.shape[1]
    band = np.zeros((_BANDWIDTH + 1, _NUMBERS * num_knots))
    for apart in range(min(4, num_knots)):
        for row in range(_NUMBERS):
            for column in range(_NUMBERS):
                below = _NUMBERS * apart + row - column
                if 0 <= below <= _BANDWIDTH:
                    band[below, column::_NUMBERS][: num_knots - apart] = blocks[
                        apart, : num_knots - apart, row, column
                    ]
    band[0] *= 1 + damping
    return solveh_banded(band, pull.ravel(), lower=True).reshape(pull.shape)
