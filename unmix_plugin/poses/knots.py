"""Where the corrections of a view's pose stand, the waves of which those of a line camera are made, and what no picture
shows of them.

Notation: `M` knots of all views, `n` knots of one view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras

KNOT_ROWS = 4
"""Rows between the knots of a line camera."""
_FEWEST_KNOTS = 4
"""Of a line camera: a piece of a cubic spline has as many."""


@dataclass(frozen=True)
class Knots:
    """Where the corrections of each view stand."""

    rows: tuple[int, ...]
    """Rows of each view's image; 0 for a frame camera, whose correction holds for all rows."""

    @staticmethod
    def of(cameras: Cameras) -> Knots:
        """Those of some cameras."""
        lines = [cameras.is_line_camera(index) for index in range(len(cameras))]
        return Knots(tuple(cameras.size(i)[1] if is_line else 0 for i, is_line in enumerate(lines)))

    @property
    def counts(self) -> list[int]:
        """Knots of each view."""
        return [1 if rows == 0 else max(_FEWEST_KNOTS, round(rows / KNOT_ROWS) + 1) for rows in self.rows]

    def heights(self, view: int) -> Float[Tensor, " n"]:
        """y of the knots of a view, pixels; the middle of the image counts for a frame camera."""
        rows, count = self.rows[view], self.counts[view]
        return torch.zeros(1) if rows == 0 else torch.linspace(0, rows, count)

    def positions(self, cameras: Cameras) -> Float[Tensor, "M 3"]:
        """Where the cameras stand at the knots."""
        found = []
        for view in range(len(self.rows)):
            y = self.heights(view)
            found.append(cameras.poses_at(torch.full((len(y),), view), y)[:, :, 3])
        return torch.cat(found)


def spline_weights(
    place: Float[Tensor, " R"], count: Int[Tensor, " R"]
) -> tuple[Int[Tensor, " R"], Float[Tensor, "R 4"]]:
    """What corrections at places between knots are made of: a cubic B-spline, whose ends go on straight.

    Straight lines from knot to knot would be off by a hundredth of a wobble of three waves over a hundred rows, which
    is a tenth of a pixel of ten.

    Args:
        place: Among the knots of a view, [0, count - 1].
        count: Knots of that view: at least 4, or 1 of a frame camera, which stands alone.
    Returns:
        The first of four knots in a row, and their weights.
    """
    piece = torch.minimum(place.long(), count - 2).clamp(min=0)
    u = place - piece
    a, b, c, d = (
        (1 - u) ** 3 / 6,
        (3 * u**3 - 6 * u**2 + 4) / 6,
        (-3 * u**3 + 3 * u**2 + 3 * u + 1) / 6,
        u**3 / 6,
    )
    zero = torch.zeros_like(u)
    inner = torch.stack([a, b, c, d], dim=1)
    first = torch.stack([b + 2 * a, c - a, d, zero], dim=1)
    last = torch.stack([zero, a, b - d, c + 2 * d], dim=1)
    weights = torch.where(
        (piece == 0)[:, None], first, torch.where((piece == count - 2)[:, None], last, inner)
    )
    return torch.minimum(piece - 1, count - _FEWEST_KNOTS).clamp(min=0), weights


def on_spline(
    values: Float[Tensor, "M C"], first: Int[Tensor, " R"], weights: Float[Tensor, "R 4"]
) -> Float[Tensor, "R C"]:
    """What values at all knots make of places between them, with the weights that `spline_weights` gives; `first`
    counts among all knots."""
    # Behind the last knot weights are 0: only a frame camera reaches so far.
    knots = (first[:, None] + torch.arange(_FEWEST_KNOTS, device=first.device)).clamp(max=len(values) - 1)
    own = values.index_select(0, knots.flatten()).unflatten(0, knots.shape)
    return (own * weights[:, :, None]).sum(dim=1)


def row_waves(count: int) -> Float[Tensor, "n n"]:
    """Cosines over the knots of a view, one a column: the first is 1 everywhere, the next half a wave, and so on.

    Few rays tell of one knot, all rays of a view tell of a wave. The k-th is 1 / (2 k) high: optimisers take steps of
    equal size, so slow drift, which is most of what line cameras do, is found first, and noise moves the rest little;
    and since waves add up, steps are half of those of a frame camera.
    """
    place = torch.arange(count, dtype=torch.float64)
    waves = torch.cos(math.pi * place[:, None] * place / max(count - 1, 1))
    return (waves / (2 * (1 + place))).float()


def similarities(
    offsets: Float[Tensor, "M 3"], reach: Float[Tensor, " M"], scale: Float[Tensor, " M"]
) -> Float[Tensor, "6*M 7"]:
    """Orthonormal steps that turn, move or scale the world as seen from cameras at these offsets from its middle; a
    step turns by `scale` and moves by `scale` times `reach`."""
    axes = torch.eye(3, dtype=torch.float64)
    places, lengths = offsets.double().cpu(), reach.double().cpu()[:, None]
    zero = torch.zeros_like(places)
    turned = [
        torch.cat([axis.expand_as(places), torch.linalg.cross(axis.expand_as(places), places) / lengths], 1)
        for axis in axes
    ]
    moved = [torch.cat([zero, axis / lengths], dim=1) for axis in axes]
    amounts = [*turned, *moved, torch.cat([zero, places / lengths], dim=1)]
    columns = torch.stack([(x / scale.double().cpu()[:, None]).flatten() for x in amounts], dim=1)
    found, sizes, _ = torch.linalg.svd(columns, full_matrices=False)
    basis = torch.zeros_like(columns)
    basis[:, : found.shape[1]] = found * (sizes > 1e-6 * sizes[0])
    return basis.to(offsets)
