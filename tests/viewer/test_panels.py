"""What a page shows and does: layers, probes, edits of materials and light, files, runs of other methods."""

import html
import math
import re
import threading

import numpy as np
import pytest
import torch
from PIL import Image
from viser import SceneApi

from tests.factories.models import make_model
from tests.factories.renders import read_exr
from tests.factories.rgb_nerf import RgbNerf, RgbNerfConfig
from tests.factories.viewers import decoded, has_control, opened, serving, show_layer
from tests.factories.views import BOX, make_source, ring, source_of_model
from unmix_plugin.editing import Light, Recipe, Retint
from unmix_plugin.engine.outputs import Output
from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.training_control import DeviceLock
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.formats.files import eight_bits
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_names, linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.material_library import LibraryMaterial, MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.camera_files import read_camera_file
from unmix_plugin.trained.measured_surface import MeasuredSurface
from unmix_plugin.trained.measures import Scale, keep_region, keep_scale, read_measures
from unmix_plugin.trained.model_scene import ModelScene
from unmix_plugin.trained.regions import Box, InView
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.run_views import recorded_views, world_frame
from unmix_plugin.viewer.panels.materials import likeness_rows
from unmix_plugin.viewer.rendering.scene import Edit, SceneSource
from unmix_plugin.viewer.rendering.settings import BACKGROUNDS
from unmix_plugin.viewer.rendering.thumbnails import Thumbnails


def put(page, values):
    for label, value in values.items():
        page.set(label, value)


def source_of_bands(folder, *centers_nm):
    """A model of other bands."""
    model, bands = make_model(), Bands.of(list(centers_nm))
    model.bands = bands
    model.metadata = {**model.metadata, "wavelengths_nm": bands.centers_nm.tolist()}
    return source_of_model(model, folder)


def test_small_pictures_and_labels_are_sent_without_loss_and_large_ones_compressed(viewer, page):
    assert page.last_picture.startswith(b"\x89PNG")
    page.set("picture height (px)", 128)
    page.wait_until(lambda: len(decoded(page.last_picture)) == 128)
    assert page.last_picture.startswith(b"\xff\xd8")
    labels = show_layer(page, "segmentation").reshape(-1, 3).astype(int)
    assert page.last_picture.startswith(b"\x89PNG")
    materials = viewer.services.maker.edited(Edit()).materials
    colours = np.round(255 * endmember_colours(materials)).astype(int).tolist()
    background = [round(255 * BACKGROUNDS["grey"])] * 3
    assert {*map(tuple, labels.tolist())} <= {*map(tuple, [*colours, background])}


def test_an_index_is_chosen_by_name_or_typed_as_a_formula_and_a_wrong_one_says_what_is_wrong(page):
    names = page.props("index")["options"]
    assert "pri" in names
    assert "ndvi" not in names
    first = show_layer(page, "spectral index")
    page.set("index", "redness")
    page.wait_for_text("redness index of soils")
    page.set("formula", " r650/r450 ")
    page.wait_for_text("formula r650/r450")
    assert "of radiance, since the scene" in page.texts
    for wrong, said in (
        ("r650/(r450", "can't be read here"),
        ("r650/r900", "needs 900 nm"),
        ("r650" + "+r650" * 300, "at most 500 characters"),
        ("nvdi", "there is no index"),
    ):
        page.set("formula", wrong)
        page.wait_for_text(html.escape(said))
    page.set("formula", "")
    page.set("index", names[0])
    page.wait_until(lambda: "characters" not in page.texts and "photochemical" in page.texts)
    assert "from the bands at" in page.texts
    page.wait_until(lambda: np.abs(decoded(page.last_picture) - first).mean() < 3)


