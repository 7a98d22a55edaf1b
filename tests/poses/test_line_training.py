"""Training on line cameras: rays by row, a whole view rendered in all bands, and the run folder that gives it back."""

import io
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from torch import Tensor
from torch.testing import assert_close

from tests.engine.stopped_runs import stop_at
from tests.method_factory import CONFIG
from tests.poses.test_training import trained
from tests.scenes.line_factory import make_line_scene
from unmix_plugin.datamanager_settings import HyperspectralDataManagerConfig
from unmix_plugin.engine.configs import PipelineConfig, TrainerConfig
from unmix_plugin.engine.runs.load_run import load_config
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.method_config import unmix_nerf
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.poses.settings import PoseConfig
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


@dataclass
class Watched:
    """A training that registers its line cameras, and what it was when the scene began anew."""

    trainer: Trainer
    begun: list[int] = field(default_factory=list)
    """Steps."""
    carved: list[int] = field(default_factory=list)
    """Steps before which space was carved."""
    before: dict[str, Tensor] = field(default_factory=dict)
    after: dict[str, Tensor] = field(default_factory=dict)

    @property
    def model(self) -> Any:
        return self.trainer.pipeline.model

    def train(self) -> None:
        begin, take_in = self.model.begin_anew, self.model.take_in

        def begin_anew(*given: Any) -> None:
            self.begun.append(self.trainer.step)
            self.before = copies(self.model)
            begin(*given)
            self.after = copies(self.model)

        def watched_take_in(data: Any) -> None:
            self.carved.append(self.trainer.step)
            take_in(data)

        self.model.begin_anew, self.model.take_in = begin_anew, watched_take_in
        self.trainer.train()
        del self.model.begin_anew, self.model.take_in


def copies(model: Any) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in model.state_dict().items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("registered")
    make_line_scene(place / "scene")
    return place


@pytest.fixture(scope="module")
def watched(folder: Path) -> Watched:
    """Ten steps; the scene is learnt anew in step 6."""
    config = replace(refining(folder, 10), steps_per_log=1)
    found = Watched(Trainer(config, console=Console(file=io.StringIO())))
    found.train()
    return found


def test_line_cameras_are_registered_while_poses_are_refined(watched):
    poses = watched.model.poses
    assert isinstance(poses, PoseRefinement)
    assert bool(poses.is_found.any())
    assert bool(poses.corrections.isfinite().all())
    given = watched.trainer.pipeline.datamanager.train_cameras
    assert not torch.equal(poses.refined(given).image_rays(0).directions, given.image_rays(0).directions)


def test_the_scene_is_learnt_anew_once_by_the_poses_that_were_found(watched):
    assert watched.begun == [6]
    assert "step 6: the scene is learnt anew" in watched.trainer.run.log_path.read_text()
    before, after = watched.before, watched.after
    assert bool(before["poses.is_found"].any())
    for name in ("steps", "found", "is_found", "gauge"):
        assert torch.equal(before[f"poses.{name}"], after[f"poses.{name}"]), name
    assert torch.equal(after["field.level_weights"], torch.ones_like(after["field.level_weights"]))
    assert float(after["field.table"].abs().max()) < 0.1 * float(before["field.table"].abs().max())


def test_optimiser_and_average_forget_all_but_poses_where_the_scene_is_learnt_anew(watched):
    optimizer = watched.trainer.optimizer
    ages = {x["name"]: float(optimizer.state[x["params"][0]]["step"]) for x in optimizer.param_groups}
    assert ages == {"grid": 4, "networks": 4, "spectra": 4, "poses": 10}
    assert watched.trainer.average is not None
    assert watched.trainer.average.updates == 2


def test_space_is_carved_again_where_the_scene_is_learnt_anew(watched):
    assert len(watched.carved) == 2
    assert watched.carved[1] == 6


def test_rates_of_learning_begin_anew_with_the_scene(watched):
    lines = [json.loads(line) for line in watched.trainer.run.metrics_path.read_text().splitlines()]
    grid, poses = ([x[f"lr/{name}"] for x in lines if x["split"] == "train"] for name in ("grid", "poses"))
    assert grid[6] == grid[0] > grid[5]
    assert grid[8] == pytest.approx(grid[5])  # half of the way
    assert poses == sorted(poses, reverse=True)


def test_a_scene_is_kept_to_the_end_where_that_is_asked(folder):
    assert "anew" not in trained(refining(folder, 5, anew_from=1.0)).run.log_path.read_text()


def test_a_scene_is_kept_to_the_end_where_no_line_camera_was_registered(folder):
    trainer = Trainer(refining(folder, 5), console=Console(file=io.StringIO()))
    poses: Any = trainer.pipeline.model.poses
    poses.take_registered = lambda *_: None
    trainer.train()
    assert "anew" not in trainer.run.log_path.read_text()


@pytest.mark.parametrize("stop", [6, 8])
def test_training_on_line_cameras_goes_on_exactly_where_it_stopped(folder, watched, stop):
    stopped = stop_at(refining(folder, 10), stop)
    resumed = trained(load_config(stopped.run)).pipeline.model
    for name, value in watched.model.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
