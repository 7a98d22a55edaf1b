"""Export and relit renders of a trained object from the command line; and its scene as a value."""

import numpy as np
import pytest
import torch

from tests.commands.running import done, refused
from tests.neumatex.factory import trained_on, write_light, write_object
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.engine import load_model
from unmix_plugin.neumatex.export.material import material_paths
from unmix_plugin.neumatex.fit.trained_object import TrainedObject
from unmix_plugin.trained.open_run import load_run, snapshot


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two steps with neural materials."""
    return trained_on(write_object(tmp_path_factory.mktemp("object") / "ball"), steps=2)


def test_the_material_is_exported_with_its_latents_and_decoder(trained, tmp_path):
    words = ["material", "--run", trained, "--output", tmp_path, "--device", "cpu", "--texture-size", 64]
    done(export, *words)
    scene = load_run(trained, "cpu").scene
    assert isinstance(scene, TrainedObject)
    expected = set(material_paths(tmp_path, scene.surface.family))
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == expected
    assert {"decoder.glsl", "latents_a.png", "latents_b.exr"} <= {path.name for path in expected}
    assert "--overwrite" in refused(export, *words)
    assert "choose 16 to 8192" in refused(export, *words, "--overwrite", "--texture-size", 3)


def test_products_of_mixed_materials_are_refused_in_one_sentence(trained, tmp_path):
    said = refused(export, "endmembers", "--run", trained, "--output", tmp_path, "--device", "cpu")
    assert "the method neumatex makes no scene of mixed materials" in said
    assert "unmix-export has products of its own for it: material" in said


def test_a_view_is_rendered_under_a_map_from_a_file(trained, tmp_path):
    light = write_light(tmp_path / "light", sky=3.0)
    words = ["--run", trained, "--device", "cpu", "--view", 0, "--outputs", "linear_rgb", "--formats", "npy"]
    pictures = []
    for name, rest in (("own", []), ("brighter", ["--environment", light])):
        done(render, *words, "--output", tmp_path / name, *rest)
        pictures.append(np.load(next((tmp_path / name / "linear_rgb").glob("*.npy"))))
    assert pictures[0].max() > 0.01
    np.testing.assert_allclose(pictures[1], 3 * pictures[0], rtol=1e-3, atol=1e-5)
    said = refused(render, *words, "--output", tmp_path / "none", "--environment", tmp_path / "none.hdr")
    assert "there is no such environment map" in said


def test_training_that_goes_on_does_not_change_a_scene(trained):
    loaded = load_model(trained, "cpu")
    scene = snapshot(loaded.model, "neumatex", loaded.scene)
    assert isinstance(scene, TrainedObject)
    camera = scene.views[0].camera
    before = scene.render(camera, ["base_colour", "latents_a", "uncertainty"])
    with torch.no_grad():
        for param in loaded.model.parameters():
            param.add_(0.5)
    after = scene.render(camera, ["base_colour", "latents_a", "uncertainty"])
    for name, values in before.items():
        torch.testing.assert_close(after[name], values, rtol=0, atol=0)
    changed = snapshot(loaded.model, "neumatex", loaded.scene).render(camera, ["base_colour"])
    assert not torch.equal(changed["base_colour"], before["base_colour"])
