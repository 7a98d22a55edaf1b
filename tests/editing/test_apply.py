"""Recipes applied to a scene: what each edit does to materials, light and what another camera sees."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.editing.scenes import CAMERAS, LIGHT, edited, lit_scene, recipe, rendered, tensors_of
from tests.method_factory import NUM_BANDS, WAVELENGTHS_NM, make_scene
from unmix_plugin.editing import Light, Recipe, Remove, Scale, changes_geometry, edit_scene
from unmix_plugin.editing.apply import (
    _LitReflectance,
    _retinted,
    assumption_of_light,
    relighting_factors,
    with_sensor,
)
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, linear_to_srgb, rgb_matrix, xyz_matrix
from unmix_plugin.spectral.library.material_library import measured_library
from unmix_plugin.spectral.library.spectra_csv import SpectraTable
from unmix_plugin.spectral.sensor import Sensor
from unmix_plugin.trained.outputs import OUTPUTS, MaterialView
from unmix_plugin.trained.trained_scene import TrainedScene

BANDS = Bands.of(WAVELENGTHS_NM)
EVERY_KIND = [
    "swap: [0, 2]",
    "replace: {endmember: 1, library: ColorChecker/red}",
    "retint: {endmember: 0, colour: '#808070'}",
    "scale: {endmember: 2, factor: 0.5}",
    "remove: 1",
    "isolate: [0, 1]",
    "rename: {endmember: 0, name: clay}",
    "gloss: {scale: 0.3, colour: '#ffd080'}",
    "gloss: {endmember: 2, scale: 4}",
]


def named_scene() -> TrainedScene:
    """Three materials with names."""
    scene = lit_scene()
    return replace(scene, materials=replace(scene.materials, names=("red", "green", "blue")))


@pytest.mark.parametrize("edit", EVERY_KIND)
def test_an_edit_leaves_the_scene_as_it_was_and_shares_its_weights(edit):
    scene = lit_scene()
    before = {name: value.clone() for name, value in tensors_of(scene).items()}
    picture, names = rendered(scene), scene.materials.names
    result = edited(scene, edit, light="A")
    rendered(result)
    assert all(torch.equal(value, before[name]) for name, value in tensors_of(scene).items())
    assert (scene.materials.names, scene.notes) == (names, ())
    assert_close(rendered(scene), picture, rtol=0, atol=0)
    weights = {id(value) for value in scene.field.parameters()}
    assert {id(value) for value in result.field.parameters()} == weights
    assert result.renderer is scene.renderer


@pytest.mark.parametrize("specular", ["none", "dictionary", "full"])
def test_swapping_two_endmembers_twice_renders_the_original(specular):
    scene = lit_scene(specular=specular)
    once, twice = edited(scene, "swap: [0, 2]"), edited(scene, "swap: [0, 2]", "swap: [2, 0]")
    again = edited(once, "swap: [0, 2]")
    for view in range(2):
        original = rendered(scene, view)
        assert (rendered(once, view)["spectral"] - original["spectral"]).abs().max() > 0.05
        for result in (twice, again):
            assert_close(rendered(result, view), original, rtol=0, atol=1e-6)


def test_swapped_endmembers_exchange_their_looks_and_keep_their_places():
    scene = lit_scene()
    result = edited(scene, "swap: [endmember_0, 2]")
    assert torch.equal(result.materials.endmembers, scene.materials.endmembers[[2, 1, 0]])
    assert torch.equal(rendered(result)["abundances"], rendered(scene)["abundances"])


def test_a_replaced_endmember_is_the_materials_reflectance_in_the_scenes_light():
    result = edited(lit_scene(), "replace: {endmember: 1, library: ColorChecker/red}")
    expected = measured_library().reflectance("ColorChecker/red", BANDS) * np.array(LIGHT)
    assert_close(result.materials.endmembers[1], torch.tensor(expected, dtype=torch.float32))


def test_in_every_view_a_new_spectrum_shows_where_and_as_much_as_its_endmember_does():
    scene = lit_scene()
    result = edited(scene, "replace: {endmember: 1, library: ColorChecker/red}")
    change = result.materials.endmembers[1] - scene.materials.endmembers[1].detach()
    for view in range(2):
        coefficients = scene.look(CAMERAS[view]).coefficients
        expected = (
            rendered(scene, view)["spectral"] + coefficients.scaled_abundances[..., 1, None] * change
        ).detach()
        assert_close(rendered(result, view)["spectral"], expected, rtol=1e-5, atol=1e-6)


def write_paints(path, wavelengths=(440, 660)):
    rows = [f"{nm},0.1,0.{6 - index}" for index, nm in enumerate(wavelengths)]
    path.write_text("\n".join(["wavelength,dark,ochre", *rows]) + "\n")
    return path


def test_a_spectrum_from_a_file_is_found_by_name(tmp_path):
    path = write_paints(tmp_path / "paints.csv")
    result = edited(lit_scene(), f"replace: {{endmember: 0, file: {path}, spectrum: ochre}}")
    expected = np.interp(WAVELENGTHS_NM, [440, 660], [0.6, 0.5]) * np.array(LIGHT)
    assert_close(result.materials.endmembers[0], torch.tensor(expected, dtype=torch.float32))


def test_a_spectrum_that_does_not_reach_all_bands_is_extrapolated_only_when_asked(tmp_path):
    path = write_paints(tmp_path / "paints.csv", (480, 640))
    words = f"endmember: 0, file: {path}, spectrum: ochre"
    with pytest.raises(ConfigError) as caught:
        edited(lit_scene(), f"replace: {{{words}}}")
    assert "edits.yml, line 2 (replace): ochre" in str(caught.value)
    assert "30 nm below and 10 nm above their range" in str(caught.value)
    assert str(caught.value).endswith("extrapolate: true holds the outermost values instead")
    result = edited(lit_scene(), f"replace: {{{words}, extrapolate: true}}")
    reflectance = (result.materials.endmembers[0] / torch.tensor(LIGHT)).numpy()
    np.testing.assert_allclose(reflectance[[0, -1]], [0.6, 0.5], rtol=1e-5)


def test_a_scaled_endmember_shows_that_much_brighter():
    scene = lit_scene()
    result = edited(scene, "scale: {endmember: 2, factor: 0.25}", "scale: {endmember: 2, factor: 2}")
    expected = scene.materials.endmembers.detach() * torch.tensor([[1.0], [1.0], [0.5]])
    assert_close(result.materials.endmembers, expected)


def test_a_new_name_is_used_from_then_on_and_ends_up_in_tables():
    scene = lit_scene()
    result = edited(
        scene, "rename: {endmember: 1, name: red brick}", "scale: {endmember: red brick, factor: 0}"
    )
    table = result.materials.table()
    assert table.names == ("endmember_0", "red brick", "endmember_2")
    assert table.spectra[1].max() == 0
    assert result.materials.endmembers[0].max() > 0


def test_a_removed_endmember_is_nowhere_and_what_is_left_sums_to_the_opacity():
    scene = lit_scene()
    for view in range(2):
        before, after = rendered(scene, view), rendered(edited(scene, "remove: [1]"), view)
        assert after["abundances"][..., 1].abs().max() == 0
        assert_close(after["abundances"].sum(-1), after["accumulation"], rtol=1e-5, atol=1e-6)
        assert (after["accumulation"] <= before["accumulation"] + 1e-5).all()
        assert (before["accumulation"] - after["accumulation"]).max() > 0.01


def test_removing_some_is_isolating_the_others():
    scene = lit_scene()
    removed, isolated = edited(scene, "remove: [0, 2]"), edited(scene, "isolate: endmember_1")
    together = edited(scene, "remove: 0", "remove: 2")
    assert_close(rendered(removed), rendered(isolated))
    assert_close(rendered(removed), rendered(together))


def test_gloss_can_be_taken_away_without_a_trace_on_the_rest():
    scene = lit_scene()
    before = rendered(scene)
    for result in (
        edited(scene, "gloss: {scale: 0}"),
        edited(scene, *(f"gloss: {{endmember: {k}, scale: 0}}" for k in range(3))),
    ):
        after = rendered(result)
        assert before["specular"].max() > 1e-3
        assert after["specular"].abs().max() == 0
        assert_close(after["diffuse"], before["diffuse"])


@pytest.mark.parametrize("specular", ["dictionary", "full"])
def test_the_gloss_of_a_scene_is_the_sum_of_that_of_its_materials(specular):
    scene = lit_scene(specular=specular, num_specular_spectra=2)
    only = [
        edited(scene, *(f"gloss: {{endmember: {other}, scale: 0}}" for other in range(3) if other != k))
        for k in range(3)
    ]
    parts = [rendered(result)["specular"] for result in only]
    assert all(part.max() > 1e-4 for part in parts)
    assert_close(sum(parts), rendered(scene)["specular"], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("specular", ["dictionary", "full"])
def test_coloured_gloss_mirrors_the_highlights_of_one_material_or_of_all(specular):
    scene = lit_scene(specular=specular, num_specular_spectra=2)
    before = rendered(scene)
    for edit, part in (
        ("gloss: {colour: '#c0a060'}", before["specular"]),
        ("gloss: {endmember: 1, colour: '#c0a060'}", None),
    ):
        after = rendered(edited(scene, edit))
        ratio = after["specular"][before["specular"] > 1e-3] / before["specular"][before["specular"] > 1e-3]
        assert ratio.max() <= 1 + 1e-5
        assert ratio.min() > 0
        assert_close(after["diffuse"], before["diffuse"])
        if part is not None:
            mirror = edited(scene, edit).materials.specular_spectra.sum(
                0
            ) / scene.materials.specular_spectra.detach().sum(0)
            assert_close(after["specular"], part * mirror, rtol=1e-4, atol=1e-6)
    white = rendered(edited(scene, "gloss: {endmember: 1, colour: '#ffffff'}"))
    assert_close(white["specular"], before["specular"], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("edit", EVERY_KIND)
def test_coefficients_serve_again_where_geometry_does_not_change(edit):
    scene = lit_scene()
    made = recipe(edit, light="A")
    result = edit_scene(scene, made)
    coefficients = scene.look(CAMERAS[0]).coefficients
    assert changes_geometry(made) == edit.startswith(("remove", "isolate", "gloss: {endmember"))
    if not changes_geometry(made):
        view = MaterialView(result, CAMERAS[0], coefficients)
        assert_close(view["spectral"], rendered(result)["spectral"])


def test_an_edited_scene_can_be_edited_again():
    scene = lit_scene()
    twice = edited(
        edited(scene, "remove: 0", "gloss: {endmember: 1, scale: 0}"), "gloss: {endmember: 2, scale: 0}"
    )
    assert rendered(twice)["specular"].abs().max() == 0
    assert_close(rendered(twice)["diffuse"], rendered(edited(scene, "remove: 0"))["diffuse"])


def test_edits_without_effect_render_the_same():
    scene = lit_scene()
    same = edited(
        scene, "scale: {endmember: 0, factor: 1}", "gloss: {endmember: 1, scale: 1}", "gloss: {scale: 1}"
    )
    assert_close(rendered(same), rendered(scene), rtol=0, atol=0)


def test_another_light_multiplies_every_spectrum_by_the_same_ratio():
    scene = lit_scene()
    for specular in ("dictionary", "full"):
        scene = lit_scene(specular=specular)
        before, after = rendered(scene)["spectral"], rendered(edited(scene, light="A"))["spectral"]
        seen = before.mean(-1) > 0.05
        ratios = after[seen] / before[seen]
        assert_close(ratios, ratios[:1].expand_as(ratios), rtol=1e-4, atol=0)
        assert (ratios[0].diff() != 0).all()


def test_a_relit_scene_knows_its_light_so_that_reflectance_stays():
    scene = lit_scene()
    result = edit_scene(scene, Recipe(illuminant=Light("D65")))
    before = scene.materials.endmembers.detach() / torch.tensor(LIGHT)
    assert result.light is not None
    assert_close(result.materials.endmembers / result.light, before)
    assert_close(
        rendered(edit_scene(result, Recipe(illuminant=Light("A")))),
        rendered(edited(scene, light="A")),
        rtol=1e-4,
        atol=1e-5,
    )


def test_edits_are_made_in_the_scenes_light_before_another_is_lit():
    edit = "replace: {endmember: 1, library: ColorChecker/red}"
    together, one_by_one = edited(lit_scene(), edit, light="A"), edited(edited(lit_scene(), edit), light="A")
    assert_close(together.materials.endmembers, one_by_one.materials.endmembers)


def test_an_unknown_light_is_taken_as_flat_and_this_is_said():
    scene = make_scene(light=None)
    result = edited(scene, "replace: {endmember: 1, library: ColorChecker/red}")
    expected = torch.tensor(measured_library().reflectance("ColorChecker/red", BANDS), dtype=torch.float32)
    assert_close(result.materials.endmembers[1], expected)
    unknown, known = scene, lit_scene()
    for made in (recipe("replace: {endmember: 1, library: ColorChecker/red}"), recipe(light="A")):
        assert "taken as flat (CIE illuminant E)" in str(assumption_of_light(unknown, made))
        assert edit_scene(unknown, made).notes[0] == assumption_of_light(unknown, made)
        assert assumption_of_light(known, made) is None
    assert assumption_of_light(unknown, recipe("remove: 1")) is None


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        (["remove: ochre"], "there is no endmember 'ochre'; the run has 0 red, 1 green, 2 blue"),
        (["remove: geen"], "there is no endmember 'geen'; did you mean green?"),
        (["swap: [0, 3]"], "line 2 (swap): there is no endmember 3; the run has 0 red, 1 green, 2 blue"),
        (["swap: [0, -1]"], "there is no endmember -1"),
        (["swap: [1, green]"], "can't be swapped with itself"),
        (
            ["remove: 1", "isolate: [green, red]"],
            "'green' can't be isolated: edits.yml, line 2 (remove) has it removed",
        ),
        (
            ["isolate: 0", "remove: red"],
            "line 3 (remove): 'red' can't be removed: edits.yml, line 2 (isolate) has it isolated",
        ),
        (["isolate: 0", "isolate: 1"], "line 3 (isolate): edits.yml, line 2 (isolate) isolates already"),
        (["remove: [0, 1, 2]"], "nothing is left"),
        (
            ["replace: {endmember: 0, library: ColorChecker/red}"] * 2,
            "'red' is replaced already by edits.yml, line 2",
        ),
        (["retint: {endmember: 0, colour: '808080'}"] * 2, "'red' is retinted already by edits.yml, line 2"),
        (
            ["gloss: {colour: '808080'}", "gloss: {endmember: 2, colour: '808080'}"],
            "given a colour of gloss already",
        ),
        (["rename: {endmember: 1, name: red}"], "line 2 (rename): endmember 0 is called 'red' already"),
        (
            ["replace: {endmember: 0, library: ColorChecker/rde}"],
            "the library has no 'ColorChecker/rde'; nearest: ColorChecker/red",
        ),
    ],
)
def test_what_does_not_fit_the_run_or_contradicts_is_refused_with_its_line(edits, message):
    scene = named_scene()
    with pytest.raises(ConfigError) as caught:
        edited(scene, *edits)
    assert str(caught.value).startswith("edits.yml, line ")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("edit", "note"),
    [
        (
            "retint: {endmember: 0, colour: '#0000ff'}",
            r"retint\): red can't be #0000ff .* nearest colour, #[0-5]",
        ),
        ("gloss: {colour: '#00ff00'}", r"gloss\): highlights can't be #00ff00 in this light; took"),
    ],
)
def test_a_colour_that_no_surface_has_becomes_the_nearest_and_the_user_is_told(edit, note):
    scene = named_scene()
    [found] = edited(scene, edit).notes
    assert re.search(note, found)
    assert edited(scene, "retint: {endmember: 0, colour: '#807060'}").notes == ()


def test_a_swapped_look_may_be_replaced_where_it_is_now():
    scene = lit_scene()
    edit = "replace: {{endmember: {}, library: ColorChecker/{}}}"
    first, second = edit.format(0, "red"), edit.format(0, "green")
    result = edited(scene, first, "swap: [0, 1]", second)
    library = measured_library()
    for k, name in enumerate(["ColorChecker/green", "ColorChecker/red"]):
        expected = library.reflectance(name, BANDS) * np.array(LIGHT)
        assert_close(result.materials.endmembers[k], torch.tensor(expected, dtype=torch.float32))
    with pytest.raises(ConfigError, match="'endmember_1' is replaced already"):
        edited(scene, first, "swap: [0, 1]", edit.format(1, "green"))


def test_gloss_of_a_run_without_a_view_dependent_part_is_refused():
    with pytest.raises(ConfigError, match="no view-dependent part"):
        edited(lit_scene(specular="none"), "gloss: {scale: 2}")


def test_files_with_several_spectra_or_per_cent_are_refused(tmp_path):
    path = write_paints(tmp_path / "paints.csv")
    with pytest.raises(ConfigError, match=r"paints.csv has 2 spectra \(dark, ochre, ...\); choose one"):
        edited(lit_scene(), f"replace: {{endmember: 0, file: {path}}}")
    path.write_text("wavelength,ochre\n440,60\n660,50\n")
    with pytest.raises(ConfigError, match=r"ochre has reflectances of up to 59\.5"):
        edited(lit_scene(), f"replace: {{endmember: 0, file: {path}}}")


def test_recipes_made_in_code_are_pointed_at_by_position():
    made = Recipe((Scale(0, 1.0), Remove((NUM_BANDS,))))
    with pytest.raises(ConfigError, match=r"^recipe, edit 2 \(remove\): there is no endmember 5"):
        edit_scene(lit_scene(), made)


VISIBLE = Bands.of(np.linspace(400, 700, 31))
INFRARED = Bands.of(np.linspace(750, 1000, 26))


def factors_of(bands: Bands, recorded: np.ndarray | None, light: str) -> np.ndarray:
    """Of a light that covers all bands."""
    factors, notes = relighting_factors(bands, recorded, Light(light))
    assert notes == []
    return factors


def test_the_lights_own_spectrum_changes_nothing():
    np.testing.assert_allclose(factors_of(VISIBLE, None, "E"), 1.0)
    recorded = 0.3 * illuminant_power("FL2", VISIBLE)
    np.testing.assert_allclose(factors_of(VISIBLE, recorded, "FL2"), 1.0)


@pytest.mark.parametrize("name", ["A", "D65", "FL11", "HP1"])
def test_a_perfect_white_keeps_its_luminance_and_takes_the_lights_spectrum(name):
    recorded = illuminant_power("D50", VISIBLE)
    white = recorded * factors_of(VISIBLE, recorded, name)
    luminance = xyz_matrix(VISIBLE).numpy()[:, 1].astype(float)
    assert white @ luminance == pytest.approx(recorded @ luminance, rel=1e-6)
    np.testing.assert_allclose(white / white.max(), illuminant_power(name, VISIBLE))


def test_where_nothing_is_visible_the_mean_radiance_is_kept():
    factors = factors_of(INFRARED, None, "A")
    assert factors.mean() == pytest.approx(1.0, rel=1e-3)
    assert factors.std() > 0.01


def test_bands_that_the_scenes_own_light_left_dark_stay_dark_and_are_named():
    recorded = np.where(VISIBLE.centers_nm < 425, 0.0, 1.0)
    factors, [note] = relighting_factors(VISIBLE, recorded, Light("A"))
    assert (factors[:3] == 0).all()
    assert (factors[3:] > 0).all()
    assert "own light does not reach 3 of 31 bands, 400-700 nm (400 to 420 nm)" in note


def test_bands_that_the_new_light_does_not_reach_are_dark_and_the_others_are_lit_as_ever():
    wide = Bands.of(np.linspace(400, 1000, 61))
    factors, [note] = relighting_factors(wide, None, Light("D65"))
    assert (factors[:39] > 0).all()
    assert (factors[39:] == 0).all()
    assert "D65 is not known at 22 of 61 bands, 400-1000 nm (790 to 1000 nm): black there" in note
    assert "illuminant: {light: D65, extrapolate: true}" in note
    np.testing.assert_allclose(factors[:31], factors_of(VISIBLE, None, "D65"), rtol=0.02)


def test_a_light_without_luminance_keeps_the_mean_radiance_of_the_bands_that_it_reaches():
    factors, _ = relighting_factors(INFRARED, None, Light("D65"))
    assert factors[:4].mean() == pytest.approx(1.0, rel=0.05)
    assert (factors[4:] == 0).all()


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
    short = edit_scene(
        scene, Recipe(illuminant=Light("ISO 7589 Sensitometric Printer"))
    )  # known up to 560 nm
    [note] = short.notes
    assert "2 of 5 bands, 450-650 nm (600 to 650 nm): black there" in note
    view = short.render(CAMERAS[0], ["spectral", "rgb", "index:r650", "index:r500"])
    assert (view["spectral"][..., 3:] == 0).all()
    assert view["spectral"][..., :3].amax() > 0.1
    assert view["rgb"].isfinite().all()
    assert view["index:r650"].isnan().all()
    assert view["index:r500"].isfinite().any()


WIDE_BANDS = Bands.of(np.linspace(400, 700, 31))
WIDE_LIGHT = illuminant_power("D50", WIDE_BANDS)
TO_RGB = WIDE_LIGHT[:, None] * rgb_matrix(WIDE_BANDS, torch.float64).numpy()


def surface(name: str = "red", bands: Bands = WIDE_BANDS) -> _LitReflectance:
    return _LitReflectance(
        bands,
        measured_library().reflectance(f"ColorChecker/{name}", bands, "hold"),
        illuminant_power("D50", bands),
    )


def roughness(spectrum: np.ndarray) -> float:
    return float(np.square(np.diff(spectrum, n=2)).sum())


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(["red", "cyan", "white 9.5", "blue flower"]), st.integers(0, 2**32 - 1))
def test_the_colour_of_any_smooth_surface_can_be_given_to_any_other(name, seed):
    g = np.random.default_rng(seed)
    other = np.interp(WIDE_BANDS.centers_nm, np.linspace(400, 700, 6), g.uniform(0.05, 0.9, 6))
    changed = _retinted(surface(name), other @ TO_RGB)
    np.testing.assert_allclose(changed @ TO_RGB, other @ TO_RGB, atol=1e-5)
    assert changed.min() >= 0
    assert changed.max() <= 1


def test_asking_for_the_colour_that_it_has_changes_nothing():
    given_surface = surface("purple")
    changed = _retinted(given_surface, given_surface.reflectance @ TO_RGB)
    np.testing.assert_allclose(changed, given_surface.reflectance, atol=1e-9)


def test_no_random_change_to_the_same_colour_is_smoother():
    """Any admissible change differs from the smoothest by one that has no colour; adding such ones never helps."""
    given_surface = surface("foliage")
    target = surface("moderate red").reflectance * 0.8 @ TO_RGB
    changed = _retinted(given_surface, target)
    base = given_surface.reflectance + 0.05
    width = 10 / 300

    def cost(spectrum: np.ndarray) -> float:
        relative = (spectrum - given_surface.reflectance) / base
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
    wide = _LitReflectance(bands, reflectance, np.ones(len(bands)))
    changed = _retinted(wide, np.array([0.45, 0.35, 0.3]))
    ratio = changed / reflectance
    assert roughness(ratio) < 0.1 * roughness(reflectance)
    assert abs(ratio[-1] - 1) < 0.35 * np.abs(ratio[bands.centers_nm < 700] - 1).max()


def test_black_can_be_given_a_colour():
    black = _LitReflectance(WIDE_BANDS, np.zeros(len(WIDE_BANDS)), WIDE_LIGHT)
    target = np.array([0.3, 0.2, 0.1])
    np.testing.assert_allclose(_retinted(black, target) @ TO_RGB, target, atol=1e-5)


def encoded(linear_rgb: np.ndarray) -> np.ndarray:
    """As a display shows it."""
    return linear_to_srgb(torch.from_numpy(np.clip(linear_rgb, 0, 1))).numpy()


@pytest.mark.parametrize("colour", [[0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.05, 0.1, 0.8]])
def test_of_a_colour_out_of_reach_the_nearest_is_taken(colour):
    """No random surface within the bounds comes nearer on a display, first order of the sRGB curve aside."""
    wanted = np.array(colour)
    changed = _retinted(surface(), wanted, greatest=0.75)
    assert changed.min() >= 0
    assert changed.max() <= 0.75
    missed = np.linalg.norm(encoded(changed @ TO_RGB) - encoded(wanted))
    assert missed > 0.01
    g = np.random.default_rng(0)
    for _ in range(300):
        other = np.interp(WIDE_BANDS.centers_nm, np.linspace(400, 700, 7), g.choice([0, 0.75, 0.4], 7))
        assert np.linalg.norm(encoded(other @ TO_RGB) - encoded(wanted)) > 0.8 * missed


def test_a_higher_bound_reaches_brighter_colours():
    target = np.array([1.2, 1.1, 0.8])
    assert np.abs(_retinted(surface(), target) @ TO_RGB - target).max() > 0.05
    changed = _retinted(surface(), target, greatest=1.6)
    np.testing.assert_allclose(changed @ TO_RGB, target, atol=1e-5)
    assert 1 < changed.max() <= 1.6


SEEN_BANDS = Bands.of(WAVELENGTHS_NM)
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

MATRIX = torch.from_numpy(SENSOR.seen_by(SEEN_BANDS).matrix).float()
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
    names = [name for name in OUTPUTS if "derivative" not in name]  # of which three bands have none
    outputs = through.render(CAMERAS[0], [*names, "band:600nm", "false-colour:600,520,450"])
    nothing = outputs["accumulation"] < 0.5  # where reflectance is unknown
    assert all(torch.isfinite(values[~nothing]).all() for values in outputs.values())
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
    seen = SENSOR.seen_by(SEEN_BANDS)
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
    assert (scene.bands, scene.notes) == (SEEN_BANDS, notes)
    assert_close(rendered(scene), picture, rtol=0, atol=0)
    assert through.field is scene.field
    assert through.renderer is scene.renderer


def test_a_sensor_that_sees_nothing_is_refused():
    far = Sensor("far", SpectraTable(Bands.of([900, 950]), ("far",), np.ones((1, 2))))
    with pytest.raises(SpectrumError, match="'far' sees nothing: the bands cover 425-675 nm"):
        with_sensor(lit_scene(), far)
