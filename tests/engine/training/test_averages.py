"""The moving average of the parameters."""

import io
from dataclasses import replace

import pytest
import torch
from rich.console import Console
from torch import nn

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.runs.load_run import load_model
from unmix_plugin.engine.training.callbacks import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.engine.training.optimizers import ParameterAverage
from unmix_plugin.engine.training.trainer import Trainer


def test_the_average_of_a_constant_is_the_constant():
    module = nn.Linear(3, 2)
    expected = module.weight.detach().clone()
    average = ParameterAverage(module, decay=0.9)
    for step in range(1, 30):
        average.update(step)
    torch.testing.assert_close(average.values["weight"], expected, rtol=0, atol=1e-7)


def test_after_many_steps_the_average_is_exponential():
    module = nn.Linear(1, 1, bias=False)
    average = ParameterAverage(module, decay=0.5)
    expected = 0.0
    for step in range(1, 60):
        with torch.no_grad():
            module.weight.fill_(float(step % 7))
        average.update(step)
        expected = 0.5 * expected + 0.5 * (step % 7)
    torch.testing.assert_close(average.values["weight"].item(), expected, rtol=1e-5, atol=1e-5)


def test_an_interval_of_two_updates_at_every_second_step_with_the_decay_squared():
    module = nn.Linear(1, 1, bias=False)
    average = ParameterAverage(module, decay=0.9, interval=2)
    assert average.decay == 0.9**2
    average.update(1)
    average.update(2)
    before = average.updates
    for step in range(3, 8):
        average.update(step)
    assert average.updates - before == 2


def test_the_steps_of_the_first_interval_are_each_taken_in_so_that_a_short_training_shows():
    module = nn.Linear(1, 1, bias=False)
    with torch.no_grad():
        module.weight.fill_(0.0)
    average = ParameterAverage(module, decay=0.99, interval=8)
    with torch.no_grad():
        module.weight.fill_(1.0)
    for step in range(1, 4):
        average.update(step)
    assert average.updates == 3
    assert average.values["weight"].item() > 0.95


@pytest.mark.parametrize("num_steps", [400, 4000])
@pytest.mark.parametrize("interval", [1, 8])
def test_before_the_decay_bites_the_average_spans_the_same_part_of_a_training_of_any_length(
    num_steps, interval
):
    module = nn.Linear(1, 1, bias=False)
    average = ParameterAverage(module, decay=0.99999, interval=interval)
    for step in range(1, num_steps + 1):
        with torch.no_grad():
            module.weight.fill_(step / num_steps)
        average.update(step)
    # A mean in which the weight of a step grows with its number to the 8th lags a tenth of the way behind.
    assert average.values["weight"].item() == pytest.approx(0.9, abs=0.02)


def test_swapping_in_shows_the_average_and_gives_the_parameters_back():
    module = nn.Linear(2, 2)
    average = ParameterAverage(module, decay=0.9)
    before = module.weight.detach().clone()
    with torch.no_grad():
        module.weight.add_(1.0)
    with average.swapped_in():
        assert torch.equal(module.weight, before)
    assert torch.equal(module.weight, before + 1.0)
    assert torch.equal(average.values["weight"], before)


def test_a_run_with_an_average_is_evaluated_and_loaded_with_it(short_config: TrainerConfig):
    config = replace(short_config, average_decay=0.8, steps_per_eval_all_images=12)
    trainer = Trainer(config, console=Console(file=io.StringIO()))
    trainer.train()
    assert trainer.average is not None
    loaded = load_model(trainer.run.path, "cpu")
    grid = dict(loaded.model.named_parameters())["field.grid"]
    assert torch.equal(grid, trainer.average.values["field.grid"])
    assert not torch.equal(grid, dict(trainer.pipeline.model.named_parameters())["field.grid"])
    line = trainer.run.metrics_path.read_text().splitlines()[-1]
    with trainer.average.swapped_in():
        assert f'"psnr": {trainer.pipeline.get_average_eval_image_metrics_and_images()[0]["psnr"]}' in line


def test_the_average_takes_parameters_as_callbacks_after_the_step_leave_them(short_config: TrainerConfig):
    trainer = Trainer(replace(short_config, average_decay=0.0), console=Console(file=io.StringIO()))
    grid = dict(trainer.pipeline.model.named_parameters())["field.grid"]

    def bound(step: int, progress: float) -> None:  # noqa: ARG001
        with torch.no_grad():
            grid.clamp_(-1e-6, 1e-6)

    trainer.callbacks.append(TrainingCallback(TrainingCallbackLocation.AFTER_TRAIN_ITERATION, bound))
    assert trainer.average is not None
    trainer.average.interval = 1
    trainer.train()
    assert torch.equal(trainer.average.values["field.grid"], grid)
