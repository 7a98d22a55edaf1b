"""A run loaded with edits: its scene edited, its light new, and what the run recorded as it was."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.commands import SMALL_METHOD, done, run_of
from tests.factories.edited_scenes import lit_scene, tensors_of
from tests.factories.models import make_model
from unmix_plugin.commands.train import train
from unmix_plugin.editing import Light, Recipe, Rename, Scale, edited_run
from unmix_plugin.editing.apply import edit_scene, light_factors
from unmix_plugin.editing.edited_run import load_edited_run, requested_recipe
from unmix_plugin.errors import ConfigError, RunError, SpectrumError
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.spectral.colour.conversion import illuminant_power
from unmix_plugin.trained.model_scene import ModelScene
from unmix_plugin.trained.open_run import load_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of one step."""
    folder = tmp_path_factory.mktemp("run")
    make_demo_scene(folder / "scene", 16, 8, 4)
    argv = ["--data", folder / "scene", "--output-dir", folder / "outputs", "--max-num-iterations", 1]
    return run_of(done(train, "unmix-nerf", *argv, *SMALL_METHOD))


def write_recipe(folder, text):
    path = folder / "edits.yml"
    path.write_text(text)
    return path


def test_without_edits_the_run_is_as_it_is(run):
    plain, loaded = load_run(run, "cpu"), load_edited_run(run, "cpu")
    assert_close(tensors_of(loaded.materials_scene), tensors_of(plain.materials_scene), rtol=0, atol=0)
    assert loaded.record.metadata == plain.record.metadata
    assert loaded.scene.notes == ()


def test_a_run_is_loaded_with_its_materials_edited_and_lit(run, tmp_path):
    recipe = "edits:\n- rename: {endmember: 0, name: cloth}\n- retint: {endmember: 1, colour: '#805040'}\n"
    loaded = load_edited_run(run, "cpu", write_recipe(tmp_path, recipe), "A")
    plain, scene = load_run(run, "cpu"), loaded.materials_scene
    assert scene.materials.names[0] == "cloth"
    light, recorded = cast(Any, (scene.light_power, plain.materials_scene.light_power))
    np.testing.assert_allclose(light / light.max(), illuminant_power("A", scene.bands), rtol=1e-6)
    assert not np.allclose(recorded, light)
    assert loaded.record.metadata == plain.record.metadata
    view = next(view for view in scene.views if view.split == "eval")
    assert torch.isfinite(scene.render(view.camera, ["rgb"])["rgb"]).all()


def test_the_command_lines_light_overrides_the_recipes(tmp_path):
    path = write_recipe(tmp_path, "illuminant: A\nedits:\n- scale: {endmember: 0, factor: 2}\n")
    assert requested_recipe(None, None) is None
    assert requested_recipe(None, "fl2") == Recipe(illuminant=Light("FL2"))
    assert requested_recipe(path, None) == Recipe((Scale(0, 2.0),), Light("A"))
    assert requested_recipe(path, "D65") == Recipe((Scale(0, 2.0),), Light("D65"))


def test_what_is_wrong_is_said_before_the_run_is_read_and_what_does_not_fit_it_with_its_line(run, tmp_path):
    with pytest.raises(SpectrumError, match="there is no light 'moon'"):
        load_edited_run(tmp_path, "cpu", None, "moon")
    with pytest.raises(ConfigError, match=r"edits\.yml, line 1: a recipe has no 'edit'"):
        load_edited_run(tmp_path, "cpu", write_recipe(tmp_path, "edit: []"))
    with pytest.raises(RunError):
        load_edited_run(tmp_path, "cpu", None, "A")
    path = write_recipe(tmp_path, "edits:\n- remove: endmember_9\n")
    with pytest.raises(
        ConfigError,
        match=r"line 2 \(remove\): there is no endmember 'endmember_9'; the run has 0 ",
    ):
        load_edited_run(run, "cpu", path)


def test_measured_radiance_is_comparable_after_the_lights_factors():
    scene, lamp, name = lit_scene(), Recipe(illuminant=Light("A")), Recipe((Rename(0, "clay"),))
    relit, renamed = edit_scene(scene, lamp), edit_scene(scene, name)
    expected = scene.materials.endmembers * torch.from_numpy(light_factors(scene, lamp)[0])
    assert_close(relit.materials.endmembers.double(), expected, rtol=1e-5, atol=1e-7)
    assert (light_factors(scene, name)[0] == 1).all()
    assert (relit.notes, renamed.notes) == ((), ())


def test_a_scene_without_materials_is_refused(run, tmp_path, monkeypatch):
    plain = load_run(run, "cpu")
    without = ModelScene(make_model(), plain.scene.frame, plain.scene.views, outputs=())
    monkeypatch.setattr(edited_run, "load_run", lambda *_: replace(plain, scene=without))
    sensor = tmp_path / "sensor.csv"
    sensor.write_text("wavelength,green\n500,0\n550,1\n600,0\n")
    for illuminant, camera in (("A", None), (None, sensor)):
        with pytest.raises(ConfigError, match="the method unmix-nerf makes no scene of mixed materials"):
            load_edited_run(run, "cpu", illuminant=illuminant, sensor=camera)
