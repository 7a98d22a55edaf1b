"""Another light, another colour and another sensor: what they make of spectra, and the scene seen through them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.factories.edited_scenes import CAMERAS, LIGHT, edited, lit_scene, rendered, tensors_of
from tests.factories.models import WAVELENGTHS_NM, make_scene
from unmix_plugin.editing import Light, Recipe, edit_scene
from unmix_plugin.editing.apply import relighting_factors, retinted, with_sensor
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, linear_to_srgb, rgb_matrix, xyz_matrix
from unmix_plugin.spectral.library.material_library import measured_library
from unmix_plugin.spectral.library.spectra_csv import SpectraTable
from unmix_plugin.spectral.sensor import SpectralResponses
from unmix_plugin.trained.plain_outputs import OUTPUTS

BANDS = Bands.of(WAVELENGTHS_NM)
VISIBLE = Bands.of(np.linspace(400, 700, 31))
INFRARED = Bands.of(np.linspace(750, 1000, 26))


def factors_of(bands, recorded, light):
    """Of a light that covers all bands."""
    factors, notes = relighting_factors(bands, recorded, Light(light))
    assert notes == []
    return factors


def test_the_lights_own_spectrum_changes_nothing():
    for recorded, name in ((None, "E"), (0.3 * illuminant_power("FL2", VISIBLE), "FL2")):
        np.testing.assert_allclose(factors_of(VISIBLE, recorded, name), 1.0)


@pytest.mark.parametrize("name", ["A", "FL11"])
def test_a_perfect_white_keeps_its_luminance_and_takes_the_lights_spectrum(name):
    recorded = illuminant_power("D50", VISIBLE)
    white = recorded * factors_of(VISIBLE, recorded, name)
    luminance = xyz_matrix(VISIBLE).numpy()[:, 1].astype(float)
    assert white @ luminance == pytest.approx(recorded @ luminance, rel=1e-6)
    np.testing.assert_allclose(white / white.max(), illuminant_power(name, VISIBLE))


def test_where_nothing_is_visible_the_mean_radiance_is_kept_in_the_bands_that_the_light_reaches():
    factors = factors_of(INFRARED, None, "A")
    assert factors.mean() == pytest.approx(1.0, rel=1e-3)
    assert factors.std() > 0.01
    factors, _ = relighting_factors(INFRARED, None, Light("D65"))
    assert factors[:4].mean() == pytest.approx(1.0, rel=0.05)
    assert (factors[4:] == 0).all()


def test_bands_that_either_light_does_not_reach_are_dark_and_named_and_the_others_are_lit_as_ever():
    recorded = np.where(VISIBLE.centers_nm < 425, 0.0, 1.0)
    factors, [note] = relighting_factors(VISIBLE, recorded, Light("A"))
    assert ((factors > 0) == (recorded > 0)).all()
    assert "own light does not reach 3 of 31 bands, 400-700 nm (400 to 420 nm)" in note
    wide = Bands.of(np.linspace(400, 1000, 61))
    factors, [note] = relighting_factors(wide, None, Light("D65"))
    assert ((factors > 0) == (np.arange(61) < 39)).all()
    assert "D65 is not known at 22 of 61 bands, 400-1000 nm (790 to 1000 nm): black there" in note
    assert "illuminant: {light: D65, extrapolate: true}" in note
    np.testing.assert_allclose(factors[:31], factors_of(VISIBLE, None, "D65"), rtol=0.02)


def test_a_light_may_be_held_beyond_what_is_known_of_it_and_must_be_where_nothing_is():
    beyond = Bands.of(np.linspace(800, 1000, 21))
    factors, notes = relighting_factors(beyond, None, Light("D65", extrapolate=True))
    np.testing.assert_allclose(factors, 1.0)
    assert notes == []
    with pytest.raises(SpectrumError, match=r"light D65 is not known in 21 bands.*extrapolate: true"):
        relighting_factors(beyond, None, Light("D65"))


def test_an_invisible_light_cannot_be_as_bright_as_before(tmp_path):
    path = tmp_path / "lamp.csv"
    path.write_text("wavelength,power\n350,1\n355,0\n1000,0\n")
    with pytest.raises(SpectrumError, match="no power in any of 31 bands"):
        relighting_factors(VISIBLE, None, Light(path))
    with pytest.raises(SpectrumError, match=r"gone\.csv: can't read spectra"):
        relighting_factors(VISIBLE, None, Light(tmp_path / "gone.csv"))


def test_a_scene_relit_by_a_light_that_ends_among_its_bands_renders_and_says_which_are_black():
    scene = lit_scene()
    until_560_nm = Light("ISO 7589 Sensitometric Printer")
    short = edit_scene(scene, Recipe(illuminant=until_560_nm))
    [note] = short.notes
    assert "2 of 5 bands, 450-650 nm (600 to 650 nm): black there" in note
    view = short.render(CAMERAS[0], ["spectral", "rgb", "index:r650", "index:r500"])
    assert (view["spectral"][..., 3:] == 0).all()
    assert view["spectral"][..., :3].amax() > 0.1
    assert view["rgb"].isfinite().all()
    assert view["index:r650"].isnan().all()
    assert view["index:r500"].isfinite().any()


def test_spectra_in_a_flat_light_are_reflectance_only_where_a_white_is_1():
    lit = edited(lit_scene(), light="E")
    assert lit.light is not None
    assert_close(lit.light, lit.light.max().expand(5))
    assert lit.light.max() < 0.95
    assert lit.materials.quantity == "radiance"
    assert lit.output("spectral").what.startswith("radiance on black")
    assert "reflectance" in [one.name for one in lit.outputs]
    assert edited(make_scene(light=[1.0] * 5), light="E").materials.quantity == "reflectance"
    assert edited(make_scene(light=[1.0] * 5), light="A").materials.quantity == "radiance"


def test_an_unknown_light_stays_unknown_in_any_other():
    unknown = make_scene()
    for light in ("E", "A"):
        lit = edited(edited(unknown, light=light), "rename: {endmember: 0, name: clay}", light=light)
        assert lit.materials.quantity == "radiance"
        assert not with_sensor(lit, SENSOR).materials.is_light_known
        assert lit.output("spectral").what.startswith("radiance on black")
        assert "of radiance, since the scene's light is unknown" in lit.output("continuum").what
        with pytest.raises(SpectrumError, match="the scene's light is unknown"):
            lit.output("reflectance")
        assert sum("taken as flat" in note for note in lit.notes) == 2  # each time that it is lit


TO_RGB = illuminant_power("D50", VISIBLE)[:, None] * rgb_matrix(VISIBLE, torch.float64).numpy()


def surface(name):
    if name == "black":
        return np.zeros(len(VISIBLE))
    return measured_library().reflectance(f"ColorChecker/{name}", VISIBLE, "hold")


def recoloured(reflectance, linear_rgb, greatest=1.0):
    return retinted(VISIBLE, reflectance, TO_RGB, linear_rgb, greatest)


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(["red", "cyan", "white 9.5", "blue flower", "black"]), st.integers(0, 2**32 - 1))
def test_the_colour_of_any_smooth_surface_can_be_given_to_any_other(name, seed):
    g, own = np.random.default_rng(seed), surface(name)
    other = np.interp(VISIBLE.centers_nm, np.linspace(400, 700, 6), g.uniform(0.05, 0.9, 6))
    changed = recoloured(own, other @ TO_RGB)
    np.testing.assert_allclose(changed @ TO_RGB, other @ TO_RGB, atol=1e-5)
    assert 0 <= changed.min() <= changed.max() <= 1
    np.testing.assert_allclose(recoloured(own, own @ TO_RGB), own, atol=1e-9)


def test_no_random_change_to_the_same_colour_is_smoother():
    """Any admissible change differs from the smoothest by one that has no colour; adding such ones never helps."""
    own = surface("foliage")
    changed = recoloured(own, surface("moderate red") * 0.8 @ TO_RGB)
    width = 10 / 300

    def cost(spectrum: np.ndarray) -> float:
        relative = (spectrum - own) / (own + 0.05)
        return float(np.square(np.diff(relative)).sum() / width + np.square(relative).sum() * width)

    colourless = np.linalg.svd(TO_RGB.T)[2][3:]
    g = np.random.default_rng(0)
    for _ in range(200):
        step = 1e-3 * g.normal(size=len(colourless)) @ colourless
        if (changed + step).min() >= 0 and (changed + step).max() <= 1:
            assert cost(changed + step) >= cost(changed) * (1 - 1e-6)


def test_a_change_of_colour_keeps_the_fine_structure_and_leaves_the_infrared_alone():
    bands = Bands.of(np.linspace(400, 1000, 121))
    reflectance = np.clip(0.4 + 0.03 * np.sin(bands.centers_nm / 4), 0, 1)
    to_rgb = rgb_matrix(bands, torch.float64).numpy()
    ratio = retinted(bands, reflectance, to_rgb, np.array([0.45, 0.35, 0.3])) / reflectance
    roughness, own = (np.square(np.diff(one, n=2)).sum() for one in (ratio, reflectance))
    assert roughness < 0.1 * own
    assert abs(ratio[-1] - 1) < 0.35 * np.abs(ratio[bands.centers_nm < 700] - 1).max()


def encoded(linear_rgb: np.ndarray) -> np.ndarray:
    """As a display shows it."""
    return linear_to_srgb(torch.from_numpy(np.clip(linear_rgb, 0, 1))).numpy()


@pytest.mark.parametrize("colour", [[0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.05, 0.1, 0.8]])
def test_of_a_colour_out_of_reach_the_nearest_is_taken(colour):
    """No random surface within the bounds comes nearer on a display, first order of the sRGB curve aside."""
    wanted = np.array(colour)
    changed = recoloured(surface("red"), wanted, greatest=0.75)
    assert 0 <= changed.min() <= changed.max() <= 0.75
    missed = np.linalg.norm(encoded(changed @ TO_RGB) - encoded(wanted))
    assert missed > 0.01
    g = np.random.default_rng(0)
    for _ in range(300):
        other = np.interp(VISIBLE.centers_nm, np.linspace(400, 700, 7), g.choice([0, 0.75, 0.4], 7))
        assert np.linalg.norm(encoded(other @ TO_RGB) - encoded(wanted)) > 0.8 * missed


def test_a_higher_bound_reaches_brighter_colours():
    target = np.array([1.2, 1.1, 0.8])
    assert np.abs(recoloured(surface("red"), target) @ TO_RGB - target).max() > 0.05
    changed = recoloured(surface("red"), target, greatest=1.6)
    np.testing.assert_allclose(changed @ TO_RGB, target, atol=1e-5)
    assert 1 < changed.max() <= 1.6


CHANNELS = {
    "red": [0, 0, 0, 1, 0.6, 0, 0, 0, 0],
    "green": [0, 0.3, 1, 0.2, 0, 0, 0, 0, 0],
    "blue": [0.9, 1, 0, 0, 0, 0, 0, 0, 0],
    "far": [0, 0, 0, 0, 0, 0, 0, 1.0, 1],
}
AT_NM = [430, 470, 520, 580, 670, 671, 899, 900, 950]
SENSOR = SpectralResponses(
    "toy", SpectraTable(Bands.of(AT_NM), tuple(CHANNELS), np.array([*CHANNELS.values()]))
)
"""Three channels that the bands cover, and one that they don't."""

