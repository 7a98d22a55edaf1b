"""Recipes applied to a scene: what each edit does to materials, light and what another camera sees."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.edited_scenes import CAMERAS, LIGHT, edited, lit_scene, recipe, rendered, tensors_of
from tests.factories.models import NUM_BANDS, WAVELENGTHS_NM, make_scene
from unmix_plugin.editing import Light, Recipe, Remove, Scale, changes_geometry, edit_scene
from unmix_plugin.editing.apply import assumption_of_light
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import measured_library
from unmix_plugin.trained.trained_scene import MaterialView

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


def named_scene(specular="dictionary"):
    """Three materials with names."""
    scene = lit_scene(specular=specular)
    return replace(scene, materials=replace(scene.materials, names=("red", "green", "blue")))


@pytest.mark.parametrize("edit", EVERY_KIND)
def test_an_edit_leaves_the_scene_as_it_was_and_its_coefficients_serve_where_geometry_stays(edit):
    scene, made = lit_scene(), recipe(edit, light="A")
    before = {name: value.clone() for name, value in tensors_of(scene).items()}
    picture, names = rendered(scene), scene.materials.names
    result = edit_scene(scene, made)
    shown = rendered(result)
    assert all(torch.equal(value, before[name]) for name, value in tensors_of(scene).items())
    assert (scene.materials.names, scene.notes) == (names, ())
    assert_close(rendered(scene), picture, rtol=0, atol=0)
    weights = {id(value) for value in scene.field.parameters()}
    assert {id(value) for value in result.field.parameters()} == weights
    assert result.renderer is scene.renderer
    assert changes_geometry(made) == edit.startswith(("remove", "isolate", "gloss: {endmember"))
    if not changes_geometry(made):
        view = MaterialView(result, CAMERAS[0], scene.look(CAMERAS[0]).coefficients)
        assert_close(view["spectral"], shown["spectral"])


def test_names_can_be_exchanged():
    renames = [
        f"rename: {{endmember: {number}, name: {name}}}" for number, name in ((0, "green"), (1, "red"))
    ]
    assert edited(named_scene(), *renames).materials.names == ("green", "red", "blue")


@pytest.mark.parametrize("specular", ["none", "dictionary", "full"])
def test_swapped_endmembers_exchange_their_looks_and_twice_render_the_original(specular):
    scene = lit_scene(specular=specular)
    once, twice = edited(scene, "swap: [endmember_0, 2]"), edited(scene, "swap: [0, 2]", "swap: [2, 0]")
    assert torch.equal(once.materials.endmembers, scene.materials.endmembers[[2, 1, 0]])
    again = edited(once, "swap: [0, 2]")
    for view in range(2):
        original = rendered(scene, view)
        found = rendered(once, view)
        assert (found["spectral"] - original["spectral"]).abs().max() > 0.05
        assert torch.equal(found["abundances"], original["abundances"])
        for result in (twice, again):
            assert_close(rendered(result, view), original, rtol=0, atol=1e-6)


def test_in_every_view_a_new_spectrum_shows_where_and_as_much_as_its_endmember_does():
    scene, edit = lit_scene(), "replace: {endmember: 1, library: ColorChecker/red}"
    result = edited(scene, edit)
    reflectance = measured_library().reflectance("ColorChecker/red", BANDS) * np.array(LIGHT)
    assert_close(result.materials.endmembers[1], torch.tensor(reflectance, dtype=torch.float32))
    change = result.materials.endmembers[1] - scene.materials.endmembers[1].detach()
    for view in range(2):
        shares = scene.look(CAMERAS[view]).coefficients.scaled_abundances[..., 1, None]
        expected = (rendered(scene, view)["spectral"] + shares * change).detach()
        assert_close(rendered(result, view)["spectral"], expected, rtol=1e-5, atol=1e-6)
    # Edits are made in the scene's light before another is lit.
    together, one_by_one = edited(scene, edit, light="A"), edited(result, light="A")
    assert_close(together.materials.endmembers, one_by_one.materials.endmembers)


def paints(path, wavelengths=(440, 660), ochre=(0.6, 0.5)):
    """The reflectances of two paints in a file, and the edit that takes one."""
    rows = [f"{nm},0.1,{value}" for nm, value in zip(wavelengths, ochre, strict=True)]
    path.write_text("\n".join(["wavelength,dark,ochre", *rows]) + "\n")
    return f"replace: {{endmember: 0, file: {path}%s}}"


def test_a_spectrum_from_a_file_is_found_by_name_and_extrapolated_only_when_asked(tmp_path):
    path, scene, held = tmp_path / "paints.csv", lit_scene(), ", spectrum: ochre, extrapolate: true"
    result = edited(scene, paints(path) % ", spectrum: ochre")
    expected = np.interp(WAVELENGTHS_NM, [440, 660], [0.6, 0.5]) * np.array(LIGHT)
    assert_close(result.materials.endmembers[0], torch.tensor(expected, dtype=torch.float32))
    assert edited(scene, paints(path) % held).notes == ()
    result = edited(scene, paints(path, (480, 640)) % held)
    reflectance = (result.materials.endmembers[0] / torch.tensor(LIGHT)).numpy()
    np.testing.assert_allclose(reflectance[[0, -1]], [0.6, 0.5], rtol=1e-5)
    (note,) = result.notes
    assert "ochre was not measured at 2 of 5 bands" in note


def test_doubtful_files_of_spectra_are_refused(tmp_path):
    def refuse(said, spectrum=", spectrum: ochre", **columns):
        with pytest.raises(ConfigError, match=r"^edits.yml, line 2 \(replace\): .*" + said):
            edited(lit_scene(), paints(tmp_path / "paints.csv", **columns) % spectrum)

    refuse(r"paints.csv has 2 spectra \(dark, ochre, ...\); choose one", "")
    refuse(r"ochre must be in reflectances, 1 for white; found 59\.5", ochre=(60, 50))
    held = "extrapolate: true holds the outermost values instead$"
    refuse(f"ochre.* 30 nm below and 10 nm above their range.*{held}", wavelengths=(480, 640))
    refuse(
        "dark must be in reflectances, 1 for white; found 55 in its file", ", spectrum: dark", ochre=(60, 50)
    )


def test_a_scaled_endmember_is_that_much_brighter_by_its_new_name_which_ends_up_in_tables():
    scene = lit_scene()
    scale = "scale: {endmember: red brick, factor: %s}"
    result = edited(scene, "rename: {endmember: 1, name: red brick}", scale % 0.25, scale % 2)
    expected = scene.materials.endmembers.detach() * torch.tensor([[1.0], [0.5], [1.0]])
    assert_close(result.materials.endmembers, expected)
    assert result.materials.table().names == (scene.materials.names[0], "red brick", scene.materials.names[2])
    same = edited(
        scene, "scale: {endmember: 0, factor: 1}", "gloss: {endmember: 1, scale: 1}", "gloss: {scale: 1}"
    )
    assert_close(rendered(same), rendered(scene), rtol=0, atol=0)


def test_a_removed_endmember_is_nowhere_and_removing_some_is_isolating_the_others():
    scene = lit_scene()
    isolated = rendered(edited(scene, "isolate: endmember_1"))
    for edits in (["remove: [0, 2]"], ["remove: 0", "remove: 2"]):
        assert_close(rendered(edited(scene, *edits)), isolated)
    for view in range(2):
        before, after = rendered(scene, view), rendered(edited(scene, "remove: [1]"), view)
        assert after["abundances"][..., 1].abs().max() == 0
        assert_close(after["abundances"].sum(-1), after["accumulation"], rtol=1e-5, atol=1e-6)
        assert (after["accumulation"] <= before["accumulation"] + 1e-5).all()
        assert (before["accumulation"] - after["accumulation"]).max() > 0.01


def test_gloss_can_be_taken_away_without_a_trace_on_the_rest():
    scene, none = lit_scene(), "gloss: {{endmember: {}, scale: 0}}".format
    before = rendered(scene)
    assert before["specular"].max() > 1e-3
    for result in (edited(scene, "gloss: {scale: 0}"), edited(scene, none(0), none(1), none(2))):
        after = rendered(result)
        assert after["specular"].abs().max() == 0
        assert_close(after["diffuse"], before["diffuse"])
    # An edited scene can be edited again.
    twice = rendered(edited(edited(scene, "remove: 0", none(1)), none(2)))
    assert twice["specular"].abs().max() == 0
    assert_close(twice["diffuse"], rendered(edited(scene, "remove: 0"))["diffuse"])


@pytest.mark.parametrize("specular", ["dictionary", "full"])
def test_gloss_is_the_sum_of_that_of_all_materials_and_mirrors_in_the_colour_of_one_or_of_all(specular):
    scene = lit_scene(specular=specular, num_specular_spectra=2)
    before = rendered(scene)
    shiny = before["specular"] > 1e-3
    for whose in ("", "endmember: 1, "):
        result = edited(scene, f"gloss: {{{whose}colour: '#c0a060'}}")
        after = rendered(result)
        ratio = after["specular"][shiny] / before["specular"][shiny]
        assert 0 < ratio.min() <= ratio.max() <= 1 + 1e-5
        assert_close(after["diffuse"], before["diffuse"])
        if not whose:
            mirror, lamp = (one.materials.specular_spectra.detach().sum(0) for one in (result, scene))
            assert_close(after["specular"], before["specular"] * mirror / lamp, rtol=1e-4, atol=1e-6)
    off = [f"gloss: {{endmember: {k}, scale: 0}}" for k in range(3)]
    parts = [rendered(edited(scene, *off[:k], *off[k + 1 :]))["specular"] for k in range(3)]
    assert all(part.max() > 1e-4 for part in parts)
    assert_close(sum(parts), before["specular"], rtol=1e-4, atol=1e-6)
    white = rendered(edited(scene, "gloss: {endmember: 1, colour: '#ffffff'}"))
    assert_close(white["specular"], before["specular"], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("specular", ["dictionary", "full"])
def test_another_light_multiplies_every_spectrum_by_the_same_ratio(specular):
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
    again = edit_scene(result, Recipe(illuminant=Light("A")))
    assert_close(rendered(again), rendered(edited(scene, light="A")), rtol=1e-4, atol=1e-5)


def test_an_unknown_light_is_taken_as_flat_and_this_is_said():
    unknown, known = make_scene(light=None), lit_scene()
    replacement = recipe("replace: {endmember: 1, library: ColorChecker/red}")
    expected = torch.tensor(measured_library().reflectance("ColorChecker/red", BANDS), dtype=torch.float32)
    assert_close(edit_scene(unknown, replacement).materials.endmembers[1], expected)
    for made in (replacement, recipe(light="A")):
        assert "taken as flat (CIE illuminant E)" in str(assumption_of_light(unknown, made))
        assert edit_scene(unknown, made).notes[0] == assumption_of_light(unknown, made)
        assert assumption_of_light(known, made) is None
    assert assumption_of_light(unknown, recipe("remove: 1")) is None


REPLACE, RETINT, COLOURED = (
    "replace: {endmember: 0, library: ColorChecker/%s}",
    "retint: {endmember: 0, colour: '808080'}",
    "gloss: {%scolour: '808080'}",
)
REFUSED = [
    (["remove: ochre"], "there is no endmember 'ochre'; the run has 0 red, 1 green, 2 blue"),
    (["remove: geen"], "there is no endmember 'geen'; did you mean green?"),
    (["swap: [0, 3]"], "line 2 (swap): there is no endmember 3; the run has 0 red, 1 green, 2 blue"),
    (["swap: [0, -1]"], "there is no endmember -1"),
    (["swap: [1, green]"], "can't be swapped with itself"),
    (["remove: 1", "isolate: [green, red]"], "'green' can't be isolated: edits.yml, line 2 (remove) has it"),
    (["isolate: 0", "remove: red"], "line 3 (remove): 'red' can't be removed: edits.yml, line 2 (isolate)"),
    (["isolate: 0", "isolate: 1"], "line 3 (isolate): edits.yml, line 2 (isolate) isolates already"),
    (["remove: [0, 1, 2]"], "nothing is left"),
    ([REPLACE % "red"] * 2, "'red' can't be replaced: edits.yml, line 2 (replace) has it replaced already"),
    ([RETINT] * 2, "'red' can't be retinted: edits.yml, line 2 (retint) has it retinted already"),
    ([COLOURED % "", COLOURED % "endmember: 2, "], "(gloss) has it given a colour of gloss already"),
    (["rename: {endmember: 1, name: red}"], "line 2 (rename): endmembers 0 and 1 would both be called 'red'"),
    (["rename: {endmember: 1, name: red}", "swap: [red, 2]"], "two endmembers are called 'red' here"),
    ([REPLACE % "rde"], "no 'ColorChecker/rde'; nearest: ColorChecker/red"),
    (["gloss: {scale: 2}"], "no view-dependent part"),
]


@pytest.mark.parametrize(("edits", "message"), REFUSED)
def test_what_does_not_fit_the_run_or_contradicts_is_refused_with_its_line(edits, message):
    scene = named_scene("none" if "view-dependent" in message else "dictionary")
    with pytest.raises(ConfigError) as caught:
        edited(scene, *edits)
    assert str(caught.value).startswith("edits.yml, line ")
    assert message in str(caught.value)
    in_code = Recipe((Scale(0, 1.0), Remove((NUM_BANDS,))))
    with pytest.raises(ConfigError, match=r"^recipe, edit 2 \(remove\): there is no endmember 5"):
        edit_scene(scene, in_code)


@pytest.mark.parametrize(
    ("edit", "note"),
    [
        ("retint: {endmember: 0, colour: '#0000ff'}", r"retint\): red can't be #0000ff .* colour, #[0-5]"),
        ("gloss: {colour: '#00ff00'}", r"gloss\): highlights can't be #00ff00 in this light; took"),
    ],
)
def test_a_colour_that_no_surface_has_becomes_the_nearest_and_the_user_is_told(edit, note):
    [found] = edited(named_scene(), edit).notes
    assert re.search(note, found)
    assert edited(named_scene(), "retint: {endmember: 0, colour: '#807060'}").notes == ()


def test_a_swapped_look_may_be_replaced_where_it_is_now():
    scene = lit_scene()
    result = edited(scene, REPLACE % "red", "swap: [0, 1]", REPLACE % "green")
    for k, name in enumerate(["ColorChecker/green", "ColorChecker/red"]):
        expected = measured_library().reflectance(name, BANDS) * np.array(LIGHT)
        assert_close(result.materials.endmembers[k], torch.tensor(expected, dtype=torch.float32))
    with pytest.raises(ConfigError, match=f"'{scene.materials.names[1]}' can't be replaced"):
        edited(scene, REPLACE % "red", "swap: [0, 1]", "replace: {endmember: 1, library: ColorChecker/green}")
