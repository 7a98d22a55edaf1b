"""A view by its name or number means the same in every command."""

import pytest
import torch

from tests.trained.camera_files.camera_scenes import around
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.run_views import RunView, find_view, recorded_views, views_of

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


def cameras(count):
    pose = torch.eye(4)[:3].expand(count, 3, 4) + torch.arange(count)[:, None, None]
    return Cameras(pose, torch.ones(count, 2), torch.ones(count, 2), torch.zeros(count, 4), 2, 2)


def record(summary):
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    return SceneRecord(box, {}, cameras(2), cameras(1), summary)


def test_views_are_named_as_the_frames_of_the_scene():
    views = recorded_views(record({"frames": ["x", "y", "z"], "train_indices": [0, 2], "eval_indices": [1]}))
    assert [view.name for view in views_of(views, "eval")] == ["y"]
    assert [view.name for view in views_of(views, "train")] == ["x", "z"]
    assert [view.name for view in views_of(views, "all")] == ["y", "x", "z"]
    last = views_of(views, "train")[-1].camera
    torch.testing.assert_close(last.camera_to_world, cameras(2).camera_to_world[1:])


def test_views_of_a_scene_without_frame_names_are_numbered():
    assert [view.name for view in views_of(recorded_views(record({})), "all")] == [
        "eval_000",
        "train_000",
        "train_001",
    ]
