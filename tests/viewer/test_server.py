"""The life of the server; pages that send nonsense, leave, come in crowds or are not allowed in: the others go on."""

import math
import socket
import threading
import time
import urllib.request
from typing import Any

import msgspec
import pytest
import viser
from viser import infra

from tests.viewer.pages import has_control, opened, page_of, serving, show_layer
from tests.viewer.view_factory import make_source
from unmix_plugin.engine.training.progress import TrainingStatus
from unmix_plugin.engine.training.training_control import TrainingControl
from unmix_plugin.viewer.access import MOST_CLIENTS
from unmix_plugin.viewer.server import _TokenPrompt


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


@pytest.mark.slow
@pytest.mark.parametrize(("is_stopped", "said"), [(True, "stopped, and saved"), (False, "done")])
def test_the_last_that_a_page_shows_is_how_training_ended(tmp_path, is_stopped, said):
    control = TrainingControl()
    with serving(make_source(tmp_path, control)) as (viewer, _), opened(viewer) as page:
        with control.running():
            control.show(TrainingStatus(7, 3.0, 0.25, 0.1, 20.0, 1000.0))
            page.wait_until(lambda: "running" in page.texts and "9 s of training" in page.texts)
            if is_stopped:
                control.request_stop()
        viewer.stop()
        page.wait_until(lambda: page.is_closed)
        assert said in page.texts
        assert "s of training" not in page.texts
        assert page.controls[page.control("pause")]["disabled"]


