"""Small networks without biases, evaluated so that a CPU's time goes into products.

Notation: `S` samples, `F` inputs, `O` outputs.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

_CACHED_ROWS = 4096
"""Samples of which a hidden layer stays in a core's cache."""


def bias_free_network(*widths: int) -> nn.Sequential:
    """Linear layers from each width to the next, with a ReLU between them."""
    # Without biases, as in Mueller et al. 2022: torch copies a bias into the output first, a fifth of the layer's time.
    layers: list[nn.Module] = []
    for num_inputs, num_outputs in pairwise(widths):
        layers += [nn.Linear(num_inputs, num_outputs, bias=False), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def rows_of_outputs(network: nn.Sequential, *inputs: Float[Tensor, "S _"]) -> Float[Tensor, "O S"]:
    """What a bias-free network gives, an output a row: products with few columns take twice as long.

    Args:
        inputs: Side by side the network's inputs, which joining would cost time.
    """
    return torch.cat([_rows_of_part(network, *part) for part in _parts(*inputs)], dim=1)


def in_parts(network: nn.Sequential, inputs: Float[Tensor, "S F"]) -> Float[Tensor, "S O"]:
    """What a network gives of samples, as `_parts` has them."""
    return torch.cat([network(part) for (part,) in _parts(inputs)])


def _rows_of_part(network: nn.Sequential, *inputs: Float[Tensor, "S _"]) -> Float[Tensor, "O S"]:
    first, *inner, last = network
    assert isinstance(first, nn.Linear)
    weights = first.weight.split([values.shape[1] for values in inputs], dim=1)
    hidden = inputs[0] @ weights[0].t()
    for values, weight in zip(inputs[1:], weights[1:], strict=True):
        hidden.addmm_(values, weight.t())
    for layer in inner:
        hidden = layer(hidden)
    assert isinstance(last, nn.Linear)
    return last.weight @ hidden.t()


def _parts(*values: Float[Tensor, "S _"]) -> Iterator[tuple[Float[Tensor, "_ _"], ...]]:
    """The same rows of all; without gradients few at a time, so that a hidden layer of them stays in the cache."""
    # As many for each thread: they wait for one another after every part.
    at_once = _CACHED_ROWS * torch.get_num_threads()
    size = max(len(values[0]), 1) if torch.is_grad_enabled() else at_once
    return zip(*(each.split(size) for each in values), strict=True)
