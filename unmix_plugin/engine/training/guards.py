"""Keeping non-finite numbers out of the parameters."""

from collections.abc import Mapping

import torch
from torch import Tensor

from unmix_plugin.errors import RunError

MAX_IN_A_ROW = 20
"""Training fails after so many steps in a row with a non-finite loss or gradient."""


class GradientGuard:
    """Looks at loss and gradients before each update and refuses non-finite ones."""

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self.optimizer = optimizer
        self.skipped = 0
        """Steps refused so far."""
        self.in_a_row = 0
        """Steps refused since the last good one."""

    @torch.no_grad()
    def check(self, loss: Tensor) -> tuple[bool, float]:
        """Whether the optimiser may step, and the loss as a number.

        Raises:
            RunError: too many steps in a row were refused.
        """
        gradients = {
            group["name"]: [param.grad for param in group["params"] if param.grad is not None]
            for group in self.optimizer.param_groups
        }
        norms = {name: _norm(values) for name, values in gradients.items() if values}
        # One transfer for all of them: each would wait for the GPU.
        numbers = torch.stack([loss.detach().float(), *norms.values()])
        finite, value = torch.stack([torch.isfinite(numbers).all().float(), numbers[0]]).tolist()
        if finite:
            self.in_a_row = 0
        else:
            self._refuse(value, norms)
        return bool(finite), value

    def _refuse(self, loss: float, norms: Mapping[str, Tensor]) -> None:
        self.skipped += 1
        self.in_a_row += 1
        if self.in_a_row >= MAX_IN_A_ROW:
            bad = [name for name, norm in norms.items() if not torch.isfinite(norm)]
            raise RunError(
                f"{self.in_a_row} training steps in a row had a non-finite loss or gradient (loss {loss:g}; "
                f"gradients of {', '.join(bad) or 'no group'}); the last checkpoint is good. Lower the learning rates, "
                "or look for values far outside [0, 1] in the scene"
            )


def _norm(gradients: list[Tensor]) -> Tensor:
    return torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients]).norm().float()
