"""What a scene says of a training that corrected cameras or fitted gains."""

from dataclasses import replace

import torch
from torch.testing import assert_close

from tests.method_factory import BOX, CAMERA, CONFIG, make_model, scene_of
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.poses.settings import PoseConfig
from unmix_plugin.trained.run_views import views_of


def model_with(**settings):
    """A model that has not begun to train."""
    return replace(CONFIG, **settings).setup(scene_box=BOX, metadata=make_model().metadata).eval()


def three_cameras() -> Cameras:
    """With distortion, as a refined lens has it."""
    return Cameras(
        CAMERA.camera_to_world.repeat(3, 1, 1),
        CAMERA.focal_px.repeat(3, 1),
        CAMERA.center_px.repeat(3, 1),
        torch.tensor([[0.1, -0.02, 0.001, 0.002]]).repeat(3, 1),
        CAMERA.width,
        CAMERA.height,
    )


def test_a_refined_lens_is_that_of_evaluation_views_too_whose_poses_stay():
    model, given = model_with(poses="refine", pose_refinement=PoseConfig(lens="radial")), three_cameras()
    with torch.no_grad():
        model.poses.lens.steps.copy_(torch.tensor([0.05, -0.08, 0.03]))
        model.poses.steps.normal_(std=0.01)
    scene = scene_of(model, given)
    for split in ("train", "eval"):
        for view in views_of(scene.views, split):
            assert_close(view.camera.focal_px, given.focal_px[:1] * torch.tensor(0.05).exp())
            assert_close(view.camera.distortion, torch.tensor([[0.02, 0.01, 0.001, 0.002]]))
    evaluated, trained = (views_of(scene.views, split)[0].camera for split in ("eval", "train"))
    assert_close(evaluated.camera_to_world, given.camera_to_world[:1])
    assert not torch.equal(trained.camera_to_world, given.camera_to_world[:1])
    # What is evaluated in training is what is evaluated afterwards.
    seen = model.get_evaluation_outputs(given[0], {})["spectral"]
    assert_close(seen, scene.look(evaluated)["spectral"], atol=1e-5, rtol=0)


def test_a_scene_says_what_training_fitted_for_each_view():
    assert scene_of(model_with()).fitted == ()
    assert scene_of(model_with(poses="refine"), three_cameras()).fitted == ("pose",)
    assert scene_of(model_with(light="per-view")).fitted == ("gain",)
