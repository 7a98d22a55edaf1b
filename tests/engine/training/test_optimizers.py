"""Learning-rate schedules as functions of progress, and the optimiser they drive."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from unmix_plugin.engine.configs import OptimizerConfig
from unmix_plugin.engine.training.optimizers import (
    build_optimizer,
    forget_gradients,
    learning_rate,
    set_learning_rates,
)
from unmix_plugin.errors import ConfigError

configs = st.builds(
    OptimizerConfig,
    lr=st.floats(1e-5, 1.0),
    final_factor=st.floats(1e-3, 1.0),
)
fractions = st.floats(0.0, 1.0)


@settings(deadline=None)
@given(configs)
def test_a_schedule_starts_at_lr_and_ends_at_its_final_factor(config: OptimizerConfig):
    assert math.isclose(learning_rate(config, 0.0), config.lr, rel_tol=1e-12)
    assert math.isclose(learning_rate(config, 1.0), config.lr * config.final_factor, rel_tol=1e-9)


@settings(deadline=None)
@given(configs, fractions, fractions)
def test_a_schedule_falls_by_equal_factors(config: OptimizerConfig, a: float, b: float):
    ratio = learning_rate(config, a) / learning_rate(config, b)
    assert math.isclose(ratio, config.final_factor ** (a - b), rel_tol=1e-9)


@settings(deadline=None)
@given(configs, st.floats(-5, 5))
def test_outside_its_range_progress_counts_as_the_nearer_end(config: OptimizerConfig, progress: float):
    assert learning_rate(config, progress) == learning_rate(config, min(max(progress, 0.0), 1.0))


def test_each_group_has_its_own_settings_and_rate():
    a, b = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(3))
    settings_ = {
        "a": OptimizerConfig(lr=0.1, weight_decay=0.5),
        "b": OptimizerConfig(lr=1.0, final_factor=0.25),
    }
    optimizer = build_optimizer({"a": [a], "b": [b], "unused": []}, settings_)
    rates = set_learning_rates(optimizer, settings_, 0.5)
    assert rates == {"a": pytest.approx(0.1 * math.sqrt(0.1)), "b": pytest.approx(0.5)}
    found = {group["name"]: group for group in optimizer.param_groups}
    assert found["a"]["lr"] == rates["a"]
    assert (found["a"]["weight_decay"], found["b"]["weight_decay"]) == (0.5, 0.0)


def test_a_group_whose_gradients_are_forgotten_steps_as_at_first():
    params = {name: [nn.Parameter(torch.zeros(1))] for name in "ab"}
    configs = {name: OptimizerConfig(lr=0.1) for name in "ab"}
    optimizer = build_optimizer(params, configs)
    for _ in range(20):
        for [param] in params.values():
            param.grad = torch.tensor([100.0])
        optimizer.step()
    before = {name: float(param.detach()) for name, [param] in params.items()}
    forget_gradients(optimizer, {"b"})
    for [param] in params.values():
        param.grad = torch.tensor([-1e-3])
    optimizer.step()
    moved = {name: float(param.detach()) - before[name] for name, [param] in params.items()}
    assert moved["a"] < 0  # what was seen before still counts
    assert moved["b"] == pytest.approx(0.1)


def test_a_step_is_adams():
    param = nn.Parameter(torch.tensor([1.0, -2.0, 3.0]))
    config = OptimizerConfig(lr=0.1)
    optimizer = build_optimizer({"a": [param]}, {"a": config})
    param.grad = torch.tensor([0.5, -4.0, 1e-3])
    optimizer.step()
    # The first step of Adam is lr times the sign of the gradient, whatever its size.
    torch.testing.assert_close(param.detach(), torch.tensor([0.9, -1.9, 2.9]))


def test_weight_decay_draws_what_has_no_gradient_to_zero_and_hardly_moves_the_rest():
    param = nn.Parameter(torch.tensor([1.0, -1.0]))
    optimizer = build_optimizer({"a": [param]}, {"a": OptimizerConfig(lr=0.01, weight_decay=1e-3)})
    for _ in range(50):
        param.grad = torch.tensor([0.0, -1.0])  # the second is asked to grow
        optimizer.step()
    assert 0.4 < float(param.detach()[0]) < 0.6
    torch.testing.assert_close(param.detach()[1], torch.tensor(-0.5), atol=1e-3, rtol=0)
    with pytest.raises(ConfigError, match="weight-decay of at least 0"):
        OptimizerConfig(weight_decay=-1.0)


def test_a_group_without_settings_is_refused_by_name():
    with pytest.raises(ConfigError, match="group heads; configs: fields"):
        build_optimizer({"heads": [nn.Parameter(torch.ones(1))]}, {"fields": OptimizerConfig()})
