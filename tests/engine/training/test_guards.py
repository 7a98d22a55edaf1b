"""Non-finite numbers never reach the parameters."""

import io
import math

import pytest
import torch
from rich.console import Console
from torch import nn

from unmix_plugin.engine.configs import OptimizerConfig, TrainerConfig
from unmix_plugin.engine.runs.checkpoints import newest_complete_checkpoint
from unmix_plugin.engine.training import optimizers as guards
from unmix_plugin.engine.training.callbacks import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.engine.training.optimizers import GradientGuard, build_optimizer
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.errors import RunError


def make_guard():
    params = [nn.Parameter(torch.zeros(2)), nn.Parameter(torch.zeros(3)), nn.Parameter(torch.zeros(1))]
    configs = {"a": OptimizerConfig(), "b": OptimizerConfig()}
    optimizer = build_optimizer({"a": params[:2], "b": params[2:]}, configs)
    for param in params:
        param.grad = torch.ones_like(param)
    return GradientGuard(optimizer), params


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_bad_loss_or_any_one_bad_gradient_entry_is_refused(bad: float):
    guard, params = make_guard()
    assert guard.check(torch.tensor(0.5)) == (True, 0.5)
    assert guard.check(torch.tensor(bad))[0] is False
    for param in params:
        assert param.grad is not None
        param.grad[-1] = bad
        assert guard.check(torch.tensor(0.5)) == (False, 0.5)
        param.grad[-1] = 1.0
    assert guard.skipped == 4


def test_parameters_without_gradient_do_not_matter():
    guard, params = make_guard()
    params[0].grad = params[2].grad = None
    assert guard.check(torch.tensor(1.0))[0] is True


def test_only_refusals_in_a_row_end_training(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(guards, "MAX_IN_A_ROW", 2)
    guard, _ = make_guard()
    for loss in (math.nan, 1.0, math.nan, 1.0):
        guard.check(torch.tensor(loss))
    assert guard.skipped == 2
    guard.check(torch.tensor(math.nan))
    with pytest.raises(RunError, match="2 training steps in a row had a non-finite loss"):
        guard.check(torch.tensor(math.nan))


def poisoned_trainer(config: TrainerConfig, steps: set[int]) -> Trainer:
    """Its loss is NaN in `steps`."""
    trainer = Trainer(config, console=Console(file=io.StringIO()))
    original = trainer.pipeline.get_train_loss_dict

    def poisoned(step: int):
        outputs, losses, metrics = original(step)
        return outputs, {"rgb_loss": losses["rgb_loss"] * (math.nan if step in steps else 1.0)}, metrics

    trainer.pipeline.get_train_loss_dict = poisoned  # type: ignore[method-assign]
    return trainer


def test_a_poisoned_step_changes_no_parameter_and_is_counted_and_logged(short_config: TrainerConfig):
    trainer = poisoned_trainer(short_config, {5})
    seen: list[torch.Tensor] = []
    grid = next(trainer.pipeline.model.parameters())
    where = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
    trainer.callbacks.append(TrainingCallback(where, lambda *_: seen.append(grid.detach().clone())))
    record = trainer.train()
    assert record.skipped_steps == 1
    assert torch.equal(seen[5], seen[4])
    assert not torch.equal(seen[6], seen[5])
    assert "step 5 skipped: non-finite loss (nan)" in trainer.log.path.read_text()
    assert '"loss": null' in trainer.run.metrics_path.read_text()


def test_training_that_stays_poisoned_ends_with_the_last_checkpoint_whole(
    short_config: TrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(guards, "MAX_IN_A_ROW", 3)
    trainer = poisoned_trainer(short_config, set(range(6, 100)))
    with pytest.raises(RunError, match="3 training steps in a row"):
        trainer.train()
    checkpoint = newest_complete_checkpoint(trainer.run.checkpoints)
    assert checkpoint is not None
    assert checkpoint.step == 8
    assert all(tensor.isfinite().all() for tensor in checkpoint.tensors.values())
