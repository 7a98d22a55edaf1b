"""When is rendered, and how finely: movements are answered at once, rest brings finer pictures, layers cost nothing."""

import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.method_factory import make_model
from tests.viewer.view_factory import Screen, make_aids, some_pose, source_of_model
from unmix_plugin.editing import Light, Recipe, Remove, Scale, sample_seen
from unmix_plugin.engine.training.training_control import TrainingControl
from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.rendering import render_loop as render_loop_module
from unmix_plugin.viewer.rendering.edits import Edit
from unmix_plugin.viewer.rendering.frames import FrameRender, num_channels
from unmix_plugin.viewer.rendering.pacing import Speedometer
from unmix_plugin.viewer.rendering.picture_maker import PictureMaker
from unmix_plugin.viewer.rendering.render_loop import RenderLoop
from unmix_plugin.viewer.rendering.view import Capture
from unmix_plugin.viewer.view_cameras import camera_of

LARGEST = 96


class FixedSpeed(Speedometer):
    """Believes what it is told, and no measurement."""

    def add(self, rays, seconds):
        pass


@contextmanager
def running_loop(source, slow_speed=None):
    """A loop that renders; with `slow_speed` it believes to be as slow as that, so that moving pictures are small."""
    aids = make_aids(source)
    with source.borrowed() as scene:
        seen, channels = sample_seen(scene), num_channels(scene.materials)
    maker = PictureMaker(source, lambda: aids, lambda _: seen, channels)
    if slow_speed is not None:
        maker.speed = FixedSpeed(slow_speed)
    loop = RenderLoop(maker)
    loop.start()
    try:
        yield loop, maker
    finally:
        loop.stop()
    assert not loop._thread.is_alive()


@pytest.fixture
def loop(source):
    with running_loop(source, slow_speed=5000.0) as (running, _):
        yield running


@pytest.fixture
def screen(loop):
    shown = Screen()
    shown.view.largest_height = LARGEST
    loop.add(shown.view)
    return shown


@pytest.fixture
def rendered(monkeypatch):
    """How many rays were rendered since the list was cleared."""
    counts = []
    original = FrameRender.render_block

    def counting(self, scene, num_rays):
        counts.append(done := original(self, scene, num_rays))
        return done

    monkeypatch.setattr(FrameRender, "render_block", counting)
    return counts


def test_a_movement_is_answered_with_a_small_picture_and_rest_with_finer_ones(loop, screen):
    loop.move(screen.view, some_pose())
    finest = screen.wait_for_finest()
    heights = [shown.picture.shape[0] for shown in screen.shown]
    assert finest.picture.shape[:2] == (LARGEST, round(LARGEST * 1.5))
    assert heights[0] < 20
    assert heights == sorted(set(heights))
    assert [shown.is_moving for shown in screen.shown] == [True] * (len(heights) - 1) + [False]


def test_a_picture_at_rest_is_rendered_once_and_nothing_after_it(loop, screen, rendered):
    loop.move(screen.view, some_pose())
    screen.wait_for_finest()
    rendered.clear()
    time.sleep(0.3)
    assert rendered == []
    assert not screen.shown[-1].is_moving


def test_the_finest_picture_is_what_the_scene_renders(loop, screen, source):
    loop.move(screen.view, some_pose())
    screen.wait_for_finest()
    frame = screen.view.frame
    with source.borrowed() as scene:
        expected = scene.look(camera_of(some_pose(), LARGEST), subpixels=1).coefficients
    torch.testing.assert_close(frame.coefficients.abundances, expected.abundances, atol=1e-5, rtol=1e-5)


def test_switching_layers_renders_nothing(loop, screen, rendered):
    loop.move(screen.view, some_pose())
    screen.wait_for_finest()
    rendered.clear()
    for layer in ("segmentation", "band", "abundances", "pca", "depth", "rgb"):
        count = len(screen.shown)
        loop.restyle(screen.view, LayerSettings(layer=layer))
        screen.wait_for_pictures(count + 1)
        assert screen.shown[-1].picture.shape[0] == LARGEST
    assert rendered == []


def test_a_movement_interrupts_what_is_refined(loop, screen, monkeypatch):
    original = FrameRender.render_block

    def slow(self, scene, num_rays):
        time.sleep(0.02)
        return original(self, scene, min(num_rays, 256))

    monkeypatch.setattr(FrameRender, "render_block", slow)
    screen.view.largest_height = 512
    monkeypatch.setattr(render_loop_module.RenderLoop, "_answer", _patient_answer(original))
    loop.move(screen.view, some_pose(0))
    screen.wait_for_pictures(2)
    moved_at = time.monotonic()
    loop.move(screen.view, some_pose(1))
    screen.wait_until(lambda: screen.times[-1] > moved_at)
    assert screen.times[-1] - moved_at < 1.0
    assert screen.shown[-1].picture.shape[0] < 40


