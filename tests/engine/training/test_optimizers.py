"""Optimisers and schedules, the guard against non-finite numbers, and the average of the parameters."""

import io
import math
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from torch import nn

from tests.factories.trainings import quiet_trainer
from unmix_plugin.commands.training import finish
from unmix_plugin.engine.configs import OptimizerConfig, TrainerConfig
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.engine.model import TrainingCallback, TrainingCallbackLocation, TrainOutputs
from unmix_plugin.engine.runs.checkpoints import newest_complete_checkpoint
from unmix_plugin.engine.runs.loading import load_model
from unmix_plugin.engine.training.optimizers import (
    GradientGuard,
    ParameterAverage,
    build_optimizer,
    forget_gradients,
    set_learning_rates,
)
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.errors import ConfigError, RunError

fractions = st.floats(0.0, 1.0)


@settings(deadline=None)
@given(st.floats(1e-5, 1.0), st.floats(1e-3, 1.0), fractions, fractions)
def test_a_schedule_falls_by_equal_factors_from_lr_to_its_final_factor(lr, final_factor, a, b):
    config = OptimizerConfig(lr=lr, final_factor=final_factor)
    optimizer = build_optimizer({"a": [nn.Parameter(torch.ones(1))]}, {"a": config})

    def rate_at(progress: float) -> float:
        return set_learning_rates(optimizer, {"a": config}, progress)["a"]

    assert math.isclose(rate_at(-a), config.lr, rel_tol=1e-12)
    assert math.isclose(rate_at(1.0 + a), config.lr * config.final_factor, rel_tol=1e-9)
    ratio = rate_at(a) / rate_at(b)
    assert math.isclose(ratio, config.final_factor ** (a - b), rel_tol=1e-9)


def test_each_group_has_its_own_settings_and_rate():
    a, b = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(3))
    of_b = OptimizerConfig(lr=1.0, final_factor=0.25)
    settings_ = {"a": OptimizerConfig(lr=0.1, weight_decay=0.5), "b": of_b}
    optimizer = build_optimizer({"a": [a], "b": [b], "unused": []}, settings_)
    rates = set_learning_rates(optimizer, settings_, 0.5)
    assert rates == {"a": pytest.approx(0.1 * math.sqrt(0.1)), "b": pytest.approx(0.5)}
    found = {group["name"]: group for group in optimizer.param_groups}
    assert found["a"]["lr"] == rates["a"]
    assert (found["a"]["weight_decay"], found["b"]["weight_decay"]) == (0.5, 0.0)
    with pytest.raises(ConfigError, match="group heads; configs: fields"):
        build_optimizer({"heads": [a]}, {"fields": OptimizerConfig()})
    with pytest.raises(ConfigError, match="group b has a parameter that it or another group has already"):
        build_optimizer({"a": [a], "b": [b, a]}, settings_)


@pytest.mark.parametrize("dtype", [torch.float32, torch.complex64])
def test_steps_are_those_of_the_optimiser_of_pytorch(dtype):
    generator = torch.Generator().manual_seed(0)
    shapes, configs = ((3, 2), (4,)), {"a": OptimizerConfig(weight_decay=0.1), "b": OptimizerConfig(lr=0.3)}
    ours = [nn.Parameter(torch.randn(shape, generator=generator, dtype=dtype)) for shape in shapes]
    theirs = [nn.Parameter(param.detach().clone()) for param in ours]
    optimizer = build_optimizer({"a": ours[:1], "b": ours[1:]}, configs)
    groups = [
        {"params": [param], "lr": config.lr, "weight_decay": config.weight_decay}
        for param, config in zip(theirs, configs.values(), strict=True)
    ]
    is_fusable = dtype == torch.float32
    reference = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=is_fusable)
    for step in range(4):
        for one, other in zip(ours, theirs, strict=True):
            gradient = torch.randn(one.shape, generator=generator, dtype=dtype)
            one.grad = other.grad = None if step == 2 and one.dim() == 1 else gradient
        optimizer.step()
        reference.step()
        for one, other in zip(ours, theirs, strict=True):
            assert torch.equal(one, other)
            found, expected = optimizer.state[one], reference.state[other]
            assert list(found) == list(expected)
            assert all(torch.equal(found[name], expected[name]) for name in found)
    optimizer.zero_grad()
    assert [param.grad for param in ours] == [None, None]


