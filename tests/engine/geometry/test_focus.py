"""Where cameras look."""

import numpy as np
import pytest

from tests.scenes.geometry.ground_views import flight_poses
from tests.scenes.scene_factory import look_at, ring_poses
from unmix_plugin.engine.geometry.camera_paths import focus_point, meeting_point


def stacked(poses):
    return np.stack(poses)[:, :3]


@pytest.mark.parametrize("find", [focus_point, meeting_point])
def test_the_focus_is_where_all_axes_meet(find):
    target = np.array([0.3, -0.2, 0.5])
    poses = [look_at(np.array(p), target) for p in ((3.0, 0, 1), (0, 3.0, 2), (-2.0, -2.0, 0))]
    found = find(stacked(poses))
    assert found is not None
    np.testing.assert_allclose(found, target, atol=1e-5)


@pytest.mark.parametrize("find", [focus_point, meeting_point])
def test_parallel_and_outward_cameras_have_no_focus(find):
    parallel = [look_at(np.array([x, -3.0, 0.0]), np.array([x, 0.0, 0.0])) for x in (-0.5, 0.0, 0.5)]
    outward = [look_at(pose[:3, 3], 2.0 * pose[:3, 3]) for pose in ring_poses(6)]
    assert find(stacked(parallel)) is None
    assert find(stacked(outward)) is None


def test_cameras_around_a_subject_or_on_one_side_of_it_meet():
    aside = [look_at(np.array([0.3 * x, -3.0, 0.0]), np.zeros(3)) for x in (-2, -1, 0, 1, 2)]
    for poses in (ring_poses(12), aside):
        found = meeting_point(stacked(poses))
        assert found is not None
        np.testing.assert_allclose(found, 0, atol=1e-6)


@pytest.mark.parametrize("count", [3, 5, 20])
def test_axes_of_a_flight_whose_camera_sways_do_not_meet(count):
    assert meeting_point(stacked(flight_poses(count))) is None
