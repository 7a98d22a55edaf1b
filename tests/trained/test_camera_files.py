import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.factories.cameras import FRAME, around
from tests.factories.refined_cameras import line_camera
from tests.factories.scenes import look_at
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.camera_files import camera_file_bytes, read_camera_file
from unmix_plugin.trained.run_views import RunView

POSE = look_at(np.array([1.0, -3.0, 2.0]), np.zeros(3))


def nerfstudio(**changes):
    """A camera_path.json as nerfstudio's viewer saves it."""
    entry = {"camera_to_world": POSE.reshape(-1).tolist(), "fov": 50.0, "aspect": 1.6}
    path = {"camera_path": [entry, {**entry, "fov": 25.0}], "keyframes": [], "is_cycle": False, "crop": None}
    size = {"render_height": 60, "render_width": 96, "fps": 30, "seconds": 4}
    return {"camera_type": "perspective", **size, **path, **changes}


def frames(**changes):
    paths = ("images/a.png", "images/b c.png")
    entries = [{"file_path": path, "transform_matrix": POSE.tolist()} for path in paths]
    return {"w": 96, "h": 60, "fl_x": 70.0, "frames": entries, **changes}


def written(tmp_path, content):
    path = tmp_path / "path.json"
    if isinstance(content, dict):
        content = json.dumps(content)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_nerfstudios_camera_path_is_read_in_model_space(tmp_path):
    found = read_camera_file(written(tmp_path, nerfstudio()), FRAME)
    assert [view.name for view in found.views] == ["frame_0000", "frame_0001"]
    assert found.frames_per_second == 30
    camera = found.views[0].camera
    assert (camera.width, camera.height) == (96, 60)
    np.testing.assert_allclose(camera.camera_to_world[0], POSE[:3], atol=1e-6)
    # The field of view is the vertical one: half a picture above the middle is seen at half its angle.
    ray = camera.image_rays(0, (0.5, 0.0)).directions[48]
    up, forward = torch.tensor(POSE[:3, 1]).float(), -torch.tensor(POSE[:3, 2]).float()
    assert math.degrees(math.atan2(float(ray @ up), float(ray @ forward))) == pytest.approx(25.0, abs=1e-2)
    assert found.views[1].camera.focal_px[0, 0] > 2 * camera.focal_px[0, 0]


def test_frames_are_read_in_the_scenes_own_world(tmp_path):
    found = read_camera_file(written(tmp_path, frames()), FRAME)
    assert [view.name for view in found.views] == ["a", "b_c"]
    assert found.frames_per_second is None
    camera = found.views[0].camera
    np.testing.assert_allclose(camera.camera_to_world[0, :, 3], FRAME.to_model(POSE[:3, 3]), atol=1e-6)
    np.testing.assert_allclose(camera.camera_to_world[0, :, :3], FRAME.rotation @ POSE[:3, :3], atol=1e-6)
    torch.testing.assert_close(camera.center_px, torch.tensor([[48.0, 30.0]]))


@pytest.mark.parametrize(
    ("common", "own", "name", "expected"),
    [
        ({}, {"camera_angle_x": 1.2}, "focal_px", [48 / math.tan(0.6)] * 2),
        ({"distortion_params": [0.3, 0.1, 0, 0, 0, 0]}, {"k1": -0.1}, "distortion", [-0.1, 0.1, 0, 0]),
        ({"k1": 0.2}, {"k1": None}, "distortion", [0.2, 0, 0, 0]),
    ],
)
def test_the_lens_of_a_frame_goes_before_that_of_the_file(tmp_path, common, own, name, expected):
    content = frames(**common)
    content["frames"][1] |= own
    camera = read_camera_file(written(tmp_path, content), FRAME).views[1].camera
    torch.testing.assert_close(getattr(camera, name), torch.tensor([expected]))


def written_again(tmp_path, views, frames_per_second=None):
    path = tmp_path / "cameras.json"
    path.write_bytes(camera_file_bytes(views, frames_per_second, FRAME))
    return read_camera_file(path, FRAME)


@pytest.mark.parametrize("size", [(9, 30), (24, 80)])
def test_a_line_camera_of_any_size_keeps_the_poses_of_all_rows_and_its_lens(tmp_path, size):
    lines = line_camera().resized(*size)
    again = written_again(tmp_path, [RunView("sweep", lines)]).views[0].camera
    rays, expected = (camera.image_rays(0) for camera in (again, lines))
    torch.testing.assert_close(again.distortion, lines.distortion)
    torch.testing.assert_close(rays.origins, expected.origins, atol=1e-5, rtol=0)
    torch.testing.assert_close(rays.directions, expected.directions, atol=1e-5, rtol=0)
    assert (rays.origins - rays.origins[0]).norm(dim=1).max() > 0.5


def test_the_one_pose_of_a_line_camera_is_halfway_through_its_image(tmp_path):
    """Key poses may begin before the image."""
    keys = []
    for row in (-200, 59):
        matrix = np.eye(4)
        matrix[1, 3] = row
        keys.append({"row": row, "transform_matrix": matrix.tolist()})
    content = frames(space="model", frames=[{"key_poses": keys}])
    [view] = read_camera_file(written(tmp_path, content), FRAME).views
    assert float(view.camera.camera_to_world[0, 1, 3]) == pytest.approx(29.5, abs=1e-4)


