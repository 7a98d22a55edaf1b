"""Settings of the model, what they find in the data, and the endmembers that it starts from."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import NUM_BANDS, WAVELENGTHS_NM, initial_data, make_model, make_rays
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.settings import LossConfig, SceneOptions, UnmixModelConfig


@pytest.mark.parametrize("trained", [True, False])
def test_endmembers_are_taught_or_held_by_request(trained):
    model = make_model(train_endmembers=trained)
    spectra = model.get_param_groups()["spectra"]
    assert any(value is model.endmembers for value in spectra) == trained
    model.get_outputs(make_rays(40))["spectral"].sum().backward()
    assert (model.endmembers.grad is not None) == trained
    assert model.specular_spectra.grad is not None


def test_endmembers_start_at_the_materials_of_the_pixels():
    found = make_model().endmembers.detach()
    shapes = torch.nn.functional.normalize(torch.eye(3, NUM_BANDS) * 0.6 + 0.1, dim=-1)
    cosines = torch.nn.functional.normalize(found, dim=-1) @ shapes.T
    assert sorted(cosines.argmax(1).tolist()) == [0, 1, 2]
    assert (cosines.amax(1) > 0.999).all()


def test_endmembers_from_a_file_are_lit_by_the_scenes_light(tmp_path):
    path = tmp_path / "materials.csv"
    rows = [f"{nm:g},0.2,0.4,0.6" for nm in (440, 660)]
    path.write_text("wavelength,a,b,c\n" + "\n".join(rows) + "\n")
    light = [0.5, 0.6, 0.7, 0.8, 1.0]
    model = make_model(endmember_init="file", endmember_file=path, light=light)
    expected = torch.tensor([[0.2], [0.4], [0.6]]) * torch.tensor(light)
    factor = model.endmembers.detach() / expected
    assert_close(factor, factor.mean().expand(3, 5))
    with pytest.raises(ConfigError, match=r"materials.csv has 3 spectra but num-endmembers is 2"):
        make_model(endmember_init="file", endmember_file=path, num_endmembers=2)


def test_more_endmembers_than_bands_or_distinct_pixels_are_refused():
    with pytest.raises(ConfigError, match="num-endmembers is 6 but the scene has 5 bands; choose at most 5"):
        make_model(num_endmembers=6)
    model = make_model()
    data = {**initial_data(), "pixels": np.full((40, NUM_BANDS), 0.5, np.float32)}
    with pytest.raises(SpectrumError, match="distinct"), torch.no_grad():
        model.initialise(data, torch.Generator())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_endmembers": "auto"}, "num-endmembers is auto"),
        ({"num_endmembers": 0}, r"num-endmembers of 1 to 255 or auto \(got 0\)$"),
        ({"endmember_init": "file"}, r"is file \(got endmember-init file, endmember-file none\)$"),
        ({"initial_opacity": 1.0}, r"initial-opacity in \(0, 1\) or auto"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        make_model(**settings)


def test_an_automatic_number_of_endmembers_is_that_of_the_pixels_said_with_evidence():
    config, reasons = UnmixModelConfig(num_endmembers="auto").resolve_auto(initial_data, torch.Generator())
    assert config.num_endmembers == 3
    assert "proposed" in reasons


@pytest.mark.parametrize(("num_bands", "expected"), [(3, 3), (8, 6)])
def test_without_a_number_there_are_six_endmembers_or_as_many_as_bands(num_bands, expected):
    data = {**initial_data(), "pixels": np.random.default_rng(0).uniform(0.2, 0.8, (50, num_bands))}
    config, reasons = UnmixModelConfig().resolve_auto(lambda: data, torch.Generator())
    assert config.num_endmembers == expected
    assert ("num-endmembers is 3" in reasons) == (num_bands == 3)


def test_given_endmembers_get_the_brightness_of_the_scene(tmp_path):
    """The pixels are materials of the file at 1.9 times its brightness: amounts above 1 would be needed."""
    shapes = np.eye(3, NUM_BANDS, dtype=np.float32) * 0.6 + 0.1
    path = tmp_path / "materials.csv"
    rows = np.column_stack([WAVELENGTHS_NM, shapes.T])
    np.savetxt(path, rows, fmt="%g", delimiter=",", header="wavelength,a,b,c", comments="")
    model = make_model(endmember_init="file", endmember_file=path, train_endmembers=False)
    data = {**initial_data(), "pixels": np.repeat(1.4 * shapes, 40, axis=0) * 0.999}
    with torch.no_grad():
        model.initialise(data, torch.Generator().manual_seed(0))
    assert_close(model.endmembers.detach(), torch.from_numpy(1.4 / 0.75 * shapes), rtol=0.02, atol=0)
    for callback in model.get_training_callbacks():
        callback.func(1, 0.0)
    assert_close(model.endmembers.detach(), torch.from_numpy(1.4 / 0.75 * shapes), rtol=0.02, atol=0)


def test_light_exposure_and_relative_errors_follow_from_the_data_unless_they_are_set():
    def resolved(**data):
        given = {**initial_data(), **{name: np.array(value) for name, value in data.items()}}
        return UnmixModelConfig(num_endmembers=3).resolve_auto(lambda: given, torch.Generator())

    config, reasons = resolved()
    assert (config.light, config.losses.exposure, config.losses.relative, reasons) == ("fixed", 1.0, 0.0, "")
    config, reasons = resolved(light="camera", exposure=7.3456, relative=1.5)
    assert (config.light, config.losses.exposure, config.losses.relative) == ("camera", 7.346, 1.5)
    assert "the scene is dark" in reasons
    assert "the light moves with the camera" in reasons
    assert "squared errors are divided by the brightness to the power of 1.5 (relative)" in reasons

    def unread():
        raise AssertionError

    losses = LossConfig(exposure=1.0, band_weights=(), relative=0.0)
    config = UnmixModelConfig(num_endmembers=4, light="fixed", poses="fixed", losses=losses)
    assert config.resolve_auto(unread, torch.Generator()) == (config, "")


@pytest.mark.parametrize(
    ("option", "rule"),
    [
        *(
            ({"value_scale": x}, "value-scale of 1e-30 to 1e30")
            for x in (0.0, -1.0, 1e-320, math.nan, math.inf)
        ),
        *(({"eval_interval": x}, "eval-interval of at least 2") for x in (1, 0, -3)),
    ],
)
def test_options_that_no_scene_can_be_read_with_are_refused(option, rule):
    with pytest.raises(ConfigError, match=rule):
        SceneOptions(**option)
