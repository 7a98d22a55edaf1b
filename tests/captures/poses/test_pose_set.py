"""Cameras and views that belong together are found by their names."""

import pytest

from tests.captures.poses.pose_factory import ring_set
from unmix_plugin.captures.names import match_poses
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.errors import CaptureError


def named(*names):
    cameras = list(ring_set(len(names)).cameras.values())
    return PoseSet(dict(zip(names, cameras, strict=True)), "poses")


def match(poses, *views):
    """The name of the camera that each view gets, and the notes."""
    names = {id(camera): name for name, camera in poses.cameras.items()}
    cameras, notes, _ = match_poses(poses, views)
    return {view: names[id(camera)] for view, camera in cameras.items()}, notes


def test_folders_and_suffixes_do_not_count_where_names_are_unique():
    poses = named("images/a.jpg", "C:\\pictures\\b.JPG", "c")
    found, notes = match(poses, ("a", []), ("view-b", ["cubes/b.hdr"]), ("c", ["cubes/c.npy"]))
    assert found == {"a": "images/a.jpg", "view-b": "C:\\pictures\\b.JPG", "c": "c"}
    assert notes == ["3 of 3 views were matched by name"]


def test_equal_file_names_are_told_apart_by_their_folder():
    poses = named("raw/left/1.tif", "raw/right/1.tif")
    found, _ = match(poses, ("left_1", ["x/left/1.npy"]), ("right_1", ["x/right/1.npy"]))
    assert found == {"left_1": "raw/left/1.tif", "right_1": "raw/right/1.tif"}


def test_a_stem_that_several_views_share_matches_none_of_them():
    poses = named("left/1.tif", "2.tif")
    found, notes = match(poses, ("a", ["x/1.npy"]), ("b", ["y/1.npy"]), ("2", []))
    assert found == {"2": "2.tif"}
    assert notes[1:3] == ["views without pose: a, b", "1 camera without view: left/1.tif"]
    assert "share the name of a, b" in notes[3]


def test_names_with_nothing_in_common_but_a_number_match_by_it():
    poses = named("rgb_0009.png", "rgb_0010.png", "rgb_0011.png")
    found, notes = match(poses, ("cube-10-refl", []), ("cube-9-refl", []))
    assert found == {"cube-10-refl": "rgb_0010.png", "cube-9-refl": "rgb_0009.png"}
    assert notes[-1] == "1 camera without view: rgb_0011.png"


def test_cameras_without_names_go_by_order_and_need_as_many_views():
    poses = named("#0000", "#0001")
    assert match(poses, ("b", []), ("a", []))[0] == {"a": "#0000", "b": "#0001"}
    with pytest.raises(CaptureError, match="2 poses without names and 3 views"):
        match(poses, ("a", []), ("b", []), ("c", []))


def test_no_match_at_all_names_both_sides():
    with pytest.raises(CaptureError, match=r"views are called p, q, the cameras of poses x\.png, y\.png"):
        match(named("x.png", "y.png"), ("p", []), ("q", []))


def test_poses_without_names_go_by_names_as_texts_which_is_said_where_numbers_go_otherwise():
    poses = named("#0000", "#0001", "#0002")
    found, notes = match(poses, ("v1", []), ("v2", []), ("v10", []))
    assert found == {"v1": "#0000", "v10": "#0001", "v2": "#0002"}
    assert "names were sorted as texts: v1, v10, v2" in notes[1]
    assert len(match(poses, ("v1", []), ("v2", []), ("v3", []))[1]) == 1


@pytest.mark.parametrize(
    ("cameras", "views", "is_doubtful"),
    [
        ([1, 2, 3], [0, 1, 2], True),
        ([0, 1, 2], [1, 2, 3], True),
        ([1, 2, 4, 5], [0, 1, 3, 4], True),
        ([1, 2, 3], [1, 2, 3], False),
        ([1, 2, 3], [0, 1, 2, 3], False),
        ([2, 3, 4], [0, 1, 2], False),
    ],
)
@pytest.mark.parametrize("name", ["frame_{:05d}.png", "cube_{}.png"])
def test_numbers_counted_from_0_and_from_1_are_told(cameras, views, is_doubtful, name):
    poses = named(*(name.format(number) for number in cameras))
    found, _, warnings = match_poses(poses, [(f"cube_{number}", []) for number in views])
    assert found
    assert ["those of the views" in text for text in warnings] == [True] * is_doubtful


def test_cameras_without_names_have_no_numbers_to_doubt():
    assert match_poses(named("#0000", "#0001"), [("v1", []), ("v2", [])])[2] == []
