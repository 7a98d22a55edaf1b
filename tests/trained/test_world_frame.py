from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.trained.camera_files.camera_scenes import FRAME, around, record
from unmix_plugin.errors import RunError
from unmix_plugin.trained.run_views import affine_to_world, directions_to_world, world_frame

SCENE = record(around(), around())
points = st.lists(st.floats(-9, 9), min_size=3, max_size=3).map(np.array)


def test_the_frame_is_what_the_run_recorded():
    found = world_frame(SCENE)
    np.testing.assert_array_equal(found.rotation, FRAME.rotation)
    np.testing.assert_array_equal(found.translation, FRAME.translation)
    assert found.scale == FRAME.scale


def test_a_run_that_recorded_none_is_in_its_world_already():
    frame = world_frame(replace(SCENE, summary={}))
    np.testing.assert_array_equal(frame.to_world(np.array([1.0, 2.0, 3.0])), [1, 2, 3])


@pytest.mark.parametrize("recorded", [{}, {"rotation": [1], "translation": [0, 0, 0], "scale": 1}, [1, 2]])
def test_a_damaged_record_is_refused(recorded):
    with pytest.raises(RunError, match=r"scene\.json is damaged: its normalisation is"):
        world_frame(replace(SCENE, summary={"normalisation": recorded}))


@given(points, points)
def test_directions_turn_as_differences_of_points_do(start, end):
    difference = FRAME.to_world(end) - FRAME.to_world(start)
    np.testing.assert_allclose(directions_to_world(FRAME, end - start), FRAME.scale * difference, atol=1e-9)


@given(points)
def test_the_matrix_of_a_grid_leads_to_the_same_world(index):
    origin, cell = np.array([0.1, -0.2, 0.3]), 0.05
    homogeneous = affine_to_world(FRAME, origin, cell) @ np.append(index, 1.0)
    np.testing.assert_allclose(homogeneous, np.append(FRAME.to_world(origin + cell * index), 1.0), atol=1e-9)
