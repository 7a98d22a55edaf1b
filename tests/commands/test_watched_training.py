"""The viewer beside `unmix-train`: what is printed, what is served, and how both end."""

import signal
import threading
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from tests.factories.commands import SMALL_METHOD, START_S, address, done, looking, refused, started, visited
from tests.factories.systems import needs_posix
from tests.factories.viewer_page import Page
from unmix_plugin.commands import train as train_module
from unmix_plugin.commands.train import parse, train
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.spectral.library.spectra_csv import read_spectra
from unmix_plugin.viewer import server


def training_argv(trained, folder, *words):
    given = ["unmix-nerf", "--data", trained.scene, "--output-dir", folder, *SMALL_METHOD]
    return [*given, "--viewer.enabled", "--viewer.port", "0", *words]


@needs_posix
def test_a_training_is_watched_while_it_runs_and_ends_as_without(trained, tmp_path):
    words = training_argv(trained, tmp_path, "--max-num-iterations", "20")
    with started("train", *words, "--viewer.keep-open") as command:
        with looking(command.address) as page:
            command.wait_for_line("the viewer stays open")
            page.wait_until(lambda: ">done<" in page.texts, START_S)
            count = len(page.pictures)
            page.look_from(1.0)
            page.wait_until(lambda: len(page.pictures) > count)
        command.process.send_signal(signal.SIGINT)
        assert command.end() == 0
        assert command.lines[-1].startswith("run: ")
        found = read_spectra(Path(command.lines[-1].removeprefix("run: ")) / "endmembers.csv")
        np.testing.assert_array_equal(found.spectra, read_spectra(trained.run / "endmembers.csv").spectra)


def test_without_keep_open_the_process_ends_with_the_training(trained, tmp_path):
    ended = done(train, *training_argv(trained, tmp_path, "--max-num-iterations", 3))
    assert "viewer: http://127.0.0.1:" in ended.out
    assert ended.last_line.startswith("run: ")
    assert not [thread for thread in threading.enumerate() if "viewer" in thread.name]


def test_the_viewer_stays_while_a_page_is_open_and_the_run_is_printed_last(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(server, "_UNWATCHED_S", 1)
    train_, is_page_open = Trainer.train, threading.Event()

    def train_once_a_page_is_open(self):  # not in a step: pages wait for the model while one is taken
        assert is_page_open.wait(START_S)
        return train_(self)

    monkeypatch.setattr(Trainer, "train", train_once_a_page_is_open)

    def visit(printed):
        with Page(address(printed)) as page:
            page.look_from(0.3)
            page.wait_until(lambda: bool(page.controls))
            is_page_open.set()
            printed("the viewer stays open while a page is; end it with Ctrl-C")
            page.wait_until(lambda: ">done<" in page.texts, START_S)
            with pytest.raises(TimeoutError):  # for longer than the viewer stays without a page
                page.wait_until(lambda: page.is_closed, 3.0)

    ended = visited(visit, train, *training_argv(trained, tmp_path, "--max-num-iterations", 3))
    assert ended.status == 0
    assert ended.last_line.startswith("run: ")


def test_a_training_that_is_stopped_from_the_page_can_go_on(trained, tmp_path):
    def visit(printed):
        with looking(address(printed)):  # a page that is loaded again
            pass
        with looking(address(printed)) as page:
            page.wait_until(lambda: any(one.get("label") == "really stop" for one in page.controls.values()))
            page.set("really stop", True)
            page.set("stop training", True)
            page.wait_until(lambda: page.is_closed, START_S)
            assert "stopped, and saved" in page.texts

    stopped = visited(visit, train, *training_argv(trained, tmp_path, "--max-seconds", "300"))
    assert stopped.status == 130
    assert "go on with: unmix-train unmix-nerf --load-run" in stopped.err
    path = stopped.last_line.removeprefix("run: ")
    done(train, "unmix-nerf", "--load-run", path, "--max-num-iterations", 2)


def test_the_viewer_is_off_where_the_output_is_no_terminal_and_on_where_it_is(tmp_path, monkeypatch):
    words = ["unmix-nerf", "--data", str(tmp_path)]
    for is_terminal in (False, True):
        monkeypatch.setattr(train_module.sys, "stdout", Mock(isatty=lambda is_one=is_terminal: is_one))
        assert parse(words)[1].enabled == is_terminal
        assert not parse([*words, "--viewer.no-enabled"])[1].enabled


def test_words_of_the_viewer_are_no_settings_of_the_training(trained):
    words = ["unmix-nerf", "--data", str(trained.scene), "--viewer.host", "::1", "--viewer.share", "0.2"]
    config, viewing = parse([*words, "--max-seconds", "7"])
    assert (viewing.host, viewing.share, viewing.port, viewing.token) == ("::1", 0.2, 7007, None)
    assert (config.max_seconds, config.max_num_iterations) == (7.0, None)
    assert "viewer" not in (trained.run / "config.json").read_text()


def test_impossible_words_of_the_viewer_end_before_training(trained, tmp_path):
    for word, value, said in (
        ("share", 2, "--viewer.share is a part"),
        ("host", "203.0.113.7", "can't listen"),
    ):
        words = training_argv(trained, tmp_path / "out", f"--viewer.{word}", value)
        assert said in refused(train, *words)
