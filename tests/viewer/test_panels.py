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

from tests.engine.rgb_nerf_plugin import RgbNerf, RgbNerfConfig
from tests.method_factory import make_model
from tests.products.render.render_factory import read_exr
from tests.viewer.pages import decoded, has_control, opened, serving, show_layer
from tests.viewer.view_factory import BOX, make_source, ring, source_of_model
from unmix_plugin.editing import Light, Recipe, Retint
from unmix_plugin.engine.registry import Output
from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.training_control import DeviceShare, TrainingControl
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_names
from unmix_plugin.trained.camera_files import read_camera_file
from unmix_plugin.trained.measured_surface import MeasuredSurface
from unmix_plugin.trained.measures import keep_region, read_measures
from unmix_plugin.trained.model_scene import ModelScene
from unmix_plugin.trained.regions import Box, InView
from unmix_plugin.trained.run_views import recorded_views, world_frame
from unmix_plugin.viewer.rendering.scene import Edit, SceneSource
from unmix_plugin.viewer.rendering.settings import BACKGROUNDS


def source_of_bands(folder, *centers_nm):
    """A model of other bands."""
    model, bands = make_model(), Bands.of(list(centers_nm))
    model.bands = bands
    model.metadata = {**model.metadata, "wavelengths_nm": bands.centers_nm.tolist()}
    return source_of_model(model, folder)


def test_small_pictures_and_labels_are_sent_without_loss_and_large_ones_compressed(viewer):
    with opened(viewer) as page:
        assert page.last_picture.startswith(b"\x89PNG")
        page.set("picture height (px)", 128)
        page.wait_until(lambda: len(decoded(page.last_picture)) == 128)
        assert page.last_picture.startswith(b"\xff\xd8")
        labels = show_layer(page, "segmentation").reshape(-1, 3).astype(int)
        assert page.last_picture.startswith(b"\x89PNG")
        materials = viewer.services.maker.edited(Edit()).materials
        colours = (viewer.services.maker.aids.for_layers().colours_of(materials) * 255).round().int().tolist()
        background = [round(255 * BACKGROUNDS["grey"])] * 3
        assert {*map(tuple, labels.tolist())} <= {*map(tuple, [*colours, background])}


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


def test_a_range_that_ends_below_its_beginning_is_refused_and_the_one_before_stays(viewer):
    with opened(viewer) as page:
        show_layer(page, "depth")
        page.set("own range", True)
        (session,) = viewer._sessions.values()
        page.wait_until(lambda: session.view.settings.value_range is not None)
        assert page.notices == []
        before = session.view.settings.value_range
        page.set("high", before[0] - 1)
        page.wait_until(lambda: any("until low is below high" in text for _, text in page.notices))
        assert session.view.settings.value_range == before
        page.set("low", before[0] - 2)
        page.wait_until(lambda: session.view.settings.value_range == (before[0] - 2, before[0] - 1))


def test_the_point_cloud_follows_the_light_and_shows_no_hidden_material(viewer, monkeypatch):
    clouds = []
    add = SceneApi.add_point_cloud
    monkeypatch.setattr(
        SceneApi, "add_point_cloud", lambda *args, **more: (clouds.append(args[2:]), add(*args, **more))[1]
    )
    with opened(viewer) as page:
        page.set("point cloud", True)
        page.wait_until(lambda: len(clouds) == 1)
        page.set("light", "A")
        recipe = page.controls[page.control("recipe")]
        page.wait_until(lambda: len(clouds) == 2 and "illuminant: A" in recipe["value"])
        (points, colours), (same, relit) = clouds
        assert np.array_equal(points, same)
        assert relit[:, 2].mean() < colours[:, 2].mean() - 5
        page.set("visible", False)
        page.wait_until(lambda: len(clouds) == 3)
        assert 0 < len(clouds[-1][0]) < len(points)
        page.set("point cloud", False)
        page.set("visible", True)
        show_layer(page, "depth")
        assert len(clouds) == 3


