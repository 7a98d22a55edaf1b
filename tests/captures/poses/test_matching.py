import pytest

from tests.captures.poses.pose_factory import ring_set
from unmix_plugin.captures.poses.matching import match_poses
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.errors import CaptureError


def named(*names):
    cameras = list(ring_set(len(names)).cameras.values())
    return PoseSet(dict(zip(names, cameras, strict=True)), "poses")


def pairs(poses, matches):
    names = {id(camera): name for name, camera in poses.cameras.items()}
    return {view: names[id(camera)] for view, camera in matches.cameras.items()}


def match(poses, *views):
    return match_poses(poses, views)


def test_folders_and_suffixes_do_not_count_where_names_are_unique():
    poses = named("images/a.jpg", "C:\\pictures\\b.JPG", "c")
    matches = match(poses, ("a", []), ("view-b", ["cubes/b.hdr"]), ("c", ["cubes/c.npy"]))
    assert pairs(poses, matches) == {"a": "images/a.jpg", "view-b": "C:\\pictures\\b.JPG", "c": "c"}
    assert matches.unposed == matches.unused == ()


def test_equal_file_names_are_told_apart_by_their_folder():
    poses = named("raw/left/1.tif", "raw/right/1.tif")
    matches = match(poses, ("left_1", ["x/left/1.npy"]), ("right_1", ["x/right/1.npy"]))
    assert pairs(poses, matches) == {"left_1": "raw/left/1.tif", "right_1": "raw/right/1.tif"}


def test_a_stem_that_several_views_share_matches_none_of_them():
    poses = named("left/1.tif", "2.tif")
    matches = match(poses, ("a", ["x/1.npy"]), ("b", ["y/1.npy"]), ("2", []))
    assert pairs(poses, matches) == {"2": "2.tif"}
    assert matches.unposed == ("a", "b")
    assert matches.unused == ("left/1.tif",)
    assert any("share the name of a, b" in note for note in matches.notes)
    assert any("views without pose: a, b" in note for note in matches.notes)


def test_names_with_nothing_in_common_but_a_number_match_by_it():
    poses = named("rgb_0009.png", "rgb_0010.png", "rgb_0011.png")
    matches = match(poses, ("cube-10-refl", []), ("cube-9-refl", []))
    assert pairs(poses, matches) == {"cube-10-refl": "rgb_0010.png", "cube-9-refl": "rgb_0009.png"}
    assert matches.unused == ("rgb_0011.png",)


def test_cameras_without_names_go_by_order_and_need_as_many_views():
    poses = named("#0000", "#0001")
    assert pairs(poses, match(poses, ("b", []), ("a", []))) == {"a": "#0000", "b": "#0001"}
    with pytest.raises(CaptureError, match="2 poses without names and 3 views"):
        match(poses, ("a", []), ("b", []), ("c", []))


def test_no_match_at_all_names_both_sides():
    with pytest.raises(CaptureError, match=r"views are called p, q, the cameras of poses x\.png, y\.png"):
        match(named("x.png", "y.png"), ("p", []), ("q", []))
