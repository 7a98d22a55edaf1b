"""Does the light move with the camera, or differ from view to view? Judged by places on surfaces, before any training.

Where an object is turned before a fixed camera and lamp, the light follows the camera: a place gets brighter when it
turns to the side of the image that the lamp is on. Where the light is fixed to the object, a place looks about as
bright from all sides. So places on the hull are followed through the views that see them, and functions of the normal
in the camera's frame that tell left from right and up from down are fitted to the changes of their brightness in one
half of the views. If they predict the changes in the other half, whichever way the views are halved, the light moves.
Functions that don't tell sides are left out: surfaces seen at a grazing angle look different under any light. So a
lamp at the camera's very place is not found. Glossy surfaces look different from all sides under a fixed light, too:
what they mirror depends on the mirrored direction of view in the world. Where that explains more of the changes, the
light does not move.

Where exposures differ, all places of a view are brighter or darker than in other views, by the same factor: what one
half of the places says of the views' gains, the other half says too, whichever way the places are halved. Highlights
and errors of the hull change some places only. Places that two views were matched by (`matched_points`) serve as well.

Notation: `P` places on the surface of a hull, `N` views, `F` functions of a normal, `V` values, `R` cells along an
edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.scenes.geometry.carving import Cells
from unmix_plugin.scenes.geometry.filters import gaussian_blur, inner_cells, mean_3x3
from unmix_plugin.scenes.geometry.views import look_up

Pictures = list[Float[np.ndarray, "H W"]]
Seen = Float[Tensor, "P N"]
"""Logarithm of the brightness of places in views; NaN where one is not seen."""
_NUM_PLACES = 2000
"""Places that are followed."""
_LARGEST_HULL = 64
"""Cells along an edge of the hull that places are taken from; finer ones are joined."""
_SMOOTHING_CELLS = 2.0
"""Standard deviation of the blur of the hull from whose slope normals are taken."""
_LEAST_FACING = 0.35
"""Cosine between normal and direction to the camera from which a place is looked at."""
_CLEAR_CELLS, _MOST_CELLS = 4.0, 64
"""Way from a place, in cells, that is not checked for what is in front of it; and how far it is checked."""
_MOVING_SHARE = 0.015
"""Share of the changes of brightness that must be predicted in every half of the views. Two turntables have 0.03 and
0.2 or more, three scenes with a fixed light none."""
_LEAST_GAIN_SPREAD = 0.04
"""Standard deviation of the views' log gains that both halves of the places must agree on. Seven scenes of one exposure
have up to 0.02, since hulls are not surfaces; with gains of +-20 % all have 0.09 or more, with +-10 % 0.04 to 0.08."""
_FEWEST_VIEWS, _FEWEST_PLACES = 4, 50
"""Views that must see a place, of one half of them for a moving light; and places that must be seen by so many."""
_NUM_FITS, _SMALLEST_ERROR = 10, 0.02
"""Least squares fits of gains; and error of a place's log brightness below which it weighs no more."""


@dataclass(frozen=True)
class Places:
    """Places on the surface of a hull."""

    positions: Float[Tensor, "P 3"]
    normals: Float[Tensor, "P 3"]
    """Unit vectors, outwards."""


