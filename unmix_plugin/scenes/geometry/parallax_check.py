"""Whether the cameras stand far enough apart to tell how far away things are."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from unmix_plugin.engine.geometry.scene_box import SceneBox

_SMALLEST_BASE = 2e-3
"""Distance between two cameras over that of what they see, below which it moves by hardly more than a pixel."""


def parallax_warning(positions: Float[np.ndarray, "N 3"], box: SceneBox) -> str | None:
    """A warning if all cameras stand at one place.

    Args:
        positions: Of the cameras, of a line camera at several rows; model space.
        box: Of the scene.
    """
    apart = np.linalg.norm(positions - positions[0], axis=1).max()
    away = np.linalg.norm(np.abs(box.aabb.cpu().numpy() - positions[0]).max(axis=0))
    if apart > _SMALLEST_BASE * away:
        return None
    return (
        "all training cameras stand at one place: turned about itself, a camera sees nothing of how far away things "
        "are, so no other place can be rendered from such views. Move it between views; if it was moved, look whether "
        "each 'transform_matrix' is camera to world: read the other way, all cameras around an object stand at one"
    )
