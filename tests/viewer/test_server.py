"""The life of the server; pages that send nonsense, leave, come in crowds or are not allowed in: the others go on."""

import base64
import contextlib
import gzip
import math
import socket
import threading
import urllib.error
import urllib.request
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import websockets.asyncio.server
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus

from tests.factories.viewers import has_control, opened, page_of, serving, show_layer
from tests.factories.views import make_source
from unmix_plugin.engine.training.progress import TrainingStatus
from unmix_plugin.engine.training.training_control import TrainingControl
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.maps.indices import parse_formula
from unmix_plugin.viewer import connections
from unmix_plugin.viewer.authentication import Authentication
from unmix_plugin.viewer.connections import RateLimit, is_heard
from unmix_plugin.viewer.rendering.captures import VideoQueue

SERVE = websockets.asyncio.server.serve


def test_stopping_frees_the_port_and_every_thread_and_prints_nothing(source, capsys):
    before = set(threading.enumerate())
    with serving(source) as (viewer, _), opened(viewer) as page:
        port = viewer.port
        viewer.stop()
        page.wait_until(lambda: page.is_closed)
        viewer.stop()
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", port))
    for thread in set(threading.enumerate()) - before:
        thread.join(120)
        assert not thread.is_alive(), thread
    assert capsys.readouterr() == ("", "")


def test_a_taken_port_is_passed_over_and_said(viewer, tmp_path):
    with serving(make_source(tmp_path), port=viewer.port) as (second, lines):
        assert second.port > viewer.port
        assert lines[0] == f"viewer: http://127.0.0.1:{second.port}"
        assert lines[1] == f"port {viewer.port} is taken, hence {second.port}"
        with opened(second):
            pass


def test_pages_that_are_opened_at_once_are_all_served(tmp_path):
    parse_formula.cache_clear()  # they are parsed for each page's menu of indices
    with serving(make_source(tmp_path)) as (viewer, lines), contextlib.ExitStack() as stack:
        pages = [stack.enter_context(page_of(viewer)) for _ in range(6)]
        for page in pages:
            page.look_from(0.3)
        for page in pages:
            page.wait_until(lambda page=page: bool(page.pictures) and has_control(page, "render a video"))
            assert "could not be served" not in page.texts
        assert len(lines) == 1


def test_the_training_panel_steers_the_training(tmp_path):
    control = TrainingControl()
    source = make_source(tmp_path, control)
    with serving(source) as (viewer, _), opened(viewer) as page, control.running():
        page.set("set scale")
        page.wait_for_notice("when training has ended")
        for label, other in (("pause", "resume"), ("resume", "pause")):
            page.set(label)
            page.wait_until(lambda other=other: has_control(page, other))
            assert control.is_paused is (label == "pause")
        page.set("viewer's share", 0.7)
        page.set("stop training")
        page.wait_for_notice("tick the box")
        assert not control.is_stop_requested
        page.set("really stop")
        page.set("stop training")
        page.wait_for_text("stopping")
        assert control.is_stop_requested
        assert control.device.viewing_share == 0.7
        page.set("save a checkpoint")
        page.wait_until(lambda: any(title == "saving" for title, _ in page.notices))
        assert control.take_save_request()


@pytest.mark.slow
@pytest.mark.parametrize(("is_stopped", "said"), [(True, "stopped, and saved"), (False, "done")])
def test_the_last_that_a_page_shows_is_how_training_ended(tmp_path, is_stopped, said):
    control = TrainingControl()
    with serving(make_source(tmp_path, control)) as (viewer, _), opened(viewer) as page:
        with control.running():
            control.show(TrainingStatus(7, 3.0, 0.25, 0.1, 20.0, 1000.0))
            page.wait_for_text("running", "9 s of training")
            if is_stopped:
                control.request_stop()
        viewer.stop()
        page.wait_until(lambda: page.is_closed)
        assert said in page.texts
        assert "s of training" not in page.texts
        assert page.props("pause")["disabled"]


