"""The life of the server: ports, threads, what it prints, and the training that it steers."""

import socket
import threading
import urllib.request

import pytest

from tests.viewer.pages import has_control, opened, serving
from tests.viewer.view_factory import make_source
from unmix_plugin.engine.training.progress import TrainingStatus
from unmix_plugin.engine.training.training_control import TrainingControl


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
    for thread in set(threading.enumerate()) - before:
        thread.join(120)
        assert not thread.is_alive(), thread


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


def test_waiting_ends_when_no_page_is_left(source, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.server._UNWATCHED_S", 1)
    with serving(source) as (viewer, _):
        waiting = threading.Thread(target=viewer.wait, args=(True,))
        with opened(viewer):
            waiting.start()
            waiting.join(2.5)
            assert waiting.is_alive()
        waiting.join(120)
        assert not waiting.is_alive()


def test_the_page_has_the_title_of_the_viewer(viewer):
    with urllib.request.urlopen(f"http://127.0.0.1:{viewer.port}/") as answer:
        page = answer.read().decode()
    assert "<title>unmix-nerf</title>" in page
    assert "<title>Viser" not in page
    assert "prefers-color-scheme: dark" in page
