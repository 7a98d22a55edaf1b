"""Pictures in strips are the pictures of the whole; videos are rendered by `unmix-render`, one at a time."""

import queue
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
import torch
import tyro

from tests.factories.views import make_frame, no_scene, some_pose
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.paint import ColourScale
from unmix_plugin.products.render import RenderOptions, files
from unmix_plugin.products.render.files import choose_formats
from unmix_plugin.products.render.job import setting_for, take_survey
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.mixture_view import picture_values
from unmix_plugin.trained.model_scene import LightChoice
from unmix_plugin.trained.outputs import find_output
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.viewer.rendering import captures
from unmix_plugin.viewer.rendering.captures import VideoJob, VideoQueue
from unmix_plugin.viewer.rendering.painting import LAYERS
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.rendering.settings import LayerSettings, first_settings
from unmix_plugin.viewer.session import Services
from unmix_plugin.viewer.view_cameras import sized_camera


@pytest.fixture
def services(source):
    running = Services(source, no_scene)
    running.start()
    yield running
    running.stop()


def captured(services, camera, read=lambda strip: strip, most_pixels=None):
    """What is read of the strips of a picture, and the parts told."""
    parts = []
    strips = services.loop.strips(camera, Edit(), 1, threading.Event(), parts.append, most_pixels)
    return [read(strip) for strip in strips], parts


@pytest.mark.parametrize("layer", ["rgb", "depth", "segmentation"])
def test_strips_make_up_the_picture_of_the_whole(services, source, layer):
    camera, settings = sized_camera(some_pose(), 31, 23), LayerSettings(layer=layer)

    def paint(frame):
        return services.maker.paint(frame, settings, False, False).picture.astype(int)

    pictures, parts = captured(services, camera, paint, most_pixels=100)
    assert len(parts) >= 8
    assert parts == sorted(parts)
    assert parts[-1] == pytest.approx(1.0)
    assert np.abs(np.concatenate(pictures) - paint(make_frame(source, camera))).max() <= 1


@pytest.mark.parametrize("is_line", [False, True])
def test_spectra_of_strips_are_those_of_the_whole(services, source, is_line):
    camera = sized_camera(some_pose(), 17, 13)
    if is_line:
        ends = torch.cat([camera.camera_to_world, sized_camera(some_pose(1), 17, 13).camera_to_world])
        camera = replace(camera, key_poses=KeyPoses(ends, torch.tensor([0.5, 12.5]), (2,)))
    frame = make_frame(source, camera)
    strips, _ = captured(services, camera, captures.strip_of_spectra, most_pixels=64)
    assert len(strips) > 1
    for found, expected in zip(
        captures.joined_strips(strips, 13), captures.strip_of_spectra(frame), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("light", "quantity"), [(None, "radiance"), (torch.ones(5), "reflectance")])
def test_a_saved_picture_says_whether_it_is_radiance_or_reflectance(source, tmp_path, light, quantity):
    frame = make_frame(source, sized_camera(some_pose(), 17, 13))
    materials = replace(frame.materials, light=light)
    path = captures.write_spectra(tmp_path / "view.exr", captures.strip_of_spectra(frame), materials)
    file = OpenEXR.File(str(path), separate_channels=True)
    assert file.header()["comments"] == f"{quantity} on black, 1 = full scale"
    layer = "T" if quantity == "reflectance" else "S0"
    assert sum(name.startswith(f"{layer}.") for name in file.channels()) == 5


def test_a_picture_that_is_cancelled_ends_and_a_strip_that_is_not_taken_keeps_nobody_waiting(services):
    camera, cancelled = sized_camera(some_pose(), 16, 16), threading.Event()
    cancelled.set()
    with pytest.raises(ConfigError, match="cancelled"):
        next(services.loop.strips(camera, Edit(), 1, cancelled))
    assert captured(services, camera)[1][-1] == 1.0
    services.stop()
    with pytest.raises(ConfigError, match="the viewer was stopped"):
        captured(services, camera)


def test_pictures_of_two_pages_are_rendered_in_turn_and_one_that_waits_can_be_cancelled(services):
    large, small = sized_camera(some_pose(), 1024, 1024), sized_camera(some_pose(), 16, 16)
    cancelled, parts = threading.Event(), []
    first = services.loop.strips(large, Edit(), 1, threading.Event(), parts.append)
    next(first)
    assert captured(services, small)[1][-1] == 1.0
    assert parts[-1] < 1
    waiting = services.loop.strips(small, Edit(), 1, cancelled)
    cancelled.set()
    with pytest.raises(ConfigError, match="cancelled"):
        next(waiting)
    next(first)  # which goes on
    assert captured(services, small)[1][-1] == 1.0