def test_a_range_of_ones_own_begins_as_it_was_and_stays_where_it_would_end_below_its_beginning(viewer, page):
    show_layer(page, "depth")
    page.wait_for_text("distance along the viewing axis")
    (session,) = viewer._sessions.values()
    low, high = (page.props(label) for label in ("low", "high"))
    assert (low["visible"], high["visible"]) == (False, False)
    before = decoded(page.last_picture)
    page.set("own range")
    page.wait_until(lambda: low["visible"] and high["visible"] and high["value"] > 2)
    page.wait_until(lambda: session.view.settings.value_range is not None)
    assert page.notices == []
    least, greatest = session.view.settings.value_range
    page.set("high", least - 1)
    page.wait_for_notice("until low is below high")
    assert session.view.settings.value_range == (least, greatest)
    page.set("high", greatest + 5)
    page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).mean() > 3)
    page.set("own range", False)
    page.wait_until(lambda: np.abs(decoded(page.last_picture) - before).mean() < 1)
    assert not low["visible"]
    page.set("own range")
    page.wait_until(lambda: low["visible"])
    show_layer(page, "abundance of one endmember")
    page.wait_until(lambda: not page.props("own range")["value"] and not low["visible"])
    assert session.view.settings.value_range is None


def test_the_point_cloud_follows_the_light_and_shows_no_hidden_material(viewer, page, monkeypatch):
    clouds, add = [], SceneApi.add_point_cloud

    def noted(*arguments, **more):
        clouds.append(arguments[2:])
        return add(*arguments, **more)

    monkeypatch.setattr(SceneApi, "add_point_cloud", noted)
    page.set("point cloud")
    page.wait_until(lambda: len(clouds) == 1)
    page.set("light", "A: incandescent lamp, 2856 K")
    recipe = page.props("recipe")
    page.wait_until(lambda: len(clouds) == 2 and "illuminant: A" in recipe["value"])
    (points, colours), (same, relit) = clouds
    maker = viewer.services.maker
    scene = maker.edited(Edit())
    materials = scene.materials
    rays = maker.aids.for_layers(scene).reference
    linear = materials.spectra(rays) / rays.accumulation[:, None] @ rgb_matrix(materials.bands)
    assert np.array_equal(colours, eight_bits(linear_to_srgb(linear.clamp(0, 1)).numpy()))
    assert np.array_equal(points, same)
    assert relit[:, 2].mean() < colours[:, 2].mean() - 5
    page.set("visible", False)
    page.wait_until(lambda: len(clouds) == 3)
    assert 0 < len(clouds[-1][0]) < len(points)
    page.set("point cloud", False)
    show_layer(page, "depth")
    page.set("visible")
    show_layer(page, "segmentation")
    assert len(clouds) == 3


def test_a_click_is_a_probe_with_a_chart_and_bars_and_one_on_nothing_says_so(viewer, page):
    page.click(0.5, 0.5)
    page.wait_for_text(page.props("endmember")["options"][0], "position")
    assert any(props.get("type") == "GuiUplotMessage" for props in page.controls.values())
    page.set("save as CSV")
    page.wait_until(lambda: len(page.downloads) == 2)
    saved = sorted(path.name for path in viewer.services.folder.glob("[!.]*"))
    assert saved == ["probe-abundances.csv", "probes.csv"]
    page.look_from(0.0, distance=40.0)
    page.click(0.01, 0.01)
    page.wait_for_notice("nothing is there")
    assert page.props("probe")["options"] == [page.props("probe")["value"]]
    page.set("forget all")
    page.wait_until(lambda: page.props("probe")["options"] == ["none yet"])


@pytest.mark.slow
def test_two_clicks_and_a_distance_set_the_scale_that_commands_read(viewer):
    run = viewer.services.source.run
    with opened(viewer) as page:
        probing = page.props("probe where I click")
        page.set("set scale")
        page.wait_for_notice("click two points of the object first")
        page.set("measure where I click")
        page.wait_until(lambda: probing["value"] is False)
        page.click(0.5, 0.5)
        page.wait_for_text("Click a second point")
        page.click(0.4, 0.5)
        page.wait_for_text(" units</td>")
        assert page.props("probe")["options"] == ["none yet"]
        units = float(re.findall(r"([0-9.]+) units</td>", page.texts)[-1])
        page.set("set scale")
        page.wait_for_notice("the distance is 0 m")
        assert not (run.path / "measures.json").exists()
        page.set("distance (m)", 0.05)
        in_the_way = run.path / "measures.json"
        in_the_way.mkdir()
        page.set("set scale")
        page.wait_for_notice("can't read")
        in_the_way.rmdir()
        page.set("set scale")
        page.wait_for_text("5 cm</td>", "1 unit is")
        scale = read_measures(run).scale
        assert scale is not None
        assert scale.metres_per_unit == pytest.approx(0.05 / units, rel=1e-3)
        page.set("probe where I click")
        page.wait_until(lambda: page.props("measure where I click")["value"] is False)
    (run.path / "measures.json").unlink()


