"""Training on line cameras: rays by row, a whole view rendered in all bands, and the run folder that gives it back."""

from pathlib import Path

import pytest
import torch

from tests.engine.stopped_runs import stop_at
from tests.poses.test_training import config_for, trained
from tests.scenes.line_factory import make_line_scene
from unmix_plugin.engine.runs.load_run import load_config
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.trained.open_run import open_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("lines")
    make_line_scene(place / "scene")
    return place


@pytest.fixture(scope="module")
def trainer(folder) -> Trainer:
    return trained(config_for(folder, "fixed"))


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


def test_refined_training_on_line_cameras_goes_on_exactly_where_it_stopped(folder):
    config = config_for(folder, steps=8, coarse_steps=2)
    straight = trained(config).pipeline
    poses, given = straight.model.poses, straight.datamanager.train_cameras
    assert isinstance(poses, PoseRefinement)
    assert not torch.equal(poses.refined(given).image_rays(0).directions, given.image_rays(0).directions)
    resumed = trained(load_config(stop_at(config, 6).run)).pipeline.model.state_dict()
    for name, value in straight.model.state_dict().items():
        assert torch.equal(value, resumed[name]), name
