"""What gradients do: Adam with a schedule, a guard against non-finite numbers, and an average of the parameters.

A schedule is a pure function of the training progress in [0, 1], so it stretches over whichever limit, steps or
seconds, a run has.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from unmix_plugin.engine.configs import OptimizerConfig
from unmix_plugin.errors import ConfigError, RunError

_BETAS = (0.9, 0.99)
_EPS = 1e-15  # far below any gradient, so that the size of the loss does not matter


class Adam:
    """`torch.optim.Adam` by PyTorch's own function, without what the class does for compiled models: at its first use
    that one imports TorchDynamo, for two seconds of every training.

    Source: Kingma and Ba 2015, Adam: A Method for Stochastic Optimization.
    """

    def __init__(self, param_groups: list[dict[str, Any]]) -> None:
        """
        Args:
            param_groups: Each with its `name`, `params`, `lr` and `weight_decay`.
        """
        self.param_groups = param_groups
        self.state: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict)
        """Of each parameter that was stepped: `step`, `exp_avg` and `exp_avg_sq`."""
        every = [param for group in param_groups for param in group["params"]]
        self._is_fused = all(x.is_floating_point() and x.device.type in ("cpu", "cuda") for x in every)

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for group in self.param_groups:
            for param in group["params"]:
                param.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update the parameters that have gradients."""
        for group in self.param_groups:
            params = [param for param in group["params"] if param.grad is not None]
            for param in params:
                if not self.state[param]:
                    device = param.device if self._is_fused else "cpu"
                    self.state[param]["step"] = torch.zeros((), dtype=torch.float32, device=device)
                    self.state[param]["exp_avg"] = torch.zeros_like(param)
                    self.state[param]["exp_avg_sq"] = torch.zeros_like(param)
            first, second = _BETAS
            adam(
                params,
                [param.grad for param in params],
                [self.state[param]["exp_avg"] for param in params],
                [self.state[param]["exp_avg_sq"] for param in params],
                [],
                [self.state[param]["step"] for param in params],
                fused=self._is_fused,
                has_complex=any(map(torch.is_complex, params)),
                amsgrad=False,
                beta1=first,
                beta2=second,
                lr=group["lr"],
                weight_decay=group["weight_decay"],
                eps=_EPS,
                maximize=False,
            )


def build_optimizer(
    param_groups: Mapping[str, list[nn.Parameter]], configs: Mapping[str, OptimizerConfig]
) -> Adam:
    """One Adam over all groups, each with its config's settings; `param_groups[i]["name"]` is the group's name. Raises
    ConfigError: a group of the model has no optimizer config, or a parameter that is in another place, too."""
    missing = sorted(name for name, params in param_groups.items() if params and name not in configs)
    if missing:
        raise ConfigError(
            f"no optimizer config for the parameter group {', '.join(missing)}; configs: {', '.join(sorted(configs))}"
        )
    seen: set[int] = set()
    for name, params in param_groups.items():
        if len({*map(id, params)} - seen) < len(params):
            raise ConfigError(
                f"the parameter group {name} has a parameter that it or another group has already; list it once"
            )
        seen.update(map(id, params))
    groups = [
        {"name": name, "params": found, "lr": configs[name].lr, "weight_decay": configs[name].weight_decay}
        for name, found in param_groups.items()
        if found
    ]
    return Adam(groups)


def set_learning_rates(
    optimizer: Adam, configs: Mapping[str, OptimizerConfig], progress: float
) -> dict[str, float]:
    """Set every group's step size for `progress`, that of the nearer end outside [0, 1]; returns them by group name.

    Between both ends they fall by equal factors.
    """
    within = min(max(progress, 0.0), 1.0)
    for group in optimizer.param_groups:
        config = configs[group["name"]]
        group["lr"] = config.lr * config.final_factor**within
    return {group["name"]: group["lr"] for group in optimizer.param_groups}


def forget_gradients(optimizer: Adam, names: Collection[str]) -> None:
    """Let some groups step as if no gradient had been seen before."""
    for group in optimizer.param_groups:
        if group["name"] in names:
            for param in group["params"]:
                optimizer.state.pop(param, None)


_MAX_IN_A_ROW = 20
"""Training fails after so many steps in a row with a non-finite loss or gradient."""


class GradientGuard:
    """Looks at loss and gradients before each update and refuses non-finite ones."""

    def __init__(self, optimizer: Adam) -> None:
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
        norms = {
            name: torch.stack([torch.linalg.vector_norm(value) for value in values]).norm().float()
            for name, values in gradients.items()
            if values
        }
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
