"""Training on line cameras: rays by row, a whole view rendered in all bands, and the run folder that gives it back."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from torch.testing import assert_close

from tests.engine.stopped_runs import stop_at
from tests.method_factory import CONFIG
from tests.scenes.line_factory import make_line_scene
from tests.test_pose_training import trained
from unmix_plugin.datamanager_settings import HyperspectralDataManagerConfig
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.pipeline import PipelineConfig
from unmix_plugin.engine.runs.load_run import load_config
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.method_config import unmix_nerf
from unmix_plugin.pose_refinement import PoseRefinement
from unmix_plugin.pose_settings import PoseConfig
from unmix_plugin.trained.open_run import open_run


@pytest.fixture(scope="module")
def trainer(tmp_path_factory) -> Trainer:
    folder: Path = tmp_path_factory.mktemp("lines")
    data = HyperspectralDataManagerConfig(train_num_rays_per_batch=64, grid_resolution=16)
    config = replace(
        unmix_nerf.config,
        data=make_line_scene(folder / "scene").root,
        output_dir=folder / "runs",
        max_num_iterations=12,
        device="cpu",
        pipeline=PipelineConfig(datamanager=data, model=replace(CONFIG, num_endmembers=1)),
    )
    trainer = Trainer(config, console=Console(file=io.StringIO()))
    trainer.train()
    return trainer


def test_training_rays_start_where_their_row_was_taken(trainer):
    manager = trainer.pipeline.datamanager
    rays, _ = manager.next_train(0)
    assert rays.image_y is not None
    expected = manager.train_cameras.poses_at(rays.camera_indices, rays.image_y)
    assert_close(rays.origins, expected[:, :, 3])
    assert len(rays.origins.unique(dim=0)) > len(manager.train_cameras)


def test_a_run_gives_back_its_line_cameras_and_renders_all_bands(trainer):
    scene = open_run(trainer.run.path, "cpu")
    view = scene.views[0]
    assert view.camera.is_line_camera(0)
    mine, theirs = view.camera.image_rays(0), trainer.pipeline.datamanager.train_cameras.image_rays(0)
    assert torch.equal(mine.origins, theirs.origins)
    found = scene.render(view.camera, ["spectral", "depth"])
    assert found["spectral"].shape == (16, 20, 4)
    assert bool(found["spectral"].isfinite().all())
    assert float(found["spectral"].std()) > 0


def refining(folder: Path, steps: int, anew_from: float = 0.6) -> TrainerConfig:
    """Training that registers its line cameras twice."""
    refinement = PoseConfig(
        start=0.0,
        coarse_steps=2,
        register_from=0.4,
        register_every=0.3,
        register_steps=1,
        anew_from=anew_from,
    )
    model = replace(CONFIG, num_endmembers=1, poses="refine", pose_refinement=refinement)
    data = HyperspectralDataManagerConfig(train_num_rays_per_batch=64, grid_resolution=16)
    return replace(
        unmix_nerf.config,
        data=folder / "scene",
        output_dir=folder / "runs",
        max_num_iterations=steps,
        device="cpu",
        pipeline=PipelineConfig(datamanager=data, model=model),
    )


def test_line_cameras_are_registered_while_poses_are_refined(tmp_path):
    make_line_scene(tmp_path / "scene")
    run = trained(refining(tmp_path, 10))
    poses = run.pipeline.model.poses
    assert isinstance(poses, PoseRefinement)
    assert bool(poses.is_found.any())
    assert bool(poses.corrections.isfinite().all())
    given = run.pipeline.datamanager.train_cameras
    assert not torch.equal(poses.refined(given).image_rays(0).directions, given.image_rays(0).directions)


def test_the_scene_is_learnt_anew_once_by_the_poses_that_were_found(tmp_path):
    make_line_scene(tmp_path / "scene")
    trainer = Trainer(refining(tmp_path, 20), console=Console(file=io.StringIO()))
    model: Any = trainer.pipeline.model
    steps, begin = list[int](), model.begin_anew

    def watched(*given: Any) -> None:
        steps.append(trainer.step)
        found, trained_table = model.poses.corrections.clone(), model.field.table.detach().clone()
        begin(*given)
        assert bool(model.poses.is_found.any())
        assert torch.equal(model.poses.corrections, found)
        assert float(model.field.table.abs().max()) < 0.1 * float(trained_table.abs().max())
        assert torch.equal(model.field.level_weights, torch.ones_like(model.field.level_weights))

    model.begin_anew = watched
    trainer.train()
    assert steps == [12]
    assert "step 12: the scene is learnt anew" in trainer.run.log_path.read_text()
    optimizer = trainer.optimizer
    ages = {x["name"]: float(optimizer.state[x["params"][0]]["step"]) for x in optimizer.param_groups}
    assert ages == {"grid": 8, "networks": 8, "spectra": 8, "poses": 20}


def test_space_is_carved_again_where_the_scene_is_learnt_anew(tmp_path):
    make_line_scene(tmp_path / "scene")
    trainer = Trainer(refining(tmp_path, 10), console=Console(file=io.StringIO()))
    model: Any = trainer.pipeline.model
    steps, take_in = list[int](), model.take_in
    model.take_in = lambda data: (steps.append(trainer.step), take_in(data))
    trainer.train()
    assert len(steps) == 2
    assert steps[1] == 6


def test_rates_of_learning_begin_anew_with_the_scene(tmp_path):
    make_line_scene(tmp_path / "scene")
    run = trained(replace(refining(tmp_path, 20), steps_per_log=1)).run
    lines = [json.loads(line) for line in run.metrics_path.read_text().splitlines()]
    grid, poses = ([x[f"lr/{name}"] for x in lines if x["split"] == "train"] for name in ("grid", "poses"))
    assert grid[12] == grid[0] > grid[11]
    assert grid[16] == pytest.approx(grid[10])  # half of the way
    assert poses == sorted(poses, reverse=True)


def test_a_scene_may_be_kept_to_the_end(tmp_path):
    make_line_scene(tmp_path / "scene")
    run = trained(refining(tmp_path, 10, anew_from=1.0)).run
    assert "anew" not in run.log_path.read_text()


@pytest.mark.parametrize("stop", [4, 6, 8])
def test_training_on_line_cameras_goes_on_exactly_where_it_stopped(tmp_path, stop):
    """The scene is learnt anew in step 6."""
    make_line_scene(tmp_path / "scene")
    whole = trained(refining(tmp_path, 10)).pipeline.model
    stopped = stop_at(refining(tmp_path, 10), stop)
    resumed = trained(load_config(stopped.run)).pipeline.model
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