def test_pictures_that_would_not_fit_are_refused():
    captures.check_size(4096, 4096)
    captures.check_size(1024, 1024, 31)
    with pytest.raises(ConfigError, match=r"8192 x 8192 pixels are too many for pictures .* 33\.6 million"):
        captures.check_size(8192, 8192)
    with pytest.raises(ConfigError, match=r"4096 x 4096 pixels are too many for spectra .* 4\.3 million"):
        captures.check_size(4096, 4096, 31)


LOOKS = [
    LayerSettings(),
    LayerSettings(exposure=1.5, gamma=1.7, highlights="kept", background="black", colour_map="magma"),
    LayerSettings(exposure=-0.3, background="white", value_range=(-1e-7, 0.3), colour_map="gray"),
]


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("layer", [name for name in LAYERS if name != "error"])
def test_a_picture_of_a_render_is_the_page_pixel_for_pixel(services, source, tmp_path, layer, look):
    """Videos are such pictures, from the same words of the command."""
    chosen = replace(look, layer=layer, wavelength_nm=500.0, index="r650/r500", endmember=1)
    frame = make_frame(source, sized_camera(some_pose(), 23, 17))
    page = services.maker.paint(frame, chosen, False, False)
    if isinstance(page.legend, ColourScale):  # as the panel does: each frame would have a range of its own
        chosen = replace(chosen, value_range=(page.legend.low, page.legend.high))
    name = LAYERS[layer].output_name(chosen, frame.materials.bands)
    options = tyro.cli(
        RenderOptions, args=captures.render_argv(tmp_path, tmp_path, name, chosen, tmp_path, None)
    )
    scene, views = frame.scene, (RunView("frame", frame.camera),)
    outputs = [one._replace(format="png") for one in choose_formats(options.outputs, ("mp4",), scene, True)]
    survey = take_survey(scene, views, [one.output for one in outputs], None, options.asked_look())
    setting = replace(
        setting_for(scene, frame.camera, [one.output for one in outputs], survey, tmp_path),
        look=options.asked_look(),
    )
    drawn = []
    with files.frame(outputs[0].output, 0.0, setting, drawn.append) as add:
        painted = {name: picture_values(frame, survey.outputs.get(name, outputs[0].output))}
        add(files.Rows(0, {}, painted, frame.opacity.numpy(), frame.coverage.numpy()))
    np.testing.assert_array_equal(drawn[0], page.picture)


@pytest.mark.parametrize("layer", ["band", "false-colour"])
def test_the_first_settings_are_outputs_for_bands_anywhere(layer):
    bands = Bands.of([1000.0, 1200.0, 1400.0, 1600.0])
    materials = Materials(bands, torch.full((2, 4), 0.5), torch.zeros(0, 4))
    find_output(LAYERS[layer].output_name(first_settings(bands), bands), materials)


@pytest.mark.parametrize(
    ("layer", "output"),
    [
        ("band", "band:1330nm"),  # shown for a wavelength in a gap of the bands
        ("false-colour", "false-colour:1330,1330,1000"),
        ("index", "absorption:650-700"),
        ("diffuse", "diffuse_rgb"),
        ("abundance", "abundance:1"),
        ("depth", "depth"),
    ],
)
def test_an_output_goes_by_the_bands_that_are_shown_or_by_its_own_name(layer, output):
    bands = Bands.of([1000.0, 1010, 1020, 1330, 1340])
    settings = LayerSettings(
        wavelength_nm=1200.0, false_colour_nm=(1335.0, 1200.0, 990.0), index="absorption:650-700", endmember=1
    )
    assert LAYERS[layer].output_name(settings, bands) == output


def test_the_words_are_those_of_the_command(tmp_path):
    paths = (
        tmp_path,
        tmp_path / "path.json",
        "rgb",
        LayerSettings(),
        tmp_path / "out",
        tmp_path / "recipe.yml",
    )
    light = LightChoice("studio", rotation_deg=-30.0, exposure_stops=0.5)
    options = tyro.cli(RenderOptions, args=captures.render_argv(*paths, light))
    assert (options.run, options.cameras) == (tmp_path, str(tmp_path / "path.json"))
    assert (options.outputs, options.formats, options.overwrite) == (("rgb",), ("mp4",), True)
    assert (options.edits, options.environment) == (tmp_path / "recipe.yml", "studio")
    assert (options.environment_rotation, options.environment_exposure) == (-30.0, 0.5)
    plain = tyro.cli(RenderOptions, args=captures.render_argv(*paths[:5], None))
    assert (plain.edits, plain.environment) == (None, RenderOptions().environment)


