"""Pages that send nonsense, leave, come in crowds or are not allowed in: the others go on."""

import math
import time

import msgspec
import pytest

from tests.viewer.pages import has_control, opened, page_of, serving, show_layer
from unmix_plugin.viewer.access import MOST_CLIENTS
from unmix_plugin.viewer.server import TokenPrompt


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
        show_layer(page, "depth")
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
        show_layer(page, "depth")
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
        with viewer.services.loop._changed:  # told of every view that is removed
            assert viewer.services.loop._changed.wait_for(lambda: viewer.services.loop.num_views == 1, 120)
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


def test_a_page_must_give_the_token_before_it_sees_anything(source):
    with serving(source, token="sesame") as (viewer, _), page_of(viewer) as page:
        try_a_wrong_token(page)
        assert page.pictures == []
        assert not has_control(page, "layer")
        assert viewer.num_clients == 0
        enter_token(page, "sesame")
        page.wait_until(lambda: bool(page.pictures))
        assert not has_control(page, "token")


def test_a_page_that_answers_at_once_is_heard(source, monkeypatch):
    ask = TokenPrompt.__init__

    def ask_slowly(*words):
        ask(*words)
        time.sleep(1.0)

    monkeypatch.setattr(TokenPrompt, "__init__", ask_slowly)
    with serving(source, token="sesame") as (viewer, _), page_of(viewer) as page:
        try_a_wrong_token(page)


def test_the_right_token_is_let_in_while_another_page_guesses(source):
    with serving(source, token="sesame") as (viewer, _), page_of(viewer) as bad, page_of(viewer) as good:
        try_a_wrong_token(bad)
        good.look_from(0.3)
        good.wait_until(lambda: has_control(good, "token"))
        for _ in range(50):
            enter_token(bad, "barley")
        enter_token(good, "sesame")
        good.wait_until(lambda: bool(good.pictures))


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
    monkeypatch.setattr("unmix_plugin.viewer.server.headers_of", lambda _: None)
    with page_of(viewer) as page:
        page.look_from(0.3)
        page.wait_until(lambda: "this page is from another site" in page.texts)
        page.wait_until(lambda: page.is_closed)


@pytest.mark.parametrize("token", [None, "sesame"])
def test_what_a_page_uploads_is_not_kept(source, token):
    with serving(source, token=token) as (viewer, _), page_of(viewer) as page:
        page.look_from(0.3)
        box = "formula" if token is None else "token"
        page.wait_until(lambda: has_control(page, box))
        upload = {"source_component_uuid": page.control(box), "transfer_uuid": "some"}
        page.send(
            "FileTransferStartUpload",
            **upload,
            filename="a",
            mime_type="text/plain",
            part_count=2,
            size_bytes=2000,
        )
        page.send("FileTransferPart", **upload, part_index=0, content=bytes(1000))
        page.look_from(0.4)
        if token is None:
            page.wait_until(lambda: bool(page.pictures))
        else:
            try_a_wrong_token(page)
        assert viewer._server is not None
        apis = [viewer._server.gui, *(client.gui for client in viewer._server.get_clients().values())]
        assert len(apis) == 2
        assert all(not api._current_file_upload_states for api in apis)


def test_there_is_a_limit_to_connections_that_are_not_served(viewer, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.web_server._MOST_CONNECTIONS", 2)
    with page_of(viewer) as first, page_of(viewer) as second:
        for page in (first, second):
            page.look_from(0.3)
            page.wait_until(lambda page=page: bool(page.pictures))
        with page_of(viewer) as third:
            third.wait_until(lambda: third.is_closed)
        assert not first.is_closed


def test_nobody_can_ask_for_a_public_tunnel(viewer, monkeypatch):
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *_, **__: pytest.fail("a tunnel was opened"))
    with opened(viewer) as page:
        page.send("ShareUrlRequest")
        show_layer(page, "depth")
