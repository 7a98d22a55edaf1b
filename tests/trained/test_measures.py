import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest

from tests.factories.ball_model import RADIUS, ball_scene, cameras_around
from tests.factories.cameras import FRAME
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.run_json import RUN_FORMAT
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.trained import measures
from unmix_plugin.trained.protocol import Probe
from unmix_plugin.trained.regions import Box
from unmix_plugin.trained.run_views import RunView

CAMERAS = cameras_around([(1.0, 0.2, 0.3), (-1.0, 0.1, 0.5)])
VIEWS = tuple(RunView(f"view_{index}", camera) for index, camera in enumerate(CAMERAS))
BALL = replace(ball_scene(), frame=FRAME, views=VIEWS)


def test_two_points_and_their_distance_tell_the_unit(tmp_path):
    scale = measures.scale_between((1.0, 2.0, 3.0), (1.0, 2.0, 3.5), 0.12)
    assert scale.metres_per_unit == pytest.approx(0.24)
    assert (measures.describe_length(0.5, scale), measures.describe_area(0.5, scale)) == ("12 cm", "288 cm²")
    assert "0.12 m between 1 2 3 and 1 2 3.5" in scale.in_words
    run = RunFolder(tmp_path)
    assert measures.read_measures(run).scale is None
    measures.keep_scale(run, scale)
    assert measures.read_measures(run).scale == scale


def test_no_distance_and_no_two_points_are_refused():
    for second, distance, message in (
        ((0.0, 0.0, 1.0), 0.0, "the distance is 0 m; it must be greater than 0"),
        ((0.0, 0.0, 1.0), float("nan"), "the distance is nan m"),
        ((0.0, 0.0, 0.0), 0.1, "the two points are the same"),
        ((0.0, 0.0, 1.0), 1e12, "a unit of the scene would be 1e\\+12 m long"),
    ):
        with pytest.raises(ConfigError, match=message):
            measures.scale_between((0.0, 0.0, 0.0), second, distance)


def test_points_count_on_the_surface_that_views_show():
    facing = np.array([1.0, 0.2, 0.3]) / np.linalg.norm([1.0, 0.2, 0.3])
    measures.require_on_surface(BALL, FRAME.to_world(RADIUS * facing).tolist())
    for place, reason in (((RADIUS + 0.3) * facing, "pixels off"), (np.array([0.0, 0, 90]), "no view shows")):
        with pytest.raises(ConfigError, match=f"not on the object: .*{reason}"):
            measures.require_on_surface(BALL, FRAME.to_world(place).tolist())


def test_a_point_in_haze_that_hardly_shows_is_not_on_the_surface():
    place = FRAME.to_world(np.array([0.9, 0.2, 0.3]))
    hazy = MagicMock(spec=BALL, frame=FRAME, views=VIEWS)
    hazy.probe.return_value = Probe({}, 0.1, None, place)
    with pytest.raises(ConfigError, match="not on the object: no view shows anything there"):
        measures.require_on_surface(hazy, place.tolist())
    hazy.probe.return_value = Probe({}, 0.9, None, place)
    measures.require_on_surface(hazy, place.tolist())


def test_a_damaged_file_is_refused(tmp_path):
    for scale in (
        {"metres_per_unit": -1.0, "how": "x"},
        {"metres_per_unit": "0.1", "how": "x"},
        {"metres_per_unit": True, "how": "x"},
        {"metres_per_unit": 0.1, "how": "x" * 10_000},
        {"how": "x"},
        [0.1],
    ):
        (tmp_path / "measures.json").write_text(json.dumps({"format_version": RUN_FORMAT, "scale": scale}))
        with pytest.raises(RunError, match=r"measures\.json is damaged"):
            measures.read_measures(RunFolder(tmp_path))


def test_changes_at_once_lose_nothing_of_each_other(tmp_path):
    run, box = RunFolder(tmp_path), Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    names = [f"part {number}" for number in range(8)]
    with ThreadPoolExecutor(len(names)) as pool:
        list(pool.map(lambda name: measures.keep_region(run, name, box), names))
    assert sorted(measures.read_measures(run).regions) == names


def test_a_scene_may_know_its_unit():
    assert measures.recorded_scale({}) is None
    millimetres = measures.Scale(0.001, "as the scene's poses say")
    assert measures.recorded_scale({"metres_per_unit": 0.001}) == millimetres
    with pytest.raises(RunError, match=r"scene\.json is damaged"):
        measures.recorded_scale({"metres_per_unit": "a metre"})
