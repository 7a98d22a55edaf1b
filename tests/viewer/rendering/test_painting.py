"""Layers are pictures of the coefficients and nothing else; settings stay within bounds whatever a browser sends."""

import math
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.factories.models import with_a_sky
from tests.factories.views import make_aids, make_frame, make_source, paint_layer
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.figures.look import BACKGROUNDS
from unmix_plugin.figures.paint import ColourScale, colour_table
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.trained import mixture_view
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.viewer.rendering import settings
from unmix_plugin.viewer.rendering.painting import LAYERS
from unmix_plugin.viewer.rendering.scene import MeasuredViews
from unmix_plugin.viewer.rendering.settings import LayerSettings

names = st.sampled_from([entry.name for entry in fields(LayerSettings) if entry.name != "mixed"])
anything = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text()),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=6,
)


@given(names, anything)
def test_settings_are_always_valid(name, value):
    found = LayerSettings().changed(name, value)
    assert isinstance(found.layer, str)
    for number, bounds in (
        (found.exposure, settings.EXPOSURE_BOUNDS),
        (found.gamma, settings.GAMMA_BOUNDS),
    ):
        assert bounds[0] <= number <= bounds[1]
    assert found.background in BACKGROUNDS
    assert found.colour_map in settings.COLOUR_MAPS
    assert found.highlights in settings.HIGHLIGHTS
    assert all(math.isfinite(value) for value in (found.wavelength_nm, *found.false_colour_nm))
    assert 0 <= found.endmember < 255
    assert len(found.index) <= 1000
    assert found.value_range is None or found.value_range[0] < found.value_range[1]


def test_sound_values_are_taken_as_they_are_and_a_range_that_is_none_leaves_the_one_before():
    found = LayerSettings()
    sound = {"layer": "pca", "wavelength_nm": 610.0, "false_colour_nm": (700.0, 600.0, 500.0), "endmember": 4}
    sound |= {"index": "(r800-r670)/(r800+r670)", "colour_map": "magma", "value_range": (-1.0, 2.0)}
    sound |= {"exposure": -2.5, "gamma": 2.2, "highlights": "kept", "background": "black"}
    for name, value in sound.items():
        found = found.changed(name, value)
        assert getattr(found, name) == value
    for nonsense in ((2.0, 1.0), (math.nan, 1.0), "ab", 3, (1.0,)):
        assert found.changed("value_range", nonsense).value_range == (-1.0, 2.0)
    assert found.changed("value_range", None).value_range is None


def test_a_formula_that_is_too_long_stays_too_long_rather_than_becoming_another_one():
    cut = LayerSettings().changed("index", "r600" + " " * 900 + "+r650" * 400)
    assert len(cut.index) == 1000
    kept = LayerSettings().changed("index", "r600" + " " * 2000 + "/ r650")
    assert kept.index == "r600 / r650"
    assert kept.changed("index", 3.0).index == "r600 / r650"


