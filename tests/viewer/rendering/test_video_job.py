"""Videos are rendered by `unmix-render` in a process of its own, one at a time."""

import sys
import threading
import time
from dataclasses import replace

import pytest

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.layers.layers import LAYERS
from unmix_plugin.viewer.rendering import video_job
from unmix_plugin.viewer.rendering.video_job import VideoJob, output_of, render_words


@pytest.mark.parametrize("layer", [name for name in LAYERS if name != "error"])
def test_every_layer_that_renders_know_is_an_output_of_theirs(layer, source):
    from unmix_plugin.products.render.outputs import choose_products

    chosen = LayerSettings(wavelength_nm=500.0, false_colour_nm=(650.0, 550.0, 450.0), index="r650 / r500")
    output = output_of(replace(chosen, layer=layer))
    products = choose_products((output,), ("mp4",), source._model.materials, True)
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

    words = render_words(tmp_path, tmp_path / "path.json", "rgb", tmp_path / "out", tmp_path / "recipe.yml")
    options = tyro.cli(RenderOptions, args=words)
    assert (options.run, options.cameras) == (tmp_path, str(tmp_path / "path.json"))
    assert (options.outputs, options.formats, options.overwrite) == (("rgb",), ("mp4",), True)
    assert options.edits == tmp_path / "recipe.yml"


@pytest.fixture
def run_instead(monkeypatch):
    """Run Python code in place of the command."""
    return lambda code: monkeypatch.setattr(video_job, "_LAUNCH", code)


def ended(job, tmp_path):
    done, said = threading.Event(), []

    def note(text):
        said.append(text)
        done.set()

    job.start(["--some", "words"], tmp_path, note)
    return done, said


def test_the_end_is_said(tmp_path, run_instead):
    run_instead("import sys; assert sys.argv[1:] == ['--some', 'words']")
    done, said = ended(VideoJob(), tmp_path)
    assert done.wait(30)
    assert said == [f"the video is in {tmp_path}"]


def test_a_failure_is_said_with_its_reason(tmp_path, run_instead):
    run_instead("import sys; sys.exit('no checkpoint')")
    done, said = ended(VideoJob(), tmp_path)
    assert done.wait(30)
    assert said == ["rendering the video failed: no checkpoint"]


def test_one_video_at_a_time_and_stopping_ends_it(tmp_path, run_instead):
    run_instead("import time; time.sleep(60)")
    job = VideoJob()
    done, said = ended(job, tmp_path)
    with pytest.raises(ConfigError, match="a video is being rendered already"):
        job.start([], tmp_path, lambda _: None)
    assert job.is_running
    job.stop()
    assert done.wait(30)
    assert not job.is_running
    assert said[0].startswith("rendering the video failed")


def test_the_command_is_run_by_this_python(tmp_path, run_instead):
    run_instead(f"import sys; assert sys.executable == {sys.executable!r}")
    done, said = ended(VideoJob(), tmp_path)
    assert done.wait(30)
    assert said[0].startswith("the video is in")


def test_stopping_ends_the_encoder_that_the_render_started(tmp_path, run_instead):
    run_instead(
        "import subprocess, sys; child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']);"
        f"open({str(tmp_path / 'child')!r}, 'w').write(str(child.pid)); child.wait()"
    )
    job = VideoJob()
    done, _ = ended(job, tmp_path)
    until = time.monotonic() + 30
    while not (tmp_path / "child").exists() or not (tmp_path / "child").read_text():
        assert time.monotonic() < until
        time.sleep(0.02)
    job.stop()
    assert done.wait(30)  # its output is closed only once the encoder, which has it too, has ended
