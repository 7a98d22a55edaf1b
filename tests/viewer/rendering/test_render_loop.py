"""When to render: by hand, piece by piece; what goes wrong; in a thread of its own beside a training."""

import threading
import time

import numpy as np
import pytest
import torch

from tests.factories import views
from tests.factories.models import make_model
from tests.factories.views import LARGEST, Screen, finest, finish, make_loop, some_pose
from unmix_plugin.editing import Light, Recipe, Remove, Scale
from unmix_plugin.engine.training.training_control import TrainingControl
from unmix_plugin.trained.gradual import FrameRender, numbers_per_pixel
from unmix_plugin.trained.trained_scene import MaterialView
from unmix_plugin.viewer.rendering.pictures import PictureMaker
from unmix_plugin.viewer.rendering.render_loop import View
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.rendering.settings import LayerSettings
from unmix_plugin.viewer.view_cameras import camera_of


@pytest.fixture
def loop(source):
    return make_loop(source, slow_speed=5000.0)


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


def test_a_movement_is_answered_with_a_small_picture_and_rest_with_finer_ones(loop, screen, source):
    loop.change(screen.view, pose=some_pose())
    last = finest(loop, screen)
    heights = [shown.picture.shape[0] for shown in screen.shown]
    assert last.picture.shape[:2] == (LARGEST, round(LARGEST * 1.5))
    assert heights[0] < 20
    assert heights == sorted(set(heights))
    assert [shown.is_moving for shown in screen.shown] == [True] * (len(heights) - 1) + [False]
    assert not loop.step()
    with source.locked() as scene:
        expected = scene.look(camera_of(some_pose(), LARGEST), subpixels=1).coefficients
    found = screen.view.frame.coefficients.abundances
    torch.testing.assert_close(found, expected.abundances, atol=1e-5, rtol=1e-5)


def test_switching_layers_renders_nothing(loop, screen, rendered):
    loop.change(screen.view, pose=some_pose())
    finish(loop)
    rendered.clear()
    for layer in ("segmentation", "band", "abundances", "pca", "depth", "rgb"):
        count = len(screen.shown)
        loop.change(screen.view, settings=LayerSettings(layer=layer))
        finish(loop)
        assert len(screen.shown) == count + 1
        assert screen.shown[-1].picture.shape[0] == LARGEST
    assert rendered == []


def test_a_movement_interrupts_what_is_refined(loop, screen):
    screen.view.largest_height = 256
    for index in range(40):  # of which only the last is answered
        loop.change(screen.view, pose=some_pose(index % 4))
    assert loop.step()
    assert loop.step()
    assert screen.view.render is not None
    count = len(screen.shown)
    loop.change(screen.view, pose=some_pose(1))
    assert loop.step()
    assert len(screen.shown) == count + 1
    assert screen.shown[-1].picture.shape[0] < 20
    assert screen.view.frame.camera.camera_to_world[0, :, 3].tolist() == pytest.approx(some_pose(1).position)


def test_nobody_starves_while_eight_move(loop):
    screens = [Screen() for _ in range(8)]
    for screen in screens:
        loop.add(screen.view)
    for _ in range(3 * len(screens)):
        for index, screen in enumerate(screens):  # all move more often than there is time to answer
            loop.change(screen.view, pose=some_pose(index % 4))
        assert loop.step()
    assert [len(screen.shown) for screen in screens] == [3] * len(screens)
    assert all(not screen.reports for screen in screens)
    for index, screen in enumerate(screens):
        layer = ("rgb", "depth", "segmentation", "abundances")[index % 4]
        loop.change(screen.view, largest_height=16 + index, settings=LayerSettings(layer=layer))
    finish(loop)
    assert [screen.shown[-1].picture.shape[0] for screen in screens] == [*range(16, 24)]


def test_other_light_is_shown_without_rendering_and_other_shapes_with(loop, screen, rendered):
    loop.change(screen.view, pose=some_pose())
    before = finest(loop, screen).picture
    rendered.clear()
    loop.change(screen.view, edit=Edit(Recipe((Scale(0, 0.1),), Light("A"))))
    assert not np.array_equal(finest(loop, screen).picture, before)
    assert rendered == []
    loop.change(screen.view, edit=Edit(Recipe((Remove((0, 1)),))))
    finish(loop)
    assert rendered
    loop.change(screen.view, edit=Edit())
    assert np.array_equal(finest(loop, screen).picture, before)


def test_pages_need_not_wait_for_a_picture_that_is_being_refined(source):
    maker = PictureMaker(source)
    render, blocks, ended = FrameRender(camera_of(some_pose(), 2048)), [], threading.Event()

    def refine():
        while not ended.is_set() and render.rays_left > 2048:
            maker.advance(render, Edit(), 2048, cost=1.0)
            blocks.append(render.rays_left)

    thread = threading.Thread(target=refine)
    thread.start()
    try:
        for _ in range(20):
            before = len(blocks)
            maker.edited(Edit())
            assert len(blocks) - before <= 3
    finally:
        ended.set()
        thread.join()


