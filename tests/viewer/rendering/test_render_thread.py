"""The render loop in its own thread, beside a training."""

import time

import torch

from tests.method_factory import make_model
from tests.viewer.rendering.loop_driver import LARGEST, running_loop
from tests.viewer.view_factory import Screen, some_pose, source_of_model
from unmix_plugin.engine.training.training_control import TrainingControl
from unmix_plugin.trained.material_view import MaterialView


def test_while_training_runs_pictures_follow_it(tmp_path, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.rendering.pictures.REFRESH_S", 0.05)
    control, model = TrainingControl(), make_model()
    source = source_of_model(model, tmp_path, control)
    with running_loop(source) as loop, control.running():
        screen = Screen()
        screen.view.largest_height = LARGEST
        loop.add(screen.view)
        loop.move(screen.view, some_pose())
        until = time.monotonic() + 120
        while len(screen.shown) < 6:
            assert time.monotonic() < until
            with control.device.training_turn(), torch.no_grad():
                model.endmembers.add_(0.01)
                screen.wait(0.01)  # a step that takes time earns the viewer its share
        means = [shown.picture.mean() for shown in screen.shown]
        assert max(means) - min(means) > 1
    assert not screen.reports


def test_when_training_ends_the_finest_picture_shows_its_last_step(tmp_path):
    control, model = TrainingControl(), make_model()
    source = source_of_model(model, tmp_path, control)
    with running_loop(source) as loop:
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
        assert isinstance(screen.view.frame, MaterialView)
        shown = screen.view.frame.materials.endmembers
        torch.testing.assert_close(shown, model.endmembers.detach())
