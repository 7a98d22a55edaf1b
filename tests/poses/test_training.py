import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import CONFIG
from tests.factories.scenes import make_line_scene, make_scene
from tests.factories.trainings import quiet_trainer, stop_at
from unmix_plugin.engine.configs import PipelineConfig, TrainerConfig
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import rotation_matrix
from unmix_plugin.engine.runs.loading import load_config, load_model
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.method_config import unmix_nerf
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.settings import HyperspectralDataManagerConfig, PoseConfig
from unmix_plugin.trained.open_run import open_run


def config_for(
    folder: Path, poses: Literal["fixed", "refine"] = "refine", steps: int = 12, **refinement: Any
) -> TrainerConfig:
    data = HyperspectralDataManagerConfig(train_num_rays_per_batch=64, grid_resolution=16)
    correcting = PoseConfig(start=0.0, **refinement)
    model = replace(CONFIG, num_endmembers=1, poses=poses, pose_refinement=correcting)
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
    trainer = quiet_trainer(config)
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
    rays, _ = quiet_trainer(config_for(folder, "fixed")).pipeline.datamanager.next_train(0)
    bare = replace(rays, axes=None, pixel_coords=None)
    model.generator = torch.Generator().manual_seed(0)
    first = model.train().get_outputs(rays)["spectral"]
    model.generator = torch.Generator().manual_seed(0)
    assert torch.equal(first, model.get_outputs(bare)["spectral"])


def test_space_is_carved_once_by_the_corrected_cameras(folder, monkeypatch):
    asked, refined = [], PoseRefinement.refined

    def watched(poses: PoseRefinement, cameras: Cameras) -> Cameras:
        asked.append((trainer.step, refined(poses, cameras)))
        return asked[-1][1]

    trainer = quiet_trainer(config_for(folder, steps=20))
    model: Any = trainer.pipeline.model
    assert bool(model.grid.reachable.all())
    monkeypatch.setattr(PoseRefinement, "refined", watched)
    trainer.train()
    datamanager: Any = trainer.pipeline.datamanager
    [(step, cameras)] = asked
    assert step == 6
    hull = datamanager.carved_by(cameras)
    assert 0 < hull.float().mean() < 1
    assert torch.equal(model.grid.reachable, hull)
    assert not torch.equal(hull, torch.from_numpy(datamanager.initial_data()["reachable"]))
    assert not bool((model.grid.occupied.bool() & ~model.grid.reachable).any())


def test_nothing_is_carved_by_cameras_that_contradict_each_other(folder):
    trainer = quiet_trainer(config_for(folder))
    datamanager: Any = trainer.pipeline.datamanager
    right = datamanager.train_cameras
    turned = right.camera_to_world.clone()
    turns = 0.3 * torch.randn(len(right), 3, generator=torch.Generator().manual_seed(0))
    turned[:, :, :3] = rotation_matrix(turns) @ turned[:, :, :3]
    assert datamanager.carved_by(right) is not None
    assert datamanager.carved_by(replace(right, camera_to_world=turned)) is None


def test_refined_poses_are_the_run_s_training_cameras(folder):
    trainer = trained(config_for(folder))
    loaded = load_model(trainer.run.path)
    poses: Any = loaded.model.poses
    expected = poses.refined(loaded.record.train_cameras)
    views = [view for view in open_run(trainer.run.path, "cpu").views if view.split == "train"]
    found = torch.cat([view.camera.camera_to_world for view in views])
    assert_close(found, expected.camera_to_world)
    given = trainer.pipeline.datamanager.train_cameras.camera_to_world
    assert float((found - given).abs().max()) > 1e-5
    lines = (trainer.run.path / "metrics.jsonl").read_text().splitlines()
    assert "poses" in json.loads(lines[-1])


@pytest.fixture(scope="module")
def lines(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("lines")
    make_line_scene(place / "scene")
    return place


def test_a_run_gives_back_its_line_cameras_and_renders_all_bands(lines):
    trainer = trained(config_for(lines, "fixed"))
    scene = open_run(trainer.run.path, "cpu")
    view = scene.views[0]
    assert view.camera.is_line_camera(0)
    mine, theirs = view.camera.image_rays(0), trainer.pipeline.datamanager.train_cameras.image_rays(0)
    assert torch.equal(mine.origins, theirs.origins)
    found = scene.render(view.camera, ["spectral", "depth"])["spectral"]
    assert found.shape == (16, 20, 4)
    assert bool(found.isfinite().all())
    assert float(found.std()) > 0


def test_refined_training_on_line_cameras_goes_on_exactly_where_it_stopped(lines):
    config = config_for(lines, steps=8, coarse_steps=2)
    straight = trained(config).pipeline
    poses, given = straight.model.poses, straight.datamanager.train_cameras
    assert isinstance(poses, PoseRefinement)
    assert not torch.equal(poses.refined(given).image_rays(0).directions, given.image_rays(0).directions)
    resumed = trained(load_config(stop_at(config, 6).run)).pipeline.model.state_dict()
    for name, value in straight.model.state_dict().items():
        assert torch.equal(value, resumed[name]), name
