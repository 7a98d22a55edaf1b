"""A page that is loaded again goes on where it was."""

import numpy as np

from tests.viewer.pages import decoded, opened, page_of, show_layer
from unmix_plugin.viewer.layers.painting import LayerSettings
from unmix_plugin.viewer.recipes import RecipeHistory
from unmix_plugin.viewer.session import KEPT_S, KeptPages, PageState


def state(rows):
    return PageState(None, LayerSettings(), RecipeHistory(), rows, 1)


def test_the_page_that_was_closed_last_comes_back_first_and_once():
    pages = KeptPages()
    for rows in (100, 200):
        pages.leave("mine", state(rows))
    pages.leave("other", state(300))
    assert [
        kept and kept.largest_height for kept in (pages.take("mine"), pages.take("mine"), pages.take("mine"))
    ] == [
        200,
        100,
        None,
    ]


def test_what_was_left_long_ago_is_forgotten():
    now = [0.0]
    pages = KeptPages(lambda: now[0])
    pages.leave("mine", state(100))
    now[0] = KEPT_S
    assert pages.take("mine") is None


def test_a_reload_keeps_camera_layer_and_edits_and_another_browser_starts_anew(viewer):
    storage = {}
    with opened(viewer, storage=storage) as page:
        page.look_from(1.7)
        page.set("brightness", 3.0)
        page.wait_until(lambda: "scale" in page.controls[page.control("recipe")]["value"])
        before = show_layer(page, "all abundances")
        page.wait_until(lambda: len(decoded(page.last_picture)) == 48)
        before = decoded(page.last_picture)
    with page_of(viewer, storage=storage) as page:
        page.look_from(0.3)
        page.wait_until(lambda: bool(page.pictures) and len(decoded(page.last_picture)) == 48)
        np.testing.assert_allclose(decoded(page.last_picture), before, atol=2)
        assert page.controls[page.control("layer")]["value"] == "all abundances"
        assert "scale" in page.controls[page.control("recipe")]["value"]
        page.set("changes", "undo")
        page.wait_until(lambda: page.controls[page.control("recipe")]["value"] == "edits: []\n")
    with opened(viewer) as page:
        assert page.controls[page.control("layer")]["value"] == "colour"
        assert page.controls[page.control("recipe")]["value"] == "edits: []\n"