def _patient_answer(original):
    """The loop's own answer, rendered at its usual speed."""
    answer = render_loop_module.RenderLoop._answer

    def patient(self, view):
        slowed, FrameRender.render_block = FrameRender.render_block, original
        try:
            answer(self, view)
        finally:
            FrameRender.render_block = slowed

    return patient


def test_only_the_last_of_many_movements_is_refined(loop, screen):
    for index in range(40):
        loop.move(screen.view, some_pose(index % 4))
    loop.move(screen.view, some_pose(2))
    finest = screen.wait_for_finest()
    fine = [shown for shown in screen.shown if shown.picture.shape[0] == finest.picture.shape[0]]
    assert len(fine) == 1
    assert len(screen.shown) < 40
    assert screen.view.frame.camera.camera_to_world[0, :, 3].tolist() == pytest.approx(some_pose(2).position)


def test_every_view_has_its_own_camera_size_and_layer(loop):
    screens = [Screen() for _ in range(3)]
    for index, (screen, height) in enumerate(zip(screens, (32, 48, 64), strict=True)):
        screen.view.largest_height = height
        loop.add(screen.view)
        loop.restyle(screen.view, LayerSettings(layer=("rgb", "depth", "segmentation")[index]))
        loop.move(screen.view, some_pose(index))
    for screen, height in zip(screens, (32, 48, 64), strict=True):
        assert screen.wait_for_finest().picture.shape[0] == height
    pictures = [screen.shown[-1].picture.mean() for screen in screens]
    assert len(set(pictures)) == 3


def test_nobody_starves_while_eight_move(loop):
    screens = [Screen() for _ in range(8)]
    for screen in screens:
        loop.add(screen.view)
    until = time.monotonic() + 1.5
    while time.monotonic() < until:
        for index, screen in enumerate(screens):
            loop.move(screen.view, some_pose(index % 4))
        time.sleep(0.02)
    counts = [len(screen.shown) for screen in screens]
    assert min(counts) >= 2
    assert max(counts) - min(counts) <= 2
    assert all(not screen.reports for screen in screens)


def test_a_layer_that_cannot_be_shown_is_said_and_the_next_one_works(loop, screen):
    loop.move(screen.view, some_pose())
    screen.wait_for_finest()
    loop.restyle(screen.view, LayerSettings(layer="error"))
    screen.wait_until(lambda: bool(screen.reports))
    assert screen.reports[-1].startswith("no error to show")
    count = len(screen.shown)
    loop.restyle(screen.view, LayerSettings(layer="rgb"))
    screen.wait_for_pictures(count + 1)
    screen.wait_until(lambda: screen.reports[-1] == "")


def test_a_defect_in_a_picture_is_said_logged_and_ends_nothing(loop, screen, monkeypatch, caplog):
    original = FrameRender.render_block
    monkeypatch.setattr(FrameRender, "render_block", lambda *_: 1 / 0)
    loop.move(screen.view, some_pose())
    screen.wait_until(lambda: bool(screen.reports))
    assert "ZeroDivisionError" in screen.reports[-1]
    assert "Traceback" in caplog.text
    time.sleep(0.2)
    assert len(screen.reports) == 1  # not tried again and again
    monkeypatch.setattr(FrameRender, "render_block", original)
    loop.move(screen.view, some_pose(1))
    screen.wait_for_finest()


def test_a_client_that_cannot_be_shown_anything_does_not_end_the_loop(loop, screen, caplog):
    gone = Screen()
    gone.view.show = lambda _: (_ for _ in ()).throw(ConnectionError("gone"))
    gone.view.report = lambda _: (_ for _ in ()).throw(ConnectionError("gone"))
    loop.add(gone.view)
    loop.move(gone.view, some_pose())
    loop.move(screen.view, some_pose())
    screen.wait_for_finest()
    assert "ConnectionError" in caplog.text


def test_a_view_that_is_removed_in_mid_render_is_shown_nothing_more(loop, screen):
    screen.view.largest_height = 512
    loop.move(screen.view, some_pose())
    screen.wait_for_pictures(1)
    loop.remove(screen.view)
    count = len(screen.shown)
    time.sleep(0.3)
    assert len(screen.shown) <= count + 1
    assert screen.view.frame is None
    assert loop.num_views == 0


def test_other_light_is_shown_without_rendering_and_other_shapes_with(loop, screen, rendered):
    loop.move(screen.view, some_pose())
    before = screen.wait_for_finest().picture
    rendered.clear()
    loop.change_edit(screen.view, Edit(Recipe((Scale(0, 0.1),), Light("A"))))
    screen.wait_until(lambda: not np.array_equal(screen.shown[-1].picture, before))
    assert rendered == []
    assert not screen.shown[-1].is_moving
    loop.change_edit(screen.view, Edit(Recipe((Remove((0, 1)),))))
    screen.wait_until(lambda: bool(rendered))
    screen.wait_for_finest()
    loop.change_edit(screen.view, Edit())
    screen.wait_until(lambda: np.array_equal(screen.shown[-1].picture, before))


