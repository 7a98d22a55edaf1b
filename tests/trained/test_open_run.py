"""From a model to its scene, which says what training corrected; and whether the measured scene is found again."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.method_factory import BOX, CAMERA, CONFIG, make_model, scene_of
from tests.scenes.scene_factory import make_scene
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import RunError, SceneError
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import PoseConfig, SceneOptions
from unmix_plugin.trained.open_run import find_scene
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


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene") / "ball").root


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def run_on(root):
    """What a run records of a scene."""
    return json.loads(json.dumps(load_scene(root, SceneOptions()).summary()))


def find(summary, data=None):
    return find_scene(summary, Path("/runs/this"), data)


def test_a_scene_that_is_where_it_was_is_found(folder):
    scene = find(run_on(folder))
    assert scene is not None
    assert scene.root == folder
    assert scene.cube(0).max() > 0


def test_a_scene_that_is_gone_is_not_at_hand(copy):
    run = run_on(copy)
    shutil.rmtree(copy)
    assert find(run) is None


def test_a_scene_that_has_moved_is_found_where_it_is_said_to_be(copy, tmp_path):
    run = run_on(copy)
    moved = copy.rename(tmp_path / "moved")
    scene = find(run, moved)
    assert scene is not None
    assert scene.root == moved
    assert find(run) is None


def changed(root):
    path = root / "cubes" / "view_0.npy"
    np.save(path, np.load(path) * np.float16(0.5))


def test_a_scene_that_was_changed_is_not_the_runs(copy):
    run = run_on(copy)
    changed(copy)
    assert find(run) is None
    with pytest.raises(
        RunError, match=r"is not the one that /runs/this was trained on: files.cubes/view_0.npy differ$"
    ):
        find(run, copy)


def test_a_scene_that_is_damaged_is_passed_over_unless_it_was_named(copy):
    run = run_on(copy)
    (copy / "transforms.json").write_text("{")
    assert find(run) is None
    with pytest.raises(SceneError):
        find(run, copy)


def test_a_run_that_kept_no_root_has_no_find_scene(folder):
    for root in (None, "relative/place"):
        assert find({**run_on(folder), "root": root}) is None


def edit_poses(root, change):
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    path.write_text(json.dumps(content))


def test_poses_that_another_machine_rounded_are_the_same_scene(copy):
    run = run_on(copy)
    edit_poses(copy, lambda pose: np.concatenate([np.nextafter(pose[:3], 9.0), pose[3:]]))
    assert find(run, copy) is not None


def test_another_camera_is_another_scene(copy):
    run = run_on(copy)
    path = copy / "transforms.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "fl_x": 30.0}))
    with pytest.raises(RunError, match=r"cameras\.focal_px.* differ"):
        find(run, copy)


def test_labels_that_were_mended_leave_a_scene_the_same(copy):
    run = run_on(copy)
    (copy / "labels" / "view_0.png").write_bytes((copy / "labels" / "view_1.png").read_bytes())
    assert find(run, copy) is not None
