"""Views of a floor from around, with poses of their own and of each other."""

from pathlib import Path

import numpy as np
import pytest

from tests.factories.captures import record_of
from tests.factories.floor_views import bumps, make_views
from unmix_plugin.captures.checks import SeenView
from unmix_plugin.captures.pose_agreement import views_of_other_poses

VIEWS = 16


@pytest.fixture(scope="module")
def floor(tmp_path_factory) -> list[SeenView]:
    return seen_views(tmp_path_factory.mktemp("floor"), bumps())


def seen_views(folder: Path, texture: np.ndarray) -> list[SeenView]:
    views = make_views(folder, lambda bent: bent, texture, VIEWS)
    return [SeenView(record_of(f"v{index}"), *view) for index, view in enumerate(views)]


def with_poses_of_others(views: list[SeenView], spoilt: list[int]) -> list[SeenView]:
    """Each of these has the pose of the view half the capture away."""
    posed = list(views)
    for view in spoilt:
        other = views[(view + VIEWS // 2) % VIEWS]
        posed[view] = SeenView(views[view].record, other.camera, views[view].picture)
    return posed


@pytest.mark.parametrize("spoilt", [[], [0], [5, 6], [2, 9, 15]])
def test_views_with_the_poses_of_others_are_named_and_no_others(floor, spoilt):
    found = views_of_other_poses(with_poses_of_others(floor, spoilt))
    assert set(found) == {f"v{view}" for view in spoilt}
    assert all(f"--keep-view {name}" in remark.sentence for name, remark in found.items())


def test_poses_that_are_off_as_a_whole_are_no_matter_of_single_views(floor):
    assert views_of_other_poses(with_poses_of_others(floor, list(range(0, VIEWS, 2)))) == {}


def test_nothing_is_said_where_true_and_false_poses_differ_alike(tmp_path):
    """A floor of noise as fine as its pixels looks unlike itself from everywhere, a plain one alike."""
    for name, texture in {
        "plain": np.full((600, 600), 0.5),
        "noise": np.random.default_rng(3).random((600, 600)),
    }.items():
        (tmp_path / name).mkdir()
        views = seen_views(tmp_path / name, texture)
        assert views_of_other_poses(with_poses_of_others(views, [3])) == {}


def test_views_from_one_place_are_not_compared(floor):
    turning = [SeenView(view.record, floor[0].camera, view.picture) for view in floor]
    assert views_of_other_poses(turning) == {}
