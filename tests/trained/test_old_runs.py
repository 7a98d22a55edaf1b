"""A run of any format from 7 on opens in every later version, and shows what it showed.

`runs/format_7` was trained and rendered by the last version of that format.
"""

import json
import shutil
from pathlib import Path

import pytest

from unmix_plugin import open_run
from unmix_plugin.engine.runs.config_json import config_to_json, flattened
from unmix_plugin.engine.runs.loading import load_config, load_model
from unmix_plugin.engine.runs.run_json import OLDEST_FORMAT, RUN_FORMAT, read_run_json

RUNS = Path(__file__).parent / "runs"


@pytest.fixture
def run(tmp_path):
    return Path(shutil.copytree(RUNS / "format_7", tmp_path / "run"))


def test_a_run_of_format_7_shows_what_it_showed(run):
    assert json.loads((run / "config.json").read_text())["format_version"] == OLDEST_FORMAT == 7
    scene = open_run(run, device="cpu")
    view = scene.look(scene.views[-1].camera)
    assert view["rgb"].double().mean((0, 1)).tolist() == pytest.approx([0.44056, 0.48153, 0.38454], abs=2e-4)
    assert float(view["accumulation"].double().mean()) == pytest.approx(0.76723, abs=2e-4)


def test_what_format_7_chose_anew_at_each_load_stays_what_it_was(run):
    found = flattened(config_to_json(load_model(run, "cpu").model.config))
    expected = {
        "num_specular_spectra": 1,
        "initial_opacity": 0.05,
        "field.finest_resolution": 39,
        "field.log2_rows_per_level": 4,
        "renderer.samples_per_pixel": 1.5,
        "renderer.coarse_samples": 256,
        "renderer.smallest_weight": 4e-3,
        "renderer.first_smallest_weight": 4e-3,
        "renderer.visible_weight": 0.05,
        "losses.background": "random",
        "losses.rgb": 0.2,
        "losses.exposure": 1.15,
    }
    assert {name: found[name] for name in expected} == expected
    machines = {"eval_num_rays_per_chunk", "samples_per_step"}
    assert {name for name, value in found.items() if value == "auto"} == machines


def test_each_step_leads_to_the_next_format(run):
    for path in run.rglob("*.json"):
        assert read_run_json(path)["format_version"] == RUN_FORMAT
    stored = flattened(config_to_json(load_config(run)))
    assert stored["pipeline.model.renderer.first_smallest_weight"] == "auto"
