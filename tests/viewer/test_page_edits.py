"""Edits of materials and light, made in a page."""

import threading

import numpy as np
import pytest

from tests.method_factory import make_model
from tests.viewer.pages import decoded, opened, serving, show_layer
from tests.viewer.view_factory import source_of_model
from unmix_plugin.editing import Light, Recipe, Retint
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_names
from unmix_plugin.viewer.rendering.scene import Edit


def test_materials_are_edited_undone_saved_and_loaded(viewer):
    with opened(viewer) as page, opened(viewer) as other:
        before, count = decoded(page.last_picture), len(other.pictures)
        page.set("brightness", 4.0)
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).max() > 10)
        page.wait_until(lambda: "scale" in page.controls[page.control("recipe")]["value"])
        page.set("save as", "../../bright")
        page.set("save", True)
        page.wait_until(lambda: bool(page.downloads))
        saved = list((viewer.services.source.run.path / "recipes").iterdir())
        assert [path.name for path in saved] == ["bright.yml"]
        page.set("changes", "undo")
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).max() < 3)
        page.set("load", True)
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).max() > 10)
        assert len(other.pictures) == count  # another page's materials are its own


@pytest.mark.parametrize(
    ("label", "value", "written"),
    [
        ("visible", False, "remove"),
        ("only this one", True, "isolate"),
        ("gloss", 0.5, "gloss"),
        ("colour of gloss", (255, 200, 0), "gloss"),
        ("colour", (120, 110, 100), "retint"),
        ("name", "clay", "name: clay"),
        ("replace by the known material", True, "library: pmc/"),
        ("swap with the other", True, "swap: [0, 2]"),
        ("light", "FL2", "illuminant: FL2"),
    ],
)
def test_every_change_is_an_edit_of_the_recipe_and_can_be_undone(viewer, label, value, written):
    with opened(viewer) as page:
        page.set(label, value)
        recipe = page.controls[page.control("recipe")]
        page.wait_until(lambda: written in recipe["value"])
        page.set("changes", "undo")
        page.wait_until(lambda: recipe["value"] == "edits: []\n")
        assert not any(title == "not done" for title, _ in page.notices)
        page.set("changes", "redo")
        page.wait_until(lambda: written in recipe["value"])


def test_a_name_with_spaces_can_be_typed_letter_by_letter_and_is_one_edit(viewer):
    with opened(viewer) as page:
        name, recipe = (page.controls[page.control(label)] for label in ("name", "recipe"))
        for length in range(len("blue ") + 1):
            page.set("name", "blue "[:length])
        page.wait_until(lambda: "name: blue" in recipe["value"])
        # What the page was sent has the letters as typed, with the space: nothing was written back.
        assert name["value"] == "endmember_0"
        for length in range(len("blue "), len("blue cloth") + 1):
            page.set("name", "blue cloth"[:length])
        page.wait_until(lambda: "name: blue cloth" in recipe["value"])
        page.set("changes", "undo")
        page.wait_until(lambda: recipe["value"] == "edits: []\n")
        page.wait_until(lambda: name["value"] == "endmember_0")
        assert page.notices == []


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


def test_what_a_user_has_to_know_of_an_edit_is_said_once(viewer):
    with opened(viewer) as page:
        page.set("colour", (120, 110, 100))
        page.wait_until(lambda: bool(page.notices))
        recipe = page.controls[page.control("recipe")]
        for label, value, written in (("brightness", 2.0, "scale"), ("light", "A", "illuminant: A")):
            page.set(label, value)
            page.wait_until(lambda written=written: written in recipe["value"])
        show_layer(page, "depth")
        assert [text for _, text in page.notices] == [
            "the scene does not say what light it was recorded in: taken as flat (CIE illuminant E)"
        ]


def test_a_name_that_is_taken_is_refused_and_the_field_goes_back(viewer):
    with opened(viewer) as page:
        page.set("name", "endmember_1")
        page.wait_until(lambda: any("is called 'endmember_1' already" in text for _, text in page.notices))
        assert page.controls[page.control("recipe")]["value"] == "edits: []\n"
        page.wait_until(lambda: page.controls[page.control("name")]["value"] == "endmember_0")


def test_an_edit_that_does_not_fit_is_said_and_changes_nothing(viewer):
    recipes = viewer.services.recipes_folder
    recipes.mkdir()
    (recipes / "wrong.yml").write_text("edits:\n  - scale: {endmember: granite, factor: 2}\n")
    (recipes / "broken.yml").write_text("edits: [")
    with opened(viewer) as page:
        for name in ("wrong.yml", "broken.yml"):
            page.set("saved", name)
            count = len(page.notices)
            page.set("load", True)
            page.wait_until(lambda count=count: len(page.notices) > count)
        texts = [text for _, text in page.notices]
        assert "there is no endmember 'granite'" in texts[0]
        assert "broken.yml" in texts[1]
        show_layer(page, "depth")


def test_files_outside_the_folder_of_recipes_are_not_read(viewer, tmp_path):
    secret = tmp_path / "secret.yml"
    secret.write_text("edits:\n  - scale: {endmember: 0, factor: 3}\n")
    with opened(viewer) as page:
        page.set("saved", "../secret.yml")
        page.set("load", True)
        page.wait_until(lambda: bool(page.notices))
        assert "choose one of the recipes" in page.notices[0][1]


def test_every_light_that_is_offered_can_be_chosen(tmp_path):
    model = make_model()
    infrared = Bands.of([700.0, 800.0, 900.0, 1000.0, 1100.0])
    model.bands = infrared
    model.metadata = {**model.metadata, "wavelengths_nm": infrared.centers_nm.tolist()}
    with serving(source_of_model(model, tmp_path)) as (viewer, _), opened(viewer) as page:
        offered = page.controls[page.control("light")]["options"]
        assert 3 < len(offered) < len(illuminant_names())
        for name in offered[1:]:
            viewer.services.maker.edited(Edit(Recipe(illuminant=Light(name))))
