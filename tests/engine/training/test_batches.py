"""The two batches of a step on a CPU with several threads: one gradient, repeatable, whoever is faster."""

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import CONFIG
from tests.factories.trainings import finished, newest, quiet_trainer, stop_at
from unmix_plugin.engine.configs import PipelineConfig, TrainerConfig
from unmix_plugin.engine.machine import operations_shared_among
from unmix_plugin.engine.model import Model
from unmix_plugin.engine.runs.loading import load_config
from unmix_plugin.engine.training.batches import work_on_batches
from unmix_plugin.errors import ConfigError
from unmix_plugin.method_config import unmix_nerf
from unmix_plugin.model import UnmixModel
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.settings import HyperspectralDataManagerConfig


@pytest.fixture
def _two_threads() -> Iterator[None]:
    with operations_shared_among(2):
        yield


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> TrainerConfig:
    folder = tmp_path_factory.mktemp("batches")
    make_demo_scene(folder / "scene", 24, 8, 6)
    data = HyperspectralDataManagerConfig(train_num_rays_per_batch=200, grid_resolution=16)
    model = replace(CONFIG, num_endmembers=2, samples_per_step=3000)
    return replace(
        unmix_nerf.config,
        data=folder / "scene",
        output_dir=folder / "runs",
        max_num_iterations=12,
        device="cpu",
        pipeline=PipelineConfig(datamanager=data, model=model),
    )


def slow_down(monkeypatch: pytest.MonkeyPatch, model: Model, thread: str) -> None:
    """Let the batch of a thread, by the start of its name, take longer than the other."""
    original = type(model).get_train_loss_dict

    def slowly(self: Any, *args: Any) -> Any:
        if threading.current_thread().name.startswith(thread):
            time.sleep(0.05)
        return original(self, *args)

    monkeypatch.setattr(type(model), "get_train_loss_dict", slowly)


def gradients_of(trainer: Any) -> dict[str, torch.Tensor]:
    params = trainer.pipeline.model.named_parameters()
    return {name: param.grad.clone() for name, param in params if param.grad is not None}


@pytest.mark.usefixtures("_two_threads")
def test_the_gradient_of_a_step_is_the_mean_of_those_of_its_batches(config):
    trainer = quiet_trainer(config)
    pipeline = trainer.pipeline.train()
    pipeline.seed_step(3)
    batches = list(pipeline.train_batches(3, 2))
    for batch in batches:
        losses = batch()[1]
        (torch.stack([loss.reshape(()) for loss in losses.values()]).sum() / 2).backward()
    expected = gradients_of(trainer)
    trainer.optimizer.zero_grad()
    found = work_on_batches(pipeline, 3)
    assert len(found) == 2
    assert set(gradients_of(trainer)) == set(expected)
    for name, gradient in gradients_of(trainer).items():
        assert_close(gradient, expected[name], rtol=1e-4, atol=1e-7)
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("_two_threads")
def test_a_training_is_the_same_whichever_batch_is_slower_and_wherever_it_was_stopped(config, monkeypatch):
    straight = newest(finished(config).run.path)
    trainer = quiet_trainer(config)
    for slower in ("MainThread", "unmix-beside"):
        with monkeypatch.context() as patch:
            slow_down(patch, trainer.pipeline.model, slower)
            again = newest(finished(config).run.path)
        assert all(torch.equal(again.tensors[name], value) for name, value in straight.tensors.items())
    resumed = quiet_trainer(load_config(stop_at(config, 5).run))
    resumed.train()
    ended = newest(resumed.run.path)
    assert all(torch.equal(ended.tensors[name], value) for name, value in straight.tensors.items())


@pytest.mark.usefixtures("_two_threads")
def test_both_batches_see_other_pixels_and_learn_of_all(config):
    pipeline = quiet_trainer(config).pipeline.train()
    pipeline.seed_step(0)
    first, second = (batch.args for batch in pipeline.train_batches(0, 2))  # type: ignore[attr-defined]
    assert len(first[0]) == len(second[0]) == 100
    assert not torch.equal(first[1]["pixels"], second[1]["pixels"])
    for batch in work_on_batches(pipeline, 0):
        pipeline.model.update(batch.outputs)
    assert isinstance(pipeline.model, UnmixModel)
    assert int(pipeline.model.grid.visibility.num_rays) == 200


@pytest.mark.usefixtures("_two_threads")
def test_a_method_that_says_nothing_of_it_has_one_batch_a_step(short_config):
    pipeline = quiet_trainer(short_config).pipeline.train()
    pipeline.seed_step(0)
    assert len(work_on_batches(pipeline, 0)) == 1


@pytest.mark.usefixtures("_two_threads")
@pytest.mark.parametrize("thread", ["MainThread", "unmix-beside"])
def test_what_goes_wrong_in_either_batch_ends_the_step(config, monkeypatch, thread):
    pipeline = quiet_trainer(config).pipeline.train()
    original = type(pipeline.model).get_train_loss_dict

    def wrong(self: Any, *args: Any) -> Any:
        outputs, losses, metrics = original(self, *args)
        here = threading.current_thread().name.startswith(thread)
        return outputs, {"odd": torch.ones(3)} if here else losses, metrics

    monkeypatch.setattr(type(pipeline.model), "get_train_loss_dict", wrong)
    pipeline.seed_step(0)
    with pytest.raises(ConfigError, match=r"the loss odd of .*UnmixModel"):
        work_on_batches(pipeline, 0)
    assert torch.get_num_threads() == 2


def test_one_thread_has_one_batch(config, tmp_path: Path):
    pipeline = quiet_trainer(replace(config, output_dir=tmp_path)).pipeline.train()
    pipeline.seed_step(0)
    assert len(work_on_batches(pipeline, 0)) == 1
