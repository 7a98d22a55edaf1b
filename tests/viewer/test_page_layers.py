"""What a page shows: pictures, layers, probes."""

import html

import numpy as np
import pytest

from tests.method_factory import make_model
from tests.viewer.pages import decoded, opened, serving, show_layer
from tests.viewer.view_factory import source_of_model
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.viewer.layers.painting import BACKGROUNDS
from unmix_plugin.viewer.rendering.scene import Edit


def test_a_page_gets_a_picture_of_its_shape_that_shows_something(viewer):
    with opened(viewer, width=400, height=200) as page:
        picture = decoded(page.last_picture)
        assert picture.shape[1] / picture.shape[0] == pytest.approx(2, rel=0.1)
        assert picture.std() > 5
        assert page.last_depth is None


def test_pages_become_finer_at_rest(viewer):
    with opened(viewer, rows=160) as page:
        page.look_from(0.9)
        page.wait_until(lambda: len(decoded(page.last_picture)) < 160)
        page.wait_until(lambda: len(decoded(page.last_picture)) == 160)


def test_small_pictures_and_labels_are_sent_without_loss_and_large_ones_compressed(viewer):
    with opened(viewer, rows=48) as page:
        assert page.last_picture.startswith(b"\x89PNG")
        page.set("finest picture (rows)", 256)
        page.wait_until(lambda: len(decoded(page.last_picture)) == 256)
        assert page.last_picture.startswith(b"\xff\xd8")
        labels = show_layer(page, "segmentation")
        assert page.last_picture.startswith(b"\x89PNG")
        materials = viewer.services.maker.edited(Edit()).materials
        known = {
            tuple(row)
            for row in (viewer.services.aids.for_layers().colours_of(materials) * 255).round().int().tolist()
        }
        background = round(255 * BACKGROUNDS["grey"])
        assert {tuple(row) for row in labels.reshape(-1, 3).astype(int).tolist()} <= known | {
            (background,) * 3
        }


def test_each_page_has_its_own_layer(viewer):
    with opened(viewer) as first, opened(viewer) as second:
        count = len(first.pictures)
        depth = show_layer(second, "depth")
        assert not np.array_equal(depth.mean(axis=(0, 1)), decoded(first.last_picture).mean(axis=(0, 1)))
        assert "distance along the viewing axis" in second.texts
        assert "distance along the viewing axis" not in first.texts
        assert len(first.pictures) >= count


def test_a_layer_that_cannot_be_shown_says_why(viewer):
    with opened(viewer) as page:
        page.set("layer", "error against a training view")
        page.wait_until(lambda: "no error to show" in page.texts)
        assert "the scene has gone" in page.texts
        show_layer(page, "colour")


def test_an_index_is_chosen_by_name_or_typed_as_a_formula_and_a_wrong_one_says_what_is_wrong(viewer):
    with opened(viewer) as page:
        names = page.controls[page.control("index")]["options"]
        assert "pri" in names
        assert "ndvi" not in names
        first = show_layer(page, "spectral index")
        page.set("index", "redness")
        page.wait_until(lambda: "redness index of soils" in page.texts)
        page.set("formula", " r650/r450 ")
        page.wait_until(lambda: "formula r650/r450" in page.texts)
        assert "of radiance: light unknown" in page.texts
        for wrong, said in (
            ("r650/(r450", "expected"),
            ("r650/r900", "needs 900 nm"),
            ("r650" + "+r650" * 300, "at most 500 characters"),
            ("nvdi", "there is no index"),
        ):
            page.set("formula", wrong)
            page.wait_until(lambda said=said: html.escape(said) in page.texts)
        page.set("formula", "")
        page.set("index", names[0])
        page.wait_until(lambda: "characters" not in page.texts and "photochemical" in page.texts)
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - first).mean() < 3)


def test_a_formula_is_shown_when_it_is_typed_not_letter_by_letter(viewer):
    with opened(viewer) as page:
        show_layer(page, "spectral index")
        formula = "r650/r450"
        for length in range(1, len(formula) + 1):
            page.set("formula", formula[:length])
        page.wait_until(lambda: "formula r650/r450" in page.texts)
        assert "formula r650/r4;" not in page.seen_texts  # a prefix that can be read, too
        assert "expected" not in page.seen_texts


def test_the_ends_of_a_range_are_shown_when_they_are_ones_own_and_begin_as_they_were(viewer):
    with opened(viewer) as page:
        show_layer(page, "depth")
        page.wait_until(lambda: "distance along the viewing axis" in page.texts)
        low, high = (page.controls[page.control(label)] for label in ("low", "high"))
        assert (low["visible"], high["visible"]) == (False, False)
        before = decoded(page.last_picture)
        page.set("own range", True)
        page.wait_until(lambda: low["visible"] and high["visible"] and high["value"] > 2)
        page.set("high", high["value"] + 5)
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).mean() > 3)
        page.set("own range", False)
        page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).mean() < 1)
        assert not low["visible"]


def test_bands_that_no_named_index_takes_say_so_and_a_formula_is_shown(tmp_path):
    model = make_model()
    narrow = Bands.of([1000.0, 1010.0, 1020.0, 1030.0, 1040.0])
    assert available_indices(narrow) == []
    model.bands = narrow
    model.metadata = {**model.metadata, "wavelengths_nm": narrow.centers_nm.tolist()}
    with serving(source_of_model(model, tmp_path)) as (viewer, _), opened(viewer) as page:
        assert page.controls[page.control("index")]["options"] == ["none for these bands"]
        page.set("layer", "spectral index")
        page.wait_until(lambda: "type a formula of the wavelengths from 995 to 1045 nm" in page.texts)
        page.set("formula", "r1040/r1000")
        page.wait_until(lambda: "formula r1040/r1000" in page.texts)


def test_a_click_is_a_probe_with_a_chart_and_bars(viewer):
    with opened(viewer) as page:
        page.click(0.5, 0.5)
        page.wait_until(lambda: "endmember_" in page.texts and "position" in page.texts)
        assert any(props["type"] == "GuiUplotMessage" for props in page.controls.values() if "type" in props)
        page.set("save as CSV", True)
        page.wait_until(lambda: len(page.downloads) == 2)
        saved = sorted(path.name for path in viewer.services.folder.iterdir())
        assert saved == ["probe-abundances.csv", "probes.csv"]


def test_a_click_on_nothing_says_so(viewer):
    with opened(viewer) as page:
        page.look_from(0.0, distance=40.0)
        page.click(0.01, 0.01)
        page.wait_until(lambda: any("nothing is there to probe" in text for _, text in page.notices))


def test_depth_comes_with_objects_and_goes_with_them(viewer):
    with opened(viewer) as page:
        page.set("scene box", True)
        page.wait_until(lambda: page.last_depth is not None)
        page.set("cameras", True)
        page.set("scene box", False)
        page.set("cameras", False)
        page.wait_until(lambda: page.last_depth is None)