def test_a_step_imports_no_compiler():
    code = (
        "import sys, torch\n"
        "from unmix_plugin.engine.configs import OptimizerConfig\n"
        "from unmix_plugin.engine.training.optimizers import build_optimizer\n"
        "param = torch.nn.Parameter(torch.ones(2))\n"
        "param.grad = torch.ones(2)\n"
        "build_optimizer({'a': [param]}, {'a': OptimizerConfig()}).step()\n"
        "print(param.detach().tolist() != [1, 1], 'torch._dynamo' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["True", "False"]


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


def make_guard():
    params = [nn.Parameter(torch.zeros(2)), nn.Parameter(torch.zeros(3)), nn.Parameter(torch.zeros(1))]
    configs = {"a": OptimizerConfig(), "b": OptimizerConfig()}
    optimizer = build_optimizer({"a": params[:2], "b": params[2:]}, configs)
    for param in params:
        param.grad = torch.ones_like(param)
    return GradientGuard(optimizer), params


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_bad_loss_or_any_one_bad_gradient_entry_is_refused(bad):
    guard, params = make_guard()
    assert guard.check(torch.tensor(0.5)) == (True, 0.5)
    assert guard.check(torch.tensor(bad))[0] is False
    for param in params:
        assert param.grad is not None
        param.grad[-1] = bad
        assert guard.check(torch.tensor(0.5)) == (False, 0.5)
        param.grad[-1] = 1.0
    assert guard.skipped == 4
    params[0].grad = params[2].grad = None
    assert guard.check(torch.tensor(1.0))[0] is True


def test_only_refusals_in_a_row_end_training():
    guard, _ = make_guard()
    for loss in (math.nan, 1.0) * 25 + (math.nan,) * 19:
        guard.check(torch.tensor(loss))
    assert guard.skipped == 25 + 19
    with pytest.raises(RunError, match="20 training steps in a row had a non-finite loss"):
        guard.check(torch.tensor(math.nan))


def poisoned_trainer(config: TrainerConfig, steps: set[int]) -> Trainer:
    """Its loss is NaN in `steps`."""
    trainer = quiet_trainer(config)
    original = trainer.pipeline.model.get_train_loss_dict

    def poisoned(ray_bundle: RayBundle, batch: dict[str, torch.Tensor]) -> TrainOutputs:
        outputs, losses, metrics = original(ray_bundle, batch)
        factor = math.nan if trainer.step in steps else 1.0
        return outputs, {"rgb_loss": losses["rgb_loss"] * factor}, metrics

    trainer.pipeline.model.get_train_loss_dict = poisoned  # type: ignore[method-assign]
    return trainer


def test_a_poisoned_step_changes_no_parameter_and_is_counted_and_logged(short_config):
    trainer = poisoned_trainer(short_config, {5})
    seen: list[torch.Tensor] = []
    grid = next(trainer.pipeline.model.parameters())
    where = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
    trainer.callbacks.append(TrainingCallback(where, lambda *_: seen.append(grid.detach().clone())))
    said = io.StringIO()
    finish(trainer, Console(file=said))
    assert trainer.record.skipped_steps == 1
    assert "warning: 1 step changed nothing: loss or gradients were not finite" in said.getvalue()
    assert torch.equal(seen[5], seen[4])
    assert not torch.equal(seen[6], seen[5])
    assert "step 5 skipped: non-finite loss (nan)" in trainer.run.log_path.read_text()
    assert '"loss": null' in trainer.run.metrics_path.read_text()


def test_training_that_stays_poisoned_ends_with_the_last_checkpoint_whole(short_config):
    config = replace(short_config, max_num_iterations=40)
    trainer = poisoned_trainer(config, set(range(6, 100)))
    with pytest.raises(RunError, match="20 training steps in a row"):
        trainer.train()
    checkpoint = newest_complete_checkpoint(trainer.run.checkpoints)
    assert checkpoint.step == 24  # of every fourth step
    assert all(tensor.isfinite().all() for tensor in checkpoint.tensors.values())


def averaged(weights: Iterable[float], decay: float, interval: int = 1) -> ParameterAverage:
    """The average of a weight that began at 0 and had these values in a training's steps."""
    module = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(module.weight)
    average = ParameterAverage(module, decay, interval)
    for step, weight in enumerate(weights, start=1):
        nn.init.constant_(module.weight, weight)
        average.update(step)
    return average


def test_an_interval_updates_at_its_steps_with_the_decay_to_its_power_after_the_first():
    average = averaged([1.0, 1.0], decay=0.9, interval=2)
    assert average.decay == 0.9**2
    before = average.updates
    for step in range(3, 8):
        average.update(step)
    assert average.updates - before == 2
    short = averaged([1.0] * 3, decay=0.99, interval=8)  # each step, so that a short training shows
    assert short.updates == 3
    assert short.values["weight"].item() > 0.95
    long = averaged([*[0.0] * 30, 1.0, 1.0], decay=0.5)  # exponential in the end
    assert long.values["weight"].item() == pytest.approx(0.75)


@pytest.mark.parametrize("num_steps", [400, 4000])
@pytest.mark.parametrize("interval", [1, 8])
def test_before_the_decay_bites_an_average_spans_the_same_part_of_any_training(num_steps, interval):
    weights = [step / num_steps for step in range(1, num_steps + 1)]
    # A mean in which the weight of a step grows with its number to the 8th lags a tenth of the way behind.
    found = averaged(weights, decay=0.99999, interval=interval).values["weight"].item()
    assert found == pytest.approx(0.9, abs=0.02)


def test_a_run_with_an_average_is_evaluated_and_loaded_with_it(short_config):
    config = replace(short_config, average_decay=0.8, steps_per_eval_all_images=12)
    trainer = quiet_trainer(config)
    trainer.train()
    assert trainer.average is not None
    loaded = load_model(trainer.run.path, "cpu")
    grid = dict(loaded.model.named_parameters())["field.grid"]
    assert torch.equal(grid, trainer.average.values["field.grid"])
    assert not torch.equal(grid, dict(trainer.pipeline.model.named_parameters())["field.grid"])
    line = trainer.run.metrics_path.read_text().splitlines()[-1]
    parameter = next(trainer.pipeline.model.parameters())
    trained = parameter.detach().clone()
    with trainer.average.swapped_in():
        assert torch.equal(parameter, grid)
        assert f'"psnr": {trainer.pipeline.get_average_eval_image_metrics_and_images()[0]["psnr"]}' in line
    assert torch.equal(parameter, trained)
    assert torch.equal(trainer.average.values["field.grid"], grid)


def test_the_average_takes_parameters_as_callbacks_after_the_step_leave_them(short_config):
    trainer = quiet_trainer(replace(short_config, average_decay=0.0))
    grid = dict(trainer.pipeline.model.named_parameters())["field.grid"]

    def bound(step, progress):  # noqa: ARG001
        with torch.no_grad():
            grid.clamp_(-1e-6, 1e-6)

    trainer.callbacks.append(TrainingCallback(TrainingCallbackLocation.AFTER_TRAIN_ITERATION, bound))
    assert trainer.average is not None
    trainer.average.interval = 1
    trainer.train()
    assert torch.equal(trainer.average.values["field.grid"], grid)
