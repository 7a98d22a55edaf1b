"""Spectra on all bands of a scene from what sensors saw of some of them: a start, which training completes.

Notation: `K` spectra, `b` channels of a sensor, `B` bands of the scene.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_SMOOTHNESS = 1e-3
"""Weight of differences between neighbouring bands, against that of what was seen."""
_CONTRAST = 0.6
"""Of distinct spectra: how far they are from the typical one, in both directions."""


def fill_bands(
    seen: Float[Tensor, "K b"], matrix: Float[Tensor, "b B"], typical: Float[Tensor, "B"]
) -> Float[Tensor, "K B"]:
    """The spectra that a sensor saw as `seen`, their ratio to a typical spectrum as smooth over bands as may be.

    Args:
        seen: Values of the channels.
        matrix: The sensor's operator.
        typical: Of the scene, positive; what is not seen of a spectrum follows it.
    """
    operator = matrix.double() * typical.double()
    differences = torch.diff(torch.eye(len(typical), dtype=torch.float64), dim=0)
    square = operator.T @ operator
    smooth = _SMOOTHNESS * square.diagonal().mean() * (differences.T @ differences)
    ratios = torch.linalg.lstsq(square + smooth, operator.T @ seen.double().T).solution
    return (ratios.T * typical.double()).clamp(min=0).to(seen)


def typical_spectrum(
    means: list[Float[Tensor, " _"]], matrices: list[Float[Tensor, "_ B"]]
) -> Float[Tensor, "B"]:
    """A smooth positive spectrum that sensors see as the means of their pixels.

    Args:
        means: Of each sensor's channels.
        matrices: The sensors' operators.
    """
    seen, matrix = torch.cat(means)[None], torch.cat(matrices)
    filled = fill_bands(seen, matrix, torch.ones(matrix.shape[1], dtype=seen.dtype))[0]
    return filled.clamp(min=0.01 * float(filled.max().clamp(min=1e-6)))


def distinct_spectra(typical: Float[Tensor, "B"], count: int) -> Float[Tensor, "K B"]:
    """Spectra around a typical one that differ in shape, for scenes of which no sensor tells the materials.

    Args:
        count: At most as many as bands.
    """
    bands = (torch.arange(len(typical)) + 0.5) / len(typical)
    middles = (torch.arange(count)[:, None] + 0.5) / count
    shapes = 1 - _CONTRAST + 2 * _CONTRAST * torch.exp(-0.5 * ((bands - middles) * count) ** 2)
    return (shapes.to(typical) * typical).clamp(0, 1)
