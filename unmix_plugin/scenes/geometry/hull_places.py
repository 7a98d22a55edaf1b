"""Places on the surface of a carved hull, and how bright each view shows them.

Notation: `P` places, `N` views, `R` cells along an edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.scene_box import SceneBox

NUM_PLACES = 2000
"""Places that are followed."""
LARGEST_HULL = 64
"""Cells along an edge of the hull that places are taken from; finer ones are joined."""
SMOOTHING_CELLS = 2.0
"""Standard deviation of the blur of the hull from whose slope normals are taken."""
LEAST_FACING = 0.35
"""Cosine between normal and direction to the camera from which a place is looked at."""
CLEAR_CELLS, MOST_CELLS = 4.0, 64
"""Way from a place, in cells, that is not checked for what is in front of it; and how far it is checked."""


@dataclass(frozen=True)
class Places:
    """Places on the surface of a hull."""

    positions: Float[Tensor, "P 3"]
    normals: Float[Tensor, "P 3"]
    """Unit vectors, outwards."""


def hull_places(hull: Bool[np.ndarray, "R R R"], box: SceneBox) -> Places:
    """Evenly thinned-out cells on the surface of a hull, with their normals."""
    from scipy import ndimage  # slow to import

    inner = np.array(ndimage.binary_erosion(hull, border_value=1), dtype=bool)
    surface = hull & ~inner
    cells = np.argwhere(surface)
    cells = cells[:: max(1, -(-len(cells) // NUM_PLACES))]
    blurred = ndimage.gaussian_filter(hull.astype(np.float32), SMOOTHING_CELLS)
    sides = np.array(hull.shape)
    gradient = [np.asarray(part) for part in np.gradient(blurred)]
    slopes = np.stack(gradient, axis=-1)[tuple(cells.T)] * (sides / box.size.numpy())
    normals = torch.nn.functional.normalize(-torch.from_numpy(slopes).float(), dim=-1)
    positions = box.aabb[0] + torch.from_numpy((cells + 0.5) / sides).float() * box.size
    return Places(positions, normals)


def seen_places(
    cameras: Cameras,
    log_brightness: list[Float[np.ndarray, "H W"]],
    hull: Bool[np.ndarray, "R R R"],
    box: SceneBox,
) -> tuple[Places, Float[Tensor, "P N"]]:
    """Places on the hull, and the logarithm of their brightness in each view; NaN where a view does not see one.

    Args:
        cameras: Of the views.
        log_brightness: Of each view, NaN on pixels that say nothing: background, saturated ones.
        hull: Cells that may be occupied, of the box.
    """
    hull = coarse_hull(hull)
    places = hull_places(hull, box)
    seen = [
        _looked_up(cameras, index, image, places, hull, box) for index, image in enumerate(log_brightness)
    ]
    return places, torch.stack(seen, dim=1)


def coarse_hull(hull: Bool[np.ndarray, "R R R"]) -> Bool[np.ndarray, "r r r"]:
    """The hull in fewer cells, each occupied if one of its parts is."""
    factor = hull.shape[0] // LARGEST_HULL
    if factor < 2 or hull.shape[0] % factor:
        return hull
    cells = hull.shape[0] // factor
    joined = hull.reshape(cells, factor, cells, factor, cells, factor)
    return np.asarray(joined.any(axis=(1, 3, 5)))


def local_log_brightness(seen: Float[Tensor, "H W"]) -> Float[np.ndarray, "H W"]:
    """Logarithm of the mean brightness of 3 x 3 pixels, of those that are above 0; NaN where the middle one isn't."""
    from scipy import ndimage  # slow to import

    known = (seen > 0).numpy()
    weights = ndimage.uniform_filter(known.astype(np.float32), 3)
    means = ndimage.uniform_filter(np.where(known, seen.numpy(), 0.0), 3) / np.maximum(weights, 1e-6)
    return np.where(known, np.log(np.where(known, means, 1.0)), np.nan)


def _looked_up(
    cameras: Cameras,
    index: int,
    image: Float[np.ndarray, "H W"],
    places: Places,
    hull: Bool[np.ndarray, "R R R"],
    box: SceneBox,
) -> Float[Tensor, " P"]:
    """What a view shows of the places, NaN where it does not see them."""
    coords, depths = cameras.project(places.positions, index)
    pixels = coords.floor().long()
    inside = (depths > 0) & (pixels >= 0).all(dim=-1)
    inside &= (pixels < torch.tensor(cameras.size(index))).all(dim=-1)
    towards = torch.nn.functional.normalize(cameras.camera_to_world[index, :, 3] - places.positions, dim=-1)
    inside &= (towards * places.normals).sum(dim=-1) > LEAST_FACING
    inside &= ~_is_hidden(places.positions, towards, hull, box)
    columns, rows = torch.where(inside[:, None], pixels, 0).unbind(-1)
    return torch.where(inside, torch.from_numpy(image).float()[rows, columns], torch.nan)


def _is_hidden(
    positions: Float[Tensor, "P 3"],
    towards: Float[Tensor, "P 3"],
    hull: Bool[np.ndarray, "R R R"],
    box: SceneBox,
) -> Bool[Tensor, " P"]:
    """Places with hull before them."""
    cells, kept = hull.shape[0], torch.from_numpy(hull)
    cell = float(box.size.max()) / cells
    hidden = torch.zeros(len(positions), dtype=torch.bool)
    for steps in torch.arange(CLEAR_CELLS, MOST_CELLS):
        unit = box.normalise(positions + steps * cell * towards)
        inside = ((unit >= 0) & (unit < 1)).all(dim=-1)
        x, y, z = (unit * cells).long().clamp(0, cells - 1).unbind(-1)
        hidden |= inside & kept[x, y, z]
    return hidden
