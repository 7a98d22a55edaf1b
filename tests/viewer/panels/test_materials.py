"""Edits of materials and light: each one of the recipe, undone, saved, loaded, or refused and said."""

import threading

import numpy as np
import pytest
import torch

from tests.factories.models import make_model
from tests.factories.viewers import decoded, opened, serving, show_layer
from tests.factories.views import source_of_model
from unmix_plugin.editing import Light, Recipe, Retint
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_names
from unmix_plugin.spectral.library.material_library import LibraryMaterial, MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.viewer.panels.materials import likeness_rows
from unmix_plugin.viewer.rendering.scene import Edit


def source_of_bands(folder, *centers_nm):
    """A model of other bands."""
    model, bands = make_model(), Bands.of(list(centers_nm))
    model.bands = bands
    model.metadata = {**model.metadata, "wavelengths_nm": bands.centers_nm.tolist()}
    return source_of_model(model, folder)


def test_materials_are_edited_undone_saved_and_loaded(viewer):
    with opened(viewer) as page, opened(viewer) as other:
        before, count = decoded(page.last_picture), len(other.pictures)
        page.set("brightness", 4.0)
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).max() > 10)
        page.wait_until(lambda: "scale" in page.props("recipe")["value"])
        page.set("save as", "../../bright")
        page.set("save")
        page.wait_until(lambda: bool(page.downloads))
        saved = list((viewer.services.source.run.path / "recipes").glob("[!.]*"))
        assert [path.name for path in saved] == ["bright.yml"]
        page.set("changes", "undo")
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).max() < 3)
        page.set("load")
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).max() > 10)
        assert len(other.pictures) == count  # another page's materials are its own


NO_EDITS = "edits: []\n"


CHANGES = (
    ("visible", False, "remove"),
    ("only this one", True, "isolate"),
    ("gloss", 0.5, "gloss"),
    ("colour of gloss", (255, 200, 0), "gloss"),
    ("colour", (120, 110, 100), "retint"),
    ("name", "clay", "name: clay"),
    ("replace by the known material", True, "library: ColorChecker/red"),
    ("swap with the other", True, "swap: [0, 2]"),
    ("light", "FL2: cool white fluorescent lamp, 4230 K", "illuminant: FL2"),
)


@pytest.mark.slow
def test_every_change_is_an_edit_of_the_recipe_and_can_be_undone(page):
    recipe = page.props("recipe")
    assert page.props("known material")["value"] == "choose one"
    page.set("known material", "ColorChecker/red")
    for label, value, written in CHANGES:
        for control, action in ((label, value), ("changes", "redo")):
            page.set(control, action)
            page.wait_until(lambda written=written: written in recipe["value"])
            page.set("changes", "undo")
            page.wait_until(lambda: recipe["value"] == NO_EDITS)
    assert not any(title == "not done" for title, _ in page.notices)


@pytest.mark.slow
def test_a_name_is_typed_letter_by_letter_as_one_edit_and_one_that_is_taken_goes_back(page):
    name, recipe = (page.props(label) for label in ("name", "recipe"))
    first, second = page.props("endmember")["options"][:2]
    for length in range(len("blue cloth") + 1):
        page.set("name", "blue cloth"[:length])
    page.wait_until(lambda: "name: blue cloth" in recipe["value"])
    assert name["value"] == first  # as the page was sent: nothing is written back over what is typed
    page.set("changes", "undo")
    page.wait_until(lambda: recipe["value"] == NO_EDITS and name["value"] == first)
    assert page.notices == []
    page.set("name", second)
    page.wait_for_notice(f"would both be called '{second}'")
    assert recipe["value"] == NO_EDITS
    page.wait_until(lambda: name["value"] == first)


def test_a_recipe_that_does_not_fit_or_lies_outside_its_folder_is_refused_and_changes_nothing(viewer):
    def load(page, name, said):
        page.set("saved", name)
        page.set("load")
        page.wait_for_notice(said)
        assert page.props("recipe")["value"] == NO_EDITS

    recipes = viewer.services.recipes_folder
    (recipes.parent / "secret.yml").write_text("edits:\n  - scale: {endmember: 0, factor: 3}\n")
    with opened(viewer) as page:
        load(page, "../secret.yml", "choose one of the recipes")
    recipes.mkdir()
    (recipes / "wrong.yml").write_text("edits:\n  - scale: {endmember: granite, factor: 2}\n")
    (recipes / "broken.yml").write_text("edits: [")
    with opened(viewer) as page:
        load(page, "wrong.yml", "there is no endmember 'granite'")
        load(page, "broken.yml", "broken.yml")


