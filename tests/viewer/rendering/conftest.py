"""A loop that is driven by hand, with one screen, and the rays that it rendered."""

import pytest

from tests.viewer.rendering.loop_driver import LARGEST, make_loop
from tests.viewer.view_factory import Screen
from unmix_plugin.viewer.rendering.pictures import FrameRender


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