def test_removed_materials_leave_no_faint_specks(loop, screen):
    loop.change(screen.view, edit=Edit(Recipe((Remove((0,)),))))
    loop.change(screen.view, pose=some_pose())
    shown = finest(loop, screen).picture
    opacity = screen.view.frame.opacity.numpy()
    is_trace = (opacity > 0.01) & (opacity < 0.25)
    assert is_trace.any()
    assert (shown[is_trace] == round(0.92 * 255)).all()
    assert (shown[opacity > 0.3] != round(0.92 * 255)).any()


def test_more_rays_a_pixel_are_cast_for_the_finest_picture_only(loop, screen, monkeypatch):
    created, original = [], FrameRender.__init__

    def noting(self, camera, subpixels=1):
        original(self, camera, subpixels)
        created.append((camera.height, subpixels))

    monkeypatch.setattr(FrameRender, "__init__", noting)
    loop.change(screen.view, pose=some_pose(), largest_height=24, subpixels=2)
    finest(loop, screen)
    assert created[-1] == (24, 2)
    assert all(subpixels == 1 for height, subpixels in created[:-1])


def test_a_picture_never_takes_more_memory_than_is_set_aside(source, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.rendering.pictures.LARGEST_FRAME_BYTES", 20_000)
    loop, screen = make_loop(source), Screen()
    screen.view.largest_height = 2048
    loop.add(screen.view)
    loop.change(screen.view, pose=some_pose())
    picture = finest(loop, screen).picture
    with source.locked() as scene:
        channels = numbers_per_pixel(scene)
    assert picture.shape[0] * picture.shape[1] * channels * 4 <= 20_000


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ({"settings": LayerSettings(layer="error")}, "no error to show"),
        ({"edit": Edit(Recipe((Scale(99, 2.0),)))}, "recipe, edit 1 (scale): there is no endmember 99"),
    ],
)
def test_what_cannot_be_shown_is_said_and_the_next_one_works(loop, screen, what, said):
    loop.change(screen.view, pose=some_pose())
    finish(loop)
    loop.change(screen.view, **what)
    finish(loop)
    assert screen.reports[-1].startswith(said)
    count = len(screen.shown)
    loop.change(screen.view, settings=LayerSettings(), edit=Edit())
    finish(loop)
    assert len(screen.shown) == count + 1
    assert screen.reports[-1] == ""


def test_a_defect_in_a_picture_is_said_logged_and_ends_nothing(loop, screen, monkeypatch, caplog):
    loop.change(screen.view, pose=some_pose())
    with monkeypatch.context() as broken:
        broken.setattr(FrameRender, "render_block", lambda *_: 1 / 0)
        finish(loop)
    assert len(screen.reports) == 1  # not tried again and again
    assert "ZeroDivisionError" in screen.reports[0]
    assert "Traceback" in caplog.text
    loop.change(screen.view, pose=some_pose(1))
    finest(loop, screen)


def test_a_client_that_cannot_be_shown_anything_does_not_end_the_loop(loop, screen, caplog):
    def fail(_):
        raise ConnectionError("gone")

    gone = View(show=fail, report=fail)
    loop.add(gone)
    for view in (gone, screen.view):
        loop.change(view, pose=some_pose())
    finest(loop, screen)
    assert "ConnectionError" in caplog.text


def test_a_view_that_is_removed_in_mid_render_is_shown_nothing_more(loop, screen):
    screen.view.largest_height = 256
    loop.change(screen.view, pose=some_pose())
    assert loop.step()
    assert loop.step()
    loop.remove(screen.view)
    count = len(screen.shown)
    finish(loop)
    assert len(screen.shown) == count
    assert screen.view.frame is None


@pytest.fixture
def training(tmp_path):
    """A model under training, and a loop that shows it in a thread of its own."""
    control, model, screen = TrainingControl(), make_model(), Screen()
    source = views.source_of_model(model, tmp_path, control)
    with views.running_loop(source) as loop:
        screen.view.largest_height = LARGEST
        loop.add(screen.view)
        yield control, model, source, loop, screen


def test_while_training_runs_pictures_follow_it(training, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.rendering.pictures.REFRESH_S", 0.05)
    control, model, _, loop, screen = training
    control.device.viewing_share = 0.8
    with control.running():
        loop.change(screen.view, pose=some_pose())
        until = time.monotonic() + 120
        while len(screen.shown) < 6:
            assert time.monotonic() < until
            with control.device.training_turn(), torch.no_grad():
                model.endmembers.add_(0.01)
                screen.wait(0.01)  # a step that takes time earns the viewer its share
        means = [shown.picture.mean() for shown in screen.shown]
        assert max(means) - min(means) > 1
    assert not screen.reports


def test_when_training_ends_the_finest_picture_shows_its_last_step(training):
    control, model, source, loop, screen = training
    with control.running():
        for _ in range(5):
            loop.change(screen.view, pose=some_pose())
            with control.device.training_turn(), torch.no_grad():
                model.endmembers.mul_(0.5)
    version = source.version
    screen.wait_until(lambda: screen.view.frame_version == version and not screen.shown[-1].is_moving)
    assert isinstance(screen.view.frame, MaterialView)
    shown = screen.view.frame.materials.endmembers
    torch.testing.assert_close(shown, model.endmembers.detach())
