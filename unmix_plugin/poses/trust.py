"""Which poses are believed: pixels that fit far worse than others correct their pose, but hardly shape the scene.

A pose that is wrong by many pixels asks for matter where none is, and gets haze. So the errors of pixels that show
matter are kept in mind for each knot of the poses. Where they are more than `LARGEST_RATIO` times the median, pixels
weigh less, by the square of what is too much; their pose sees them at full weight.

Notation: `M` knots of all views, `R` rays.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from unmix_plugin.engine.processes import Processes

LARGEST_RATIO = 4.0
"""Mean squared error of a knot's pixels over the median, up to which its pose is believed: it varies as much with what
pixels show."""
_MEMORY = 0.98
"""Part of what is kept in mind that is left after a step."""
_FEWEST_PIXELS = 3.0
"""Kept in mind, from which on a knot's error is known."""
_LEAST_WEIGHT = 1e-4


class PoseTrust(nn.Module):
    """Errors of the pixels around each knot, and what these pixels weigh; all 1 at first."""

    squares: Tensor
    counts: Tensor
    weights: Tensor

    def __init__(self, num_knots: int) -> None:
        """`num_knots` is M."""
        super().__init__()
        self.register_buffer("squares", torch.zeros(num_knots))
        self.register_buffer("counts", torch.zeros(num_knots))
        self.register_buffer("weights", torch.ones(num_knots))

    @torch.no_grad()
    def observe(
        self, knots: Int[Tensor, " R"], squares: Float[Tensor, " R"], shows_matter: Bool[Tensor, " R"]
    ) -> None:
        """Note the mean squared errors of pixels, each near one of the knots."""
        shown = shows_matter.to(squares)
        self.squares.mul_(_MEMORY).index_add_(0, knots, squares * shown)
        self.counts.mul_(_MEMORY).index_add_(0, knots, shown)

    @torch.no_grad()
    def judge(self, processes: Processes) -> None:
        """Decide what pixels weigh, alike in all processes."""
        processes.mean(self.squares)
        processes.mean(self.counts)
        is_known = self.counts > _FEWEST_PIXELS
        errors = self.squares / self.counts.clamp(min=_FEWEST_PIXELS)
        usual = errors[is_known].median() if bool(is_known.any()) else errors.new_ones(())
        believed = (LARGEST_RATIO * usual / errors.clamp(min=1e-12)).clamp(max=1.0)
        self.weights.copy_(torch.where(is_known, believed.square().clamp(min=_LEAST_WEIGHT), 1.0))