def test_an_edit_that_does_not_fit_is_said(loop, screen):
    loop.move(screen.view, some_pose())
    screen.wait_for_finest()
    loop.change_edit(screen.view, Edit(Recipe((Scale(99, 2.0),))))
    screen.wait_until(lambda: bool(screen.reports))
    assert "there is no endmember 99" in screen.reports[-1]


def test_depth_is_sent_only_where_it_is_wanted(loop, screen):
    loop.move(screen.view, some_pose())
    screen.wait_for_finest()
    assert screen.shown[-1].depth is None
    loop.want_depth(screen.view, True)
    screen.wait_until(lambda: screen.shown[-1].depth is not None)
    depth = screen.shown[-1].depth
    assert depth is not None
    assert depth.shape == screen.shown[-1].picture.shape[:2]


def test_a_capture_is_rendered_beside_the_views(loop, screen):
    camera = camera_of(some_pose(3), 40)
    done = threading.Event()
    results, parts = [], []

    def finish(frame, reason):
        results.append((frame, reason))
        done.set()

    loop.capture(Capture(FrameRender(camera), Edit(), finish, parts.append))
    loop.move(screen.view, some_pose())
    screen.wait_for_finest()
    assert done.wait(20)
    frame, reason = results[0]
    assert (frame.camera.height, reason) == (40, "")
    assert parts == sorted(parts)
    assert parts[-1] == 1.0


def test_a_capture_that_is_cancelled_or_left_is_told_so(source):
    camera = camera_of(some_pose(), 400)
    reasons = []
    with running_loop(source, slow_speed=5000.0) as (loop, _):
        cancelled = Capture(FrameRender(camera), Edit(), lambda _, reason: reasons.append(reason))
        cancelled.is_cancelled = True
        loop.capture(cancelled)
        loop.capture(Capture(FrameRender(camera), Edit(), lambda _, reason: reasons.append(reason)))
        time.sleep(0.1)
    assert reasons == ["cancelled", "the viewer was stopped"]


def test_more_rays_a_pixel_are_cast_for_the_finest_picture_only(loop, screen, monkeypatch):
    created = []
    original = FrameRender.__init__

    def noting(self, camera, subpixels=1):
        original(self, camera, subpixels)
        created.append((camera.height, subpixels))

    monkeypatch.setattr(FrameRender, "__init__", noting)
    loop.move(screen.view, some_pose())
    loop.change_quality(screen.view, 48, 2)
    screen.wait_until(lambda: bool(screen.shown) and not screen.shown[-1].is_moving)
    assert created[-1] == (48, 2)
    assert all(subpixels == 1 for height, subpixels in created[:-1])


def test_a_picture_never_takes_more_memory_than_is_set_aside(source, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.rendering.picture_maker.LARGEST_FRAME_BYTES", 40_000)
    with running_loop(source) as (loop, _):
        screen = Screen()
        screen.view.largest_height = 2048
        loop.add(screen.view)
        loop.move(screen.view, some_pose())
        picture = screen.wait_for_finest().picture
        with source.borrowed() as scene:
            channels = num_channels(scene.materials)
        assert picture.shape[0] * picture.shape[1] * channels * 4 <= 40_000


def test_while_training_runs_pictures_follow_it(tmp_path, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.rendering.picture_maker.REFRESH_S", 0.05)
    control, model = TrainingControl(), make_model()
    source = source_of_model(model, tmp_path, control)
    with running_loop(source) as (loop, _), control.running():
        screen = Screen()
        screen.view.largest_height = LARGEST
        loop.add(screen.view)
        loop.move(screen.view, some_pose())
        until = time.monotonic() + 20
        while time.monotonic() < until and len(screen.shown) < 6:
            with control.device.training_turn(), torch.no_grad():
                model.endmembers.add_(0.01)
                time.sleep(0.01)
        assert len(screen.shown) >= 6
        means = [shown.picture.mean() for shown in screen.shown]
        assert max(means) - min(means) > 1
    assert not screen.reports


def test_when_training_ends_the_finest_picture_shows_its_last_step(tmp_path):
    control, model = TrainingControl(), make_model()
    source = source_of_model(model, tmp_path, control)
    with running_loop(source) as (loop, _):
        screen = Screen()
        screen.view.largest_height = LARGEST
        loop.add(screen.view)
        with control.running():
            for _ in range(5):
                loop.move(screen.view, some_pose())
                with control.device.training_turn(), torch.no_grad():
                    model.endmembers.mul_(0.5)
        version = source.version
        screen.wait_until(lambda: screen.view.frame_version == version and not screen.shown[-1].is_moving)
        assert screen.view.frame is not None
        shown = screen.view.frame.materials.endmembers
        torch.testing.assert_close(shown, model.endmembers.detach())


def test_an_error_of_ours_in_a_report_is_a_sentence(loop, screen, monkeypatch):
    def refuse(*_):
        raise ConfigError("the scene has gone")

    monkeypatch.setattr(FrameRender, "render_block", refuse)
    loop.move(screen.view, replace(some_pose(), fov=0.5))
    screen.wait_until(lambda: bool(screen.reports))
    assert screen.reports == ["the scene has gone"]