@pytest.mark.slow
def test_waiting_ends_when_no_page_is_left(source, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.server._UNWATCHED_S", 1)
    with serving(source) as (viewer, _):
        waiting = threading.Thread(target=viewer.wait, args=(True,))
        with opened(viewer):
            waiting.start()
            waiting.join(2.0)
            assert waiting.is_alive()
        waiting.join(120)
        assert not waiting.is_alive()


def test_the_page_has_the_title_of_the_viewer(viewer):
    with urllib.request.urlopen(f"http://127.0.0.1:{viewer.port}/") as answer:
        page = answer.read().decode()
    assert "<title>unmix-nerf</title>" in page
    assert "<title>Viser" not in page
    assert "prefers-color-scheme: dark" in page


NO_CAMERAS: tuple[dict[str, Any], ...] = (
    {"wxyz": (math.nan, 0.0, 0.0, 1.0)},
    {"position": (math.inf, 0.0, 0.0)},
    {"fov": -math.inf},
    {"image_width": 0, "image_height": 0},
    {"image_height": -5},
    {"image_height": 10**9, "image_width": 10**9},
    {"wxyz": ()},
)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.viser. .* does not match annotation")
def test_a_camera_that_is_none_harms_nobody(viewer):
    with opened(viewer) as page:
        for number, changes in enumerate(NO_CAMERAS):
            page.look_from(0.5, **changes)
            show_layer(page, ("depth", "colour")[number % 2])
            count = len(page.pictures)
            page.look_from(0.9 + number)
            page.wait_until(lambda count=count: len(page.pictures) > count)


@pytest.mark.slow
@pytest.mark.parametrize("label", ["layer", "formula", "low", "finest picture (rows)", "width", "brightness"])
def test_values_that_no_control_would_send_harm_nobody(viewer, label):
    with opened(viewer) as page:
        page.set("own range", True)
        for value in (math.nan, math.inf, -1e300, "x" * 1000, None, [1, 2], {"a": 1}, True):
            page.set(label, value)
        show_layer(page, "depth")
        count = len(page.pictures)
        page.set("layer", "colour")
        page.look_from(1.3)
        page.wait_until(lambda: len(page.pictures) > count)


def test_a_page_that_sends_nonsense_loses_its_connection_and_others_go_on(viewer):
    words = {"type": "ViewerCameraMessage", "position": ("a", "b", "c")}
    nonsense = (b"", b"\xff\xff", b"\x81", "text", b"\x81\xa4type\xa4Nope", msgspec.msgpack.encode(words))
    with opened(viewer) as good:
        for number, data in enumerate(nonsense):
            with page_of(viewer) as bad:
                bad.look_from(0.3)
                bad.send_raw(data)
                bad.wait_until(lambda bad=bad: bad.is_closed)
            count = len(good.pictures)
            good.look_from(2.0 + number)
            good.wait_until(lambda count=count: len(good.pictures) > count)


@pytest.mark.slow
def test_pages_that_leave_in_mid_render_are_forgotten(viewer):
    for _ in range(5):
        with page_of(viewer) as page:
            page.look_from(0.3)
            page.look_from(0.4)
    loop = viewer.services.loop
    with opened(viewer):
        with loop._changed:  # told of every view that is removed
            assert loop._changed.wait_for(lambda: len(loop._views) == 1, 120)
        assert viewer.num_clients == 1


def test_no_more_pages_are_served_than_there_is_room_for(viewer, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.server.MOST_CLIENTS", 1)
    assert MOST_CLIENTS > 1
    with opened(viewer), page_of(viewer) as second:
        second.look_from(0.3)
        second.wait_until(lambda: "pages are open already" in second.texts)
        second.wait_until(lambda: second.is_closed)
        assert second.pictures == []


def enter_token(page, token):
    page.set("token", token)
    page.set("enter", True)


def try_a_wrong_token(page):
    page.look_from(0.3)
    page.wait_until(lambda: has_control(page, "token"))
    enter_token(page, "barley")
    page.wait_until(lambda: "That is not the token" in page.texts)


@pytest.fixture(autouse=True)
def brief(monkeypatch):
    """Pages that are turned away need no time to read why."""
    monkeypatch.setattr("unmix_plugin.viewer.server._READING_S", 0.2)


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A viewer that asks for the token."""
    with serving(make_source(tmp_path_factory.mktemp("run")), token="sesame") as (running, _):
        yield running


def test_a_page_must_give_the_token_before_it_sees_anything(guarded):
    with page_of(guarded) as page:
        try_a_wrong_token(page)
        assert page.pictures == []
        assert not has_control(page, "layer")
        assert guarded.num_clients == 0
        enter_token(page, "sesame")
        page.wait_until(lambda: bool(page.pictures))
        assert not has_control(page, "token")


def test_a_page_that_answers_at_once_is_heard(guarded, monkeypatch):
    ask = _TokenPrompt.__init__

    def ask_slowly(*words):
        ask(*words)
        time.sleep(1.0)

    monkeypatch.setattr(_TokenPrompt, "__init__", ask_slowly)
    with page_of(guarded) as page:
        try_a_wrong_token(page)


def test_a_page_of_another_site_is_refused_and_one_of_its_own_is_served(source):
    with serving(source) as (viewer, lines):
        for _ in range(2):
            with page_of(viewer, origin="http://evil.example") as foreign:
                foreign.look_from(0.3)
                foreign.wait_until(lambda: "this page is from another site" in foreign.texts)
                foreign.wait_until(lambda: foreign.is_closed)
                assert foreign.pictures == []
        assert [line for line in lines if "another site (http://evil.example)" in line] == lines[1:]
        assert len(lines) == 2
        with opened(viewer, origin=f"http://127.0.0.1:{viewer.port}"):
            pass


def test_a_page_whose_headers_cannot_be_read_is_refused(viewer, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.server._headers_of", lambda _: None)
    with page_of(viewer) as page:
        page.look_from(0.3)
        page.wait_until(lambda: "this page is from another site" in page.texts)
        page.wait_until(lambda: page.is_closed)


@pytest.mark.parametrize("is_guarded", [False, True])
def test_what_a_page_uploads_is_not_kept(viewer, guarded, is_guarded):
    serves = guarded if is_guarded else viewer
    with page_of(serves) as page:
        page.look_from(0.3)
        box = "token" if is_guarded else "formula"
        page.wait_until(lambda: has_control(page, box))
        upload = {"source_component_uuid": page.control(box), "transfer_uuid": "some"}
        start = {"filename": "a", "mime_type": "text/plain", "part_count": 2, "size_bytes": 2000}
        page.send("FileTransferStartUpload", **upload, **start)
        page.send("FileTransferPart", **upload, part_index=0, content=bytes(1000))
        page.look_from(0.4)
        if is_guarded:
            try_a_wrong_token(page)
        else:
            page.wait_until(lambda: bool(page.pictures))
        apis = [serves._server.gui, *(client.gui for client in serves._server.get_clients().values())]
        assert len(apis) >= 2
        assert all(not api._current_file_upload_states for api in apis)


@pytest.mark.slow
def test_there_is_a_limit_to_connections_that_are_not_served(viewer, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.server._MOST_CONNECTIONS", 2)
    with page_of(viewer) as first, page_of(viewer) as second:
        for page in (first, second):
            page.look_from(0.3)
            page.wait_until(lambda page=page: bool(page.pictures))
        with page_of(viewer) as third:
            third.wait_until(lambda: third.is_closed)
        assert not first.is_closed


@pytest.mark.slow
def test_nobody_can_ask_for_a_public_tunnel(viewer, monkeypatch):
    tunnels = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *words, **_: tunnels.append(words))
    with opened(viewer) as page:
        page.send("ShareUrlRequest")
        show_layer(page, "depth")
    assert tunnels == []


def test_the_private_parts_are_those_of_the_version_that_they_were_taken_from(viewer):
    assert viser.__version__.startswith("1.1."), (
        "read server.py beside the source of this viser, then name it here"
    )
    server = viewer._server
    with opened(viewer):
        (client,) = server.get_clients().values()
        connection = client._viser_server._websock_server._live_connections[client.client_id]
        assert connection.request.headers["Host"].endswith(str(viewer.port))
        assert connection.remote_address[0] == "127.0.0.1"
        assert client._viser_server._event_loop is server._event_loop
    assert server._websock_server._incoming_handlers


@pytest.mark.usefixtures("viewer")
def test_viser_itself_is_left_as_it_is():
    assert infra.WebsockServer.__module__.startswith("viser")