def test_a_region_that_is_kept_or_removed_elsewhere_is_listed_or_no_longer(tmp_path):
    source = make_source(tmp_path, initial_opacity=0.6)
    with serving(source) as (viewer, _), opened(viewer) as page:
        options = lambda: page.controls[page.control("region")]["options"]  # noqa: E731
        keep_region(source.run, "cup", Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
        page.wait_until(lambda: "cup" in options())
        keep_region(source.run, "cup", None)
        page.wait_until(lambda: "cup" not in options())


def test_a_click_is_a_probe_with_a_chart_and_bars_and_one_on_nothing_says_so(viewer):
    with opened(viewer) as page:
        page.click(0.5, 0.5)
        page.wait_until(lambda: "endmember_" in page.texts and "position" in page.texts)
        assert any(props.get("type") == "GuiUplotMessage" for props in page.controls.values())
        page.set("save as CSV", True)
        page.wait_until(lambda: len(page.downloads) == 2)
        saved = sorted(path.name for path in viewer.services.folder.iterdir())
        assert saved == ["probe-abundances.csv", "probes.csv"]
        page.look_from(0.0, distance=40.0)
        page.click(0.01, 0.01)
        page.wait_until(lambda: any("nothing is there" in text for _, text in page.notices))
        assert page.controls[page.control("probe")]["options"] == [
            page.controls[page.control("probe")]["value"]
        ]
        page.set("forget all", True)
        page.wait_until(lambda: page.controls[page.control("probe")]["options"] == ["none yet"])


@pytest.mark.slow
def test_two_clicks_and_a_distance_set_the_scale_that_commands_read(viewer):
    run = viewer.services.source.run
    with opened(viewer) as page:
        probing = page.controls[page.control("probe where I click")]
        page.set("set scale", True)
        page.wait_until(
            lambda: any("click two points of the object first" in text for _, text in page.notices)
        )
        page.set("measure where I click", True)
        page.wait_until(lambda: probing["value"] is False)
        page.click(0.5, 0.5)
        page.wait_until(lambda: "Click a second point" in page.texts)
        page.click(0.4, 0.5)
        page.wait_until(lambda: " units</td>" in page.texts)
        assert page.controls[page.control("probe")]["options"] == ["none yet"]
        units = float(re.findall(r"([0-9.]+) units</td>", page.texts)[-1])
        page.set("set scale", True)
        page.wait_until(lambda: any("the distance is 0 m" in text for _, text in page.notices))
        assert not (run.path / "measures.json").exists()
        page.set("distance (m)", 0.05)
        in_the_way = run.path / ".measures.json.tmp"
        in_the_way.mkdir()
        page.set("set scale", True)
        page.wait_until(lambda: any("can't write" in text for _, text in page.notices))
        in_the_way.rmdir()
        page.set("set scale", True)
        page.wait_until(lambda: "5 cm</td>" in page.texts and "1 unit is" in page.texts)
        scale = read_measures(run).scale
        assert scale is not None
        assert scale.metres_per_unit == pytest.approx(0.05 / units, rel=1e-3)
        page.set("probe where I click", True)
        page.wait_until(lambda: page.controls[page.control("measure where I click")]["value"] is False)
    (run.path / "measures.json").unlink()


def test_no_scale_is_set_before_training_has_ended(tmp_path):
    with serving(make_source(tmp_path, TrainingControl())) as (viewer, _), opened(viewer) as page:
        page.set("set scale", True)
        page.wait_until(lambda: any("when training has ended" in text for _, text in page.notices))


@pytest.mark.slow
def test_a_region_is_drawn_named_kept_as_commands_read_it_and_removed(tmp_path):
    source = make_source(tmp_path, initial_opacity=0.6)
    with serving(source) as (viewer, _), opened(viewer) as page:
        options = lambda: page.controls[page.control("region")]["options"]  # noqa: E731
        page.set("keep the region", True)
        page.wait_until(lambda: any("can't be the name of a region" in text for _, text in page.notices))
        page.set("region name", "middle part")
        page.set("keep the region", True)
        page.wait_until(lambda: any("draw a region first" in text for _, text in page.notices))
        page.set("draw where I click", True)
        page.wait_until(lambda: page.controls[page.control("probe where I click")]["value"] is False)
        page.click(0.4, 0.4)
        page.wait_until(lambda: "Corners: 1" in page.texts)
        page.click(0.6, 0.6)
        page.wait_until(lambda: "Corners: 2" in page.texts)
        page.set("keep the region", True)
        page.wait_until(lambda: options() == ["none: choose one", "middle part"])
        page.wait_until(lambda: " square units</td>" in page.texts)
        kept = read_measures(source.run).regions["middle part"]
        assert isinstance(kept, InView)
        rows, columns = np.nonzero(kept.mask())
        height, width = kept.mask().shape
        assert (rows.min() / height, columns.max() / width) == (
            pytest.approx(0.4, abs=0.01),
            pytest.approx(0.6, abs=0.01),
        )
        with source.borrowed_materials() as scene:
            found = MeasuredSurface.of(scene).measure(kept, "")
        assert f"{found.area:.4g} square units" in page.texts
        page.look_from(0.9)
        page.click(0.5, 0.5)
        page.wait_until(lambda: "Corners: 1" in page.texts)
        page.look_from(0.3)
        page.click(0.5, 0.5)
        page.wait_until(lambda: "The view has changed, so the outline begins here" in page.texts)
        page.set("shape", "polygon")
        page.wait_until(lambda: "Tick the box" in page.texts)
        for count, place in enumerate(((0.5, 0.4), (0.6, 0.6), (0.45, 0.6)), 1):
            page.click(*place)
            page.wait_until(lambda count=count: f"Corners: {count}." in page.texts)
        page.set("region name", "wedge")
        page.set("keep the region", True)
        page.wait_until(lambda: options() == ["none: choose one", "middle part", "wedge"])
        for name in ("wedge", "middle part"):
            page.set("region", name)
            page.set("remove the region", True)
            page.wait_until(lambda name=name: ("region removed", name) in page.notices)
            assert name not in options()
        assert read_measures(source.run).regions == {}


def test_numbers_of_a_region_go_when_one_is_chosen_that_cannot_be_measured(tmp_path):
    source = make_source(tmp_path, initial_opacity=0.6)
    keep_region(source.run, "all of it", Box((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0)))
    keep_region(source.run, "far away", Box((50.0, 50.0, 50.0), (51.0, 51.0, 51.0)))
    with serving(source) as (viewer, _), opened(viewer) as page:
        page.set("region", "all of it")
        page.wait_until(lambda: " square units</td>" in page.texts)
        page.set("region", "far away")
        page.wait_until(lambda: any("far away has nothing" in text for _, text in page.notices))
        assert " square units</td>" not in page.texts


def test_depth_comes_with_objects_and_goes_with_them(viewer):
    with opened(viewer) as page:
        page.set("scene box", True)
        page.wait_until(lambda: page.last_depth is not None)
        for label, is_on in (("cameras", True), ("point cloud", True), ("scene box", False)):
            page.set(label, is_on)
        show_layer(page, "depth")
        assert page.last_depth is not None
        page.set("cameras", False)
        page.set("point cloud", False)
        page.wait_until(lambda: page.last_depth is None)
        assert page.notices == []


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


CHANGES = (
    ("visible", False, "remove"),
    ("only this one", True, "isolate"),
    ("gloss", 0.5, "gloss"),
    ("colour of gloss", (255, 200, 0), "gloss"),
    ("colour", (120, 110, 100), "retint"),
    ("name", "clay", "name: clay"),
    ("replace by the known material", True, "library: ColorChecker/red"),
    ("swap with the other", True, "swap: [0, 2]"),
    ("light", "FL2", "illuminant: FL2"),
)


@pytest.mark.slow
def test_every_change_is_an_edit_of_the_recipe_and_can_be_undone(viewer):
    with opened(viewer) as page:
        recipe = page.controls[page.control("recipe")]
        assert page.controls[page.control("known material")]["value"] == "choose one"
        page.set("known material", "ColorChecker/red")
        for label, value, written in CHANGES:
            page.set(label, value)
            page.wait_until(lambda written=written: written in recipe["value"])
            page.set("changes", "undo")
            page.wait_until(lambda: recipe["value"] == "edits: []\n")
            page.set("changes", "redo")
            page.wait_until(lambda written=written: written in recipe["value"])
            page.set("changes", "undo")
            page.wait_until(lambda: recipe["value"] == "edits: []\n")
        assert not any(title == "not done" for title, _ in page.notices)


@pytest.mark.slow
def test_a_name_is_typed_letter_by_letter_as_one_edit_and_one_that_is_taken_goes_back(viewer):
    with opened(viewer) as page:
        name, recipe = (page.controls[page.control(label)] for label in ("name", "recipe"))
        for length in range(len("blue cloth") + 1):
            page.set("name", "blue cloth"[:length])
        page.wait_until(lambda: "name: blue cloth" in recipe["value"])
        assert (
            name["value"] == "endmember_0"
        )  # as the page was sent: nothing is written back over what is typed
        page.set("changes", "undo")
        page.wait_until(lambda: recipe["value"] == "edits: []\n" and name["value"] == "endmember_0")
        assert page.notices == []
        page.set("name", "endmember_1")
        page.wait_until(lambda: any("is called 'endmember_1' already" in text for _, text in page.notices))
        assert recipe["value"] == "edits: []\n"
        page.wait_until(lambda: name["value"] == "endmember_0")


def test_a_recipe_that_does_not_fit_or_lies_outside_its_folder_is_refused_and_changes_nothing(viewer):
    def load(page, name, said):
        page.set("saved", name)
        page.set("load", True)
        page.wait_until(lambda: any(said in text for _, text in page.notices))
        assert page.controls[page.control("recipe")]["value"] == "edits: []\n"

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
def test_a_known_material_is_held_where_it_was_not_measured_and_refused_where_it_never_was(
    tmp_path, first_nm, title, said
):
    source = source_of_bands(tmp_path, *(first_nm + 50.0 * index for index in range(5)))
    with serving(source) as (viewer, _), opened(viewer) as page:
        page.set("known material", "ColorChecker/red")
        page.set("replace by the known material", True)
        page.wait_until(lambda: any(title == one and said in text for one, text in page.notices))


@pytest.mark.slow
def test_every_light_that_is_offered_can_be_chosen(tmp_path):
    source = source_of_bands(tmp_path, 700.0, 800.0, 900.0, 1000.0, 1100.0)
    with serving(source) as (viewer, _), opened(viewer) as page:
        offered = page.controls[page.control("light")]["options"]
        assert 3 < len(offered) < len(illuminant_names())
        for name in offered[1:]:
            edited = viewer.services.maker.edited(Edit(Recipe(illuminant=Light(name))))
            assert edited.light_power is not None


def test_a_screenshot_has_the_size_asked_for_and_lies_in_the_run_folder(viewer):
    with opened(viewer) as page:
        for label, value in (("width", 60), ("height", 40), ("file name", "../../../evil/../shot")):
            page.set(label, value)
        page.set("save a screenshot (PNG)", True)
        page.wait_until(lambda: bool(page.downloads))
        (path,) = viewer.services.folder.iterdir()
        assert path.name == "evil_.._shot.png"
        picture = Image.open(path)
        assert picture.size == (60, 40)
        assert np.asarray(picture).std() > 5


@pytest.mark.slow
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
def test_what_a_user_has_to_know_of_an_edit_is_said_once(viewer):
    with opened(viewer) as page:
        page.set("colour", (120, 110, 100))
        page.wait_until(lambda: bool(page.notices))
        recipe = page.controls[page.control("recipe")]
        for label, value, written in (("brightness", 2.0, "scale"), ("light", "A", "illuminant: A")):
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
        page.wait_until(
            lambda: axes(page) == ["reflectance"] * 3
        )  # of materials, of the probe, of all probes
        page.set("light", "A")
        page.wait_until(lambda: axes(page) == ["radiance", "reflectance", "reflectance"])
        page.click(0.5, 0.5)  # the first probe keeps its light
        page.wait_until(lambda: axes(page) == ["radiance", "radiance", "radiance or reflectance"])


def test_spectra_are_saved_as_exr(viewer):
    with opened(viewer) as page:
        page.set("width", 32)
        page.set("height", 24)
        page.set("save the spectra (EXR)", True)
        page.wait_until(lambda: page.downloads == ["view.exr"])
        (path,) = viewer.services.folder.iterdir()
        assert read_exr(path)["S0.450,000000nm"].shape == (24, 32)


@pytest.mark.slow
def test_sizes_that_are_too_large_or_out_of_bounds_are_refused(viewer):
    with opened(viewer) as page:
        for label, value in (("width", 100_000), ("height", 1e9), ("width", -3)):
            for one in ("width", "height"):
                page.set(one, value if one == label else 1024)
            page.set("save the spectra (EXR)" if value < 0 else "save a screenshot (PNG)", True)
            said = f"{label} is a number of pixels from 16 to 8192; found {value:g}"
            page.wait_until(lambda said=said: any(said in text for _, text in page.notices))
        page.set("width", 8192)
        page.set("height", 8192)
        page.set("save a screenshot (PNG)", True)
        page.wait_until(lambda: "8192 x 8192 pixels are too many" in page.notices[-1][1])
        assert not viewer.services.folder.exists()


def test_a_path_through_key_frames_is_a_camera_file(viewer):
    with opened(viewer) as page:
        for number, angle in enumerate((0.3, 0.8, 1.3), start=1):
            page.look_from(angle)
            page.set("add a key frame here", True)
            key = page.controls[page.control("key frame")]
            page.wait_until(lambda key=key, number=number: key.get("value") == f"{number} of {number}")
        for label, value in (("seconds", 1.0), ("frames a second", 10), ("width", 641), ("height", 360)):
            page.set(label, value)
        page.set("save the path", True)
        page.wait_until(lambda: any(title == "saved" for title, _ in page.notices))
        (path,) = viewer.services.folder.iterdir()
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
    source = SceneSource(RunFolder(tmp_path), record, DeviceShare(), lambda: scene)
    with serving(source) as (viewer, _), opened(viewer) as page:
        assert page.controls[page.control("layer")]["options"] == [output.title for output in OUTPUTS]
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
        page.wait_until(lambda: "direction" in page.texts and "rgb" in page.texts)
        page.set("measure where I click", True)
        page.wait_until(lambda: page.controls[page.control("probe where I click")]["value"] is False)
        page.click(0.5, 0.5)
        page.wait_until(lambda: "Click a second point" in page.texts or bool(page.notices))
        page.set("width", 32)
        page.set("height", 24)
        page.set("save a screenshot (PNG)", True)
        page.wait_until(lambda: page.downloads == ["view.png"])
