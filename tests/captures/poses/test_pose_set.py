"""Cameras and views that belong together are found by their names."""

import pytest

from tests.factories.poses import ring_set
from unmix_plugin.captures.names import match_poses
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.report import Code, Kind, sentences
from unmix_plugin.errors import CaptureError


def named(*names):
    cameras = list(ring_set(len(names)).cameras.values())
    return PoseSet(dict(zip(names, cameras, strict=True)), "poses")


@pytest.mark.parametrize(
    ("cameras", "views", "expected", "said"),
    [
        (  # folders and suffixes do not count where names are unique
            ["images/a.jpg", "C:\\pictures\\b.JPG", "c"],
            {"a": [], "view-b": ["cubes/b.hdr"], "c": ["cubes/c.npy"]},
            {"a": "images/a.jpg", "view-b": "C:\\pictures\\b.JPG", "c": "c"},
            ["3 of 3 views were matched by name"],
        ),
        (
            ["raw/left/1.tif", "raw/right/1.tif"],
            {"left_1": ["x/left/1.npy"], "right_1": ["x/right/1.npy"]},
            {"left_1": "raw/left/1.tif", "right_1": "raw/right/1.tif"},
            ["2 of 2"],
        ),
        (  # a stem that several views share matches none of them
            ["left/1.tif", "2.tif"],
            {"a": ["x/1.npy"], "b": ["y/1.npy"], "2": []},
            {"2": "2.tif"},
            ["1 of 3", "views without pose: a, b", "1 camera without view: left/1", "share the name of a, b"],
        ),
        (  # nothing in common but a number
            ["rgb_0009.png", "rgb_0010.png", "rgb_0011.png"],
            {"cube-10-refl": [], "cube-9-refl": []},
            {"cube-10-refl": "rgb_0010.png", "cube-9-refl": "rgb_0009.png"},
            ["2 of 2", "1 camera without view: rgb_0011.png"],
        ),
        (["#0000", "#0001"], {"b": [], "a": []}, {"a": "#0000", "b": "#0001"}, ["by their order"]),
        (["#9999", "#10000"], {"b": [], "a": []}, {"a": "#9999", "b": "#10000"}, ["by their order"]),
        (  # by names as texts, which is said where numbers go otherwise
            ["#0000", "#0001", "#0002"],
            {"v1": [], "v2": [], "v10": []},
            {"v1": "#0000", "v10": "#0001", "v2": "#0002"},
            ["by their order", "names were sorted as texts: v1, v10, v2"],
        ),
    ],
)
def test_views_get_the_cameras_of_their_names_and_what_is_odd_is_said(cameras, views, expected, said):
    poses = named(*cameras)
    found, remarks = match_poses(poses, list(views.items()))
    notes = sentences(remarks, Kind.DONE)
    assert set(found) == set(expected)
    assert all(found[view] is poses.cameras[name] for view, name in expected.items())
    assert [text in note for text, note in zip(said, notes, strict=True)] == [True] * len(said)


def test_names_that_do_not_fit_at_all_are_refused():
    with pytest.raises(CaptureError, match="2 poses without names and 3 views"):
        match_poses(named("#0000", "#0001"), [("a", []), ("b", []), ("c", [])])
    with pytest.raises(CaptureError, match=r"views are called p, q, the cameras of poses x\.png, y\.png"):
        match_poses(named("x.png", "y.png"), [("p", []), ("q", [])])


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
    """Those of names, which cameras without any have not."""
    poses = named(*(name.format(number) for number in cameras))
    found, remarks = match_poses(poses, [(f"cube_{number}", []) for number in views])
    assert found
    assert (Code.NUMBERS_SHIFTED in {remark.code for remark in remarks}) == is_doubtful
    _, remarks = match_poses(named("#0000", "#0001"), [("v1", []), ("v2", [])])
    assert Code.NUMBERS_SHIFTED not in {remark.code for remark in remarks}