@pytest.mark.slow
def test_a_region_is_drawn_named_kept_as_commands_read_it_and_removed(tmp_path):
    source = make_source(tmp_path, initial_opacity=0.95)

    def kept():
        region = read_measures(source.run).regions["middle part"]
        assert isinstance(region, InView)
        return region

    def area_of(region):
        with source.locked_materials() as scene:
            return MeasuredSurface.of(scene).measure(region, "").area

    with serving(source) as (viewer, _), opened(viewer) as page:
        options = lambda: page.props("region")["options"]  # noqa: E731
        page.set("keep the region")
        page.wait_for_notice("can't be the name of a region")
        page.set("region name", "middle part")
        page.set("keep the region")
        page.wait_for_notice("draw a region first")
        page.set("draw where I click")
        page.wait_until(lambda: page.props("probe where I click")["value"] is False)
        page.click(0.4, 0.4)
        page.wait_for_text("Corners: 1")
        page.click(0.6, 0.6)
        page.wait_for_text("Corners: 2")
        page.set("keep the region")
        page.wait_until(lambda: options() == ["none: choose one", "middle part"])
        page.wait_for_text(" square units</td>")
        mask, area = kept().mask(), area_of(kept())
        rows, columns = np.nonzero(mask)
        assert rows.min() / mask.shape[0] == pytest.approx(0.4, abs=0.01)
        assert columns.max() / mask.shape[1] == pytest.approx(0.6, abs=0.01)
        assert f"{area:.4g} square units" in page.texts
        page.look_from(0.9)
        page.click(0.5, 0.5)
        page.wait_for_text("Corners: 1")
        page.look_from(0.3)
        page.click(0.5, 0.5)
        page.wait_for_text("The view has changed, so the outline begins here")
        page.click(0.75, 0.7)
        page.wait_for_text("Corners: 2")
        page.set("keep the region")  # once more under its name
        page.wait_for_notice("in place of the one before")
        page.wait_until(lambda: not np.array_equal(kept().mask(), mask))
        redrawn = area_of(kept())
        assert redrawn != pytest.approx(area, rel=0.01)
        page.wait_for_text(f"{redrawn:.4g} square units")
        page.set("shape", "polygon")
        page.wait_for_text("Tick the box")
        for count, place in enumerate(((0.5, 0.4), (0.6, 0.6), (0.45, 0.6)), 1):
            page.click(*place)
            page.wait_for_text(f"Corners: {count}.")
        page.set("region name", "wedge")
        page.set("keep the region")
        page.wait_until(lambda: options() == ["none: choose one", "middle part", "wedge"])
        for name in ("wedge", "middle part"):
            page.set("region", name)
            page.set("remove the region")
            page.wait_until(lambda name=name: ("region removed", name) in page.notices)
            assert name not in options()
        assert read_measures(source.run).regions == {}


def test_a_region_kept_or_removed_elsewhere_is_listed_or_not_and_numbers_are_of_the_one_chosen(tmp_path):
    source = make_source(tmp_path, initial_opacity=0.6)
    keep_region(source.run, "far away", Box((50.0, 50.0, 50.0), (51.0, 51.0, 51.0)))
    with serving(source) as (viewer, _), opened(viewer) as page:
        keep_region(source.run, "all of it", Box((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0)))
        page.wait_until(lambda: "all of it" in page.props("region")["options"])
        page.set("region", "all of it")
        page.wait_for_text(" square units</td>")
        page.set("region", "far away")
        page.wait_for_notice("far away has nothing")
        assert " square units</td>" not in page.texts
        page.set("region", "all of it")
        page.wait_for_text(" square units</td>")
        before = page.texts
        keep_region(source.run, "all of it", Box((-5.0, -5.0, -5.0), (5.0, 5.0, 0.0)))
        page.wait_until(lambda: " square units</td>" in page.texts and page.texts != before)
        keep_scale(source.run, Scale(0.01, "known"))
        page.wait_for_text(" cm²</td>", "1 unit is 0.01 m")
        keep_region(source.run, "all of it", None)
        page.wait_until(lambda: "all of it" not in page.props("region")["options"])


