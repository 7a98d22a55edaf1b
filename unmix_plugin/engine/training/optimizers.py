"""Optimisers and learning-rate schedules.

A schedule is a pure function of the training progress in [0, 1], so it stretches over whichever limit, steps or
seconds, a run has.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from torch import nn

from unmix_plugin.errors import ConfigError, require

_BETAS = (0.9, 0.99)
_EPS = 1e-15  # far below any gradient, so that the size of the loss does not matter


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam for one group of parameters, and its learning-rate schedule."""

    lr: float = 1e-2
    """Step size at the start of training."""
    final_factor: float = 0.1
    """Step size at the end of training as a part of `lr`; between, it falls by equal factors. 1 keeps it constant."""
    weight_decay: float = 0.0
    """Times the parameters, added to their gradient: draws what the data leaves open to 0."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        rules = {
            "lr above 0 and finite": 0 < self.lr < math.inf,
            "final-factor in (0, 1]": 0 < self.final_factor <= 1,
            "weight-decay of at least 0 and finite": 0 <= self.weight_decay < math.inf,
        }
        require("an optimizer", self, rules)


def learning_rate(config: OptimizerConfig, progress: float) -> float:
    """Step size at `progress` in [0, 1]; beyond, that of the nearer end.

    >>> learning_rate(OptimizerConfig(lr=1.0, final_factor=0.01), 0.5)
    0.1
    """
    return config.lr * config.final_factor ** min(max(progress, 0.0), 1.0)


def build_optimizer(
    param_groups: Mapping[str, list[nn.Parameter]], configs: Mapping[str, OptimizerConfig]
) -> torch.optim.Adam:
    """One Adam over all groups, each with its config's settings; `param_groups[i]["name"]` is the group's name.

    Raises:
        ConfigError: a group of the model has no optimizer config.
    """
    missing = sorted(name for name, params in param_groups.items() if params and name not in configs)
    if missing:
        raise ConfigError(
            f"no optimizer config for the parameter group {', '.join(missing)}; configs: {', '.join(sorted(configs))}"
        )
    groups = [
        {
            "name": name,
            "params": params,
            "lr": configs[name].lr,
            "weight_decay": configs[name].weight_decay,
        }
        for name, params in param_groups.items()
        if params
    ]
    return torch.optim.Adam(groups, betas=_BETAS, eps=_EPS, fused=_all_fusable(param_groups))


def set_learning_rates(
    optimizer: torch.optim.Optimizer,
    configs: Mapping[str, OptimizerConfig],
    progress: float,
    group_progress: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Set every group's step size for `progress`, or for its own in `group_progress`; returns them by group name."""
    own = group_progress or {}
    names = [group["name"] for group in optimizer.param_groups]
    rates = {name: learning_rate(configs[name], own.get(name, progress)) for name in names}
    for group in optimizer.param_groups:
        group["lr"] = rates[group["name"]]
    return rates


def forget_gradients(optimizer: torch.optim.Optimizer, names: Collection[str]) -> None:
    """Let some groups step as if no gradient had been seen before."""
    for group in optimizer.param_groups:
        if group["name"] in names:
            for param in group["params"]:
                optimizer.state.pop(param, None)


def _all_fusable(param_groups: Mapping[str, list[nn.Parameter]]) -> bool:
    """Whether torch has a fused Adam for these parameters: real floating point on the CPU or a CUDA GPU."""
    params = [param for group in param_groups.values() for param in group]
    return all(param.is_floating_point() and param.device.type in ("cpu", "cuda") for param in params)
