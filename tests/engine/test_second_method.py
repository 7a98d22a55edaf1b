"""A method that has nothing to do with spectra is found, trained and brought back by the engine as it is."""

import ast
import json
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from tests.factories import rgb_nerf
from tests.factories.rgb_nerf import GridField, RgbNerf, RgbNerfConfig
from tests.factories.trainings import finished, newest, quiet_trainer, stop_at
from unmix_plugin.engine.registry import find_method
from unmix_plugin.engine.runs.checkpoints import save_checkpoint
from unmix_plugin.engine.runs.loading import load_config, load_model, load_pipeline
from unmix_plugin.errors import ConfigError


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("device", ["cpu"] + ["cuda"] * torch.cuda.is_available())
def test_a_plain_rgb_nerf_trains_from_its_entry_point_to_23_db(tmp_path, device):
    tree = ast.parse(Path(rgb_nerf.__file__).read_text())
    modules = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert [name for name in modules if name.startswith("unmix_plugin")] == ["unmix_plugin.engine"]
    (tmp_path / "ball").mkdir()
    place = {"data": tmp_path / "ball", "output_dir": tmp_path}
    trainer = quiet_trainer(replace(find_method("rgb-nerf").config, device=device, **place))
    assert trainer.pipeline.get_average_eval_image_metrics_and_images()[0]["psnr"] < 12
    record = trainer.train()
    loaded = load_pipeline(trainer.run.path, "cpu")
    assert loaded.training.steps == record.steps == 200
    assert loaded.pipeline.get_average_eval_image_metrics_and_images()[0]["psnr"] > 23


def test_a_finished_run_renders_from_its_folder_alone(short_config, tmp_path):
    trainer = finished(short_config)
    pipeline = trainer.pipeline.eval()
    expected = pipeline.model.get_outputs_for_camera(pipeline.datamanager.eval_cameras[1])
    short_config.data.rmdir()
    moved = trainer.run.path.rename(tmp_path / "elsewhere")
    loaded = load_model(moved, "cpu")
    actual = loaded.model.get_outputs_for_camera(loaded.record.eval_cameras[1])
    assert set(actual) == {"rgb", "accumulation"}
    assert torch.equal(actual["rgb"], expected["rgb"])
    assert loaded.record.summary == {"scene": "ball"}
    assert len(loaded.record.train_cameras) == 10


def test_a_scene_without_evaluation_views_trains_and_opens(short_config):
    data = replace(short_config.pipeline.datamanager, eval_views=())
    trainer = finished(replace(short_config, pipeline=replace(short_config.pipeline, datamanager=data)))
    loaded = load_pipeline(trainer.run.path, "cpu")
    assert len(loaded.record.eval_cameras) == 0
    assert loaded.pipeline.get_average_eval_image_metrics_and_images() == ({}, {})


def test_a_parameter_that_modules_share_is_loaded_with_its_average(short_config, monkeypatch):
    def share_field(model):
        model.field = model.again = GridField(20)

    monkeypatch.setattr(RgbNerf, "populate_modules", share_field)
    trainer = finished(replace(short_config, average_decay=0.8))
    assert trainer.average is not None
    loaded = dict(load_model(trainer.run.path, "cpu").model.named_parameters())
    assert torch.equal(loaded["field.grid"], trainer.average.values["field.grid"])


def test_parameters_that_no_checkpoint_would_hold_are_refused(short_config, monkeypatch):
    stray = {"fields": [torch.nn.Parameter(torch.zeros(1))]}
    monkeypatch.setattr(RgbNerf, "get_param_groups", lambda _: stray)
    with pytest.raises(ConfigError, match="group fields has parameters that no module of the model holds"):
        quiet_trainer(short_config)


def test_a_parameter_that_is_trained_from_a_resume_on_joins_the_average(short_config, monkeypatch):
    stopped = stop_at(replace(short_config, average_decay=0.8), 6).run
    monkeypatch.setattr(RgbNerf, "populate_modules", with_a_gain)
    checkpoint = newest(stopped)
    tensors = {**checkpoint.tensors, "model/gain": torch.tensor(2.0)}
    save_checkpoint(stopped / "checkpoints", 6, tensors, checkpoint.record)
    resumed = quiet_trainer(load_config(stopped))
    assert resumed.average is not None
    assert resumed.average.values["gain"] == 2.0


def with_a_gain(model: RgbNerf) -> None:
    model.field, model.gain = GridField(20), torch.nn.Parameter(torch.ones(()))


def test_what_could_be_trained_and_is_in_no_group_is_named(short_config, monkeypatch):
    assert "no parameter group" not in quiet_trainer(short_config).pipeline.reasons
    monkeypatch.setattr(RgbNerf, "populate_modules", with_a_gain)
    trainer = quiet_trainer(short_config)
    said = "warning: gain of the model can be trained, but no parameter group has it"
    assert trainer.pipeline.reasons == said
    assert said in trainer.run.log_path.read_text()


def test_settings_that_would_be_read_back_as_another_class_are_refused_before_training(short_config):
    @dataclass(frozen=True)
    class Twin(RgbNerfConfig):
        """The same fields under another name."""

    pipeline = replace(short_config.pipeline, model=Twin())
    with pytest.raises(ConfigError, match="classes that may stand in one place must differ in their fields"):
        quiet_trainer(replace(short_config, pipeline=pipeline))
    assert not short_config.output_dir.exists()


def test_groups_that_a_model_resets_between_steps_are_forgotten(short_config, monkeypatch):
    trainer = quiet_trainer(replace(short_config, average_decay=0.9))
    asked = []

    def between_steps(step, _progress, data):
        assert data is trainer.pipeline.datamanager
        assert not torch.is_grad_enabled()
        asked.append(step)
        return ["fields"] if step == 3 else []

    monkeypatch.setattr(trainer.pipeline.model, "between_steps", between_steps)
    steps = trainer.train().steps
    assert asked == list(range(steps))
    param = trainer.optimizer.param_groups[0]["params"][0]
    assert float(trainer.optimizer.state[param]["step"]) == steps - 3
    assert trainer.average is not None
    assert trainer.average.updates == 5  # one a step up to the eighth, of which three are forgotten


def test_training_json_says_how_long_and_how_much_was_trained(short_config):
    trainer = finished(short_config)
    record = trainer.record
    written = json.loads(trainer.run.training_path.read_text())
    assert written["steps"] == 12
    assert written["total_rays"] == record.total_rays == sum(512 + i for i in range(12))
    assert written["train_rays_per_second"] == record.total_rays / record.train_seconds
    assert written["num_rays"] == 524
