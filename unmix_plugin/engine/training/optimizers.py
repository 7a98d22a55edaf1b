"""What gradients do: Adam with a schedule, a guard against non-finite numbers, and an average of the parameters.

A schedule is a pure function of the training progress in [0, 1], so it stretches over whichever limit, steps or
seconds, a run has.
"""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from unmix_plugin.engine.configs import OptimizerConfig
from unmix_plugin.errors import ConfigError, RunError

_BETAS = (0.9, 0.99)
_EPS = 1e-15  # far below any gradient, so that the size of the loss does not matter


def _learning_rate(config: OptimizerConfig, progress: float) -> float:
    """Step size at `progress` in [0, 1]; beyond, that of the nearer end.

    >>> _learning_rate(OptimizerConfig(lr=1.0, final_factor=0.01), 0.5)
    0.1
    """
    return config.lr * config.final_factor ** min(max(progress, 0.0), 1.0)


def build_optimizer(
    param_groups: Mapping[str, list[nn.Parameter]], configs: Mapping[str, OptimizerConfig]
) -> torch.optim.Adam:
    """One Adam over all groups, each with its config's settings; `param_groups[i]["name"]` is the group's name. Raises
    ConfigError: a group of the model has no optimizer config."""
    missing = sorted(name for name, params in param_groups.items() if params and name not in configs)
    if missing:
        raise ConfigError(
            f"no optimizer config for the parameter group {', '.join(missing)}; configs: {', '.join(sorted(configs))}"
        )
    groups = [
        {"name": name, "params": found, "lr": configs[name].lr, "weight_decay": configs[name].weight_decay}
        for name, found in param_groups.items()
        if found
    ]
    params = [param for found in param_groups.values() for param in found]
    is_fusable = all(param.is_floating_point() and param.device.type in ("cpu", "cuda") for param in params)
    return torch.optim.Adam(groups, betas=_BETAS, eps=_EPS, fused=is_fusable)


def set_learning_rates(
    optimizer: torch.optim.Optimizer, configs: Mapping[str, OptimizerConfig], progress: float
) -> dict[str, float]:
    """Set every group's step size for `progress`; returns them by group name."""
    for group in optimizer.param_groups:
        group["lr"] = _learning_rate(configs[group["name"]], progress)
    return {group["name"]: group["lr"] for group in optimizer.param_groups}


def forget_gradients(optimizer: torch.optim.Optimizer, names: Collection[str]) -> None:
    """Let some groups step as if no gradient had been seen before."""
    for group in optimizer.param_groups:
        if group["name"] in names:
            for param in group["params"]:
                optimizer.state.pop(param, None)


_MAX_IN_A_ROW = 20
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
        """Whether the optimiser may step, and the loss as a number. Raises RunError: too many steps in a row were
        refused."""
        gradients = {
            group["name"]: [param.grad for param in group["params"] if param.grad is not None]
            for group in self.optimizer.param_groups
        }
        norms = {name: _norm(values) for name, values in gradients.items() if values}
        # One transfer for all of them: each would wait for the GPU.
        numbers = torch.stack([loss.detach().float(), *norms.values()])
        finite, value = torch.stack([torch.isfinite(numbers).all().float(), numbers[0]]).tolist()
        self.skipped += not finite
        self.in_a_row = 0 if finite else self.in_a_row + 1
        if self.in_a_row >= _MAX_IN_A_ROW:
            bad = [name for name, norm in norms.items() if not torch.isfinite(norm)]
            raise RunError(
                f"{self.in_a_row} training steps in a row had a non-finite loss or gradient (loss {value:g}; "
                f"gradients of {', '.join(bad) or 'no group'}); the last checkpoint is good. Lower the learning rates, "
                "or look for values far outside [0, 1] in the scene"
            )
        return bool(finite), value


def _norm(gradients: list[Tensor]) -> Tensor:
    return torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients]).norm().float()


AVERAGE_INTERVAL = 8
"""Steps of a training between updates, each of which costs about as much as a step of the optimiser."""


class ParameterAverage:
    """Exponential moving average of a module's trained parameters.

    Its decay rises as (1 + n) / (10 + n) with the number n of updates until it reaches the one asked for: until then it
    spans about the last ninth of the training so far, however long that is. Each step of the first interval is an
    update, so that a training of few steps isn't shown as it began.
    """

    def __init__(self, module: nn.Module, decay: float, interval: int = 1) -> None:
        """Start from the current values. `decay` is of a step, in [0, 1); updates after the first interval count for as
        many steps as it has."""
        self.interval, self.decay, self.updates = interval, decay**interval, 0
        self.params = {name: param for name, param in module.named_parameters() if param.requires_grad}
        self.values = {name: param.detach().clone() for name, param in self.params.items()}
        """The averages by parameter name."""

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

    def restore(self, values: Mapping[str, Tensor], updates: int) -> None:
        """Go on from these `values`, after so many updates; parameters that were not trained until now have none."""
        for name, value in self.values.items():
            value.copy_(values.get(name, value))
        self.updates = updates

    def _swap(self) -> None:
        for name, param in self.params.items():
            param.data, self.values[name] = self.values[name], param.data