MATRIX = torch.from_numpy(SENSOR.seen_by(BANDS).matrix).float()

SAME = ("abundances", "segmentation", "confidence", "accumulation", "depth", "normals")


@pytest.mark.parametrize("specular", ["none", "dictionary", "full"])
@pytest.mark.parametrize("is_edited", [False, True])
def test_rendering_through_the_sensor_is_rendering_spectra_and_seeing_them_through_it(specular, is_edited):
    scene = lit_scene(specular=specular)
    if is_edited:
        gloss = [] if specular == "none" else ["gloss: {endmember: 2, scale: 4, colour: '#ffd080'}"]
        scene = edited(scene, "swap: [0, 2]", "remove: 1", *gloss, light="A")
    kept, notes = {name: value.clone() for name, value in tensors_of(scene).items()}, scene.notes
    through = with_sensor(scene, SENSOR)
    assert through.field is scene.field
    assert through.renderer is scene.renderer
    for view in range(2):
        before, after = rendered(scene, view), rendered(through, view)
        assert after["spectral"].shape == (10, 12, 3)
        assert after["spectral"].max() > 0.05
        for name in ("spectral", "diffuse", "specular"):
            assert_close(after[name], (before[name] @ MATRIX).detach(), rtol=0, atol=1e-5)
    before, after = scene.render(CAMERAS[0], SAME), through.render(CAMERAS[0], SAME)
    assert all(torch.equal(after[name], before[name]) for name in SAME)
    assert all(torch.equal(value, kept[name]) for name, value in tensors_of(scene).items())
    assert (scene.bands, scene.notes) == (BANDS, notes)


