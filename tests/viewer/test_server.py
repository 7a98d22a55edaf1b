"""The viewer as pages see it: over its own protocol, without a browser."""

import html
import io
import math
import socket
import threading
import time
from contextlib import contextmanager

import msgspec
import numpy as np
import pytest
from PIL import Image

from benchmarks._viewer_page import Page
from tests.viewer.view_factory import make_source, no_scene
from unmix_plugin.engine.training_control import TrainingControl
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.indices import available_indices
from unmix_plugin.viewer.gate import MOST_CLIENTS
from unmix_plugin.viewer.options import ViewerOptions
from unmix_plugin.viewer.server import Viewer


@contextmanager
def serving(source, read_scene=no_scene, **options):
    """A viewer that listens at any free port, and what it said."""
    lines = []
    viewer = Viewer(source, ViewerOptions(**{"port": 0, **options}), read_scene, lines.append)
    viewer.start()
    try:
        yield viewer, lines
    finally:
        viewer.stop()


@pytest.fixture
def viewer(source):
    with serving(source) as (running, _):
        yield running


def page_of(viewer, **settings):
    return Page(f"ws://127.0.0.1:{viewer.port}", **settings)


@contextmanager
def opened(viewer, rows=48, **settings):
    """A page that has its first picture and all of its controls; its finest picture has few rows."""
    with page_of(viewer, **settings) as page:
        page.look_from(0.3)
        page.wait_until(lambda: bool(page.pictures) and has_control(page, "render a video"))
        page.set("finest picture (rows)", rows)
        page.wait_until(lambda: len(decoded(page.last_picture)) == rows)
        yield page


def has_control(page, label):
    return any(props.get("label") == label for props in page.controls.values())


def decoded(picture):
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(float)


def show_layer(page, title):
    count = len(page.pictures)
    page.set("layer", title)
    page.wait_until(lambda: len(page.pictures) > count)
    return decoded(page.last_picture)


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


def test_bands_that_no_named_index_takes_say_so_and_a_formula_is_shown(tmp_path):
    source = make_source(tmp_path)
    narrow = Bands.of([1000.0, 1010.0, 1020.0, 1030.0, 1040.0])
    assert available_indices(narrow) == []
    source._model.bands = narrow
    source._model.metadata = {**source._model.metadata, "wavelengths_nm": narrow.centers_nm.tolist()}
    with serving(source) as (viewer, _), opened(viewer) as page:
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


def test_spectra_are_saved_as_exr(viewer):
    import OpenEXR

    with opened(viewer) as page:
        page.set("width", 32)
        page.set("height", 24)
        page.set("save the spectra (EXR)", True)
        page.wait_until(lambda: any(title == "saved" for title, _ in page.notices))
        (path,) = viewer.services.folder.iterdir()
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            assert sum(name.startswith("S0.") for name in channels) == 5
            assert channels["S0.450,000000nm"].pixels.shape == (24, 32)


def test_pictures_too_large_are_refused(viewer):
    with opened(viewer) as page:
        page.set("width", 8192)
        page.set("height", 1e9)
        page.set("save a screenshot (PNG)", True)
        page.wait_until(lambda: bool(page.notices))
        assert "8192 x 8192 pixels are too many" in page.notices[0][1]


def test_a_path_through_key_frames_is_a_camera_file(viewer):
    from unmix_plugin.exports.camera_files import read_camera_file
    from unmix_plugin.exports.world_frame import world_frame

    with opened(viewer) as page:
        for number, angle in enumerate((0.3, 0.8, 1.3), start=1):
            page.look_from(angle)
            page.set("add a key frame here", True)
            key = page.controls[page.control("key frame")]
            page.wait_until(lambda key=key, number=number: key.get("value") == f"{number} of {number}")
        page.set("seconds", 1.0)
        page.set("frames a second", 10)
        time.sleep(0.3)
        page.set("save the path", True)
        page.wait_until(lambda: any(title == "saved" for title, _ in page.notices))
        (path,) = viewer.services.folder.iterdir()
        found = read_camera_file(path, world_frame(viewer.services.source.scene))
        assert (len(found.views), found.frames_per_second) == (10, 10.0)
        first = found.views[0].camera.camera_to_world[0, :, 3].tolist()
        assert first == pytest.approx([4 * math.cos(0.3), 4 * math.sin(0.3), 1.5], abs=1e-4)


@pytest.mark.parametrize(
    "changes",
    [
        {"wxyz": (math.nan, 0.0, 0.0, 1.0)},
        {"position": (math.inf, 0.0, 0.0)},
        {"fov": -math.inf},
        {"image_height": 0},
        {"image_width": 0, "image_height": 0},
        {"image_height": -5},
        {"image_height": 10**9, "image_width": 10**9},
        {"wxyz": ()},
    ],
)
@pytest.mark.filterwarnings("ignore:.viser. .* does not match annotation")
def test_a_camera_that_is_none_harms_nobody(viewer, changes):
    with opened(viewer) as page:
        page.look_from(0.5, **changes)
        time.sleep(0.1)
        count = len(page.pictures)
        page.look_from(0.9)
        page.wait_until(lambda: len(page.pictures) > count)


