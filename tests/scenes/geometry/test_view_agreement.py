import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.factories.models import CAMERA
from tests.factories.scenes import look_at, make_scene
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.scenes.doctor import check_lenses, check_parallax, check_poses
from unmix_plugin.scenes.geometry.view_agreement import (
    GIVEN,
    compare_conventions,
    compare_scene_conventions,
    convention_decision,
)
from unmix_plugin.scenes.geometry.views import Views
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import HyperspectralDataManagerConfig

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
WRONG = {
    "camera to world, OpenCV axes": lambda pose: pose @ FLIP,
    "world to camera, OpenGL axes": np.linalg.inv,
    "world to camera, OpenCV axes": lambda pose: np.linalg.inv(pose @ FLIP),
}


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "scene"
    make_demo_scene(folder, size=64, bands=8, views=16)
    return folder


def rewritten(demo, folder, change=lambda pose: pose, with_alpha=True, shift=0.0):
    """The demo scene with other poses; without alpha its pictures are left out and its background is black."""
    shutil.copytree(demo, folder)
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += shift
        frame["transform_matrix"] = change(pose).tolist()
        if not with_alpha:
            frame["file_path"] = None
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        cubes = [f"cubes/{Path(name).stem}.npy" for name in content[key]]
        content[key] = content[key] if with_alpha else cubes
    path.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("with_alpha", [True, False])
def test_right_poses_raise_no_alarm_far_from_the_origin(demo, tmp_path, with_alpha):
    scene = load_scene(rewritten(demo, tmp_path / "scene", with_alpha=with_alpha, shift=1000.0))
    assert check_poses(compare_scene_conventions(scene)) is None


TURN = [[0, 0, 1, 0.5], [1, 0, 0, -2], [0, 1, 0, 0.25]]
APPLIED = {"applied_transform": TURN, "applied_scale": 0.5, "offset": [-2.5e6, -4.2e6, 4e6]}


@pytest.mark.parametrize(
    ("wrong", "with_alpha"),
    [*((wrong, False) for wrong in (None, *WRONG)), ("world to camera, OpenCV axes", True)],
)
def test_conventions_are_told_in_scenes_turned_and_geo_referenced(demo, tmp_path, wrong, with_alpha):
    folder = rewritten(demo, tmp_path / "scene", WRONG.get(wrong, lambda pose: pose), with_alpha)
    path = folder / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | ({} if with_alpha else APPLIED)))
    try:
        found = check_poses(compare_scene_conventions(load_scene(folder)))
        said = None if found is None else found.sentence()
    except SceneError as error:
        said = str(error)
    assert said is None if wrong is None else f"the poses look like {wrong}" in str(said)


def warnings_of(folder):
    config = HyperspectralDataManagerConfig(grid_resolution=8)
    return config.setup(data=folder, device=torch.device("cpu"), seed=0).warnings()


def test_the_remedy_of_the_warning_mends_the_poses(demo, tmp_path):
    as_colmap = rewritten(demo, tmp_path / "wrong", WRONG["world to camera, OpenCV axes"], with_alpha=False)
    (warning,) = [said for said in warnings_of(as_colmap) if "the poses look like" in said]
    assert "invert each, then multiply it from the right by diag(1, -1, -1, 1)" in warning
    mended = rewritten(as_colmap, tmp_path / "mended", lambda pose: np.linalg.inv(pose) @ FLIP)
    assert check_poses(compare_scene_conventions(load_scene(mended))) is None


def test_views_that_show_nothing_give_no_verdict(demo):
    scene = load_scene(demo)
    poses = scene.cameras.camera_to_world.double().numpy()
    grey = np.full((64, 64, 8), 0.5, np.float32)
    assert compare_conventions(poses, Views(scene.cameras, lambda _, part: grey[part])) == {}
    assert compare_conventions(poses[:3], Views(scene.cameras[[0, 1, 2]], scene.cube)) == {}


def test_what_pixels_show_that_do_not_count_changes_no_verdict(demo):
    scene = load_scene(demo)
    poses = scene.cameras.camera_to_world.double().numpy()
    valid = np.ones((64, 64), bool)
    valid[20:44, 30:] = False

    def verdict(fill):
        def read(view, part):
            return np.where(valid[..., None], scene.cube(view), np.float32(fill))[part]

        return compare_conventions(poses, Views(scene.cameras, read, lambda _: valid))

    found = [verdict(fill) for fill in (0.0, np.random.default_rng(0).random((64, 64, 8)), np.nan)]
    assert found[0] == found[1] == found[2]
    assert min(found[0], key=found[0].__getitem__) == "camera to world, OpenGL axes"
    nothing = Views(scene.cameras, scene.cube, lambda _: np.zeros((64, 64), bool))
    assert compare_conventions(poses, nothing) == {}


BOX = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))


def test_cameras_at_one_place_are_told_from_those_that_are_apart():
    for base, is_said in ((0.0, True), (0.005, True), (0.05, False)):
        positions = np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 4.0], [base, 0.0, 4.0]])
        assert (check_parallax(positions, BOX) is not None) == is_said, base


def test_a_camera_that_only_turns_is_said_before_a_training(tmp_path):
    turned = [look_at(np.array([0.0, 3.0, 0.5]), np.array([x, 0.0, 0.0])) for x in np.linspace(-0.4, 0.4, 6)]
    folder = make_scene(tmp_path / "scene", alpha=False, poses=turned)
    assert any("all training cameras stand at one place" in said for said in warnings_of(folder.root))


@pytest.mark.parametrize(("k1", "said"), [(0.0, None), (-0.5, None), (0.5, None), (-4.0, "1 view folds")])
def test_pixels_to_which_no_direction_leads_are_said(k1: float, said: str | None):
    bent = replace(CAMERA, distortion=torch.tensor([[k1, 0.0, 0.0, 0.0]]))
    found = check_lenses(bent)
    assert (found is not None) == (said is not None)
    assert (said or "") in ("" if found is None else found.sentence())


def test_conventions_under_which_views_share_nothing_decide_nothing_and_are_no_evidence():
    apart = convention_decision({GIVEN: float("inf")})
    assert apart.is_undecided
    assert apart.evidence == {}
    other = "world to camera, OpenGL axes"
    assert convention_decision({GIVEN: float("inf"), other: 0.1}).evidence == {
        f"views differ as {other}": 0.1
    }
