"""What a pipeline computes from a model and a data manager, whatever they are."""

import random

import numpy as np
import pytest
import torch

from tests.factories.rgb_nerf import RgbNerf
from tests.factories.trainings import finished, quiet_trainer
from unmix_plugin.engine.model import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.engine.runs.loading import load_pipeline
from unmix_plugin.errors import ConfigError


@pytest.fixture
def pipeline(short_config):
    torch.manual_seed(0)
    made = short_config.pipeline.setup(data=short_config.data, device=torch.device("cpu"), seed=3)
    made.initialise()
    return made


def test_a_whole_image_is_its_rays_rendered_in_any_chunks(pipeline):
    camera = pipeline.datamanager.eval_cameras[0]
    model = pipeline.model.eval()
    at_once = model.get_outputs(camera.image_rays(0))
    image = model.get_outputs_for_camera(camera)
    assert image["rgb"].shape == (20, 20, 3)
    assert image["accumulation"].shape == (20, 20)
    torch.testing.assert_close(image["rgb"].reshape(-1, 3), at_once["rgb"], rtol=0, atol=1e-6)
    assert set(model.get_outputs_for_camera(camera, ["rgb"])) == {"rgb"}
    with pytest.raises(ConfigError, match="no output depht; it has accumulation, rgb"):
        model.get_outputs_for_camera(camera, ["depht"])


def test_average_metrics_are_the_mean_over_the_evaluation_views_that_have_them(pipeline, monkeypatch):
    seen: list[bool] = []

    def metrics(outputs, _):
        seen.append(pipeline.model.training)
        return ({"psnr": 10.0, "miou": 0.5} if len(seen) == 1 else {"psnr": 20.0}), {"rgb": outputs["rgb"]}

    monkeypatch.setattr(pipeline.model, "get_image_metrics_and_images", metrics)
    pipeline.train()
    means, pictures = pipeline.get_average_eval_image_metrics_and_images()
    assert means == {"psnr": 15.0, "miou": 0.5}
    assert set(pictures) == {"rgb"}
    assert seen == [False, False]
    assert pipeline.model.training


def test_what_a_step_draws_follows_from_the_seed_and_the_step_alone(pipeline):
    def loss(step):
        pipeline.seed_step(step)
        torch.rand(3)  # somebody else draws from the global generator
        return next(pipeline.train_batches(5))()[1]["rgb_loss"].item()

    assert loss(5) == loss(5) != loss(6)

    def globally(step):
        pipeline.seed_step(step)
        return np.random.rand(), random.random()  # noqa: NPY002 - a method's own code may draw from them

    assert globally(5) == globally(5)
    assert not set(globally(5)) & set(globally(6))


def test_training_calls_the_callbacks_of_every_step_in_order_with_its_progress(short_config):
    trainer = quiet_trainer(short_config)
    seen: list[tuple[str, int, float]] = []
    before, after = TrainingCallbackLocation
    for where, name in ((after, "b"), (before, "a"), (after, "c")):
        call = lambda step, progress, name=name: seen.append((name, step, progress))  # noqa: E731
        trainer.callbacks.append(TrainingCallback(where, call))
    trainer.train()
    assert seen == [(name, step, step / 12) for step in range(12) for name in "abc"]


def test_a_model_takes_its_first_values_from_the_scene_only_when_a_run_starts(short_config, monkeypatch):
    calls = []
    original = RgbNerf.initialise

    def counted(self, initial_data, generator):
        calls.append(set(initial_data))
        original(self, initial_data, generator)

    monkeypatch.setattr(RgbNerf, "initialise", counted)
    trainer = finished(short_config)
    load_pipeline(trainer.run.path, "cpu")
    assert calls == [{"raw_density"}]


def test_a_pipeline_loads_with_its_scene_at_another_place(short_config, tmp_path):
    trainer = finished(short_config)
    moved = short_config.data.rename(tmp_path / "moved")
    loaded = load_pipeline(trainer.run.path, "cpu", data=moved)
    assert loaded.config.data == loaded.pipeline.datamanager.data == moved
    assert loaded.training == trainer.record
    assert not loaded.pipeline.model.training


def test_warnings_of_the_data_are_told_only_when_a_run_starts(short_config, monkeypatch):
    made = short_config.pipeline.setup(data=short_config.data, device=torch.device("cpu"), seed=3)
    monkeypatch.setattr(made.datamanager, "warnings", lambda: ["the poses look odd"])
    assert "odd" not in made.reasons
    made.initialise()
    assert made.reasons.splitlines()[-1] == "warning: the poses look odd"
