"""A run loaded with edits: the model edited, the record of its light new, and the run folder untouched."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.editing.scenes import CAMERAS, LIGHT, lit_model
from unmix_plugin.editing import Light, Recipe, Rename, Scale
from unmix_plugin.editing.edited_run import apply_recipe, light_note, load_edited_model, requested_recipe
from unmix_plugin.engine.runs.load_run import load_model
from unmix_plugin.errors import ConfigError, RunError, SpectrumError
from unmix_plugin.model import UnmixModel
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.spectral.colour.illuminants import illuminant_power


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of one step."""
    from tests.commands.running import SMALL_METHOD
    from tests.commands.running import run as run_command
    from unmix_plugin.commands.train import train

    folder = tmp_path_factory.mktemp("run")
    make_demo_scene(folder / "scene", 16, 8, 4)
    words = ["--data", folder / "scene", "--output-dir", folder / "outputs", "--max-num-iterations", 1]
    ended = run_command(train, "unmix-nerf", *words, *SMALL_METHOD)
    assert ended.status == 0, ended.err
    return Path(ended.last_line.removeprefix("run: "))


def write_recipe(folder: Path, text: str) -> Path:
    path = folder / "edits.yml"
    path.write_text(text)
    return path


def test_without_edits_the_run_is_as_it_is(run):
    plain, loaded = load_model(run, "cpu"), load_edited_model(run, "cpu")
    assert_close(loaded.model.state_dict(), plain.model.state_dict(), rtol=0, atol=0)
    assert loaded.scene.metadata == plain.scene.metadata


def test_a_run_is_loaded_with_its_materials_edited_and_lit(run, tmp_path):
    recipe = "edits:\n- rename: {endmember: 0, name: cloth}\n- retint: {endmember: 1, colour: '#805040'}\n"
    loaded = load_edited_model(run, "cpu", write_recipe(tmp_path, recipe), "A")
    assert isinstance(loaded.model, UnmixModel)
    assert loaded.model.materials.names[0] == "cloth"
    light = np.array(loaded.scene.metadata["illuminant"])
    np.testing.assert_allclose(light / light.max(), illuminant_power("A", loaded.model.bands))
    assert loaded.model.metadata["illuminant"] == loaded.scene.metadata["illuminant"]
    assert load_model(run, "cpu").scene.metadata["illuminant"] != loaded.scene.metadata["illuminant"]
    outputs = loaded.model.get_outputs_for_camera(loaded.scene.eval_cameras[0], ["rgb"])
    assert torch.isfinite(outputs["rgb"]).all()


def test_the_command_lines_light_goes_before_the_recipes(tmp_path):
    path = write_recipe(tmp_path, "illuminant: A\nedits:\n- scale: {endmember: 0, factor: 2}\n")
    assert requested_recipe(None, None) is None
    assert requested_recipe(None, "fl2") == Recipe(illuminant=Light("FL2"))
    assert requested_recipe(path, None) == Recipe((Scale(0, 2.0),), Light("A"))
    assert requested_recipe(path, "D65") == Recipe((Scale(0, 2.0),), Light("D65"))


def test_what_is_wrong_is_said_before_the_run_is_read(tmp_path):
    with pytest.raises(SpectrumError, match="there is no light 'moon'"):
        load_edited_model(tmp_path, "cpu", None, "moon")
    with pytest.raises(ConfigError, match=r"edits\.yml, line 1: a recipe has no 'edit'"):
        load_edited_model(tmp_path, "cpu", write_recipe(tmp_path, "edit: []"))
    with pytest.raises(RunError):
        load_edited_model(tmp_path, "cpu", None, "A")


def test_a_recipe_that_does_not_fit_names_its_file_and_line(run, tmp_path):
    path = write_recipe(tmp_path, "edits:\n- remove: endmember_9\n")
    with pytest.raises(ConfigError, match=r"edits\.yml, line 2 \(remove\): .* did you mean endmember_"):
        load_edited_model(run, "cpu", path)


def test_measured_radiance_is_comparable_after_the_lights_factors():
    model = lit_model()
    edited = apply_recipe(model, Recipe(illuminant=Light("A")), CAMERAS)
    expected = model.materials.endmembers.detach() * torch.from_numpy(edited.light_factors)
    assert_close(edited.model.materials.endmembers.double(), expected, rtol=1e-5, atol=1e-7)
    same = apply_recipe(model, Recipe((Rename(0, "clay"),)), CAMERAS)
    assert (same.light_factors == 1).all()
    assert (edited.notes, same.notes) == ([], [])


def test_a_model_without_materials_is_refused():
    from unmix_plugin.engine.model import Model

    class Grey(Model):
        def __init__(self) -> None:
            torch.nn.Module.__init__(self)

        populate_modules = get_param_groups = get_outputs = get_loss_dict = None  # type: ignore[assignment]
        get_image_metrics_and_images = None  # type: ignore[assignment]

    with pytest.raises(ConfigError, match="Grey has no materials to edit"):
        apply_recipe(Grey(), Recipe(), CAMERAS)


def test_a_light_that_is_not_recorded_is_spoken_of(run, tmp_path):
    loaded = load_model(run, "cpu")
    assert light_note(loaded, None, "A") is None
    loaded.scene.summary["illuminant"] = None
    assert "taken as flat" in str(light_note(loaded, None, "A"))
    assert light_note(loaded, write_recipe(tmp_path, "edits:\n- remove: 0\n"), None) is None
    assert light_note(loaded, None, None) is None
    assert len(LIGHT) == 5
