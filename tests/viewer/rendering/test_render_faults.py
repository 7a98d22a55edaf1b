"""What goes wrong while pictures are rendered is said, and ends nothing else."""

from dataclasses import replace

from tests.viewer.rendering.loop_driver import finest, finish
from tests.viewer.view_factory import Screen, some_pose
from unmix_plugin.editing import Recipe, Scale
from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.layers.painting import LayerSettings
from unmix_plugin.viewer.rendering.pictures import Capture, FrameRender
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.view_cameras import camera_of


def test_a_layer_that_cannot_be_shown_is_said_and_the_next_one_works(loop, screen):
    loop.move(screen.view, some_pose())
    finish(loop)
    loop.restyle(screen.view, LayerSettings(layer="error"))
    finish(loop)
    assert screen.reports[-1].startswith("no error to show")
    count = len(screen.shown)
    loop.restyle(screen.view, LayerSettings(layer="rgb"))
    finish(loop)
    assert len(screen.shown) == count + 1
    assert screen.reports[-1] == ""


def test_a_defect_in_a_picture_is_said_logged_and_ends_nothing(loop, screen, monkeypatch, caplog):
    original = FrameRender.render_block
    monkeypatch.setattr(FrameRender, "render_block", lambda *_: 1 / 0)
    loop.move(screen.view, some_pose())
    finish(loop)
    assert len(screen.reports) == 1  # not tried again and again
    assert "ZeroDivisionError" in screen.reports[0]
    assert "Traceback" in caplog.text
    monkeypatch.setattr(FrameRender, "render_block", original)
    loop.move(screen.view, some_pose(1))
    finest(loop, screen)


def test_a_client_that_cannot_be_shown_anything_does_not_end_the_loop(loop, screen, caplog):
    gone = Screen()
    gone.view.show = lambda _: (_ for _ in ()).throw(ConnectionError("gone"))
    gone.view.report = lambda _: (_ for _ in ()).throw(ConnectionError("gone"))
    loop.add(gone.view)
    loop.move(gone.view, some_pose())
    loop.move(screen.view, some_pose())
    finest(loop, screen)
    assert "ConnectionError" in caplog.text


def test_a_view_that_is_removed_in_mid_render_is_shown_nothing_more(loop, screen):
    screen.view.largest_height = 512
    loop.move(screen.view, some_pose())
    assert loop.step()
    assert loop.step()
    loop.remove(screen.view)
    count = len(screen.shown)
    finish(loop)
    assert len(screen.shown) == count
    assert screen.view.frame is None
    assert loop.num_views == 0


def test_an_edit_that_does_not_fit_is_said(loop, screen):
    loop.move(screen.view, some_pose())
    finish(loop)
    loop.change_edit(screen.view, Edit(Recipe((Scale(99, 2.0),))))
    finish(loop)
    assert "there is no endmember 99" in screen.reports[-1]


def test_a_capture_that_is_cancelled_or_left_is_told_so(loop):
    reasons = []
    for _ in range(2):
        render = FrameRender(camera_of(some_pose(), 400))
        loop.capture(Capture(render, Edit(), lambda _, reason: reasons.append(reason)))
    loop._captures[0].is_cancelled = True
    assert loop.step()
    loop.stop()
    assert reasons == ["cancelled", "the viewer was stopped"]


def test_an_error_of_ours_in_a_report_is_a_sentence(loop, screen, monkeypatch):
    def refuse(*_):
        raise ConfigError("the scene has gone")

    monkeypatch.setattr(FrameRender, "render_block", refuse)
    loop.move(screen.view, replace(some_pose(), fov=0.5))
    finish(loop)
    assert screen.reports == ["the scene has gone"]
