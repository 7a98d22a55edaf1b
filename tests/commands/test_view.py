"""`unmix-view`, and the viewer beside `unmix-train`: what is printed, what is served, and how they end."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from benchmarks._viewer_page import Page
from tests.commands.running import SMALL_METHOD, run
from tests.commands.test_bad_runs import SPOILT, contents
from tests.formats.video_reading import read_video
from unmix_plugin.commands import train as train_module
from unmix_plugin.commands.train import parse_all, train
from unmix_plugin.commands.view import ViewOptions, prepared, view
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv
from unmix_plugin.viewer import server
from unmix_plugin.viewer.options import ViewerOptions

START_S = 90.0


class Started:
    """A command in a process of its own, its output read line by line."""

    def __init__(self, command, *words):
        # A test run in the background of a script inherits an ignored SIGINT, which Python would leave ignored.
        launch = (
            "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
            f"from unmix_plugin.commands.{command} import main; main()"
        )
        self.process = subprocess.Popen(
            [sys.executable, "-c", launch, *map(str, words)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.lines = []
        self._changed = threading.Condition()
        self._has_ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self.lines.append(line.rstrip())
                self._changed.notify_all()
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def wait_for_line(self, pattern):
        def found():
            return next((match for line in self.lines if (match := re.search(pattern, line))), None)

        with self._changed:
            self._changed.wait_for(lambda: found() or self._has_ended, START_S)
            match = found()
        assert match is not None, self.lines
        return match

    @property
    def address(self):
        """Of the viewer's websocket."""
        return "ws://" + self.wait_for_line(r"viewer: http://(\S+)")[1]

    def close(self):
        """Let go of its output."""
        self._reader.join(10)
        assert self.process.stdout is not None
        self.process.stdout.close()

    def end(self):
        status = self.process.wait(START_S)
        self._reader.join(10)
        return status


@contextmanager
def started(command, *words):
    """A command that is not left behind."""
    one = Started(command, *words)
    try:
        yield one
    finally:
        if one.process.poll() is None:
            one.process.kill()
        one.process.wait()
        one.close()


def visited(visit, command, *words):
    """How a command ended that ran in this process, while `visit(printed)` in a thread looked at its pages.

    `printed(pattern)` waits for such a line; `visit` is what ends the command.
    """
    out, is_over, failures = io.StringIO(), threading.Event(), []

    def printed(pattern):
        until = time.monotonic() + START_S
        while (match := re.search(pattern, out.getvalue())) is None:
            assert time.monotonic() < until, out.getvalue()
            time.sleep(0.01)
        return match

    def visit_and_note_failures():
        try:
            visit(printed)
        except BaseException as error:  # noqa: BLE001 - raised again below, once the command has ended
            failures.append(error)
            if not is_over.is_set():
                os.kill(os.getpid(), signal.SIGINT)

    visitor = threading.Thread(target=visit_and_note_failures)
    visitor.start()
    ended = run(command, *words, out=out)
    is_over.set()
    visitor.join(START_S)
    if failures:
        raise failures[0]
    return ended


def address(printed):
    """Of the websocket of a viewer."""
    return "ws://" + printed(r"viewer: http://(\S+)")[1]


@contextmanager
def looking(address):
    """A page with its first picture."""
    with Page(address) as page:
        page.look_from(0.3)
        page.wait_until(lambda: bool(page.pictures), START_S)
        yield page


@pytest.mark.parametrize("spoil", SPOILT)
def test_a_run_that_cannot_be_used_is_refused_with_one_message(run_copy, spoil):
    change, message = SPOILT[spoil]
    change(run_copy)
    before = contents(run_copy)
    ended = run(view, "--run", run_copy, "--device", "cpu")
    assert (ended.status, len(ended.err.splitlines())) == (2, 1)
    assert message in ended.err
    assert contents(run_copy) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--viewer.port", "99999"], "--viewer.port is a number from 0"),
        (["--viewer.host", "203.0.113.7"], "can't listen at --viewer.host 203.0.113.7"),
        (["--viewer.token", ""], "--viewer.token is empty"),
    ],
)
def test_an_address_that_is_none_is_refused(trained, words, message):
    ended = run(view, "--run", trained.run, "--device", "cpu", *words)
    assert ended.status == 2
    assert message in ended.err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_is_served_until_it_is_asked_to_end(trained, number):
    def visit(printed):
        printed("stop with Ctrl-C")
        with looking(address(printed)) as page:
            page.wait_until(lambda: any(one.get("label") == "layer" for one in page.controls.values()))
            os.kill(os.getpid(), number)
            page.wait_until(lambda: page.is_closed)

    ended = visited(visit, view, "--run", trained.run, "--device", "cpu", "--viewer.port", "0")
    assert (ended.status, ended.err) == (0, "")
    assert ended.out.splitlines()[-2:] == ["stop with Ctrl-C", "stopped"]


