"""Drives a render loop by hand, piece by piece, or starts one in a thread of its own."""

from contextlib import contextmanager

from unmix_plugin.viewer.rendering.pictures import PictureMaker, Speedometer, num_channels
from unmix_plugin.viewer.rendering.render_loop import RenderLoop
from unmix_plugin.viewer.rendering.scene import SceneAids

LARGEST = 64


class FixedSpeed(Speedometer):
    """A speed that is set, not measured."""

    def add(self, rays, seconds):
        pass


def make_loop(source, slow_speed=None):
    """A loop that waits to be driven; `slow_speed` is a speed at which moving pictures are small."""
    with source.borrowed() as scene:
        channels = num_channels(scene.materials)
    maker = PictureMaker(source, SceneAids(source, has_materials=True), channels)
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
    loop = make_loop(source, slow_speed)
    loop.start()
    try:
        yield loop
    finally:
        loop.stop()
    assert not loop._thread.is_alive()
