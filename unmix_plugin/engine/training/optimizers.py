"""Optimisers and learning-rate schedules.

A schedule is a pure function of the training progress in [0, 1], so it stretches over whichever limit, steps or
seconds, a run has.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam for one group of parameters, and its learning-rate schedule."""

    lr: float = 1e-2
    """Largest step size, reached after the warm-up."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay of the running mean and of the running square of the gradient."""
    eps: float = 1e-15
    """Added to the root of the running square."""
    schedule: Literal["exponential", "cosine"] = "exponential"
    """How the step size falls after the warm-up."""
    final_factor: float = 0.1
    """Step size at the end of training as a part of `lr`; 1 keeps it constant."""
    warmup_fraction: float = 0.0
    """Part of the training over which the step size rises linearly from 1 % of `lr`."""
    weight_decay: float = 0.0
    """Times the parameters, added to their gradient: draws what the data leaves open to 0."""
    max_gradient_norm: float | None = None
    """Gradients of the group longer than this are shortened to it."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        rules = {
            "lr > 0": self.lr > 0,
            "betas in [0, 1)": all(0 <= beta < 1 for beta in self.betas),
            "eps > 0": self.eps > 0,
            "final_factor in (0, 1]": 0 < self.final_factor <= 1,
            "warmup_fraction in [0, 1)": 0 <= self.warmup_fraction < 1,
            "weight_decay >= 0": self.weight_decay >= 0,
            "max_gradient_norm > 0": self.max_gradient_norm is None or self.max_gradient_norm > 0,
        }
        broken = [rule for rule, holds in rules.items() if not holds]
        if broken:
            raise ConfigError(f"optimizer settings must have {' and '.join(broken)}; got {self}")


WARMUP_START = 0.01
"""Learning rate at progress 0, where there is a warm-up, as a part of the largest."""


def learning_rate(config: OptimizerConfig, progress: float) -> float:
    """Step size at `progress` in [0, 1]; beyond, that of the nearer end.

    >>> learning_rate(OptimizerConfig(lr=1.0, final_factor=0.01), 0.5)
    0.1
    """
    progress = min(max(progress, 0.0), 1.0)
    if progress < config.warmup_fraction:
        return config.lr * (WARMUP_START + (1.0 - WARMUP_START) * progress / config.warmup_fraction)
    decayed = (progress - config.warmup_fraction) / (1.0 - config.warmup_fraction)
    if config.schedule == "exponential":
        return config.lr * config.final_factor**decayed
    return config.lr * (
        config.final_factor + (1.0 - config.final_factor) * 0.5 * (1.0 + math.cos(math.pi * decayed))
    )


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
            "betas": configs[name].betas,
            "eps": configs[name].eps,
            "weight_decay": configs[name].weight_decay,
        }
        for name, params in param_groups.items()
        if params
    ]
    return torch.optim.Adam(groups, fused=_all_fusable(param_groups))


def set_learning_rates(
    optimizer: torch.optim.Optimizer, configs: Mapping[str, OptimizerConfig], progress: float
) -> dict[str, float]:
    """Set every group's step size for `progress`; returns them by group name."""
    rates = {
        group["name"]: learning_rate(configs[group["name"]], progress) for group in optimizer.param_groups
    }
    for group in optimizer.param_groups:
        group["lr"] = rates[group["name"]]
    return rates


def _all_fusable(param_groups: Mapping[str, list[nn.Parameter]]) -> bool:
    """Whether torch has a fused Adam for these parameters: real floating point on the CPU or a CUDA GPU."""
    params = [param for group in param_groups.values() for param in group]
    return all(param.is_floating_point() and param.device.type in ("cpu", "cuda") for param in params)