def test_a_run_is_served_by_a_process_of_its_own_until_ctrl_c(trained):
    with started("view", "--run", trained.run, "--device", "cpu", "--viewer.port", "0") as command:
        with looking(command.address) as page:
            page.wait_until(lambda: any(one.get("label") == "layer" for one in page.controls.values()))
            command.process.send_signal(signal.SIGINT)
            page.wait_until(lambda: page.is_closed)
        assert command.end() == 0
        assert command.lines[-2:] == ["stop with Ctrl-C", "stopped"]
        assert not any("viser" in line for line in command.lines)


@pytest.fixture
def served(trained):
    """The viewer of a run whose scene is at hand."""
    viewer = prepared(ViewOptions(run=trained.run, device="cpu", viewer=ViewerOptions(port=0)))
    viewer.start()
    yield viewer
    viewer.stop()


def test_what_was_measured_is_shown_where_the_scene_is_at_hand(served):
    with looking(f"ws://127.0.0.1:{served.port}") as page:
        served.services._reader.join(START_S)
        assert served.services.aids.measured is not None, served.services.aids.why_not_measured
        page.set("layer", "error against a training view")
        page.wait_until(lambda: "mean absolute error of the bands against training view" in page.texts)
        page.set("cameras", True)
        page.wait_until(lambda: page.last_depth is not None)


def test_a_run_whose_scene_has_gone_is_shown_without_what_was_measured(run_copy):
    scene = json.loads((run_copy / "scene.json").read_text())
    scene["summary"]["root"] = "/nowhere/at/all"
    (run_copy / "scene.json").write_text(json.dumps(scene))
    viewer = prepared(ViewOptions(run=run_copy, device="cpu", viewer=ViewerOptions(port=0)))
    viewer.start()
    try:
        with looking(f"ws://127.0.0.1:{viewer.port}") as page:
            page.set("layer", "error against a training view")
            page.wait_until(lambda: "no error to show: the scene is not at hand" in page.texts)
            assert "/nowhere/at/all" in page.texts
    finally:
        viewer.stop()


def test_a_path_becomes_a_video_of_the_edited_scene(run_copy):
    viewer = prepared(ViewOptions(run=run_copy, device="cpu", viewer=ViewerOptions(port=0)))
    viewer.start()
    try:
        with looking(f"ws://127.0.0.1:{viewer.port}") as page:
            page.wait_until(
                lambda: any(one.get("label") == "render a video" for one in page.controls.values())
            )
            for number, angle in enumerate((0.3, 0.6), start=1):
                page.look_from(angle)
                page.set("add a key frame here", True)
                key = page.controls[page.control("key frame")]
                page.wait_until(lambda key=key, number=number: key.get("value") == f"{number} of {number}")
            page.set("light", "A")
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
    finally:
        viewer.stop()


def test_nothing_is_written_into_a_run_that_is_only_looked_at(run_copy):
    before = contents(run_copy)
    viewer = prepared(ViewOptions(run=run_copy, device="cpu", viewer=ViewerOptions(port=0)))
    viewer.start()
    with looking(f"ws://127.0.0.1:{viewer.port}"):
        pass
    viewer.stop()
    assert contents(run_copy) == before


def test_a_run_is_shown_with_the_edits_and_the_light_asked_for(run_copy):
    recipe = run_copy / "recipe.yml"
    recipe.write_text("edits:\n  - rename: {endmember: endmember_1, name: clay}\n")
    options = ViewOptions(
        run=run_copy, device="cpu", edits=recipe, illuminant="fl2", viewer=ViewerOptions(port=0)
    )
    viewer = prepared(options)
    viewer.start()
    try:
        with looking(f"ws://127.0.0.1:{viewer.port}") as page:
            page.wait_until(
                lambda: any(one.get("label") == "render a video" for one in page.controls.values())
            )
            assert page.controls[page.control("light")]["value"] == "FL2"
            assert "clay" in page.controls[page.control("other endmember")]["options"]
            page.set("changes", "start again")
            page.wait_until(lambda: page.controls[page.control("light")]["value"] == "as recorded")
    finally:
        viewer.stop()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--illuminant", "D66"], "there is no light 'D66'; nearest: D65"),
        (["--edits", "nowhere.yml"], "can't read the recipe nowhere.yml"),
    ],
)
def test_edits_that_are_none_are_refused(trained, words, message):
    ended = run(view, "--run", trained.run, "--device", "cpu", *words)
    assert ended.status == 2
    assert message in ended.err


