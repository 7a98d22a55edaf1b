"""A model seen through another camera renders what that camera would make of its spectra."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.editing.scenes import CAMERAS, LIGHT, edited, lit_model, rendered
from tests.method_factory import WAVELENGTHS_NM, make_model
from unmix_plugin.editing.simulated_sensor import with_sensor
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.composition import OUTPUT_NAMES
from unmix_plugin.spectral.library.spectra_csv import SpectraTable
from unmix_plugin.spectral.sensor import Sensor

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
    model = lit_model(specular=specular)
    through, _ = with_sensor(model, SENSOR)
    for view in range(2):
        before, after = rendered(model, view), rendered(through, view)
        assert after["spectral"].shape == (10, 12, 3)
        assert after["spectral"].max() > 0.05
        for name in ("spectral", "diffuse", "specular"):
            assert_close(after[name], (before[name] @ MATRIX).detach(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("specular", SPECULAR)
def test_edits_made_before_are_seen_through_the_sensor_too(specular):
    gloss = [] if specular == "none" else ["gloss: {endmember: 2, scale: 4, colour: '#ffd080'}"]
    model = edited(lit_model(specular=specular), "swap: [0, 2]", "remove: 1", *gloss, light="A")
    through, _ = with_sensor(model, SENSOR)
    expected = (rendered(model)["spectral"] @ MATRIX).detach()
    assert_close(rendered(through)["spectral"], expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("specular", SPECULAR)
def test_materials_and_geometry_are_those_of_the_model(specular):
    model = lit_model(specular=specular)
    through, _ = with_sensor(model, SENSOR)
    names = ["abundances", "segmentation", "confidence", "accumulation", "depth", "normals"]
    before = model.get_outputs_for_camera(CAMERAS[0], names)
    after = through.get_outputs_for_camera(CAMERAS[0], names)
    assert len(before["segmentation"].unique()) > 1
    for name in names:
        assert torch.equal(after[name], before[name]), name


def test_every_output_can_be_rendered_through_the_sensor():
    through, _ = with_sensor(lit_model(), SENSOR)
    outputs = through.get_outputs_for_camera(
        CAMERAS[0], [*OUTPUT_NAMES, "band:600nm", "false-colour:600,520,450"]
    )
    assert all(torch.isfinite(values).all() for values in outputs.values())
    assert torch.equal(outputs["band:600nm"], outputs["spectral"][..., 2])
    assert_close(outputs["false-colour:600,520,450"], outputs["spectral"].flip(-1).clamp(0, 1))


def test_reflectance_under_the_sensor_is_radiance_over_light_both_seen_through_it():
    model = lit_model()
    through, _ = with_sensor(model, SENSOR)
    light = torch.tensor(through.metadata["illuminant"])
    assert_close(light, torch.tensor(LIGHT) @ MATRIX)
    with torch.no_grad():
        model.endmembers.copy_(0.25 * torch.tensor(LIGHT))  # grey in that light
    grey, _ = with_sensor(model, SENSOR)
    assert_close(grey.endmembers / light, torch.full((3, 3), 0.25))


def test_what_a_model_says_of_its_bands_is_the_sensors():
    through, notes = with_sensor(lit_model(), SENSOR)
    seen = SENSOR.seen_by(BANDS)
    assert through.materials.bands == seen.bands == Bands.of(through.metadata["wavelengths_nm"])
    assert torch.equal(through.rgb_weights, rgb_matrix(seen.bands))
    assert notes[0].startswith("seen through toy: blue 4")
    assert notes[1:] == ["left out far (900-950 nm): the bands cover 425-675 nm"]
    assert with_sensor(make_model(), SENSOR)[0].metadata["illuminant"] is None


def test_the_model_itself_stays_as_it_was_and_shares_its_weights():
    model = lit_model()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    picture, metadata = rendered(model), dict(model.metadata)
    through, _ = with_sensor(model, SENSOR)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert model.metadata == metadata
    assert_close(rendered(model), picture, rtol=0, atol=0)
    assert through.field is model.field
    assert through.renderer is model.renderer


def test_a_sensor_that_sees_nothing_is_refused():
    far = Sensor("far", SpectraTable(Bands.of([900, 950]), ("far",), np.ones((1, 2))))
    with pytest.raises(SpectrumError, match="'far' sees nothing: the bands cover 425-675 nm"):
        with_sensor(lit_model(), far)
