from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.factories.cameras import FRAME, around, record
from tests.factories.models import make_scene
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.products.render import RenderOptions
from unmix_plugin.products.render.cameras import choose_cameras
from unmix_plugin.trained.run_views import (
    RunView,
    affine_to_world,
    cameras_of,
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
    with pytest.raises(ConfigError, match=r"no view '3'; give a number from 0 to 2, or a name such as left"):
        find_view(VIEWS, "3")
    with pytest.raises(ConfigError, match=r"no view 'rihgt' \(did you mean right\?\)"):
        find_view(VIEWS, "rihgt")


def test_a_run_without_evaluation_views_says_so_where_one_is_needed():
    training = [replace(view, split="train") for view in OTHERS]
    with pytest.raises(ConfigError, match="no view '0'; give a name such as 1"):
        find_view([], "0", training)
    with pytest.raises(ConfigError, match="no view '0'; the run has none"):
        find_view([], "0")
    with pytest.raises(ConfigError, match="no evaluation views; choose --cameras dataset-train"):
        cameras_of(training, "eval")
    scene = replace(make_scene(), views=tuple(training))
    for cameras in ("dataset-eval", "interpolate"):
        with pytest.raises(ConfigError, match="no evaluation views"):
            choose_cameras(scene, RenderOptions(cameras=cameras))


def test_views_are_named_as_the_frames_of_the_scene_or_numbered():
    given = record(around(2), around(1))
    named = replace(given, summary={"frames": ["x", "y", "z"], "train_indices": [0, 2], "eval_indices": [1]})
    views = recorded_views(named)
    names = {split: [view.name for view in views_of(views, split)] for split in ("eval", "train", "all")}
    assert names == {"eval": ["y"], "train": ["x", "z"], "all": ["y", "x", "z"]}
    last = views_of(views, "train")[-1].camera
    torch.testing.assert_close(last.camera_to_world, given.train_cameras.camera_to_world[1:])
    bare = views_of(recorded_views(replace(given, summary={})), "all")
    assert [view.name for view in bare] == ["eval_000", "train_000", "train_001"]


SCENE = record(around(), around())
points = st.lists(st.floats(-9, 9), min_size=3, max_size=3).map(np.array)


def test_the_frame_is_what_the_run_recorded_or_none_and_a_damaged_record_refused():
    found = world_frame(SCENE)
    np.testing.assert_array_equal(found.rotation, FRAME.rotation)
    np.testing.assert_array_equal(found.translation, FRAME.translation)
    assert found.scale == FRAME.scale
    frame = world_frame(replace(SCENE, summary={}))
    np.testing.assert_array_equal(frame.to_world(np.array([1.0, 2.0, 3.0])), [1, 2, 3])
    for recorded in ({}, {"rotation": [1], "translation": [0, 0, 0], "scale": 1}, [1, 2]):
        with pytest.raises(RunError, match=r"scene\.json is damaged: its normalisation is"):
            world_frame(replace(SCENE, summary={"normalisation": recorded}))


@given(points, points)
def test_directions_turn_and_grids_lead_as_points_do(start, end):
    difference = FRAME.to_world(end) - FRAME.to_world(start)
    np.testing.assert_allclose(directions_to_world(FRAME, end - start), FRAME.scale * difference, atol=1e-9)
    cell, index = 0.05, end
    homogeneous = affine_to_world(FRAME, start, cell) @ np.append(index, 1.0)
    np.testing.assert_allclose(homogeneous, np.append(FRAME.to_world(start + cell * index), 1.0), atol=1e-9)