PAINTED = [name for name in LAYERS if name != "error"]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return make_source(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def frame(source):
    """A frame of which every pixel is somewhere between empty and solid."""
    return make_frame(source)


@pytest.fixture(scope="module")
def aids(source):
    return make_aids(source)


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """A frame of one material without gloss, and what layers need of it."""
    source = make_source(tmp_path_factory.mktemp("single"), num_endmembers=1, specular="none")
    return make_frame(source), make_aids(source)


def painted(frame, aids, layer, **settings) -> tuple[Any, Any]:
    """The picture of a layer, and its legend."""
    return paint_layer(frame, replace(LayerSettings(layer=layer, index="r600/r500"), **settings), aids)


def solid(frame):
    """The same view as if every ray ended fully on what it meets."""
    part = frame.coefficients.accumulation.clamp(min=1e-6)
    opaque = frame.map(lambda packed: packed / part[..., None])
    opaque.coefficients.accumulation.fill_(1)
    return opaque


@pytest.mark.parametrize("layer", PAINTED)
def test_every_layer_is_a_picture_that_shows_something_also_of_a_single_material(frame, aids, single, layer):
    picture, legend = painted(frame, aids, layer)
    assert picture.shape == (*frame.opacity.shape, 3)
    assert picture.flatten(0, 1).std(dim=0).max() > 0.01
    assert isinstance(legend, ColourScale | tuple | str)
    for shown in (picture, painted(single[0], single[1], layer)[0]):
        assert shown.isfinite().all()
        assert 0 <= shown.min() <= shown.max() <= 1


def test_colour_is_the_output_of_renders_mixed_with_the_background_in_linear_light(frame, aids):
    opaque = solid(frame)
    picture, legend = painted(opaque, aids, "rgb")
    assert_close(picture, opaque["rgb"], atol=1e-5, rtol=0)
    assert legend.startswith("true colour")
    half, _ = painted(opaque.map(lambda packed: packed / 2), aids, "rgb", background="white")
    assert_close(half, linear_to_srgb((opaque["linear_rgb"] + 1) / 2), atol=1e-4, rtol=0)


@pytest.mark.parametrize("layer", ["rgb", "false-colour", "band", "diffuse"])
def test_nothing_shines_through_a_sky(frame, aids, layer):
    def over(view, background):
        settings = {"background": background, "value_range": (0.0, 1.0), "colour_map": "gray"}
        return painted(view, aids, layer, **settings)[0]

    world = replace(frame, scene=replace(frame.scene, field=with_a_sky(frame.scene.field)))
    for view, is_alike in ((frame, False), (world, True)):
        assert torch.equal(over(view, "black"), over(view, "white")) is is_alike
    assert_close(over(world, "white"), over(frame, "black"), atol=0.02, rtol=0)


def test_bands_and_shares_are_painted_by_their_value_between_the_ends_of_the_scale(frame, aids):
    opaque, grey = solid(frame), {"colour_map": "gray"}
    picture, legend = painted(opaque, aids, "band", wavelength_nm=550.0, value_range=(0.0, 2.0), **grey)
    assert_close(picture[..., 0], (opaque["band:550"] / 2).clamp(0, 1), atol=4e-3, rtol=0)
    assert (legend.low, legend.high, legend.colour_map) == (0.0, 2.0, "gray")
    assert "550 nm" in legend.label
    picture, legend = painted(opaque, aids, "abundance", endmember=1, **grey)
    assert_close(picture[..., 1], opaque.coefficients.abundances[..., 1], atol=4e-3, rtol=0)
    assert legend.label == f"abundance of {opaque.materials.names[1]}"
    _, legend = painted(frame, aids, "false-colour", false_colour_nm=(649.0, 551.0, 449.0))
    assert legend == "red 650 nm, green 550 nm, blue 450 nm"


def test_wavelengths_beyond_the_bands_show_the_outermost_band(frame, aids):
    centers = frame.materials.bands.centers_nm
    for wavelength, center in ((1.0, float(centers[0])), (99_999.0, float(centers[-1]))):
        picture, legend = painted(frame, aids, "band", wavelength_nm=wavelength)
        assert_close(picture, painted(frame, aids, "band", wavelength_nm=center)[0])
        assert f"{center:.0f} nm" in legend.label


def test_pure_pixels_have_the_colours_of_all_figures(frame, aids):
    count, num_specular = len(frame.materials.names), frame.coefficients.specular.shape[-1]
    colours = torch.as_tensor(endmember_colours(frame.materials), dtype=torch.float32)
    pure, ones = torch.eye(count)[None], torch.ones(1, count)
    no_gloss = torch.zeros(1, count, num_specular)
    row = replace(frame, coefficients=Coefficients.of(ones, ones, pure, pure, no_gloss))
    for layer in ("abundances", "segmentation"):
        picture, legend = painted(row, aids, layer)
        assert_close(picture[0], colours, atol=1e-6, rtol=0)
        assert [name for name, _ in legend] == list(frame.materials.names)


@pytest.mark.parametrize("layer", [name for name in PAINTED if name != "accumulation"])
def test_where_nothing_is_the_background_shows(frame, aids, layer):
    nothing = frame.map(torch.zeros_like)
    for background, value in BACKGROUNDS.items():
        picture, _ = painted(nothing, aids, layer, background=background)
        assert_close(picture, torch.full_like(picture, value), atol=1e-5, rtol=0)


@pytest.mark.parametrize("layer", ["band", "index", "pca"])
def test_colours_mean_the_same_when_the_camera_moves(source, frame, aids, layer):
    whole, _ = painted(frame, aids, layer, index="1+r650")
    cropped, _ = painted(frame.map(lambda packed: packed[4:12, 6:18]), aids, layer, index="1+r650")
    assert_close(cropped, whole[4:12, 6:18], atol=1e-5, rtol=0)
    frames = [make_frame(source, source.record.train_cameras[index]) for index in range(3)]
    legends = [painted(one, aids, layer, index="1+r650")[1] for one in frames]
    assert len({str(legend) for legend in legends}) == 1


def test_an_error_is_painted_where_it_is_known(frame, aids, monkeypatch):
    values = torch.full_like(frame.coefficients.accumulation, 0.05)
    is_known = torch.zeros_like(values, dtype=torch.bool)
    is_known[3, 4] = True
    monkeypatch.setattr(MeasuredViews, "error", lambda *_: (values, is_known, "train_007"))
    known = replace(aids, measured=object.__new__(MeasuredViews))
    picture, legend = painted(frame, known, "error", value_range=(0.0, 0.1), background="white")
    assert_close(picture[3, 4], torch.tensor(colour_table("viridis")[128]).float(), atol=0.01, rtol=0)
    assert_close(picture[0, 0], torch.ones(3))
    assert "train_007" in legend.label


FORMULA = "(r650-r450)/(r650+r450)"


@pytest.mark.parametrize("light", [None, [0.2, 0.4, 0.6, 0.8, 1.0]])
def test_an_index_is_the_output_of_renders_over_the_background(frame, aids, light, monkeypatch):
    monkeypatch.setattr(mixture_view, "_CHUNK", 100)  # fewer than there are pixels
    lit = replace(frame.materials, light=None if light is None else torch.tensor(light))
    shown = replace(frame, scene=replace(frame.scene, materials=lit))
    values = shown[f"index:{FORMULA}"]
    assert 0.05 < float(values.isnan().float().mean()) < 0.95
    chosen = LayerSettings(layer="index", index=FORMULA, value_range=(-1.0, 1.0), background="white")
    picture, legend = paint_layer(shown, chosen, aids)
    opacity = frame.coefficients.accumulation * values.isfinite()
    levels = ((values.nan_to_num() + 1) / 2 * 256).long().clamp(0, 255)
    solid_colours = torch.from_numpy(colour_table("viridis")).float()[levels]
    part = opacity[..., None]
    assert_close(picture, solid_colours * part + 1 - part, atol=1e-5, rtol=0)
    assert_close(picture[values.isnan()], torch.ones_like(picture[values.isnan()]))
    assert isinstance(legend, ColourScale)
    assert ("of radiance, since the scene's light is unknown" in legend.label) == (light is None)


@pytest.mark.parametrize(("chosen", "shown"), [(None, (-0.2, 0.2)), ((0.0, 0.1), (0.0, 0.1))])
def test_a_named_index_has_its_usual_range_unless_one_is_chosen(frame, aids, chosen, shown):
    _, legend = painted(frame, aids, "index", index="pri", value_range=chosen)
    assert (legend.low, legend.high) == shown
    assert legend.label.startswith("photochemical reflectance index, (r531-r570)/(r531+r570)")


def test_odd_formulas_still_have_a_scale_and_a_short_label(frame, aids):
    for formula in ("r650-r650", "log(r650-r650)"):  # everywhere the same, nowhere defined
        picture, legend = painted(frame, aids, "index", index=formula)
        assert picture.isfinite().all()
        assert (legend.low, legend.high) == (0.0, 1.0)
        assert ("; undefined wherever something is" in legend.label) == (formula[:3] == "log")
    _, legend = painted(frame, aids, "index", index="+".join(["r650"] * 90))
    assert len(legend.label) < 240
    assert "..." in legend.label


@pytest.mark.parametrize(
    ("layer", "index", "error", "message"),
    [
        ("error", "", ConfigError, "no error to show: the scene is not at hand"),
        ("x-ray", "", ConfigError, "there is no layer named 'x-ray'; known: rgb, false-colour"),
        ("index", "", ConfigError, r"wavelengths that the bands cover, 425-675 nm, .*r650/r450"),
        ("index", "prri", ConfigError, "nearest: pri"),
        ("index", "ndvi", SpectrumError, "needs 800 nm"),
    ],
)
def test_what_cannot_be_shown_says_why(frame, aids, layer, index, error, message):
    with pytest.raises(error, match=message):
        painted(frame, aids, layer, index=index)
