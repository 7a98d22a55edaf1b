"""Keeping non-finite numbers out of the parameters."""

from collections.abc import Mapping

import torch
from torch import Tensor

from unmix_plugin.engine.training.optimizers import OptimizerConfig
from unmix_plugin.errors import RunError


class GradientGuard:
    """Looks at loss and gradients before each update, shortens long gradients, and refuses non-finite ones."""

    def __init__(
        self, optimizer: torch.optim.Optimizer, configs: Mapping[str, OptimizerConfig], max_in_a_row: int
    ) -> None:
        self.optimizer = optimizer
        self.configs = configs
        self.max_in_a_row = max_in_a_row
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
            self._shorten(gradients, norms)
        else:
            self._refuse(value, norms)
        return bool(finite), value

    def _shorten(self, gradients: Mapping[str, list[Tensor]], norms: Mapping[str, Tensor]) -> None:
        for name, norm in norms.items():
            longest = self.configs[name].max_gradient_norm
            if longest is not None:
                factor = (longest / norm.clamp_min(1e-20)).clamp_max(1.0)
                for gradient in gradients[name]:
                    gradient.mul_(factor)

    def _refuse(self, loss: float, norms: Mapping[str, Tensor]) -> None:
        self.skipped += 1
        self.in_a_row += 1
        if self.in_a_row >= self.max_in_a_row:
            bad = [name for name, norm in norms.items() if not torch.isfinite(norm)]
            raise RunError(
                f"{self.in_a_row} training steps in a row had a non-finite loss or gradient (loss {loss:g}; "
                f"gradients of {', '.join(bad) or 'no group'}); the last checkpoint is good. Lower the learning rates, "
                "or look for values far outside [0, 1] in the scene"
            )


def _norm(gradients: list[Tensor]) -> Tensor:
    return torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients]).norm().float()