@pytest.mark.parametrize(
    "label",
    [
        "layer",
        "index",
        "formula",
        "exposure (stops)",
        "low",
        "finest picture (rows)",
        "known material",
        "width",
        "brightness",
    ],
)
def test_values_that_no_control_would_send_harm_nobody(viewer, label):
    with opened(viewer) as page:
        page.set("own range", True)
        for value in (math.nan, math.inf, -1e300, "x" * 1000, None, [1, 2], {"a": 1}, True):
            page.set(label, value)
        time.sleep(0.1)
        count = len(page.pictures)
        page.set("layer", "colour")
        page.look_from(1.3)
        page.wait_until(lambda: len(page.pictures) > count)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xff",
        b"\x81",
        "text",
        b"\x81\xa4type\xa4Nope",
        msgspec.msgpack.encode({"type": "ViewerCameraMessage", "position": ("a", "b", "c")}),
    ],
)
def test_a_page_that_sends_nonsense_loses_its_connection_and_others_go_on(viewer, data):
    with opened(viewer) as good, page_of(viewer) as bad:
        bad.look_from(0.3)
        bad.send_raw(data)
        bad.wait_until(lambda: bad.is_closed)
        count = len(good.pictures)
        good.look_from(2.0)
        good.wait_until(lambda: len(good.pictures) > count)


def test_pages_that_leave_in_mid_render_are_forgotten(viewer):
    for _ in range(5):
        with page_of(viewer) as page:
            page.look_from(0.3)
            page.look_from(0.4)
    with opened(viewer):
        deadline = time.monotonic() + 20
        while viewer.num_clients > 1 or viewer.services.loop.num_views > 1:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_no_more_pages_are_served_than_there_is_room_for(viewer, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.server.MOST_CLIENTS", 1)
    assert MOST_CLIENTS > 1
    with opened(viewer), page_of(viewer) as second:
        second.look_from(0.3)
        second.wait_until(lambda: "pages are open already" in second.texts)
        assert second.pictures == []


def test_a_page_must_give_the_token_before_it_sees_anything(source):
    with serving(source, token="sesame") as (viewer, _), page_of(viewer) as page:
        page.look_from(0.3)
        page.wait_until(lambda: has_control(page, "token"))
        page.set("token", "barley")
        page.set("enter", True)
        page.wait_until(lambda: "That is not the token" in page.texts)
        assert page.pictures == []
        assert not has_control(page, "layer")
        assert viewer.num_clients == 0
        time.sleep(0.6)
        page.set("token", "sesame")
        page.set("enter", True)
        page.wait_until(lambda: bool(page.pictures))
        assert not has_control(page, "token")


def test_tokens_cannot_be_tried_quickly(source):
    with serving(source, token="sesame") as (viewer, _), page_of(viewer) as page:
        page.look_from(0.3)
        page.wait_until(lambda: has_control(page, "token"))
        page.set("token", "barley")
        page.set("enter", True)
        page.wait_until(lambda: "That is not the token" in page.texts)
        page.set("token", "sesame")
        page.set("enter", True)
        time.sleep(0.2)
        assert page.pictures == []


def test_a_page_of_another_site_is_refused_and_one_of_its_own_is_served(source):
    with serving(source) as (viewer, lines):
        with page_of(viewer, origin="http://evil.example") as foreign:
            foreign.look_from(0.3)
            foreign.wait_until(lambda: "this page is from another site" in foreign.texts)
            assert foreign.pictures == []
        assert any("another site" in line for line in lines)
        with opened(viewer, origin=f"http://127.0.0.1:{viewer.port}"):
            pass


def test_nobody_can_ask_for_a_public_tunnel(viewer, monkeypatch):
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *_, **__: pytest.fail("a tunnel was opened"))
    with opened(viewer) as page:
        page.send("ShareUrlRequest")
        show_layer(page, "depth")


def test_stopping_frees_the_port_and_every_thread(source):
    before = set(threading.enumerate())
    with serving(source) as (viewer, _), opened(viewer) as page:
        port = viewer.port
        viewer.stop()
        page.wait_until(lambda: page.is_closed)
        viewer.stop()
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", port))
    deadline = time.monotonic() + 10
    while left := [thread for thread in set(threading.enumerate()) - before if thread.is_alive()]:
        assert time.monotonic() < deadline, left
        time.sleep(0.05)


def test_a_taken_port_is_passed_over_and_said(source, tmp_path):
    with serving(source) as (first, _):
        second_source = make_source(tmp_path / "second")
        with serving(second_source, port=first.port) as (second, lines):
            assert second.port > first.port
            assert lines[0] == f"viewer: http://127.0.0.1:{second.port}"
            assert lines[1] == f"port {first.port} is taken, hence {second.port}"
            with opened(second):
                pass


def test_the_viewer_prints_nothing_of_its_own(source, capsys):
    with serving(source) as (viewer, _), opened(viewer):
        pass
    assert capsys.readouterr() == ("", "")


def test_the_training_panel_steers_the_training(tmp_path):
    control = TrainingControl()
    source = make_source(tmp_path, control)
    with serving(source) as (viewer, _), opened(viewer) as page, control.running():
        page.set("pause", True)
        page.wait_until(lambda: has_control(page, "resume"))
        assert control.is_paused
        page.set("resume", True)
        page.wait_until(lambda: has_control(page, "pause"))
        assert not control.is_paused
        page.set("viewer's share", 0.7)
        page.set("stop training", True)
        page.wait_until(lambda: any("tick the box" in text for _, text in page.notices))
        assert not control.is_stop_requested
        page.set("really stop", True)
        page.set("stop training", True)
        page.wait_until(lambda: "stopping" in page.texts)
        assert control.is_stop_requested
        assert control.device.guest_share == 0.7
        page.set("save a checkpoint", True)
        page.wait_until(lambda: any(title == "saving" for title, _ in page.notices))
        assert control.take_save_request()
