"""Where things are in the scene's own world: that of the source of its poses, before anything moved and scaled it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64

from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.errors import RunError
from unmix_plugin.scenes.scene import Normalisation

PRECISION = 1e-6
"""Of positions in files, as a part of the extent of what is exported."""


def world_frame(scene: SceneRecord) -> Normalisation:
    """How a run's world became its model space; one that changes nothing where the run has recorded none.

    Raises:
        RunError: the record is damaged.
    """
    recorded = scene.summary.get("normalisation")
    if recorded is None:
        return Normalisation(np.eye(3), np.zeros(3), 1.0)
    try:
        return Normalisation.from_json(recorded)
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(
            f"the run's scene.json is damaged: its normalisation is {recorded!r} ({error}); train again"
        ) from error


def positions_for_files(
    world: Float64[np.ndarray, "*points 3"],
) -> Float32[np.ndarray, "*points 3"] | Float64[np.ndarray, "*points 3"]:
    """World positions in the type that files need: float32 where it keeps them to a millionth of their extent.

    Others, such as geo-referenced ones, stay float64.
    """
    if world.size == 0:
        return world.astype(np.float32)
    extent = float(
        (world.max(axis=tuple(range(world.ndim - 1))) - world.min(axis=tuple(range(world.ndim - 1)))).max()
    )
    rounding = 0.5 * float(np.spacing(np.float32(np.abs(world).max())))
    return world if rounding > PRECISION * extent else world.astype(np.float32)


def directions_to_world(
    frame: Normalisation, directions: Float[np.ndarray, "*points 3"]
) -> Float64[np.ndarray, "*points 3"]:
    """Directions of model space in the world: turned back, lengths kept."""
    return directions @ frame.rotation


def affine_to_world(
    frame: Normalisation, origin: Float[np.ndarray, "3"], cell: float
) -> Float64[np.ndarray, "4 4"]:
    """Matrix from indices of a model-space grid, as (i, j, k, 1), to world points; `origin` is that of (0, 0, 0)."""
    matrix = np.eye(4)
    matrix[:3, :3] = frame.rotation.T * (cell / frame.scale)
    matrix[:3, 3] = frame.to_world(np.asarray(origin, dtype=np.float64))
    return matrix
