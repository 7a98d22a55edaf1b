"""Does the light move with the camera? Judged by the brightness of the hull's surface, before any training.

Where an object is turned before a fixed camera and lamp, the light follows the camera: a place gets brighter when it
turns to the side of the image that the lamp stands on. Where the light is fixed to the object, a place looks about as
bright from all sides. So places on the hull are followed through the views that see them, and functions of the normal
in the camera's frame that tell left from right and up from down are fitted to the changes of their brightness in one
half of the views. If they foretell the changes in the other half, whichever way the views are halved, the light moves.
Functions that don't tell sides are left out: surfaces seen at a grazing angle look different under any light. So a
lamp at the camera's very place is not found.

Notation: `P` places, `N` views, `F` functions of a normal, `V` values, `R` cells along an edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.spectral.evidence import brightness

MOVING_SHARE = 0.015
"""Share of the changes of brightness that must be foretold in every half of the views. Two turntables have 0.03 and 0.2
or more, three scenes with a fixed light none."""
NUM_PLACES, FEWEST_VIEWS, FEWEST_PLACES = 2000, 4, 50
"""Places that are followed, views of one half that must see each, and places that must be seen by so many."""
LARGEST_HULL = 64
"""Cells along an edge of the hull that places are taken from; finer ones are joined."""
SMOOTHING_CELLS = 2.0
"""Standard deviation of the blur of the hull from whose slope normals are taken."""
LEAST_FACING = 0.35
"""Cosine between normal and direction to the camera from which on a place is looked at."""
CLEAR_CELLS, MOST_CELLS = 4.0, 64
"""Way from a place, in cells, that is not checked for what stands in front of it; and how far it is checked."""


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


def light_moves(
    cameras: Cameras,
    log_brightness: list[Float[np.ndarray, "H W"]],
    hull: Bool[np.ndarray, "R R R"],
    box: SceneBox,
) -> bool:
    """Whether the light moves with the camera; False where too little is seen to tell. Arguments as below."""
    return foretold_share(cameras, log_brightness, hull, box) > MOVING_SHARE


def foretold_share(
    cameras: Cameras,
    log_brightness: list[Float[np.ndarray, "H W"]],
    hull: Bool[np.ndarray, "R R R"],
    box: SceneBox,
) -> float:
    """Least share of the changes of brightness that the other half of the views foretells; 0 if too little is seen.

    Args:
        cameras: Of the views.
        log_brightness: Of each view, NaN on pixels that say nothing: background, saturated ones.
        hull: Cells that may be occupied, of the box.
    """
    hull = _coarse(hull)
    places = hull_places(hull, box)
    if len(places.positions) == 0:
        return 0.0
    seen, turned = [], []
    for index, image in enumerate(log_brightness):
        seen.append(_looked_up(cameras, index, image, places, hull, box))
        turned.append(_smooth_functions(places.normals @ cameras.camera_to_world[index, :, :3]))
    return _least_share(torch.stack(seen, dim=1), torch.stack(turned, dim=1), _halves(cameras))


def _coarse(hull: Bool[np.ndarray, "R R R"]) -> Bool[np.ndarray, "r r r"]:
    """The hull in fewer cells, each occupied if one of its parts is."""
    factor = hull.shape[0] // LARGEST_HULL
    if factor < 2 or hull.shape[0] % factor:
        return hull
    cells = hull.shape[0] // factor
    joined = hull.reshape(cells, factor, cells, factor, cells, factor)
    return np.asarray(joined.any(axis=(1, 3, 5)))


def _halves(cameras: Cameras) -> Bool[Tensor, "2 N"]:
    """The views cut into two halves, twice: along the two axes in which their positions vary most."""
    positions = cameras.camera_to_world[:, :, 3]
    centred = positions - positions.mean(dim=0)
    axes = torch.linalg.svd(centred, full_matrices=False).Vh[:2]
    along = centred @ axes.T
    return (along > along.median(dim=0).values).T


def local_log_brightness(
    spectra: Float[Tensor, "H W B"], counts: Bool[Tensor, "H W"]
) -> Float[np.ndarray, "H W"]:
    """Logarithm of the mean brightness of 3 x 3 pixels, of those that count; NaN where the middle one doesn't."""
    from scipy import ndimage  # slow to import

    seen = brightness(spectra.flatten(0, 1)).view(counts.shape)
    known = (counts & (seen > 0)).numpy()
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


def _smooth_functions(normals: Float[Tensor, "P 3"]) -> Float[Tensor, "P F"]:
    """Polynomials that change sign with x or y."""
    x, y, z = normals.unbind(-1)
    return torch.stack([x, y, x * z, y * z, x * y], dim=-1)


def _least_share(
    values: Float[Tensor, "P N"], functions: Float[Tensor, "P N F"], halves: Bool[Tensor, "2 N"]
) -> float:
    """Least share of the variance within places, seen by a half of the views, that a fit to the other foretells."""
    shares: list[float] = []
    for half in halves:
        parts = [_changes(values[:, chosen], functions[:, chosen]) for chosen in (half, ~half)]
        if min(len(y) for _, y in parts) < FEWEST_PLACES * FEWEST_VIEWS:
            return 0.0
        for (x, y), (others, known) in (parts, parts[::-1]):
            fit = torch.linalg.lstsq(x, y[:, None]).solution[:, 0]
            total = float(known.square().sum())
            left = float((known - others @ fit).square().sum())
            shares.append(1.0 - left / total if total > 0 else 0.0)

    return min(shares)


def _changes(
    values: Float[Tensor, "P N"], functions: Float[Tensor, "P N F"]
) -> tuple[Float[Tensor, "V F"], Float[Tensor, " V"]]:
    """Functions and values without their means over the views of each place, of places that enough views see."""
    known = values.isfinite()
    enough = known.sum(dim=1) >= FEWEST_VIEWS
    known, values, functions = known[enough], values[enough].double(), functions[enough].double()
    counts = known.sum(dim=1, keepdim=True)
    values = torch.where(known, values, 0.0)
    functions = torch.where(known[..., None], functions, 0.0)
    values = values - values.sum(dim=1, keepdim=True) / counts
    functions = functions - functions.sum(dim=1, keepdim=True) / counts[..., None]
    return functions[known], values[known]