@pytest.mark.parametrize(
    ("first_nm", "title", "said"),
    [(600.0, "edited", "was not measured at 1 of 5 bands"), (850.0, "not done", "ColorChecker/red")],
)
def test_a_known_material_is_held_or_refused_beyond_its_bands(tmp_path, first_nm, title, said):
    source = source_of_bands(tmp_path, *(first_nm + 50.0 * index for index in range(5)))
    with serving(source) as (viewer, _), opened(viewer) as page:
        page.set("known material", "ColorChecker/red")
        page.set("replace by the known material")
        page.wait_until(lambda: any(title == one and said in text for one, text in page.notices))
        offered = page.props("light")["options"]
        assert 1 < len(offered) <= len(illuminant_names())
        for title in offered[1:]:
            light = Light(title.partition(": ")[0])
            edited = viewer.services.maker.edited(Edit(Recipe(illuminant=light)))
            assert edited.light_power is not None


@pytest.mark.slow
def test_the_colour_that_is_shown_is_the_one_that_was_reached(page):
    page.set("colour", (0, 255, 0))
    page.wait_for_notice("took the nearest colour")
    _, said = page.notices[-1]
    nearest = said[said.index("took the nearest colour, ") :].split()[-1]
    page.wait_until(lambda: css_colour([value / 255 for value in page.props("colour")["value"]]) == nearest)
    assert "#00ff00" in page.props("recipe")["value"]


def test_what_a_spectrum_is_like_is_said_in_one_line_a_material_or_that_it_is_like_nothing_known(source):
    bands = Bands.of([500.0, 600.0, 700.0])
    materials = Materials(bands, torch.eye(3), torch.zeros(0, 3))
    sample = LibraryMaterial("set/moss", bands, np.array([0.2, 0.4, 0.1]), "a walk")
    near = LibraryMaterial("set/lichen", bands, np.array([0.2, 0.41, 0.1]), "a walk")
    library = MaterialLibrary((sample, near))
    assert likeness_rows(library, np.array([0.4, 0.8, 0.2]), materials) == [
        ("like", "set/moss, 0.000 rad"),
        ("", "set/lichen, 0.010 rad"),
        ("known from", "a walk"),
    ]
    assert likeness_rows(library, np.array([0.4, 0.0, 0.2]), materials) == [
        ("like", "nothing that is known; nearest is set/moss, 1.061 rad")
    ]
    with serving(source) as (viewer, _), opened(viewer) as page:
        count = len(viewer.services.maker.edited(Edit()).materials.names)
        (listing,) = [
            text for text in map(str, page.texts.splitlines()) if "white-space:nowrap;text-overflow" in text
        ]
        assert listing.count("title=") == count


def test_a_colour_that_is_refused_again_and_again_is_one_notice(viewer, monkeypatch):
    accept, refused = viewer.services.maker.edited, threading.Semaphore(0)

    def refuse_colours(edit):
        if any(isinstance(one, Retint) for one in edit.recipe.operations):
            refused.release()
            raise ConfigError("that can't be")
        return accept(edit)

    monkeypatch.setattr(viewer.services.maker, "edited", refuse_colours)
    with opened(viewer) as page:
        for green in range(10):
            page.set("colour", (10, green, 10))
            assert refused.acquire(timeout=120)
        page.wait_until(lambda: bool(page.notices))
        show_layer(page, "depth")
        assert [text for _, text in page.notices].count("that can't be") == 1


@pytest.mark.slow
def test_what_a_user_has_to_know_of_an_edit_is_said_once(page):
    page.set("colour", (120, 110, 100))
    page.wait_until(lambda: bool(page.notices))
    recipe = page.props("recipe")
    for label, value, written in (
        ("brightness", 2.0, "scale"),
        ("light", "A: incandescent lamp, 2856 K", "illuminant: A"),
    ):
        page.set(label, value)
        page.wait_until(lambda written=written: written in recipe["value"])
    show_layer(page, "depth")
    (notice,) = page.notices
    assert notice[1].endswith("taken as flat (CIE illuminant E)")
