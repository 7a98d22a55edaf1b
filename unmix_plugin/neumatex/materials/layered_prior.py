"""What layered materials are drawn from, to train the decoder and to measure it."""

import torch
from jaxtyping import Float
from torch import Tensor


def draw_materials(number: int, generator: torch.Generator) -> Float[Tensor, "N 14"]:
    """Parameters of `LayeredFamily`: every combination of layers, each layer in about four of ten materials.

    Dielectrics, metals and mixtures of both are about as frequent; a third of the base colours are greys.
    """

    def uniform(columns: int) -> Tensor:
        return torch.rand(number, columns, generator=generator)

    grey = (uniform(1) < 1 / 3).float()
    colours = uniform(3)
    base = grey * colours[:, :1] + (1.0 - grey) * colours
    kind = uniform(1)
    metallicity = torch.where(kind < 0.4, 0.0, torch.where(kind > 0.7, 1.0, uniform(1)))
    drawn = uniform(10)
    present = (uniform(4) < 0.4).float()
    for weight, layer in zip((2, 4, 7, 9), present.unbind(-1), strict=True):
        drawn[:, weight] *= layer
    return torch.cat([base, metallicity, drawn], -1)