@pytest.fixture
def run_instead(monkeypatch):
    """Run Python code in place of the command."""

    def run(code):
        monkeypatch.setattr(
            captures, "child_command", lambda _module, argv: [sys.executable, "-c", code, *argv]
        )

    return run


class Ending:
    """A video, and how it ended."""

    def __init__(self, folder):
        self.parts, self.begun, self._ends = [], threading.Event(), queue.Queue()
        self.job = VideoJob(["--some", "words"], folder, self._note, lambda *end: self._ends.put(end))

    def _note(self, part):
        self.parts.append(part)
        self.begun.set()

    def wait(self):
        """The video and the reason why there is none."""
        return self._ends.get(timeout=120)


FOLLOWED = "list(follow(Console(), 'rendering', [1, 2])); print('other'); print('rendering: 1 of 4 done')"


@pytest.mark.parametrize(
    ("code", "name", "reason", "parts"),
    [
        ("assert sys.argv[1:] == ['--some', 'words']; open({!r}, 'w').close()", "a.mp4", None, []),
        (FOLLOWED, None, None, [0.0, 0.25]),
        ("sys.exit('no checkpoint')", None, "rendering the video failed: no checkpoint", []),
    ],
    ids=["a video", "progress as the command prints it", "a failure"],
)
def test_a_video_or_why_there_is_none_is_told_and_progress(tmp_path, run_instead, code, name, reason, parts):
    imports = (
        "import sys; from rich.console import Console; from unmix_plugin.commands.reporting import follow\n"
    )
    run_instead(imports + code.format(str(tmp_path / "a.mp4")))
    one = Ending(tmp_path)
    VideoQueue().start(one.job)
    found, said = one.wait()
    assert found == (name and tmp_path / name)
    assert reason is None or said == reason
    assert one.parts == parts


WAIT = "import sys, time, pathlib; print('rendering: 0 of 1 done', flush=True); time.sleep(60)"


def test_videos_are_rendered_in_turn_and_can_be_cancelled(tmp_path, run_instead):
    run_instead(WAIT)
    videos, first, second, third = VideoQueue(), *(Ending(tmp_path) for _ in range(3))
    videos.start(first.job)
    assert first.begun.wait(120)
    videos.start(second.job)
    videos.cancel(second.job)
    run_instead("print('rendering: 1 of 1 done')")
    videos.start(third.job)
    assert third.parts == []
    videos.cancel(first.job)
    assert [one.wait() for one in (first, second)] == [(None, "cancelled")] * 2
    third.wait()
    assert third.parts == [1.0]


def test_a_render_that_has_just_ended_by_itself_can_be_cancelled(tmp_path):
    job = Ending(tmp_path).job
    with subprocess.Popen([sys.executable, "-c", ""], text=True, start_new_session=True) as job.process:
        job.process.wait()
        VideoQueue().cancel(job)
    assert job.process.returncode == 0


def test_stopping_ends_the_encoder_that_the_render_started(tmp_path, run_instead):
    run_instead(
        "import subprocess, sys; child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']);"
        "print('rendering: 0 of 1 done', flush=True); child.wait()"
    )
    videos, one = VideoQueue(), Ending(tmp_path)
    videos.start(one.job)
    assert one.begun.wait(120)
    assert videos.is_busy
    videos.stop()
    assert not videos.is_busy
    # Its output is read to the end, which comes only once the encoder, which shares it, has ended.
    assert one.wait() == (None, "cancelled")
    run_instead("print('rendering: 1 of 1 done')")
    late = Ending(tmp_path)
    videos.start(late.job)
    assert late.wait() == (None, "cancelled")
    assert late.parts == []


def test_a_video_whose_process_cannot_be_begun_ends_with_the_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(captures, "child_command", lambda _module, _argv: [str(tmp_path / "no program")])
    one = Ending(tmp_path)
    VideoQueue().start(one.job)
    video, reason = one.wait()
    assert video is None
    assert reason.startswith("rendering the video failed: ")
    assert "No such file or directory" in reason