def test_every_output_can_be_rendered_through_the_sensor_in_its_bands_and_colours():
    through = with_sensor(edited(lit_scene(), "gloss: {colour: '#00ff00'}"), SENSOR)
    seen = SENSOR.seen_by(BANDS)
    assert through.bands == through.materials.bands == seen.bands
    names = [
        name for name in OUTPUTS if "derivative" not in name and name != "unexplained"
    ]  # three bands, no views
    outputs = through.render(CAMERAS[0], [*names, "band:600nm", "false-colour:600,520,450"])
    nothing = outputs["accumulation"] < 0.5  # where reflectance is unknown
    assert all(torch.isfinite(values[~nothing]).all() for values in outputs.values())
    spectra = outputs["spectral"]
    assert_close(outputs["rgb"], linear_to_srgb((spectra @ rgb_matrix(seen.bands)).clamp(0, 1)))
    assert_close(outputs["band:600nm"], spectra[..., 2])
    assert_close(outputs["false-colour:600,520,450"], spectra.flip(-1).clamp(0, 1))
    edit_note, description, left_out = through.notes
    assert "highlights can't be #00ff00" in edit_note
    assert description.startswith("seen through toy: blue 4")
    assert left_out == "left out far (900-950 nm): the bands cover 425-675 nm"
    far = SpectralResponses("far", SpectraTable(Bands.of([900, 950]), ("far",), np.ones((1, 2))))
    with pytest.raises(SpectrumError, match="'far' sees nothing: the bands cover 425-675 nm"):
        with_sensor(lit_scene(), far)


def test_reflectance_under_the_sensor_is_radiance_over_light_both_seen_through_it():
    scene = lit_scene()
    through = with_sensor(scene, SENSOR)
    light = through.light
    assert light is not None
    assert_close(light, torch.tensor(LIGHT) @ MATRIX)
    assert with_sensor(make_scene(), SENSOR).light is None
    greys = (0.25 * torch.tensor(LIGHT)).expand(3, 5)  # in that light
    grey = with_sensor(replace(scene, materials=replace(scene.materials, endmembers=greys)), SENSOR)
    assert_close(grey.materials.endmembers / light, torch.full((3, 3), 0.25))
