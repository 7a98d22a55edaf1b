import copy

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.scenes import HEIGHT, fault_of, make_line_scene, ring_poses, row_poses, set_frame
from unmix_plugin.scenes.geometry.carving import carve
from unmix_plugin.scenes.reading.loader import load_scene


@pytest.fixture
def folder(tmp_path):
    return make_line_scene(tmp_path / "lines")


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    return load_scene(make_line_scene(tmp_path_factory.mktemp("lines") / "scene").root)


def test_a_pose_a_row_and_key_poses_of_the_same_path_are_one_camera(folder, lines):
    for index in range(6):
        matrices = [matrix.tolist() for matrix in row_poses(ring_poses(6)[index])]
        ends = [{"row": row, "transform_matrix": matrices[row]} for row in (0, HEIGHT - 1)]
        rows, keys = (matrices, None) if index % 2 else (None, ends)
        folder.edit(set_frame(index, row_poses=rows, key_poses=keys))
    found = load_scene(folder.root)
    for index in range(6):
        mine, theirs = lines.cameras.image_rays(index), found.cameras.image_rays(index)
        assert_close(mine.origins, theirs.origins, atol=1e-5, rtol=0)
        assert_close(mine.directions, theirs.directions, atol=1e-5, rtol=0)


def test_rays_start_where_the_row_was_taken(lines):
    poses = np.stack([matrix[:3, 3] for matrix in row_poses(ring_poses(6)[2])])
    origins = lines.cameras.image_rays(2).origins[:: lines.cameras.width].double().numpy()
    assert_close(origins, lines.normalisation.to_model(poses), atol=1e-5, rtol=0)
    middle = lines.normalisation.to_model(ring_poses(6)[2][:3, 3])
    assert_close(lines.cameras.camera_to_world[2, :, 3].double().numpy(), middle, atol=1e-5, rtol=0)


def test_the_focal_length_along_the_sweep_does_not_count(folder, lines):
    for index in range(6):
        folder.edit(set_frame(index, fl_y=(1.0, 5.0, 500.0)[index % 3]))
    found = load_scene(folder.root).cameras
    assert torch.equal(found.focal_px, lines.cameras.focal_px)


def test_the_box_and_the_hull_hold_what_the_sweeps_show(lines):
    corners = lines.normalisation.to_world(lines.scene_box.aabb.double().numpy())
    assert (corners[0] < -0.55).all()
    assert (corners[1] > 0.55).all()
    assert (np.abs(corners) < 2.0).all()
    alphas = [lines.alpha(index) for index in lines.train_indices]
    hull = carve(lines, 32, [alpha > 0 for alpha in alphas if alpha is not None])
    steps = (np.arange(32) + 0.5) / 32
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1)
    distance = np.linalg.norm(corners[0] + grid * (corners[1] - corners[0]), axis=-1)
    assert hull[distance < 0.7].all()
    assert hull[(distance > 1.0) & (distance < 1.4)].mean() < 0.5


def test_a_scene_may_mix_frame_cameras_and_line_cameras(folder):
    pose = ring_poses(6)[4]
    folder.edit(set_frame(4, row_poses=None, transform_matrix=pose.tolist()))
    scene = load_scene(folder.root)
    assert [scene.cameras.is_line_camera(index) for index in (3, 4, 5)] == [True, False, True]
    origins = scene.cameras.image_rays(4).origins.unique(dim=0)
    assert torch.equal(origins, scene.cameras.camera_to_world[[4], :, 3])


def test_the_one_pose_of_a_view_does_not_change_with_key_poses_beyond_the_image(folder):
    before = load_scene(folder.root).cameras.camera_to_world

    def begin_earlier(content):
        keys = content["frames"][1]["key_poses"]
        first, last = (np.array(key["transform_matrix"]) for key in keys)
        keys[0] = {"row": 1 - HEIGHT, "transform_matrix": (2 * first - last).tolist()}  # it moves evenly

    after = load_scene(folder.edit(begin_earlier).root).cameras.camera_to_world
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)


def turned(entries, row):
    changed = copy.deepcopy(entries)
    matrix = np.array(changed[row]["transform_matrix"])
    matrix[:3, :3] = matrix[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    changed[row]["transform_matrix"] = matrix.tolist()
    return changed


def test_poses_that_do_not_fit_the_rows_are_one_error(folder):
    content = folder.content
    few = content["frames"][2]["row_poses"][:-3]
    keys = content["frames"][3]["key_poses"]
    early = [keys[0], {**keys[1], "row": HEIGHT - 5}]
    folder.edit(set_frame(2, row_poses=few)).edit(set_frame(3, key_poses=early))
    message = fault_of(folder)
    assert f"frames[2]: 'row_poses' has {HEIGHT - 3} poses, but the image has {HEIGHT} rows" in message
    assert f"frames[3]: 'key_poses' reach from row 0 to row {HEIGHT - 5}" in message


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda keys: {"key_poses": keys[::-1]}, "must increase; got 15 then 0"),
        (lambda keys: {"key_poses": keys[:1]}, "at least two poses"),
        (lambda _: {"key_poses": "a"}, "at least two poses"),
        (lambda keys: {"key_poses": [keys[0], 7]}, "expected an object with 'row'"),
        (lambda keys: {"key_poses": [keys[0], {**keys[1], "row": "x"}]}, 'has the row "x"; expected an'),
        (lambda keys: {"key_poses": [keys[0], {"row": 15}]}, "'transform_matrix' is absent"),
        (lambda keys: {"key_poses": turned(keys, 1)}, "turns by 180 degrees from row 0 to row 15"),
        (lambda keys: {"row_poses": [k["transform_matrix"] for k in keys]}, "'row_poses' and 'key_poses'"),
        (lambda keys: {"transform_matrix": keys[0]["transform_matrix"]}, "'key_poses' and 'transform_matri"),
        (lambda _: {"key_poses": None, "row_poses": [1, 2]}, "the pose is"),
    ],
)
def test_poses_that_mean_nothing_are_refused(folder, change, expected):
    folder.edit(set_frame(3, **change(folder.content["frames"][3]["key_poses"])))
    message = fault_of(folder)
    assert expected in message
    assert "frames[3]" in message
