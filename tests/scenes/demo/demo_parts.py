"""Things, lamp and points of the built-in scene, for its tests."""

import numpy as np

from unmix_plugin.scenes.demo.shading import _LAMP_POSITION, THINGS

PLACEMENTS = tuple(thing.placement for thing in THINGS)
TABLE, APPLE, *_ = THINGS
LAMP = np.array(_LAMP_POSITION, dtype=np.float32)


def row(*values):
    """One point or direction as the rays have them, (1, 3)."""
    return np.array([values], dtype=np.float32)
