"""Things, lamp and points of the built-in scene, for its tests; and small scenes of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest

from unmix_plugin.scenes.demo import scene as demo_scene
from unmix_plugin.scenes.demo.shading import LAMP_POSITION, THINGS, render_view

PLACEMENTS = tuple(thing.placement for thing in THINGS)
TABLE, APPLE, *_ = THINGS
LAMP = np.array(LAMP_POSITION, dtype=np.float32)


def row(*values):
    """One point or direction as the rays have them, (1, 3)."""
    return np.array([values], dtype=np.float32)


@contextmanager
def one_ray_a_pixel() -> Iterator[pytest.MonkeyPatch]:
    """Coarser views, for tests of files rather than pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo_scene, "render_view", partial(render_view, subpixels=1))
        yield patch
