import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import BOX, CAMERA, CONFIG, make_model, scene_of
from tests.factories.scenes import make_scene
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import RunError, SceneError
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import PoseConfig, SceneOptions
from unmix_plugin.trained.open_run import find_scene
from unmix_plugin.trained.run_views import views_of


def model_with(**settings):
    return replace(CONFIG, **settings).setup(scene_box=BOX, metadata=make_model().metadata).eval()


def three_cameras() -> Cameras:
    """With distortion, as a refined lens has it."""
    return replace(CAMERA, distortion=torch.tensor([[0.1, -0.02, 0.001, 0.002]]))[[0, 0, 0]]


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


def test_a_scene_says_what_training_fitted_for_each_view_and_with_which_gain_it_is_as_it_was_measured():
    assert (scene_of(model_with()).fitted, scene_of(model_with()).view_gains) == ((), None)
    assert scene_of(model_with(poses="refine"), three_cameras()).fitted == ("pose",)
    model = model_with(light="per-view")
    with torch.no_grad():
        model.view_gains.log_gains[:, 0] = torch.tensor([0.3, -0.1, -0.2])
    found = scene_of(model)
    assert found.fitted == ("gain",)
    with torch.no_grad():
        model.view_gains.log_gains.zero_()  # training that goes on
    expected = torch.tensor([0.3, -0.1, -0.2]).exp()[:, None].expand(3, len(found.bands))
    assert_close(found.view_gains, expected)


def test_pixels_have_the_rays_of_training_and_two_where_they_are_finer_than_any_measured_one():
    scene = replace(scene_of(model_with()), subpixels=2)
    own = scene.views[0].camera

    def looked(factor: float, subpixels: int | None = None):
        camera = own.resized(round(factor * own.width), round(factor * own.height))
        return scene.look(camera, subpixels).coefficients.packed

    for factor in (0.5, 1.0, 1.5):
        torch.testing.assert_close(looked(factor), looked(factor, 2), rtol=0, atol=0)
    ends = looked(2.0), looked(2.0, 2), looked(2.0, 1)
    assert all((ends[0] - other).abs().max() > 0 for other in ends[1:])
    # Two rays tell what four do better than one.
    assert (ends[0] - ends[1]).square().mean() < (ends[2] - ends[1]).square().mean()


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


def test_a_scene_is_found_where_it_was_or_is_said_to_be(copy, tmp_path):
    run = run_on(copy)
    for root in (None, "relative/place"):
        assert find({**run, "root": root}) is None
    moved = tmp_path / "moved"
    for root, data in ((copy, None), (moved, moved)):
        scene = find(run, data)
        assert scene is not None
        assert scene.root == root
        assert scene.cube(0).max() > 0
        if data is None:
            copy.rename(moved)
            assert find(run) is None


def edit(root, change):
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def halve_a_cube(root):
    path = root / "cubes" / "view_0.npy"
    np.save(path, np.load(path) * np.float16(0.5))


def round_poses(content):
    """As another machine would."""
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        frame["transform_matrix"] = np.concatenate([np.nextafter(pose[:3], 9.0), pose[3:]]).tolist()


SAME = {
    "rounded poses": lambda root: edit(root, round_poses),
    "mended labels": lambda root: shutil.copy(root / "labels" / "view_1.png", root / "labels" / "view_0.png"),
}
OTHER = {
    "another cube": (
        halve_a_cube,
        RunError,
        "not the one that /runs/this .*: files.cubes/view_0.npy differ$",
    ),
    "another lens": (lambda root: edit(root, lambda c: c.update(fl_x=30.0)), RunError, "focal_px.* differ"),
    "damage": (lambda root: (root / "transforms.json").write_text("{"), SceneError, "JSON"),
}


@pytest.mark.parametrize("change", SAME)
def test_what_a_run_does_not_depend_on_leaves_a_scene_the_same(copy, change):
    run = run_on(copy)
    SAME[change](copy)
    assert find(run, copy) is not None


@pytest.mark.parametrize("change", OTHER)
def test_a_scene_that_was_changed_is_passed_over_and_refused_where_it_was_named(copy, change):
    make, error, said = OTHER[change]
    run = run_on(copy)
    make(copy)
    assert find(run) is None
    with pytest.raises(error, match=said):
        find(run, copy)


def test_a_scene_that_is_moved_to_a_device_shows_the_same():
    scene = scene_of(model_with())
    moved = scene.to("cpu:0")
    assert moved is not scene
    assert moved.field is not scene.field
    assert_close(moved.look(CAMERA)["spectral"], scene.look(CAMERA)["spectral"])