def training_argv(trained, folder, *words):
    return [
        *("unmix-nerf", "--data", trained.scene, "--output-dir", folder, *SMALL_METHOD),
        *("--viewer.enabled", "--viewer.port", "0", *words),
    ]


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
        found = read_spectra_csv(
            type(trained.run)(command.lines[-1].removeprefix("run: ")) / "endmembers.csv"
        )
        np.testing.assert_array_equal(found.spectra, read_spectra_csv(trained.run / "endmembers.csv").spectra)


def test_without_keep_open_the_process_ends_with_the_training(trained, tmp_path):
    ended = run(train, *training_argv(trained, tmp_path, "--max-num-iterations", 3))
    assert ended.status == 0
    assert "viewer: http://127.0.0.1:" in ended.out
    assert ended.last_line.startswith("run: ")
    assert not [thread for thread in threading.enumerate() if "viewer" in thread.name]


def test_the_viewer_stays_as_long_as_a_page_is_open_and_the_run_is_printed_last(
    trained, tmp_path, monkeypatch
):
    monkeypatch.setattr(server, "_UNWATCHED_S", 1)
    loop, is_page_open = Trainer._loop, threading.Event()

    def loop_once_a_page_is_open(self, *args):  # not in a step: pages wait for the model while one is taken
        assert is_page_open.wait(START_S)
        loop(self, *args)

    monkeypatch.setattr(Trainer, "_loop", loop_once_a_page_is_open)

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
    resumed = run(train, "unmix-nerf", "--load-run", path, "--max-num-iterations", 2)
    assert resumed.status == 0


def test_a_page_that_is_loaded_again_while_training_goes_on(trained, tmp_path):
    def visit(printed):
        for _ in range(3):
            with looking(address(printed)):
                pass
        os.kill(os.getpid(), signal.SIGINT)

    ended = visited(visit, train, *training_argv(trained, tmp_path, "--max-seconds", "300"))
    assert ended.status == 130
    assert "Traceback" not in ended.out + ended.err


def test_the_viewer_is_off_where_the_output_is_no_terminal_and_on_where_it_is(tmp_path, monkeypatch):
    words = ["unmix-nerf", "--data", str(tmp_path)]
    monkeypatch.setattr(train_module.sys, "stdout", io.StringIO())
    assert not parse_all(words)[1].enabled
    monkeypatch.setattr(train_module.sys, "stdout", Terminal())
    assert parse_all(words)[1].enabled
    assert not parse_all([*words, "--viewer.no-enabled"])[1].enabled


class Terminal:
    """Says that it is one."""

    def isatty(self):
        return True


def test_words_of_the_viewer_are_no_settings_of_the_training(trained):
    words = ["unmix-nerf", "--data", str(trained.scene), "--viewer.host", "::1", "--viewer.share", "0.2"]
    config, viewing = parse_all([*words, "--max-seconds", "7"])
    assert (viewing.host, viewing.share, viewing.port, viewing.token) == ("::1", 0.2, 7007, None)
    assert (config.max_seconds, config.max_num_iterations) == (7.0, None)
    assert "viewer" not in (trained.run / "config.json").read_text()


def test_impossible_words_of_the_viewer_end_before_training(trained, tmp_path):
    ended = run(train, *training_argv(trained, tmp_path / "out", "--viewer.share", "2"))
    assert ended.status == 2
    assert "--viewer.share is a part" in ended.err
    ended = run(train, *training_argv(trained, tmp_path / "out", "--viewer.host", "203.0.113.7"))
    assert ended.status == 2
    assert "can't listen" in ended.err


def test_a_recipe_of_the_viewer_is_taken_by_other_commands(run_copy):
    from unmix_plugin.commands.export import export
    from unmix_plugin.editing import Recipe, Scale, recipe_to_yaml

    recipe = run_copy / "recipe.yml"
    recipe.write_text(recipe_to_yaml(Recipe((Scale(0, 0.5),))))
    ended = run(export, "endmembers", "--run", run_copy, "--edits", recipe, "--output", run_copy / "edited")
    assert ended.status == 0, ended.err
    before = read_spectra_csv(run_copy / "endmembers.csv").spectra
    after = read_spectra_csv(run_copy / "edited" / "endmembers.csv").spectra
    np.testing.assert_allclose(after[0], before[0] / 2, rtol=1e-5)
