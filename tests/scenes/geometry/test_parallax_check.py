"""Cameras at one place are told before a training."""

import numpy as np
import torch

from tests.scenes.scene_factory import look_at, make_scene
from unmix_plugin.datamanager_settings import HyperspectralDataManagerConfig
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.scenes.geometry.view_agreement import parallax_warning

BOX = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))


def test_cameras_at_one_place_are_told_from_those_that_are_apart():
    for base, is_said in ((0.0, True), (0.005, True), (0.05, False)):
        positions = np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 4.0], [base, 0.0, 4.0]])
        assert (parallax_warning(positions, BOX) is not None) == is_said, base


def test_a_camera_that_only_turns_is_said_before_a_training(tmp_path):
    turned = [look_at(np.array([0.0, 3.0, 0.5]), np.array([x, 0.0, 0.0])) for x in np.linspace(-0.4, 0.4, 6)]
    for name, poses, is_said in (("turned", turned, True), ("moved", None, False)):
        folder = make_scene(tmp_path / name, alpha=False, poses=poses)
        config = HyperspectralDataManagerConfig(grid_resolution=8)
        warnings = config.setup(data=folder.root, device=torch.device("cpu"), seed=0).warnings()
        assert any("all training cameras stand at one place" in warning for warning in warnings) == is_said