def test_depth_comes_with_objects_and_goes_with_them(page):
    page.set("scene box")
    page.wait_until(lambda: page.last_depth is not None)
    put(page, {"cameras": True, "point cloud": True, "scene box": False})
    show_layer(page, "depth")
    assert page.last_depth is not None
    put(page, {"cameras": False, "point cloud": False})
    page.wait_until(lambda: page.last_depth is None)
    assert page.notices == []


class SlowThumbnails(Thumbnails):
    """Images of views that take as long as a test wants."""

    def __init__(self):
        self.may_go, self.asked = threading.Event(), []

    def of(self, name):
        self.asked.append(name)
        assert self.may_go.wait(60)
        return np.full((4, 6, 3), 200, np.uint8)


def test_a_page_goes_on_while_images_of_its_cameras_are_read(source, monkeypatch):
    with serving(source) as (viewer, _), opened(viewer) as page:
        images = SlowThumbnails()
        monkeypatch.setattr(viewer.services, "thumbnails", images)
        page.set("cameras")
        page.wait_until(lambda: len(page.frusta) == len(viewer.services.views))
        show_layer(page, "depth")  # while the first image is being read
        assert not any(page.frusta.values())
        images.may_go.set()
        page.wait_until(lambda: all(page.frusta.values()))
        assert images.asked == [view.name for view in viewer.services.views]
        assert page.notices == []


def test_images_are_read_no_further_once_cameras_are_hidden(source, monkeypatch):
    with serving(source) as (viewer, _), opened(viewer) as page:
        images = SlowThumbnails()
        monkeypatch.setattr(viewer.services, "thumbnails", images)
        page.set("cameras")
        page.wait_until(lambda: len(images.asked) == 1)
        page.set("cameras", False)
        show_layer(page, "depth")
        images.may_go.set()
        show_layer(page, "colour")
        assert len(images.asked) <= 2


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


def test_pictures_and_spectra_have_the_size_asked_for_and_lie_in_the_run_folder(viewer, page):
    put(page, {"width": 60, "height": 40, "file name": "../../../evil/../shot"})
    page.set("save a screenshot (PNG)")
    page.wait_until(lambda: bool(page.downloads))
    (path,) = viewer.services.folder.glob("[!.]*")
    assert path.name == "evil_.._shot.png"
    picture = Image.open(path)
    assert picture.size == (60, 40)
    assert np.asarray(picture).std() > 5
    put(page, {"width": 32, "height": 24, "file name": "view"})
    page.set("save the spectra (EXR)")
    page.wait_until(lambda: "view.exr" in page.downloads)
    found = read_exr(viewer.services.folder / "view.exr")
    assert found["S0.450,000000nm"].shape == (24, 32)


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


def test_the_axis_of_spectra_says_reflectance_only_in_a_light_of_1(tmp_path):
    source = make_source(tmp_path, light=[1.0] * 5)

    def axes(page):
        charts = [one for one in page.controls.values() if one.get("type") == "GuiUplotMessage"]
        return sorted(chart["axes"][1]["label"] for chart in charts)

    with serving(source) as (viewer, _), opened(viewer) as page:
        page.click(0.5, 0.5)
        page.wait_until(lambda: axes(page) == ["reflectance"] * 3)  # of materials, the probe, all probes
        page.set("light", "A: incandescent lamp, 2856 K")
        page.wait_until(lambda: axes(page) == ["radiance", "reflectance", "reflectance"])
        page.click(0.5, 0.5)  # the first probe keeps its light
        page.wait_until(lambda: axes(page) == ["radiance", "radiance", "radiance or reflectance"])