def test_a_viewer_that_nobody_watches_stays_until_its_videos_are_rendered(source, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.server._UNWATCHED_S", 1)
    is_rendering = threading.Event()
    is_rendering.set()
    monkeypatch.setattr(VideoQueue, "is_busy", property(lambda _: is_rendering.is_set()))
    with serving(source) as (viewer, lines):
        waiting = threading.Thread(target=viewer.wait, kwargs={"while_watched": True})
        waiting.start()
        waiting.join(2.5)
        assert waiting.is_alive()
        is_rendering.clear()
        waiting.join(60)
        assert not waiting.is_alive()
        is_rendering.set()
        viewer.stop()
        assert lines[-1] == "a video was being rendered and is not kept: the viewer was stopped"


NO_CAMERAS: tuple[dict[str, Any], ...] = (
    {"wxyz": (math.nan, 0.0, 0.0, 1.0)},
    {"position": (math.inf, 0.0, 0.0)},
    {"fov": -math.inf},
    {"image_width": 0, "image_height": 0},
    {"image_height": -5},
    {"image_height": 10**9, "image_width": 10**9},
)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.viser. .* does not match annotation")
def test_cameras_and_values_that_no_page_would_send_harm_nobody(page):
    page.set("own range")
    for label in ("layer", "formula", "low", "picture height (px)", "width", "brightness"):
        for value in (math.nan, math.inf, -1e300, "x" * 1000, None, [1, 2], {"a": 1}, True):
            page.set(label, value)
    for number, changes in enumerate(({}, *NO_CAMERAS)):
        page.look_from(0.5, **changes)
        show_layer(page, ("depth", "colour")[number % 2])
        count = len(page.pictures)
        page.look_from(0.9 + number)
        page.wait_until(lambda count=count: len(page.pictures) > count)


def test_a_page_that_sends_nonsense_loses_its_connection_and_others_go_on(viewer):
    words = {"type": "ViewerCameraMessage", "position": ("a", "b", "c")}
    nonsense = (b"", b"\xff\xff", b"\x81", "text", b"\x81\xa4type", msgspec.msgpack.encode(words))
    with opened(viewer) as good:
        for number, data in enumerate(nonsense):
            with page_of(viewer) as bad:
                bad.look_from(0.3)
                bad.send_raw(data)
                bad.wait_until(lambda bad=bad: bad.is_closed)
            count = len(good.pictures)
            good.look_from(2.0 + number)
            good.wait_until(lambda count=count: len(good.pictures) > count)


def test_no_more_pages_are_served_than_there_is_room_for(viewer, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.authentication.MOST_PAGES", 1)
    with opened(viewer):
        assert refused(viewer) == 503
    with opened(viewer):  # which waits until the one before has gone
        pass


def refused(viewer, **settings):
    """HTTP status with which a page's connection is refused."""
    with pytest.raises(InvalidStatus) as caught, page_of(viewer, **settings):
        pass
    return caught.value.response.status_code


def coded(word):
    return {"Authorization": "Basic " + base64.b64encode(f":{word}".encode()).decode()}


def read(viewer, headers=None, path=""):
    """Status, headers and text of the page that a browser would load."""
    asking = urllib.request.Request(f"http://127.0.0.1:{viewer.port}/{path}", headers=headers or {})
    try:
        answer = urllib.request.urlopen(asking)
    except urllib.error.HTTPError as error:
        answer = error
    with answer:
        return answer.status, answer.headers, answer.read().decode()


def test_the_page_has_the_title_of_the_viewer(viewer):
    _, _, page = read(viewer)
    assert " - unmix-nerf</title>" in page
    assert "<title>Viser" not in page
    assert "prefers-color-scheme: dark" in page


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A viewer that asks for the token."""
    with serving(make_source(tmp_path_factory.mktemp("run")), token="sesame") as (running, _):
        yield running


def test_a_page_must_give_the_token_before_it_sees_anything(guarded):
    status, _, text = read(guarded)
    assert (status, "asks for the token" in text, '<div id="root">' in text) == (401, True, False)
    assert read(guarded, coded("barley"))[0] == 401
    assert refused(guarded) == refused(guarded, headers=coded("barley")) == 401
    assert guarded.sessions == ()
    status, headers, _ = read(guarded, coded("sesame"))
    assert status == 200
    cookie = {"Cookie": headers["Set-Cookie"].partition(";")[0]}
    assert " - unmix-nerf</title>" in read(guarded, cookie)[2]
    with opened(guarded, headers=cookie, origin=f"http://127.0.0.1:{guarded.port}"):
        pass


def test_a_page_of_another_site_is_refused_and_one_of_its_own_is_served(source):
    with serving(source) as (viewer, lines):
        assert [refused(viewer, origin="http://evil.example") for _ in range(20)] == [403] * 20
        assert refused(viewer, origin=f"https://127.0.0.1:{viewer.port}") == 403
        assert [line for line in lines if "another site (http://evil.example)" in line] == lines[1:2]
        with opened(viewer, origin=f"http://127.0.0.1:{viewer.port}"):
            pass


def test_a_page_of_another_version_is_refused(viewer, monkeypatch):
    monkeypatch.setattr("tests.factories.viewer_page.viser", SimpleNamespace(__version__="0.0.1"))
    assert refused(viewer) == 400


def test_a_message_larger_than_any_that_a_page_sends_ends_its_connection(viewer, capfd):
    with page_of(viewer) as page:
        page.look_from(0.3)
        page.wait_until(lambda: has_control(page, "formula"))
        page.set("formula", "x" * 100_000)
        page.wait_until(lambda: page.is_closed)
    assert capfd.readouterr().err == ""


def test_a_page_that_sends_faster_than_any_is_slowed_down():
    clock, rate = (
        SimpleNamespace(now=100.0),
        RateLimit(messages_per_s=200.0, bytes_per_s=10_000.0, burst_s=2.0),
    )

    def send(number, size):
        begun = clock.now
        for _ in range(number):
            clock.now += rate.delay(size, clock.now)
        return clock.now - begun

    assert send(400, 10) == pytest.approx(0.0)
    assert send(200, 10) == pytest.approx(1.0)
    assert send(1, 10_000) == pytest.approx(1.0)
    clock.now += 60.0
    assert send(400, 10) == pytest.approx(0.0)


def test_a_page_that_never_says_anything_loses_its_place(viewer, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.connections._SILENT_S", 0.2)
    with page_of(viewer) as page:
        page.wait_until(lambda: page.is_closed)


CAMERA = {"wxyz": (1, 0, 0, 0), "position": (0.5, 0, 0), "fov": 1, "near": 0.1, "far": 10, "image_height": 20}
CLICK = {"event_type": "click", "ray_origin": None, "ray_direction": (0, 0, 1), "screen_pos": ((0.5, 0.5),)}
HEARD = {
    "ViewerCameraMessage": {**CAMERA, "image_width": 30.5, "look_at": (0, 0, 0), "up_direction": (0, 0, 1)},
    "GuiUpdateMessage": {"uuid": "a", "updates": {"value": [1, "x", None]}},
    "LocalStorageGetItemResponseMessage": {"value": None, "error": None, "request_uuid": "a"},
    "ScenePointerMessage": {**CLICK, "modifier": None},
}


@pytest.mark.parametrize("kind", HEARD)
def test_what_a_page_sends_is_checked_before_anything_of_it_is_kept(kind):
    message = {"type": kind, **HEARD[kind]}
    assert is_heard(msgspec.msgpack.encode(message))
    for name in HEARD[kind]:
        with pytest.raises(ValueError, match=r"missing|Expected"):
            is_heard(msgspec.msgpack.encode({key: value for key, value in message.items() if key != name}))
        with pytest.raises(ValueError, match="Expected"):
            is_heard(msgspec.msgpack.encode({**message, name: b"x"}))


def test_what_no_control_of_the_viewer_needs_is_not_listened_to():
    upload = {"source_component_uuid": "a", "transfer_uuid": "b"}
    kinds = [("ShareUrlRequest", {}), ("GuiFormDirtyMessage", {"uuid": "a"})]
    kinds += [(f"FileTransfer{name}", upload) for name in ("StartUpload", "Part")]
    kinds += [("GuiUpdateMessage", {"uuid": "a", "updates": updates}) for updates in ({"update_cb": 1}, {})]
    for kind, values in kinds:
        assert not is_heard(msgspec.msgpack.encode({"type": kind, **values}))


@given(st.binary(max_size=100))
def test_bytes_of_any_kind_are_a_message_or_none(data):
    with contextlib.suppress(ValueError):
        is_heard(data)


def test_what_a_page_uploads_is_not_kept_and_nobody_can_ask_for_a_public_tunnel(page, monkeypatch):
    tunnels = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *words, **_: tunnels.append(words))
    page.send("ShareUrlRequest")
    upload = {"source_component_uuid": page.control("formula"), "transfer_uuid": "some"}
    start = {"filename": "a", "mime_type": "text/plain", "part_count": 2, "size_bytes": 2000}
    page.send("FileTransferStartUpload", **upload, **start)
    page.send("FileTransferPart", **upload, part_index=0, content=bytes(1000))
    show_layer(page, "depth")
    assert "GuiUpdateMessage" in page.kinds
    assert "FileTransferPartAck" not in page.kinds  # with which viser answers each part that it keeps
    assert tunnels == []


def test_viser_itself_is_left_as_it_is_and_its_server_is_ours(viewer):
    assert websockets.asyncio.server.serve is SERVE
    with opened(viewer) as page:
        page.send_raw(b"\xff")  # which viser itself would answer with a traceback
        page.wait_until(lambda: page.is_closed)


def test_a_version_of_viser_that_cannot_be_guarded_is_refused(monkeypatch):
    own = SimpleNamespace(asyncio=SimpleNamespace(server=SimpleNamespace(serve=SERVE)), datastructures=None)
    monkeypatch.setattr("viser.infra._infra.websockets", own)  # which then never asks for ours
    before = set(threading.enumerate())
    with pytest.raises(ConfigError, match=r"in a way that the viewer can't guard; install viser 1\.1"):
        connections.open_server("127.0.0.1", 0, Authentication("127.0.0.1", None), lambda _: None)
    for thread in set(threading.enumerate()) - before:
        thread.join(20)
        assert not thread.is_alive(), thread
    assert websockets.asyncio.server.serve is SERVE


@pytest.mark.parametrize("path", ["", "index.html", "?darkMode", "assets/no.js", "../secret", "%2e%2e/x"])
def test_no_page_of_another_site_can_show_the_viewer_in_a_frame(viewer, guarded, path):
    for one, headers in (
        (viewer, {}),
        (guarded, {}),
        (guarded, coded("barley")),
        (viewer, {"Host": "evil.example"}),
    ):
        status, answered, text = read(one, headers, path)
        assert answered["Content-Security-Policy"] == "frame-ancestors 'self'"
        assert answered["X-Frame-Options"] == "SAMEORIGIN"
        assert ('<div id="root">' in text) is (status == 200)
    assert read(viewer, path=path)[0] == (404 if "/" in path else 200)


def test_the_page_comes_compressed_where_the_browser_takes_that(viewer):
    asking = urllib.request.Request(
        f"http://127.0.0.1:{viewer.port}/", headers={"Accept-Encoding": "gzip, br"}
    )
    with urllib.request.urlopen(asking) as answer:
        packed = answer.read()
    assert answer.headers.get_all("Content-Encoding") == ["gzip"]
    assert gzip.decompress(packed).decode() == read(viewer)[2]