def test_names_that_would_give_one_file_are_numbered_and_frames_with_a_speed_are_a_path(tmp_path):
    entries = [{"name": name, "transform_matrix": POSE.tolist()} for name in ("leaf a", "leaf  a", "stem")]
    found = read_camera_file(written(tmp_path, frames(frames=entries, space="model", fps=12.5)), FRAME)
    assert [view.name for view in found.views] == ["0_leaf_a", "1_leaf_a", "2_stem"]
    np.testing.assert_allclose(found.views[0].camera.camera_to_world[0], POSE[:3], atol=1e-6)
    assert found.frames_per_second == 12.5


@pytest.mark.parametrize("frames_per_second", [None, 24.0])
def test_what_is_written_is_read_back_as_the_same_cameras(tmp_path, frames_per_second):
    odd = replace(
        around(3),
        focal_px=torch.tensor([[50.0, 51.5]] * 3),
        center_px=torch.tensor([[19.0, 15.25]] * 3),
        distortion=torch.tensor([[0.1, -0.02, 0.003, -0.004]] * 3),
    )
    views = [RunView(f"v.{index}", odd[index]) for index in range(3)]
    found = written_again(tmp_path, views, frames_per_second)
    assert found.frames_per_second == frames_per_second
    assert [view.name for view in found.views] == [view.name for view in views]
    for view, again in zip(views, found.views, strict=True):
        for part in ("camera_to_world", "focal_px", "center_px", "distortion"):
            own, other = (getattr(one.camera, part) for one in (view, again))
            torch.testing.assert_close(other, own, atol=1e-6, rtol=0)


def path_of(camera_to_world, fov=50):
    return nerfstudio(camera_path=[{"camera_to_world": camera_to_world, "fov": fov}])


FLAT = POSE.reshape(-1).tolist()
SIZES = [{"transform_matrix": POSE.tolist()}, {"transform_matrix": POSE.tolist(), "w": 50}]
TWINS = [{"name": "a", "transform_matrix": POSE.tolist()}] * 2
BAD = {
    "missing": (None, "can't read the camera file .*: No such file"),
    "blank": (" \n", "is empty"),
    "no object": ("[1, 2]", "holds a list of 2; expected an object with cameras"),
    "something else": ({"wavelengths": [1]}, "is not a camera file: .* found the keys wavelengths"),
    "newer": (frames(format_version=2), "has format_version 2; this version reads 1"),
    "no cameras": (nerfstudio(camera_path=[]), "'camera_path' is empty; expected at least one camera"),
    "cameras no list": (nerfstudio(camera_path=3), "'camera_path' is 3; expected a list"),
    "camera no object": (nerfstudio(camera_path=[3]), r"camera_path\[0\]: is 3; expected an object"),
    "fisheye": (nerfstudio(camera_type="fisheye"), "'camera_type' is \"fisheye\"; expected perspective"),
    "crop": (nerfstudio(crop={"crop_scale": [1, 1, 1]}), "'crop' is not supported; take it out"),
    "no size": (nerfstudio(render_width=None), "'render_width' is absent; expected a number"),
    "size 0": (nerfstudio(render_width=0), "0 x 60 pixels; expected whole numbers from 1 to 16384"),
    "absurd size of a frame": (frames(w=1e9), r"frames\[0\]: 1e[+]09 x 60 pixels"),
    "sizes that differ": (frames(frames=SIZES), r"sizes \[\(50, 60\), \(96, 60\)\]; expected one size"),
    "no size of frames": (frames(w=None), r"frames\[0\]: 'w' and 'h' are absent"),
    "no lens": (frames(fl_x=None), "'fl_x' is absent"),
    "lens of the file": (frames(fl_x=-1), r"path\.json: 'fl_x' is -1; expected a focal length above 0"),
    "fov": (path_of(FLAT, 180), r"camera_path\[0\]: 'fov' is 180; expected degrees between 0 and 180"),
    "speed": (nerfstudio(fps=0), "'fps': 0.0 frames a second; expected a number above 0"),
    "speed of no kind": (frames(fps="fast"), "'fps': None frames a second"),
    "space": (frames(space="outer"), "'space' is \"outer\"; expected world or model"),
    "names": (frames(frames=TWINS), "two frames have one name"),
    "15 numbers": (path_of([1.0] * 15), "'camera_to_world' is a list of 15 with 1.0 in row 0; expected 4"),
    "key poses that end early": (
        frames(frames=[{"key_poses": [{"row": row, "transform_matrix": POSE.tolist()} for row in (0, 50)]}]),
        r"'key_poses' reach from row 0 to row 50, but the image has rows 0 to 59",
    ),
    "no pose": (frames(frames=[{}]), "'transform_matrix' is absent"),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_file_that_cannot_be_used_is_refused_in_one_sentence_that_names_it(tmp_path, fault):
    content, said = BAD[fault]
    path = tmp_path / "path.json" if content is None else written(tmp_path, content)
    with pytest.raises(ConfigError, match=said) as caught:
        read_camera_file(path, FRAME)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
