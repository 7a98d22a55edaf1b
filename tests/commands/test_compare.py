"""`unmix-compare` end to end: what it writes, and what it refuses before anything is rendered."""

import csv
import json

import pytest

from tests.factories.commands import SMALL_METHOD, done, refused, run_of
from tests.factories.runs import lose_scene
from unmix_plugin.commands.compare import compare
from unmix_plugin.commands.train import train
from unmix_plugin.scenes.demo.scene import make_demo_scene

pytestmark = pytest.mark.usefixtures("coarse_surfaces")


@pytest.fixture(scope="module")
def seen_often(tmp_path_factory):
    """A run of a surface that many views see."""
    folder = tmp_path_factory.mktemp("seen-often")
    make_demo_scene(folder / "scene", 24, 5, 24)
    words = ["--data", folder / "scene", "--output-dir", folder / "outputs", "--max-num-iterations", 10]
    return run_of(done(train, "unmix-nerf", *words, *SMALL_METHOD, "--pipeline.model.initial-opacity=0.6"))


def test_a_run_compared_with_itself_has_not_changed(seen_often, tmp_path):
    words = [seen_often, seen_often, seen_often, "--output", tmp_path / "out", "--max-views", 1]
    ended = done(compare, *words, "--device", "cpu")
    assert "nothing has changed" in ended.out
    folders = sorted(path for path in (tmp_path / "out").iterdir() if path.is_dir())
    found = json.loads((folders[0] / "changes.json").read_text())
    assert found["registration"]["rms_px"] < 0.01
    assert found["registration"]["scale"] == pytest.approx(1.0, abs=1e-3)
    assert found["light_after_over_before"] == pytest.approx([1.0] * 5, abs=1e-3)
    with (tmp_path / "out" / "series.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["capture"] for row in rows} == {folder.name for folder in folders}
    assert len(folders) == 2
    assert {float(row["changed_part"]) for row in rows if row["region"] == "everything"} == {0.0}
    assert "exist already" in refused(compare, *words)


def test_captures_that_see_no_place_often_enough_are_refused(solid, tmp_path):
    said = refused(compare, solid.run, solid.run, "--output", tmp_path / "out", "--device", "cpu")
    assert "no place of the first surface is seen by at least 4 views of both captures" in said


def test_runs_that_can_not_be_compared_are_refused_in_one_sentence(trained, run_copy, tmp_path):
    lose_scene(run_copy, trained.scene)
    pair = [trained.run, trained.run, "--output", tmp_path / "out", "--device", "cpu"]
    assert "name its folder with --after-data" in refused(compare, trained.run, run_copy, *pair[2:])
    assert "name its folder with --before-data" in refused(compare, run_copy, trained.run, *pair[2:])
    assert "--after-data names 2 scenes for 1 later run" in refused(compare, *pair, "--after-data", "a", "b")
    assert "the level is 2" in refused(compare, *pair, "--level", 2)
    assert "--max-views is 0" in refused(compare, *pair, "--max-views", 0)
    assert not (tmp_path / "out").exists()
