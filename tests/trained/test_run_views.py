"""Views of a run by name or number, and its world."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.trained.camera_scenes import FRAME, around, record
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.trained.run_views import (
    RunView,
    affine_to_world,
    directions_to_world,
    find_view,
    recorded_views,
    views_of,
    world_frame,
)

VIEWS = [RunView(name, around()[0]) for name in ("left", "right", "0042")]
OTHERS = [RunView(name, around()[1]) for name in ("1", "far")]


def test_a_view_is_found_by_its_number_among_the_numbered_or_by_any_name():
    assert find_view(VIEWS, "2").name == "0042"
    assert find_view(VIEWS, "0042").name == "0042"
    assert find_view(VIEWS, "1").name == "right"
    assert find_view(VIEWS, "far", OTHERS).name == "far"
    assert find_view(VIEWS, "1", OTHERS).name == "1"


def test_a_view_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(ConfigError, match=r"no view '3'; give a number from 0 to 2, or a name such as left"):
        find_view(VIEWS, "3")
    with pytest.raises(ConfigError, match=r"no view 'rihgt' \(did you mean right\?\)"):
        find_view(VIEWS, "rihgt")


def plain_cameras(count):
    pose = torch.eye(4)[:3].expand(count, 3, 4) + torch.arange(count)[:, None, None]
    return Cameras(pose, torch.ones(count, 2), torch.ones(count, 2), torch.zeros(count, 4), 2, 2)


def record_of(summary):
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    return SceneRecord(box, {}, plain_cameras(2), plain_cameras(1), summary)


def test_views_are_named_as_the_frames_of_the_scene():
    views = recorded_views(
        record_of({"frames": ["x", "y", "z"], "train_indices": [0, 2], "eval_indices": [1]})
    )
    assert [view.name for view in views_of(views, "eval")] == ["y"]
    assert [view.name for view in views_of(views, "train")] == ["x", "z"]
    assert [view.name for view in views_of(views, "all")] == ["y", "x", "z"]
    last = views_of(views, "train")[-1].camera
    torch.testing.assert_close(last.camera_to_world, plain_cameras(2).camera_to_world[1:])


def test_views_of_a_scene_without_frame_names_are_numbered():
    assert [view.name for view in views_of(recorded_views(record_of({})), "all")] == [
        "eval_000",
        "train_000",
        "train_001",
    ]


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