@pytest.mark.slow
def test_sizes_that_are_too_large_or_out_of_bounds_are_refused(viewer, page):
    for label, value in (("width", 100_000), ("height", 1e9), ("width", -3)):
        put(page, {"width": 1024, "height": 1024, label: value})
        page.set("save the spectra (EXR)" if value < 0 else "save a screenshot (PNG)")
        page.wait_for_notice(f"{label} is a number of pixels from 16 to 8192; found {value:g}")
    put(page, {"width": 8192, "height": 8192})
    page.set("save a screenshot (PNG)")
    page.wait_for_notice("8192 x 8192 pixels are too many")
    assert not viewer.services.folder.exists()


def test_a_path_through_key_frames_is_a_camera_file(viewer, page):
    for number, angle in enumerate((0.3, 0.8, 1.3), start=1):
        page.look_from(angle)
        page.set("add a key frame here")
        key = page.props("key frame")
        page.wait_until(lambda key=key, number=number: key.get("value") == f"{number} of {number}")
    put(page, {"seconds": 1.0, "frames a second": 10, "width": 641, "height": 360})
    page.set("save the path")
    page.wait_until(lambda: any(title == "saved" for title, _ in page.notices))
    (path,) = viewer.services.folder.glob("[!.]*")
    found = read_camera_file(path, world_frame(viewer.services.source.record))
    assert (len(found.views), found.frames_per_second) == (10, 10.0)
    camera = found.views[0].camera
    assert (camera.width, camera.height) == (640, 360)  # even, as encoders of videos want it
    place = camera.camera_to_world[0, :, 3].tolist()
    assert place == pytest.approx([4 * math.cos(0.3), 4 * math.sin(0.3), 1.5], abs=1e-4)
    assert camera.focal_px[0].tolist() == pytest.approx([180 / math.tan(0.4)] * 2, rel=1e-4)


OUTPUTS = (
    Output("rgb", "srgb", "colour", "sRGB on black, 0 to 1"),
    Output("accumulation", "map", "opacity", "opacity, 0 to 1", (0.0, 1.0)),
    Output("label", "labels", "half", "upper or lower half"),
    Output("direction", "vectors", "direction", "viewing direction"),
)


class Described(RgbNerf):
    """The plain radiance field with outputs of each kind."""

    outputs = OUTPUTS

    def get_outputs(self, ray_bundle):
        found = super().get_outputs(ray_bundle)
        found["label"] = (ray_bundle.directions[:, 2] > -0.35).to(torch.uint8)
        found["direction"] = ray_bundle.directions
        return found


def test_all_that_another_method_names_is_shown_by_its_kind_as_its_scene_renders_it(tmp_path):
    torch.manual_seed(0)
    model = Described(RgbNerfConfig(), scene_box=BOX, metadata={"grid_size": 6})
    cameras = ring()
    record = SceneRecord(BOX, {"grid_size": 6}, cameras, cameras[[1, 3]], {})
    scene = ModelScene(model.eval(), world_frame(record), recorded_views(record), OUTPUTS)
    source = SceneSource(RunFolder(tmp_path), record, DeviceLock(), lambda: scene)
    with serving(source) as (viewer, _), opened(viewer) as page:
        assert page.props("layer")["options"] == [output.title for output in OUTPUTS]
        assert not has_control(page, "known material")
        assert not has_control(page, "save the spectra (EXR)")
        pictures = [show_layer(page, output.title) for output in OUTPUTS[1:]]
        assert all(picture.std() > 4 for picture in pictures)
        assert len(np.unique(pictures[1].reshape(-1, 3), axis=0)) == 2
        (view,) = (session.view for session in viewer._sessions.values())
        assert view.frame is not None
        assert (view.frame.camera.width, view.frame.camera.height) == (32, 24)
        torch.testing.assert_close(view.frame["direction"], scene.look(view.frame.camera)["direction"])
        page.click(0.5, 0.5)
        page.wait_for_text("direction", "rgb")
        page.set("measure where I click")
        page.wait_until(lambda: page.props("probe where I click")["value"] is False)
        page.click(0.5, 0.5)
        page.wait_until(lambda: "Click a second point" in page.texts or bool(page.notices))
        put(page, {"width": 32, "height": 24})
        page.set("save a screenshot (PNG)")
        page.wait_until(lambda: page.downloads == ["view.png"])
