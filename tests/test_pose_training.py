"""Training that corrects poses: it carves by corrected cameras, goes on where it stopped, and moves its views."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from rich.console import Console
from torch.testing import assert_close

from tests.engine.stopped_runs import stop_at
from tests.method_factory import CONFIG
from tests.scenes.scene_factory import make_scene
from unmix_plugin.datamanager_settings import HyperspectralDataManagerConfig
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.rotations import rotation_matrix
from unmix_plugin.engine.pipeline import PipelineConfig
from unmix_plugin.engine.runs.load_run import load_config, load_model
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.method_config import unmix_nerf
from unmix_plugin.pose_refinement import PoseRefinement
from unmix_plugin.pose_settings import PoseConfig
from unmix_plugin.trained.open_run import open_run


def config_for(folder: Path, poses: Literal["fixed", "refine"] = "refine", steps: int = 12) -> TrainerConfig:
    data = HyperspectralDataManagerConfig(train_num_rays_per_batch=64, grid_resolution=16)
    model = replace(CONFIG, num_endmembers=1, poses=poses, pose_refinement=PoseConfig(start=0.0))
    return replace(
        unmix_nerf.config,
        data=folder / "scene",
        output_dir=folder / "runs",
        max_num_iterations=steps,
        steps_per_log=4,
        device="cpu",
        pipeline=PipelineConfig(datamanager=data, model=model),
    )


def trained(config: TrainerConfig) -> Trainer:
    trainer = Trainer(config, console=Console(file=io.StringIO()))
    trainer.train()
    return trainer


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("refined")
    make_scene(place / "scene")
    return place


def test_poses_that_are_taken_as_they_are_leave_training_as_it_was(folder):
    model = trained(config_for(folder, "fixed")).pipeline.model
    assert model.poses is None
    assert not [name for name, _ in model.named_parameters() if name.startswith("poses")]
    assert "field.level_weights" not in model.state_dict()
    rays, _ = Trainer(
        config_for(folder, "fixed"), console=Console(file=io.StringIO())
    ).pipeline.datamanager.next_train(0)
    bare = replace(rays, axes=None, image_y=None)
    model.generator = torch.Generator().manual_seed(0)
    first = model.train().get_outputs(rays)["spectral"]
    model.generator = torch.Generator().manual_seed(0)
    assert torch.equal(first, model.get_outputs(bare)["spectral"])


def test_space_is_carved_by_the_corrected_cameras_and_again_where_the_scene_is_learnt_anew(folder):
    asked = []

    class Watched(PoseRefinement):
        def refined(self, cameras: Cameras) -> Cameras:
            asked.append((trainer.step, super().refined(cameras)))
            return asked[-1][1]

    trainer = Trainer(config_for(folder, steps=20), console=Console(file=io.StringIO()))
    model: Any = trainer.pipeline.model
    assert bool(model.grid.reachable.all())
    model.poses.__class__ = Watched
    trainer.train()
    datamanager: Any = trainer.pipeline.datamanager
    assert [step for step, _ in asked] == [6, 12]
    cameras = asked[-1][1]
    hull = torch.from_numpy(datamanager.judge_again(cameras)["reachable"])
    assert 0 < hull.float().mean() < 1
    assert torch.equal(model.grid.reachable, hull)
    assert not torch.equal(hull, torch.from_numpy(datamanager.initial_data()["reachable"]))
    assert not bool((model.grid.occupied.bool() & ~model.grid.reachable).any())


def test_nothing_is_carved_by_cameras_that_contradict_each_other(folder):
    trainer = Trainer(config_for(folder), console=Console(file=io.StringIO()))
    datamanager: Any = trainer.pipeline.datamanager
    right = datamanager.train_cameras
    turned = right.camera_to_world.clone()
    turns = 0.3 * torch.randn(len(right), 3, generator=torch.Generator().manual_seed(0))
    turned[:, :, :3] = rotation_matrix(turns) @ turned[:, :, :3]
    assert set(datamanager.judge_again(right)) == {"reachable"}
    assert datamanager.judge_again(replace(right, camera_to_world=turned)) == {}


def test_a_scene_is_learnt_anew_once_with_the_poses_that_were_found(folder):
    trainer = Trainer(config_for(folder, steps=20), console=Console(file=io.StringIO()))
    model: Any = trainer.pipeline.model
    steps, begin = list[int](), model.begin_anew

    def watched(*given: Any) -> None:
        steps.append(trainer.step)
        corrections = model.poses.corrections.clone()
        begin(*given)
        assert torch.equal(model.poses.corrections, corrections)
        assert float(corrections.abs().max()) > 0
        assert float(model.field.table.abs().max()) < 1e-3  # as drawn at first
        assert torch.equal(model.field.level_weights, torch.ones_like(model.field.level_weights))

    model.begin_anew = watched
    trainer.train()
    assert steps == [12]
    assert "step 12: the scene is learnt anew" in trainer.run.log_path.read_text()
    assert len(trainer.optimizer.state) == sum(len(x["params"]) for x in trainer.optimizer.param_groups)
    ages = {
        x["name"]: float(trainer.optimizer.state[x["params"][0]]["step"])
        for x in trainer.optimizer.param_groups
    }
    assert ages == {"grid": 8, "networks": 8, "spectra": 8, "poses": 20}


def test_rates_of_learning_begin_anew_with_the_scene(folder):
    trainer = trained(replace(config_for(folder, steps=20), steps_per_log=1))
    lines = [json.loads(line) for line in trainer.run.metrics_path.read_text().splitlines()]
    grid, poses = (
        [line[f"lr/{name}"] for line in lines if line["split"] == "train"] for name in ("grid", "poses")
    )
    assert grid[12] == grid[0] > grid[11]
    assert grid[16] == pytest.approx(grid[10])  # half of the way
    assert poses == sorted(poses, reverse=True)


def test_a_scene_may_be_kept_to_the_end(folder):
    config = config_for(folder)
    model = replace(config.pipeline.model, pose_refinement=PoseConfig(start=0.0, anew_from=1.0))
    trainer = trained(replace(config, pipeline=replace(config.pipeline, model=model)))
    assert "anew" not in trainer.run.log_path.read_text()


@pytest.mark.parametrize("stop", [6, 8, 9])
def test_a_resumed_refinement_is_the_one_that_was_never_stopped(folder, stop):
    """The scene is learnt anew in step 8."""
    straight = trained(config_for(folder))
    stopped = stop_at(config_for(folder), stop)
    resumed = trained(load_config(stopped.run))
    expected, found = straight.pipeline.model.state_dict(), resumed.pipeline.model.state_dict()
    assert float(expected["poses.steps"].abs().max()) > 0
    for name, tensor in expected.items():
        assert torch.equal(found[name], tensor), name


def test_refined_poses_are_the_run_s_training_cameras(folder):
    trainer = trained(config_for(folder))
    loaded = load_model(trainer.run.path)
    poses: Any = loaded.model.poses
    expected = poses.refined(loaded.scene.train_cameras)
    views = [view for view in open_run(trainer.run.path, "cpu").views if view.split == "train"]
    found = torch.cat([view.camera.camera_to_world for view in views])
    assert_close(found, expected.camera_to_world)
    given = trainer.pipeline.datamanager.train_cameras.camera_to_world
    assert float((found - given).abs().max()) > 1e-5
    lines = (trainer.run.path / "metrics.jsonl").read_text().splitlines()
    assert "poses" in json.loads(lines[-1])
