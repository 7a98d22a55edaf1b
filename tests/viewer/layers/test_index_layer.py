"""A spectral index is shown as renders give it, where it is defined, in colours that stay the same."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.viewer.view_factory import make_aids, make_frame, make_source, paint_layer
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.viewer.layers import layers as index_layer
from unmix_plugin.viewer.layers.painting import ColourMapLegend, LayerSettings, over_background, paint_values

FORMULA = "(r650-r450)/(r650+r450)"


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return make_source(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def frame(source):
    return make_frame(source)


@pytest.fixture(scope="module")
def aids(source):
    return make_aids(source)


def painted(frame, aids, index, **settings) -> tuple[Any, Any]:
    """The picture of an index, and its legend."""
    return paint_layer(frame, LayerSettings(layer="index", index=index, **settings), aids)


def with_materials(frame, materials):
    """The same view with other spectra."""
    return replace(frame, scene=replace(frame.scene, materials=materials))


@pytest.mark.parametrize("light", [None, [0.2, 0.4, 0.6, 0.8, 1.0]])
def test_an_index_is_the_output_of_renders_over_the_background_where_that_is_undefined(
    frame, aids, light, monkeypatch
):
    monkeypatch.setattr(index_layer, "_CHUNK", 100)  # fewer than there are pixels
    lit = replace(frame.materials, light=None if light is None else torch.tensor(light))
    shown = with_materials(frame, lit)
    values = shown[f"index:{FORMULA}"]
    assert 0.05 < float(values.isnan().float().mean()) < 0.95
    settings = LayerSettings(layer="index", index=FORMULA, value_range=(-1.0, 1.0), background="white")
    picture, legend = paint_layer(shown, settings, aids)
    opacity = frame.coefficients.accumulation * values.isfinite()
    expected = over_background(paint_values(values, (-1.0, 1.0), "viridis"), opacity, settings)
    assert_close(picture, expected, atol=1e-5, rtol=0)
    assert_close(picture[values.isnan()], torch.ones_like(picture[values.isnan()]))
    assert isinstance(legend, ColourMapLegend)
    assert ("of radiance: light unknown" in legend.label) == (light is None)


def test_the_light_of_the_scene_is_divided_out(frame, aids):
    power = torch.tensor([0.2, 0.4, 0.6, 0.8, 1.0])
    materials = frame.materials
    lit = replace(
        materials,
        endmembers=materials.endmembers * power,
        specular_spectra=materials.specular_spectra * power,
        light=power,
    )
    before, _ = painted(frame, aids, FORMULA, value_range=(-1.0, 1.0))
    after, _ = painted(with_materials(frame, lit), aids, FORMULA, value_range=(-1.0, 1.0))
    assert_close(after, before, atol=2e-3, rtol=0)


def test_a_named_index_has_its_usual_range_unless_one_is_chosen(frame, aids):
    _, legend = painted(frame, aids, "pri")
    assert (legend.low, legend.high) == (-0.2, 0.2)
    assert legend.label.startswith("photochemical reflectance index, (r531-r570)/(r531+r570)")
    _, legend = painted(frame, aids, "pri", value_range=(0.0, 0.1))
    assert (legend.low, legend.high) == (0.0, 0.1)


def test_a_formula_has_the_range_that_is_seen_from_everywhere(source, aids):
    legends = [
        painted(make_frame(source, source.record.train_cameras[index]), aids, "1+r650")[1]
        for index in range(3)
    ]
    reference = aids.reference
    with source.borrowed() as scene:
        seen = 1 + reference.spectra(scene.materials)[:, 4]
    expected = torch.quantile(seen, torch.tensor([0.01, 0.99])).tolist()
    for legend in legends:
        assert (legend.low, legend.high) == pytest.approx(expected, abs=1e-5)
    assert expected[0] > 0.9


@pytest.mark.parametrize("formula", ["r650-r650", "log(r650-r650)"])
def test_a_formula_that_is_everywhere_the_same_or_nowhere_defined_still_has_a_scale(frame, aids, formula):
    picture, legend = painted(frame, aids, formula)
    assert picture.isfinite().all()
    assert (legend.low, legend.high) == (0.0, 1.0)


def test_a_long_formula_is_shortened_in_the_legend(frame, aids):
    _, legend = painted(frame, aids, "+".join(["r650"] * 90))
    assert len(legend.label) < 160
    assert "..." in legend.label


def test_an_index_that_is_not_chosen_says_what_to_do(frame, aids):
    with pytest.raises(ConfigError, match=r"type a formula of the wavelengths from 425 to 675 nm.*r650/r450"):
        painted(frame, aids, "")


@pytest.mark.parametrize(
    ("index", "error", "message"),
    [
        ("prri", ConfigError, "nearest: pri"),
        ("r650/", ConfigError, "r650/"),
        ("ndvi", SpectrumError, "needs 800 nm"),
    ],
)
def test_an_index_that_cannot_be_shown_says_why(frame, aids, index, error, message):
    with pytest.raises(error, match=message):
        painted(frame, aids, index)
