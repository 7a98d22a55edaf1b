"""Whether the masks of the training views fit together: what one view shows, no other may look through.

They don't where poses are off by more than a few pixels, and where masks err.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.scenes.geometry.carving import WITNESS_CELLS, carve_box
from unmix_plugin.scenes.geometry.foreground_rays import foreground_rays, share_through, without_specks
from unmix_plugin.scenes.scene import Scene

LEAST_AGREEMENT = 0.98
"""Share of the foreground that all masks together must leave. Scenes with true poses have 1, with masks of which some
err 0.984 to 0.996, the demo scene with poses off by 3 px 0.993 and by 5 px 0.968."""


def share_explained(
    scene: Scene,
    hull: Bool[np.ndarray, "R R R"],
    foreground: list[Bool[np.ndarray, "_ _"]],
    cameras: Cameras,
) -> float:
    """Share of the training views' foreground behind which a hull has something.

    Args:
        scene: In whose box the hull lies.
        foreground: For each training view True on pixels that may show something.
        cameras: Of the training views.
    """
    rays = foreground_rays(cameras, [without_specks(mask) for mask in foreground])
    return share_through(rays, scene.scene_box, hull)


def mask_warning(scene: Scene, foreground: list[Bool[np.ndarray, "_ _"]]) -> str | None:
    """What to say of masks that contradict each other; None if they don't. For bounded scenes with alpha."""
    cameras = scene.cameras[list(scene.train_indices)]
    share = share_explained(
        scene, carve_box(cameras, foreground, scene.scene_box, WITNESS_CELLS), foreground, cameras
    )
    if share >= LEAST_AGREEMENT:
        return None
    return (
        f"the masks of the training views contradict each other: behind {1 - share:.1%} of what they show, other views "
        f"see only background (expected at most {1 - LEAST_AGREEMENT:.0%}). Poses may be off by some pixels "
        "(--poses refine corrects them), or masks have holes"
    )
