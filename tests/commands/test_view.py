"""`unmix-view`: what is printed, what is served, and how it ends."""

import json
import signal
import time
from contextlib import contextmanager

import pytest

from tests.commands.test_bad_runs import contents
from tests.factories.commands import START_S, address, looking, refused, started, visited
from tests.factories.outputs import read_video
from tests.factories.systems import SIGNALS_TO_END, needs_posix
from unmix_plugin.commands.view import ViewOptions, prepared, view
from unmix_plugin.viewer.access import ViewerOptions
from unmix_plugin.viewer.rendering.scene import MeasuredViews


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--viewer.port", "99999"], "--viewer.port is a number from 0"),
        (["--viewer.host", "203.0.113.7"], "can't listen at --viewer.host 203.0.113.7"),
        (["--viewer.token", ""], "--viewer.token is empty"),
        (["--illuminant", "D66"], "there is no light 'D66'; nearest: D65"),
        (["--edits", "nowhere.yml"], "can't read the recipe nowhere.yml"),
    ],
)
def test_an_address_or_an_edit_that_is_none_is_refused(trained, words, message):
    assert message in refused(view, "--run", trained.run, "--device", "cpu", *words)


@pytest.mark.parametrize("number", SIGNALS_TO_END)
def test_a_run_is_served_until_it_is_asked_to_end(trained, number):
    def visit(printed):
        printed("stop with Ctrl-C")
        with looking(address(printed)) as page:
            wait_for_control(page, "layer")
            signal.raise_signal(number)
            page.wait_until(lambda: page.is_closed)

    ended = visited(visit, view, "--run", trained.run, "--device", "cpu", "--viewer.port", "0")
    assert (ended.status, ended.err) == (0, "")
    assert ended.out.splitlines()[-2:] == ["stop with Ctrl-C", "stopped"]


@needs_posix
def test_a_run_is_served_by_a_process_of_its_own_until_ctrl_c(trained):
    with started("view", "--run", trained.run, "--device", "cpu", "--viewer.port", "0") as command:
        with looking(command.address) as page:
            wait_for_control(page, "layer")
            command.process.send_signal(signal.SIGINT)
            page.wait_until(lambda: page.is_closed)
        assert command.end() == 0
        assert command.lines[-2:] == ["stop with Ctrl-C", "stopped"]
        assert not any("viser" in line for line in command.lines)


@contextmanager
def served(run, **options):
    """The viewer of a run, and a page with its first picture."""
    viewer = prepared(ViewOptions(run=run, device="cpu", viewer=ViewerOptions(port=0), **options))
    viewer.start()
    try:
        with looking(f"ws://127.0.0.1:{viewer.port}") as page:
            yield viewer, page
    finally:
        viewer.stop()


def wait_for_control(page, label):
    page.wait_until(lambda: any(one.get("label") == label for one in page.controls.values()))


def test_what_was_measured_is_shown_where_the_scene_is_at_hand(trained):
    with served(trained.run) as (viewer, page):
        viewer.services.wait_for_scene(START_S)
        assert isinstance(viewer.services.maker.aids.measured, MeasuredViews)
        page.set("layer", "error against a training view")
        page.wait_until(lambda: "mean absolute error of the bands against training view" in page.texts)
        page.set("cameras", True)
        page.wait_until(lambda: page.last_depth is not None)


def test_a_run_whose_scene_has_gone_is_shown_without_what_was_measured(run_copy):
    scene = json.loads((run_copy / "scene.json").read_text())
    scene["summary"]["root"] = "/nowhere/at/all"
    (run_copy / "scene.json").write_text(json.dumps(scene))
    before = contents(run_copy)
    with served(run_copy) as (_, page):
        page.set("layer", "error against a training view")
        page.wait_until(lambda: "no error to show: the scene is not at hand" in page.texts)
        assert "/nowhere/at/all" in page.texts
    assert contents(run_copy) == before


def add_key_frames(page, *angles):
    for number, angle in enumerate(angles, start=1):
        page.look_from(angle)
        page.set("add a key frame here", True)
        key = page.controls[page.control("key frame")]
        page.wait_until(lambda key=key, number=number: key.get("value") == f"{number} of {number}")


def test_a_path_becomes_a_video_of_the_edited_scene(run_copy):
    with served(run_copy) as (_, page):
        wait_for_control(page, "render a video")
        add_key_frames(page, 0.3, 0.6)
        page.set("light", "A: incandescent lamp, 2856 K")
        for label, value in (("width", 33), ("height", 32), ("seconds", 0.5), ("frames a second", 6)):
            page.set(label, value)
        page.wait_until(lambda: "illuminant: A" in page.controls[page.control("recipe")]["value"])
        page.set("render a video", True)
        page.wait_until(lambda: any(name.endswith(".mp4") for name in page.downloads), START_S)
    (video,) = (run_copy / "exports" / "viewer").rglob("*.mp4")
    frames, _ = read_video(video)
    assert frames.shape == (3, 32, 32, 3)
    assert frames.std() > 4
    assert "illuminant: A" in (run_copy / "exports" / "viewer" / "view-path.yml").read_text()


def test_a_run_is_shown_with_the_edits_and_the_light_asked_for(run_copy):
    recipe = run_copy / "recipe.yml"
    recipe.write_text("edits:\n  - rename: {endmember: endmember_1, name: clay}\n")
    with served(run_copy, edits=recipe, illuminant="fl2") as (_, page):
        wait_for_control(page, "render a video")
        assert page.controls[page.control("light")]["value"] == "FL2: cool white fluorescent lamp, 4230 K"
        assert "clay" in page.controls[page.control("other endmember")]["options"]
        page.set("changes", "start again")
        page.wait_until(lambda: page.controls[page.control("light")]["value"] == "as recorded")


def test_a_video_goes_on_when_its_page_is_closed(run_copy):
    folder = run_copy / "exports" / "viewer"
    viewer = prepared(ViewOptions(run=run_copy, device="cpu", viewer=ViewerOptions(port=0)))
    viewer.start()
    try:
        with looking(f"ws://127.0.0.1:{viewer.port}") as page:
            wait_for_control(page, "render a video")
            add_key_frames(page, 0.3, 0.6)
            for label, value in (("width", 64), ("height", 64), ("seconds", 1.0), ("frames a second", 12)):
                page.set(label, value)
            page.set("render a video", True)
            page.wait_until(lambda: any(title == "video" for title, _ in page.notices))
        until = time.monotonic() + START_S
        while viewer.services.videos.is_busy:
            assert time.monotonic() < until, list(folder.rglob("*"))
            time.sleep(0.1)
        assert not list(folder.rglob("*.tmp"))
        with looking(f"ws://127.0.0.1:{viewer.port}") as page:
            wait_for_control(page, "render a video")
    finally:
        viewer.stop()
    (video,) = folder.rglob("*.mp4")
    assert read_video(video)[0].shape == (12, 64, 64, 3)
