"""A scene seen through another camera renders what that camera would make of its spectra."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.editing.scenes import CAMERAS, LIGHT, edited, lit_scene, rendered, tensors_of
from tests.method_factory import WAVELENGTHS_NM, make_scene
from unmix_plugin.editing.apply import with_sensor
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable
from unmix_plugin.spectral.sensor import Sensor
from unmix_plugin.trained.outputs import OUTPUTS

BANDS = Bands.of(WAVELENGTHS_NM)
SENSOR = Sensor(
    "toy",
    SpectraTable(
        Bands.of([430, 470, 520, 580, 670, 671, 899, 900, 950]),
        ("red", "green", "blue", "far"),
        np.array(
            [
                [0, 0, 0, 1, 0.6, 0, 0, 0, 0],
                [0, 0.3, 1, 0.2, 0, 0, 0, 0, 0],
                [0.9, 1, 0, 0, 0, 0, 0, 0, 0],
                [0, 0, 0, 0, 0, 0, 0, 1.0, 1],
            ]
        ),
    ),
)
"""Three channels that the bands cover, and one that they don't."""

MATRIX = torch.from_numpy(SENSOR.seen_by(BANDS).matrix).float()
SPECULAR = ["none", "dictionary", "full"]


@pytest.mark.parametrize("specular", SPECULAR)
def test_rendering_through_the_sensor_is_rendering_spectra_and_seeing_them_through_it(specular):
    scene = lit_scene(specular=specular)
    through = with_sensor(scene, SENSOR)
    for view in range(2):
        before, after = rendered(scene, view), rendered(through, view)
        assert after["spectral"].shape == (10, 12, 3)
        assert after["spectral"].max() > 0.05
        for name in ("spectral", "diffuse", "specular"):
            assert_close(after[name], (before[name] @ MATRIX).detach(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("specular", SPECULAR)
def test_edits_made_before_are_seen_through_the_sensor_too(specular):
    gloss = [] if specular == "none" else ["gloss: {endmember: 2, scale: 4, colour: '#ffd080'}"]
    scene = edited(lit_scene(specular=specular), "swap: [0, 2]", "remove: 1", *gloss, light="A")
    through = with_sensor(scene, SENSOR)
    expected = (rendered(scene)["spectral"] @ MATRIX).detach()
    assert_close(rendered(through)["spectral"], expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("specular", SPECULAR)
def test_materials_and_geometry_are_those_of_the_scene(specular):
    scene = lit_scene(specular=specular)
    through = with_sensor(scene, SENSOR)
    names = ["abundances", "segmentation", "confidence", "accumulation", "depth", "normals"]
    before = scene.render(CAMERAS[0], names)
    after = through.render(CAMERAS[0], names)
    assert len(before["segmentation"].unique()) > 1
    for name in names:
        assert torch.equal(after[name], before[name]), name


def test_every_output_can_be_rendered_through_the_sensor():
    through = with_sensor(lit_scene(), SENSOR)
    outputs = through.render(CAMERAS[0], [*OUTPUTS, "band:600nm", "false-colour:600,520,450"])
    assert all(torch.isfinite(values).all() for values in outputs.values())
    assert torch.equal(outputs["band:600nm"], outputs["spectral"][..., 2])
    assert_close(outputs["false-colour:600,520,450"], outputs["spectral"].flip(-1).clamp(0, 1))


def test_reflectance_under_the_sensor_is_radiance_over_light_both_seen_through_it():
    scene = lit_scene()
    through = with_sensor(scene, SENSOR)
    light = through.light
    assert light is not None
    assert_close(light, torch.tensor(LIGHT) @ MATRIX)
    greys = (0.25 * torch.tensor(LIGHT)).expand(3, 5)  # in that light
    grey = with_sensor(replace(scene, materials=replace(scene.materials, endmembers=greys)), SENSOR)
    assert_close(grey.materials.endmembers / light, torch.full((3, 3), 0.25))


def test_bands_and_colours_are_the_sensors_and_notes_say_what_it_is():
    through = with_sensor(edited(lit_scene(), "gloss: {colour: '#00ff00'}"), SENSOR)
    seen = SENSOR.seen_by(BANDS)
    assert through.bands == through.materials.bands == seen.bands
    view = rendered(through)
    assert_close(view["rgb"], linear_to_srgb((view["spectral"] @ rgb_matrix(seen.bands)).clamp(0, 1)))
    edit_note, description, left_out = through.notes
    assert "highlights can't be #00ff00" in edit_note
    assert description.startswith("seen through toy: blue 4")
    assert left_out == "left out far (900-950 nm): the bands cover 425-675 nm"
    assert with_sensor(make_scene(), SENSOR).light is None


def test_the_scene_itself_stays_as_it_was_and_shares_its_weights():
    scene = lit_scene()
    before = {name: value.clone() for name, value in tensors_of(scene).items()}
    picture, notes = rendered(scene), scene.notes
    through = with_sensor(scene, SENSOR)
    assert all(torch.equal(value, before[name]) for name, value in tensors_of(scene).items())
    assert (scene.bands, scene.notes) == (BANDS, notes)
    assert_close(rendered(scene), picture, rtol=0, atol=0)
    assert through.field is scene.field
    assert through.renderer is scene.renderer


def test_a_sensor_that_sees_nothing_is_refused():
    far = Sensor("far", SpectraTable(Bands.of([900, 950]), ("far",), np.ones((1, 2))))
    with pytest.raises(SpectrumError, match="'far' sees nothing: the bands cover 425-675 nm"):
        with_sensor(lit_scene(), far)
