"""What gradients are on their way back, where values stay."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def scale_gradient(values: Float[Tensor, "*S"], factors: Float[Tensor, "*#S"]) -> Float[Tensor, "*S"]:
    """The same values; gradients that reach them are multiplied with `factors`."""
    constant = values.detach()
    return constant + factors * (values - constant)