def _hull_places(hull: Cells, box: SceneBox) -> Places:
    """Evenly thinned-out cells on the surface of a hull, with their normals."""
    cells = np.argwhere(hull & ~inner_cells(hull))
    cells = cells[:: max(1, -(-len(cells) // _NUM_PLACES))]
    blurred = gaussian_blur(hull.astype(np.float32), _SMOOTHING_CELLS)
    sides = np.array(hull.shape)
    gradient = [np.asarray(part) for part in np.gradient(blurred)]
    slopes = np.stack(gradient, axis=-1)[tuple(cells.T)] * (sides / box.size.numpy())
    normals = torch.nn.functional.normalize(-torch.from_numpy(slopes).float(), dim=-1)
    positions = box.aabb[0] + torch.from_numpy((cells + 0.5) / sides).float() * box.size
    return Places(positions, normals)


def seen_places(
    cameras: Cameras, log_brightness: Pictures, hull: Cells, box: SceneBox
) -> tuple[Places, Seen]:
    """Places on a hull in a box, and the logarithm of their brightness in each view; NaN where a view does not see one,
    or its picture is NaN: background, saturated pixels."""
    hull = coarse_hull(hull)
    places = _hull_places(hull, box)
    seen = []
    for index, image in enumerate(log_brightness):
        coords, _, inside = look_up(cameras, index, places.positions)
        towards = cameras.camera_to_world[index, :, 3] - places.positions
        towards = torch.nn.functional.normalize(towards, dim=-1)
        inside &= (towards * places.normals).sum(dim=-1) > _LEAST_FACING
        inside &= ~_is_hidden(places.positions, towards, hull, box)
        columns, rows = torch.where(inside[:, None], coords, 0.0).long().unbind(-1)
        seen.append(torch.where(inside, torch.from_numpy(image).float()[rows, columns], torch.nan))
    return places, torch.stack(seen, dim=1)


def coarse_hull(hull: Cells) -> Bool[np.ndarray, "r r r"]:
    """The hull in fewer cells, each occupied if one of its parts is."""
    factor = hull.shape[0] // _LARGEST_HULL
    if factor < 2 or hull.shape[0] % factor:
        return hull
    cells = hull.shape[0] // factor
    joined = hull.reshape(cells, factor, cells, factor, cells, factor)
    return np.asarray(joined.any(axis=(1, 3, 5)))


def local_log_brightness(seen: Float[Tensor, "H W"]) -> Float[np.ndarray, "H W"]:
    """Logarithm of the mean brightness of 3 x 3 pixels, of those that are above 0; NaN where the middle one isn't."""
    known = (seen > 0).numpy()
    weights = mean_3x3(known.astype(np.float32))
    means = mean_3x3(np.where(known, seen.numpy(), np.float32(0))) / np.maximum(weights, 1e-6)
    return np.where(known, np.log(np.where(known, means, 1.0)), np.nan)


def _is_hidden(
    positions: Float[Tensor, "P 3"], towards: Float[Tensor, "P 3"], hull: Cells, box: SceneBox
) -> Bool[Tensor, " P"]:
    """Places with hull before them."""
    cells, kept = hull.shape[0], torch.from_numpy(hull)
    cell = float(box.size.max()) / cells
    hidden = torch.zeros(len(positions), dtype=torch.bool)
    for steps in torch.arange(_CLEAR_CELLS, _MOST_CELLS):
        unit = box.normalise(positions + steps * cell * towards)
        inside = ((unit >= 0) & (unit < 1)).all(dim=-1)
        x, y, z = (unit * cells).long().clamp(0, cells - 1).unbind(-1)
        hidden |= inside & kept[x, y, z]
    return hidden


LightKind = Literal["fixed", "camera", "per-view"]


def judge_light(cameras: Cameras, log_brightness: Pictures, hull: Cells, box: SceneBox) -> LightKind:
    """Which light the views were taken in; fixed where too little is seen to tell. Arguments as of `seen_places`."""
    places, seen = seen_places(cameras, log_brightness, hull, box)
    if _follows_camera(cameras, places, seen):
        return "camera"
    followed = seen.isfinite().sum(dim=1) >= _FEWEST_VIEWS
    return judge_exposure(cameras, places.positions[followed], seen[followed])


def judge_exposure(
    cameras: Cameras, positions: Float[Tensor, "P 3"], seen: Seen
) -> Literal["fixed", "per-view"]:
    """Whether views differ in exposure; fixed where too little is seen to tell.

    Args:
        positions: Of places on surfaces.
        seen: Logarithm of the brightness of each place in each view, NaN where a view does not see it; two are enough.
    """
    return "per-view" if _gain_spread(cameras, positions, seen) > _LEAST_GAIN_SPREAD else "fixed"


def _follows_camera(cameras: Cameras, places: Places, seen: Seen) -> bool:
    """Whether each half of the views predicts the changes of brightness in the other by how surfaces face the camera,
    and reflections of a fixed light explain no more of them; False if too little is seen."""
    if len(places.positions) == 0:
        return False
    rotations = cameras.camera_to_world[:, :, :3]
    x, y, z = torch.einsum("pi,nij->pnj", places.normals, rotations).unbind(-1)
    turned = torch.stack([x, y, x * z, y * z, x * y], dim=-1)  # polynomials that change sign with x or y
    positions = cameras.camera_to_world[:, :, 3]
    centred = positions - positions.mean(dim=0)
    # The views are cut into two halves, twice (one view: once): along the two axes in which positions vary most.
    along = centred @ torch.linalg.svd(centred, full_matrices=False).Vh[:2].T
    if _least_share(seen, turned, (along > along.median(dim=0).values).T) <= _MOVING_SHARE:
        return False
    towards = torch.nn.functional.normalize(positions - places.positions[:, None], dim=-1)
    facing = (towards * places.normals[:, None]).sum(dim=-1, keepdim=True)
    mirrored = _up_to_second_degree(2 * facing * places.normals[:, None] - towards)
    return _explained_share(seen, turned) > _explained_share(seen, mirrored)


def _gain_spread(cameras: Cameras, positions: Float[Tensor, "P 3"], seen: Seen) -> float:
    """Standard deviation of the views' log gains, as far as two halves of the places agree on them.

    The least of the ways to halve the places along an axis so that enough views see both; 0 if there is none. Gains
    that are a smooth function of the camera's direction don't count: where brightness changes across a surface, a hull
    that is a little too large looks as if they were there. Arguments as of `judge_exposure`.
    """
    if len(seen) < _FEWEST_PLACES:
        return 0.0
    directions = torch.nn.functional.normalize(
        cameras.camera_to_world[:, :, 3] - positions.mean(dim=0), dim=-1
    )
    smooth = torch.cat([torch.ones_like(directions[:, :1]), _up_to_second_degree(directions)], dim=-1)
    shared = []
    for half in (positions > positions.median(dim=0).values).T:
        one, other = view_gains(seen[half]), view_gains(seen[~half])
        both = one.isfinite() & other.isfinite()
        freedom = int(both.sum()) - smooth.shape[1]
        if freedom < _FEWEST_VIEWS:  # halves of a flight are seen by different views
            continue
        gains = torch.stack([one[both], other[both]], dim=1)
        rest = gains - smooth[both] @ torch.linalg.lstsq(smooth[both], gains, driver="gelsd").solution
        shared.append(float(rest.prod(dim=1).sum()) / freedom)
    return max(min(shared, default=0.0), 0.0) ** 0.5


def view_gains(seen: Seen) -> Float[Tensor, " N"]:
    """Logarithms of the views' gains, of mean 0, by which places look most alike; NaN where a view sees none.

    Least absolute differences of what a place looks like, gains taken off, from its mean over views; by repeated least
    squares, in which the places' means are eliminated.
    """
    known = seen.isfinite()
    values, weights = torch.where(known, seen, 0.0).double(), known.double()
    gains = values.new_zeros(seen.shape[1])
    for _ in range(_NUM_FITS):
        shares = weights / weights.sum(dim=1, keepdim=True).clamp(min=1e-12)
        means = (shares * values).sum(dim=1, keepdim=True)
        system = torch.diag(weights.sum(dim=0)) - weights.T @ shares
        gains = torch.linalg.pinv(system, hermitian=True) @ (weights * (values - means)).sum(dim=0)
        lit = values - gains
        errors = (lit - (shares * lit).sum(dim=1, keepdim=True)).abs()
        weights = known / errors.clamp(min=_SMALLEST_ERROR)
    return torch.where(known.any(dim=0), gains, torch.nan).float()


def _up_to_second_degree(directions: Float[Tensor, "*D 3"]) -> Float[Tensor, "*D 8"]:
    """Polynomials of first and second degree on the sphere."""
    x, y, z = directions.unbind(-1)
    return torch.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, z * z], dim=-1)


def _explained_share(values: Seen, functions: Float[Tensor, "P N F"]) -> float:
    """Share of the variance within places that a fit to all views explains."""
    x, y = _changes(values, functions)
    fit = torch.linalg.lstsq(x, y[:, None]).solution[:, 0]
    return 1.0 - float((y - x @ fit).square().sum() / y.square().sum())


def _least_share(values: Seen, functions: Float[Tensor, "P N F"], halves: Bool[Tensor, "D N"]) -> float:
    """Least share of the variance within places, seen by a half of the views, that a fit to the other predicts."""
    shares: list[float] = []
    for half in halves:
        parts = [_changes(values[:, chosen], functions[:, chosen]) for chosen in (half, ~half)]
        if min(len(y) for _, y in parts) < _FEWEST_PLACES * _FEWEST_VIEWS:
            return 0.0
        for (x, y), (others, known) in (parts, parts[::-1]):
            fit = torch.linalg.lstsq(x, y[:, None]).solution[:, 0]
            total = float(known.square().sum())
            residual = float((known - others @ fit).square().sum())
            shares.append(1.0 - residual / total if total > 0 else 0.0)

    return min(shares)


def _changes(
    values: Seen, functions: Float[Tensor, "P N F"]
) -> tuple[Float[Tensor, "V F"], Float[Tensor, " V"]]:
    """Functions and values without their means over the views of each place, of places that enough views see."""
    known = values.isfinite()
    enough = known.sum(dim=1) >= _FEWEST_VIEWS
    known, values, functions = known[enough], values[enough].double(), functions[enough].double()
    counts = known.sum(dim=1, keepdim=True)
    values = torch.where(known, values, 0.0)
    functions = torch.where(known[..., None], functions, 0.0)
    values = values - values.sum(dim=1, keepdim=True) / counts
    functions = functions - functions.sum(dim=1, keepdim=True) / counts[..., None]
    return functions[known], values[known]
