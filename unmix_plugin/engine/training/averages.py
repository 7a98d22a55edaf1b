"""A moving average of the parameters, which renders better than the last step's."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn

AVERAGE_INTERVAL = 8
"""Steps of a training between updates, each of which costs about as much as a step of the optimiser."""


class ParameterAverage:
    """Exponential moving average of a module's trained parameters.

    Its decay rises as (1 + n) / (10 + n) with the number n of updates until it reaches the one asked for: until then it
    spans about the last ninth of the training so far, however long that is. Each step of the first interval is an
    update, so that a training of few steps isn't shown as it began.
    """

    def __init__(self, module: nn.Module, decay: float, interval: int = 1) -> None:
        """Start from the current values.

        Args:
            module: Whose parameters to follow.
            decay: Of a step, in [0, 1).
            interval: Steps between updates after the first interval; each then counts for so many steps.
        """
        self.interval = interval
        self.decay = decay**interval
        self.updates = 0
        self.params = {name: param for name, param in module.named_parameters() if param.requires_grad}
        self.values = {name: param.detach().clone() for name, param in self.params.items()}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the parameters after `step` steps, if that is a multiple of the interval or none has passed yet."""
        if step > self.interval and step % self.interval != 0:
            return
        self.updates += 1
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        for name, value in self.values.items():
            value.lerp_(self.params[name], 1.0 - decay)

    @contextmanager
    def swapped_in(self) -> Iterator[None]:
        """Context in which the module has the averaged values."""
        self._swap()
        try:
            yield
        finally:
            self._swap()

    def state_dict(self) -> dict[str, Tensor]:
        """The averaged values by parameter name."""
        return self.values

    def load_state_dict(self, values: Mapping[str, Tensor], updates: int) -> None:
        """Restore `state_dict` and the number of updates."""
        for name, value in self.values.items():
            value.copy_(values[name])
        self.updates = updates

    def _swap(self) -> None:
        for name, param in self.params.items():
            param.data, self.values[name] = self.values[name], param.data
