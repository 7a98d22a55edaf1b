"""Poses of transforms.json and of LLFF."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from tests.factories.files import present
from tests.factories.poses import (
    FLIP,
    IDEAL,
    LENS,
    assert_same_poses,
    by_hand,
    lens_of,
    llff_table,
    metashape_document,
    pixels_in_file,
    ring,
    transforms,
    write_json,
)
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import CaptureError
from unmix_plugin.formats.meshes import write_ply
from unmix_plugin.scenes.placement import Placement


def read(tmp_path, content, **options):
    return read_poses(write_json(tmp_path / "transforms.json", content), **options)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_poses_and_lens_are_those_of_the_file(tmp_path, encoding):
    content = transforms(ring(), k3=0.02, k4=-0.01)
    (tmp_path / "transforms.json").write_bytes(json.dumps(content).encode(encoding))
    found = read_poses(tmp_path / "transforms.json")
    assert_same_poses(found, ring())
    assert {camera.lens for camera in found.cameras.values()} == {replace(LENS, higher_radial=(0.02, -0.01))}
    assert any("6 of 6 frames name files that are not there" in note for note in found.notes)
    np.testing.assert_array_equal(found.up, [0, 0, 1])
    bare = read(tmp_path, transforms(ring())["frames"])
    assert_same_poses(bare, ring())
    assert all(camera.lens is None for camera in bare.cameras.values())


def test_blenders_split_files_are_read_together_with_an_angle_and_the_size_of_the_pictures(tmp_path):
    poses = {f"./{('train', 'val')[i % 2]}/r_{i}": pose for i, pose in enumerate(ring().values())}
    for split in ("train", "val"):
        own = {name: pose for name, pose in poses.items() if split in name}
        content = {"camera_angle_x": math.pi / 2, "frames": transforms(own)["frames"]}
        write_json(tmp_path / f"transforms_{split}.json", content)
    found = read_poses(tmp_path, {"r_0": (512, 400)})
    assert sorted(found.cameras) == sorted(name.removeprefix("./") for name in poses)
    lens = lens_of(found)
    assert (lens.width, lens.height, lens.center_px) == (512, 400, (256.0, 200.0))
    assert lens.focal_px == pytest.approx((256.0, 256.0))


def test_the_size_is_that_of_the_picture_that_a_frame_names_and_not_of_the_view(tmp_path):
    poses = {"view.png": next(iter(ring().values()))}
    Image.new("RGB", (30, 20)).save(tmp_path / "view.png")
    for sizes in ({}, {"view": (15, 10)}, {"other": (15, 10)}):
        found = read(tmp_path, {"fl_x": 40.0, "frames": transforms(poses)["frames"]}, picture_sizes=sizes)
        assert lens_of(found) == Lens(30, 20, (40.0, 40.0), (15.0, 10.0))
        assert found.warnings == ()


def test_a_lens_of_pictures_that_are_gone_is_taken_as_that_of_the_views_or_refused(tmp_path):
    content = {"fl_x": 40.0, "frames": transforms(ring())["frames"]}
    sizes = {f"view_{index}": (15, 10) for index in range(6)}
    found = read(tmp_path, content, picture_sizes=sizes)
    assert (lens_of(found).width, lens_of(found).focal_px) == (15, (40.0, 40.0))
    assert len(found.warnings) == 1
    assert "focal lengths are taken in pixels of the views" in found.warnings[0]
    for center in ({"cx": 15.0, "cy": 5.0}, {"cy": 10.0}):
        with pytest.raises(CaptureError, match="outside the view's 15 x 10 pixels, so the lens is that of"):
            read(tmp_path, content | center, picture_sizes=sizes)


def test_what_was_applied_is_undone_for_cameras_and_points(tmp_path):
    turn = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    shift, scale = np.array([1.0, -2.0, 3.0]), 0.5
    way = Placement(turn, shift, scale)
    applied = {name: PosedCamera(pose, None).moved(way).camera_to_world for name, pose in ring().items()}
    points = np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]])
    moved = way.to_scene(points)
    red = np.array([255, 0], np.uint8)
    columns = {axis: moved[:, index] for index, axis in enumerate("xyz")}
    write_ply(tmp_path / "sparse.ply", {**columns, "red": red, "green": red, "blue": red})
    stated = {"applied_transform": np.column_stack([turn, shift]).tolist(), "applied_scale": scale}
    stated |= {"ply_file_path": "sparse.ply", "metres_per_unit": 0.001}
    found = read(tmp_path, transforms(applied, **stated))
    assert_same_poses(found, ring())
    assert found.metres_per_unit == 0.001
    np.testing.assert_allclose(present(found.points), points, atol=1e-12)
    np.testing.assert_array_equal(present(found.colours)[:, 0], red)
    np.testing.assert_allclose(present(found.up), [0, 0, -1])


def test_the_offset_of_instant_ngp_moves_no_pose_and_cameras_of_neus2_have_the_axes_of_opencv(tmp_path):
    applied = np.eye(4).tolist()
    for hints in ({}, {"scale": 0.5, "from_na": False}, {"applied_transform": applied, "scale": 1}):
        found = read(tmp_path, transforms(ring(), offset=[0.5, 0.5, 0.5], **hints))
        assert_same_poses(found, ring())
        assert not found.offset.any()
    flipped = {name: np.column_stack([pose[:, :3] @ FLIP, pose[:, 3]]) for name, pose in ring().items()}
    content = transforms(flipped, from_na=True, scale=0.5, offset=[0.5, 0.5, 0.5])
    found = read(tmp_path, content)
    assert_same_poses(found, ring())
    assert any("'from_na' is set: cameras have OpenCV's axes" in note for note in found.notes)
    assert_same_poses(read(tmp_path, content | {"from_na": False}), flipped)


def test_a_fisheye_of_instant_ngp_is_one(tmp_path):
    terms = {"k1": 0.01, "k2": -0.02, "k3": 0.001, "k4": -0.002, "p1": 0.0, "p2": 0.0}
    keys = ({"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": False})
    each = [read(tmp_path, transforms(ring(), fl_x=900, fl_y=900, **terms, **key)) for key in keys]
    lenses = [next(iter(found.cameras.values())).lens for found in each]
    assert lenses[0] == lenses[1] != lenses[2]
    with pytest.raises(CaptureError, match="'is_fisheye' is true and camera_model \"PINHOLE\""):
        read(tmp_path, transforms(ring(), **terms, is_fisheye=True, camera_model="PINHOLE"))


def test_a_fisheye_with_tangential_terms_is_the_one_that_metashape_writes(tmp_path):
    center, terms = {"cx": 323, "cy": 236}, {"k1": 0.1, "k2": 0.02, "p1": 0.02, "p2": -0.01}
    content = transforms(ring(), camera_model="OPENCV_FISHEYE", fl_x=500, fl_y=500, **center, **terms)
    written = "<k1>0.1</k1><k2>0.02</k2><p1>-0.01</p1><p2>0.02</p2>"  # Metashape's order is the other one
    (tmp_path / "cameras.xml").write_text(metashape_document(ring(), kind="fisheye", terms=written))
    expected = by_hand(IDEAL, (500, 500), (323, 236), (0.1, 0.02), (0.02, -0.01), is_fisheye=True)
    for found in (read(tmp_path, content), read_poses(tmp_path / "cameras.xml")):
        np.testing.assert_allclose(pixels_in_file(found, IDEAL), expected, atol=0.1)


REFUSED = dict.fromkeys(("latlong", "equirectangular", "orthographic", "from_mitsuba"), True)
REFUSED |= {"k6": 0.1, "skew": -0.5, "fisheye624_params": [0.0, 1.0]}


@pytest.mark.parametrize(("key", "value"), REFUSED.items())
@pytest.mark.parametrize("is_of_frame", [False, True])
def test_keys_that_change_geometry_are_refused_by_name_where_they_are_set(tmp_path, key, value, is_of_frame):
    content = transforms(ring())
    (content["frames"][2] if is_of_frame else content)[key] = value
    with pytest.raises(CaptureError, match=f"'{key}' is set, which stands for"):
        read(tmp_path, content)
    (content["frames"][2] if is_of_frame else content)[key] = [0, False, None]
    assert_same_poses(read(tmp_path, content), ring())


def test_keys_that_are_not_followed_are_said(tmp_path):
    content = transforms(ring(), rolling_shutter=[0, 0, 0.5, 0], sparkle=3)
    for number, frame in enumerate(content["frames"]):
        frame["time"] = number
    found = read(tmp_path, content)
    assert len(found.warnings) == 2
    assert "'rolling_shutter' is set and not followed" in found.warnings[0]
    assert "'time'" in found.warnings[1]
    assert any(note.endswith("not known and not used: sparkle") for note in found.notes)
    assert read(tmp_path, transforms(ring(), aabb_scale=4, rolling_shutter=[0, 0, 0, 0])).warnings == ()


def test_focal_lengths_in_degrees_and_as_a_matrix(tmp_path):
    content = transforms(ring())
    for key in ("fl_x", "fl_y", "cx", "cy"):
        content.pop(key)
    lens = lens_of(read(tmp_path, {**content, "x_fov": 60.0, "y_fov": 50.0}))
    np.testing.assert_allclose(lens.focal_px, [320 / math.tan(math.pi / 6), 240 / math.tan(math.radians(25))])
    matrix = [[500, 0, 321, 0], [0, 510, 239, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    for more in ({"intrinsic_matrix": matrix}, {"fl_x": None, "cy": None}):
        for frame in content["frames"]:
            frame |= more
        lens = lens_of(read(tmp_path, content))
        assert (lens.focal_px, lens.center_px) == ((500, 510), (321, 239))
    matrix[0][1] = 2
    with pytest.raises(CaptureError, match="skew 2; expected focal lengths above 0 and no skew"):
        read(tmp_path, content)


def test_large_coordinates_are_split_into_an_offset_and_the_rest(tmp_path):
    far = np.array([500_123.4, 5_400_321.6, 300.0])
    moved = {name: pose + np.column_stack([np.zeros((3, 3)), far]) for name, pose in ring().items()}
    found = read(tmp_path, transforms(moved))
    assert_same_poses(found, moved)
    np.testing.assert_allclose(found.offset, far, atol=3.0)
    assert max(np.abs(camera.camera_to_world).max() for camera in found.cameras.values()) < 10


@pytest.mark.parametrize(
    ("factor", "message"), [(0, "all zeros"), ([[-1, 1, 1, 1]], "mirror image"), ([[1, 2, 1, 1]], "sheared")]
)
def test_matrices_that_are_no_poses_are_refused_by_name_and_scaled_ones_made_rigid(tmp_path, factor, message):
    scaled = {name: pose * [[0.25, 0.25, 0.25, 1.0]] for name, pose in ring().items()}
    found = read(tmp_path, transforms(scaled))
    assert_same_poses(found, ring())
    assert "the rotations of 6 of 6 cameras were scaled by 0.25; made rigid, positions kept" in found.notes
    poses = ring()
    poses["images/view_3.png"] = factor * poses["images/view_3.png"]
    with pytest.raises(CaptureError, match=rf"1 of 6 .*images/view_3.png: .*{message}"):
        read(tmp_path, transforms(poses))


NO_NUMBERS = [{"file_path": f"{i}.png", "transform_matrix": [math.nan] * 12} for i in range(2)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": []}, "has no camera; expected one for each view"),
        ({"frames": [1]}, r"frames\[0\]: is 1"),
        ({"frames": [{"file_path": "a.png"}]}, "'transform_matrix' is absent"),
        ({"frames": [{"transform_matrix": [0] * 11}]}, r"frames\[0\]: .* list of 11; .*4 numbers"),
        ({"frames": NO_NUMBERS}, r"2 of 2 camera matrices .*: 0\.png, 1\.png: .* not finite"),
        ({"fl_x": "long"}, "'fl_x' is \"long\""),
        ({"fl_x": -5}, "'fl_x' is -5"),
        ({"w": 0.5}, "'w' is 0.5; expected a whole number"),
        ({"camera_model": "ORTHOPHOTO"}, "ORTHOPHOTO.*EQUIRECTANGULAR: undistort"),
        ({"ftheta_p0": 0.0, "fl_x": 300.0}, "'ftheta_p1' is 0; expected pixels per radian"),
        ({"ftheta_p0": "steep"}, "'ftheta_p0' to 'ftheta_p5' are .*expected 6 numbers"),
        (
            {"camera_model": "FISHEYE624", "distortion_params": [0] * 6},
            "are a list of 6; expected 12 numbers",
        ),
        ({"applied_transform": np.diag([2, 1, 1, 1])[:3].tolist()}, "'applied_transform'.*a rotation"),
        ({"applied_scale": 0}, "'applied_scale' is 0"),
        ({"metres_per_unit": -1}, "'metres_per_unit' is -1; expected 1e-9 to 1e9"),
        ({"applied_scale": 2, "offset": [1, 2]}, "'offset' is a list of 2; expected 3"),
    ],
)
def test_faults_are_told_with_what_was_expected(tmp_path, change, message):
    with pytest.raises(CaptureError, match=message):
        read(tmp_path, transforms(ring()) | change)


def test_one_name_for_two_poses_or_one_pose_for_all_is_refused_and_a_frame_listed_twice_mentioned(tmp_path):
    content = transforms(ring())
    content["frames"].append(content["frames"][0])
    assert any("listed twice" in note for note in read(tmp_path, content).notes)
    content["frames"][-1] = {**content["frames"][1], "file_path": content["frames"][0]["file_path"]}
    with pytest.raises(CaptureError, match=r"two cameras of the name images/view_0\.png"):
        read(tmp_path, content)
    pose = next(iter(ring().values()))
    with pytest.raises(CaptureError, match="all 6 cameras have the same pose"):
        read(tmp_path, transforms(dict.fromkeys(ring(), pose)))


def write(tmp_path, **options):
    np.save(tmp_path / "poses_bounds.npy", llff_table(ring().values(), **options))
    return tmp_path / "poses_bounds.npy"


def test_axes_are_turned_and_names_are_those_of_the_pictures_or_go_by_order(tmp_path):
    path = write(tmp_path)
    assert list(read_poses(path).cameras) == [f"#{index:04d}" for index in range(6)]
    (tmp_path / "images").mkdir()
    for index in range(6):
        (tmp_path / f"images/view_{index}.png").touch()
    for place in (path, tmp_path):
        found = read_poses(place)
        assert_same_poses(found, ring())
    assert lens_of(found) == Lens(640, 480, (500.0, 500.0), (320.0, 240.0))


def test_other_arrays_and_damaged_files_are_refused(tmp_path):
    path = write(tmp_path, hwf=(480.0, 640.0, -1.0))
    with pytest.raises(CaptureError, match="focal length 480, 640, -1"):
        read_poses(path)
    np.save(path, np.zeros((3, 4)))
    with pytest.raises(CaptureError, match=r"shape \(3, 4\)"):
        read_poses(path)
    np.save(path, np.array([{"a": 1}]), allow_pickle=True)
    with pytest.raises(CaptureError, match="never loaded"):
        read_poses(path)
    path.write_bytes(write(tmp_path).read_bytes()[:300])
    with pytest.raises(CaptureError, match="is cut short"):
        read_poses(path)


def test_sparse_points_that_are_too_far_are_left_out_and_said(tmp_path):
    points = np.array([[0.1, 0.2, 0.3], [1e300, 2.0, 3.0], [np.nan, 0, 0]])
    write_ply(tmp_path / "sparse.ply", {axis: points[:, index] for index, axis in enumerate("xyz")})
    found = read(tmp_path, transforms(ring(), ply_file_path="sparse.ply"))
    np.testing.assert_array_equal(found.points, points[:1])
    assert any("2 sparse points are not finite, or more than 1e9 units away" in note for note in found.notes)
