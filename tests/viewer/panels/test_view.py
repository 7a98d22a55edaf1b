"""What a page shows: layers, ranges, point cloud, objects, images of its cameras, outputs of other methods."""

import html
import threading

import numpy as np
import torch
from viser import SceneApi

from tests.factories.rgb_nerf import RgbNerf, RgbNerfConfig
from tests.factories.viewers import decoded, has_control, opened, serving, show_layer
from tests.factories.views import BOX, ring
from unmix_plugin.engine.outputs import Output
from unmix_plugin.engine.runs.loading import SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.training_control import DeviceLock
from unmix_plugin.formats.files import eight_bits
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.trained.model_scene import ModelScene
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.run_views import recorded_views, world_frame
from unmix_plugin.viewer.rendering.scene import Edit, SceneSource
from unmix_plugin.viewer.rendering.settings import BACKGROUNDS
from unmix_plugin.viewer.rendering.thumbnails import Thumbnails


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
    (session,) = viewer.sessions
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


def test_depth_comes_with_objects_and_goes_with_them(page):
    page.set("scene box")
    page.wait_until(lambda: page.last_depth is not None)
    page.set_all({"cameras": True, "point cloud": True, "scene box": False})
    show_layer(page, "depth")
    assert page.last_depth is not None
    page.set_all({"cameras": False, "point cloud": False})
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
        (view,) = (session.view for session in viewer.sessions)
        assert view.frame is not None
        assert (view.frame.camera.width, view.frame.camera.height) == (32, 24)
        torch.testing.assert_close(view.frame["direction"], scene.look(view.frame.camera)["direction"])
        page.click(0.5, 0.5)
        page.wait_for_text("direction", "rgb")
        page.set("measure where I click")
        page.wait_until(lambda: page.props("probe where I click")["value"] is False)
        page.click(0.5, 0.5)
        page.wait_until(lambda: "Click a second point" in page.texts or bool(page.notices))
        page.set_all({"width": 32, "height": 24})
        page.set("save a screenshot (PNG)")
        page.wait_until(lambda: page.downloads == ["view.png"])
