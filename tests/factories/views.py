"""Sources, cameras and render loops, driven by hand or in a thread of their own, for tests of the viewer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torch import Tensor

from tests.factories.cameras import cameras_at
from tests.factories.models import BOX, make_model
from tests.factories.scenes import ring_poses
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.runs.loading import SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.training_control import DeviceLock, TrainingControl
from unmix_plugin.errors import SceneError
from unmix_plugin.figures.paint import Legend, background_of
from unmix_plugin.model import UnmixModel
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.trained.open_run import unmix_scene
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene, reference_rays
from unmix_plugin.viewer.rendering import painting
from unmix_plugin.viewer.rendering.aids import LayerAids
from unmix_plugin.viewer.rendering.painting import LAYERS, layer_named
from unmix_plugin.viewer.rendering.pictures import Picture, PictureMaker, Speedometer
from unmix_plugin.viewer.rendering.render_loop import RenderLoop, View
from unmix_plugin.viewer.rendering.scene import SceneSource
from unmix_plugin.viewer.rendering.settings import LayerSettings
from unmix_plugin.viewer.view_cameras import ViewPose, pose_of

WIDTH, HEIGHT, FOCAL = 24, 16, 20.0


def ring(count: int = 4) -> Cameras:
    """Cameras around the origin that see the whole box."""
    return cameras_at(ring_poses(count, distance=4.0), WIDTH, HEIGHT, FOCAL)


def make_source(folder: Path, control: TrainingControl | None = None, **settings: Any) -> SceneSource:
    """A model of random blobs as a finished run, or as one under training."""
    return source_of_model(make_model(**settings), folder, control)


def source_of_model(model: UnmixModel, folder: Path, control: TrainingControl | None = None) -> SceneSource:
    """The scenes of a model that a test may change in training turns."""
    cameras = ring()
    record = SceneRecord(BOX, dict(model.metadata), cameras, cameras[[1, 3]], {})
    device = DeviceLock() if control is None else control.device
    return SceneSource(RunFolder(folder), record, device, lambda: unmix_scene(model, record), control)


def no_scene() -> Scene:
    """A reader of a scene that is not at hand."""
    raise SceneError("the scene has gone")


def make_frame(source: SceneSource, camera: Cameras | None = None) -> MaterialView:
    """A rendered view."""
    with source.locked() as scene:
        assert isinstance(scene, TrainedScene)
        return scene.look(source.record.train_cameras[0] if camera is None else camera, subpixels=1)


def make_aids(source: SceneSource) -> LayerAids:
    """What layers need."""
    with source.locked() as scene:
        assert isinstance(scene, TrainedScene)
        return LayerAids(*reference_rays(scene, source.record.train_cameras), source.record.scene_box)


def paint_layer(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Tensor, Legend]:
    """The picture of the layer that the settings name, (H, W, 3) sRGB over its background, and its legend."""
    painted = painting.paint_layer(layer_named(settings.layer, LAYERS), frame, settings, aids)
    return painted.over(background_of(settings))[:, :, 0].float(), painted.legend


def some_pose(index: int = 0) -> ViewPose:
    """Where one of the ring's cameras is."""
    return pose_of(ring()[index])


class Screen:
    """Stands in for a browser: keeps what is shown and what is said."""

    def __init__(self) -> None:
        self.shown: list[Picture] = []
        self.reports: list[str] = []
        self._changed = threading.Condition()
        self.view = View(show=self._show, report=self._report)

    def wait_until(self, holds: Callable[[], bool], timeout_s: float = 120.0) -> None:
        """Wait for something to become true; fails the test if it does not."""
        with self._changed:
            assert self._changed.wait_for(holds, timeout_s), (len(self.shown), self.reports)

    def wait(self, seconds: float) -> None:
        """Wait for the next picture or report, but no longer than that."""
        with self._changed:
            self._changed.wait(seconds)

    def _show(self, shown: Picture) -> None:
        with self._changed:
            self.shown.append(shown)
            self._changed.notify_all()

    def _report(self, text: str) -> None:
        with self._changed:
            self.reports.append(text)
            self._changed.notify_all()


LARGEST = 32


class FixedSpeed(Speedometer):
    """A speed that is set, not measured."""

    def add(self, rays, seconds):
        pass


def make_loop(source, slow_speed=None):
    """A loop that waits to be driven; `slow_speed` is a speed at which moving pictures are small."""
    maker = PictureMaker(source)
    if slow_speed is not None:
        maker.speed = FixedSpeed(slow_speed)
    return RenderLoop(maker)


def finish(loop):
    """Drive a loop until nothing is left to do."""
    for _ in range(10_000):
        if not loop.step():
            return
    raise AssertionError("there is always more to do")


def finest(loop, screen):
    """The picture that a screen has in the end."""
    finish(loop)
    assert not screen.shown[-1].is_moving
    return screen.shown[-1]


@contextmanager
def running_loop(source, slow_speed=None):
    """A loop in a thread of its own."""
    loop, before = make_loop(source, slow_speed), set(threading.enumerate())
    loop.start()
    try:
        yield loop
    finally:
        loop.stop()
    left = {thread for thread in threading.enumerate() if thread.name == "unmix-viewer-render"}
    assert left <= before
