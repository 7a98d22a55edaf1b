"""Videos are rendered by `unmix-render` in a process of its own, one at a time."""

import sys
import threading
from dataclasses import replace

import pytest
import tyro

from unmix_plugin.commands.render import RenderOptions
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.relighting import LightChoice
from unmix_plugin.viewer.layers.layers import LAYERS
from unmix_plugin.viewer.layers.painting import LayerSettings
from unmix_plugin.viewer.rendering import captures as video_job
from unmix_plugin.viewer.rendering.captures import VideoJob, VideoQueue, output_of, render_argv


@pytest.mark.parametrize("layer", [name for name in LAYERS if name != "error"])
def test_every_layer_that_renders_know_is_an_output_of_theirs(layer, source):
    from unmix_plugin.products.render.formats import choose_formats

    chosen = LayerSettings(wavelength_nm=500.0, false_colour_nm=(650.0, 550.0, 450.0), index="r650 / r500")
    output = output_of(replace(chosen, layer=layer))
    with source.borrowed() as scene:
        products = choose_formats((output,), ("mp4",), scene, True)
    assert [product.format for product in products] == ["mp4"]


def test_the_error_is_no_output():
    with pytest.raises(ConfigError, match="videos can't show the layer error"):
        output_of(LayerSettings(layer="error"))


def test_an_index_that_is_not_chosen_is_no_output():
    with pytest.raises(ConfigError, match="videos can't show the layer index"):
        output_of(LayerSettings(layer="index"))


def test_the_words_are_those_of_the_command(tmp_path):
    import tyro

    from unmix_plugin.commands.render import RenderOptions

    words = render_argv(tmp_path, tmp_path / "path.json", "rgb", tmp_path / "out", tmp_path / "recipe.yml")
    options = tyro.cli(RenderOptions, args=words)
    assert (options.run, options.cameras) == (tmp_path, str(tmp_path / "path.json"))
    assert (options.outputs, options.formats, options.overwrite) == (("rgb",), ("mp4",), True)
    assert options.edits == tmp_path / "recipe.yml"


@pytest.fixture
def run_instead(monkeypatch):
    """Run Python code in place of the command."""
    return lambda code: monkeypatch.setattr(video_job, "_LAUNCH", code)


class Ending:
    """A video, and how it ended."""

    def __init__(self, folder):
        self.parts, self.video, self.reason = [], None, None
        self._ended = threading.Event()
        self.job = VideoJob(["--some", "words"], folder, self.parts.append, self._done)

    def _done(self, video, reason):
        self.video, self.reason = video, reason
        self._ended.set()

    def wait(self):
        assert self._ended.wait(120)
        return self


def rendered(folder, queue=None):
    one = Ending(folder)
    (queue or VideoQueue()).start(one.job)
    return one.wait()


WRITE = "import sys, pathlib; pathlib.Path({folder!r}, 'a.mp4').write_bytes(b'video')"


def test_the_video_is_handed_over(tmp_path, run_instead):
    run_instead(WRITE.format(folder=str(tmp_path)) + "; assert sys.argv[1:] == ['--some', 'words']")
    assert rendered(tmp_path).video == tmp_path / "a.mp4"


def test_progress_is_told_as_the_command_prints_it(tmp_path, run_instead):
    run_instead("print('rendering: 1 of 4 done'); print('other'); print('rendering: 3 of 4 done')")
    assert rendered(tmp_path).parts == [0.25, 0.75]


def test_the_command_prints_progress_as_it_is_read(capsys):
    from rich.console import Console

    from unmix_plugin.commands.reporting import follow

    list(follow(Console(), "rendering", [1, 2]))
    found = video_job._PROGRESS.match(capsys.readouterr().out)
    assert found is not None
    assert found.groups() == ("0", "2")


def test_a_failure_is_said_with_its_reason(tmp_path, run_instead):
    run_instead("import sys; sys.exit('no checkpoint')")
    ended = rendered(tmp_path)
    assert (ended.video, ended.reason) == (None, "rendering the video failed: no checkpoint")


WAIT = "import sys, time, pathlib; print('rendering: 0 of 1 done', flush=True); time.sleep(60)"


def test_videos_are_rendered_in_turn_and_can_be_cancelled(tmp_path, run_instead):
    run_instead(WAIT)
    queue, first, second, third = VideoQueue(), *(Ending(tmp_path) for _ in range(3))
    begun = threading.Event()
    first.job.progress = lambda _: begun.set()
    queue.start(first.job)
    assert begun.wait(120)
    queue.start(second.job)
    queue.cancel(second.job)
    run_instead("print('rendering: 1 of 1 done')")
    queue.start(third.job)
    assert third.parts == []
    queue.cancel(first.job)
    assert [one.wait().reason for one in (first, second)] == ["cancelled", "cancelled"]
    assert third.wait().parts == [1.0]


def test_stopping_ends_the_encoder_that_the_render_started(tmp_path, run_instead):
    run_instead(
        "import subprocess, sys; child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']);"
        "print('rendering: 0 of 1 done', flush=True); child.wait()"
    )
    queue, one, begun = VideoQueue(), Ending(tmp_path), threading.Event()
    one.job.progress = lambda _: begun.set()
    queue.start(one.job)
    assert begun.wait(120)
    queue.stop()
    # Its output is read to the end, which comes only once the encoder, which shares it, has ended.
    assert one.wait().reason == "cancelled"


def test_the_command_is_run_by_this_python(tmp_path, run_instead):
    run_instead(WRITE.format(folder=str(tmp_path)) + f"; assert sys.executable == {sys.executable!r}")
    assert rendered(tmp_path).video is not None


def test_another_light_is_rendered_by_the_command_as_the_page_shows_it(tmp_path):
    paths = (tmp_path, tmp_path / "path.json", "rgb", tmp_path / "out", None)
    words = render_argv(*paths, LightChoice("studio", rotation_deg=-30.0, exposure_stops=0.5))
    options = tyro.cli(RenderOptions, args=words)
    assert options.environment == "studio"
    assert (options.environment_rotation, options.environment_exposure) == (-30.0, 0.5)
    assert options.edits is None
    assert render_argv(*paths) == render_argv(*paths, LightChoice())
