"""Where surfaces are in an unbounded world, as far as training views agree on it before any training: a plane sweep.

Points along the rays of a coarse grid of pixels are projected into neighbouring views. A pixel's distance is where
these agree best with it. It is known only where they agree well, and nowhere else nearly as well: on plain surfaces,
in mirrors and in what one view alone shows it stays unknown. A view looks through a cell of contracted space if the
cell lies clearly before all known distances of the pixels around it. Known distances may be wrong in places, so three
views must look through a cell that is empty, and few may see their surface in it.

Notation: `N` views, `h x w` pixels of a view that are asked, `P` = h w or cells, `D` distances along a ray, `F`
features, `C` cells along an edge, `R` drawn pixels.

Source: Collins 1996, A Space-Sweep Approach to True Multi-Image Matching.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox, UnitSpace
from unmix_plugin.scenes.geometry.carving import Cells, refined, unit_centres
from unmix_plugin.scenes.geometry.view_agreement import training_views
from unmix_plugin.scenes.geometry.views import (
    NUM_AGREEING,
    Differences,
    ThinnedViews,
    Views,
    best_agreement,
    choose_neighbours,
    look_up,
    view_differences,
    view_features,
)
from unmix_plugin.scenes.pixel_block import DrawnPixels
from unmix_plugin.scenes.scene import Scene

_MOST_VIEWS = 64
"""Of a scene with more, so many are swept."""
_NUM_NEIGHBOURS = 5
_PIXEL_STRIDE = 2
"""Of the thinned-out view, pixels from one that is asked to the next."""
_STEP = 1 / 32
"""Distance of the planes within the box, in half edges of the box; outside they lie farther apart, as samples do."""
_FARTHEST = 64.0
"""The last plane, in half edges of the box from its middle."""
_MOST_DISAGREEMENT = 0.3
"""Of a pixel whose distance is known, against that of unrelated pixels."""
_CLEARLY = 0.7
"""Most disagreement there, over the least at planes that are not beside it."""
_BESIDE = 3
"""Planes that count as beside one."""
_LEAST_KNOWN = 0.35
"""Of all pixels. Where fewer are known views may differ in exposure, and brightness is taken over that around it."""
_SURROUNDINGS = 21
"""Edge of what is around a pixel, in pixels of the thinned-out view."""
_CHANCE_PIXELS = 4000
_WITNESSES = 3
"""Views that must look through a cell."""
_MOST_CONTRADICTION = 0.15
"""Views that may see a surface in it, over those that look through it."""
_MARGIN = 1.5
"""Between a cell's centre and a surface behind it, in edges of the cell."""
_CELLS = 64
"""Along an edge of the grid in which empty space is sought; finer grids repeat it."""


@dataclass(frozen=True)
class SweptDepths:
    """Distances of some pixels of some views."""

    views: tuple[int, ...]
    """Which of the given cameras were swept."""
    distances: Float[Tensor, "N h w"]
    """Along the rays, model units; inf where unknown."""
    stride: int
    """Pixels of the whole view from one that is asked to the next; the first stands at `stride` / 2."""


def sweep_depths(views: Views, box: SceneBox) -> SweptDepths | None:
    """Distances of the pixels of all views, or of `_MOST_VIEWS`, in a box of their cameras' space; None if views are
    too few, too small or too plain. All have one size and one pose each. Pixels that don't count stay unknown."""
    cameras, count = views.cameras, min(len(views.cameras), _MOST_VIEWS)
    chosen = np.linspace(0, len(cameras) - 1, count).round().astype(int).tolist()
    if count < NUM_AGREEING + 1:
        return None
    thinned = ThinnedViews(views)
    if min(cameras.width, cameras.height) // thinned.stride < _PIXEL_STRIDE:
        return None
    images = [thinned.read(view) for view in chosen]
    lenses = thinned.cameras(images[0])[chosen]
    found = _sweep_all(images, lenses, box)
    if found is None:
        return None
    if torch.isfinite(found).float().mean() < _LEAST_KNOWN:
        relative = _sweep_all([_over_surroundings(image) for image in images], lenses, box)
        found = found if relative is None else torch.where(torch.isfinite(found), found, relative)
    every = slice(_PIXEL_STRIDE // 2, None, _PIXEL_STRIDE)
    for view, distances in zip(chosen, found, strict=True):
        share = thinned.valid_share(view)
        if share is not None:
            distances.masked_fill_(share[every, every] < 1, torch.inf)
    return SweptDepths(tuple(chosen), found, thinned.stride * _PIXEL_STRIDE)


def _over_surroundings(image: Float[Tensor, "H W B"]) -> Float[Tensor, "H W B"]:
    """Spectra over the mean brightness around them: the same whatever the exposure."""
    brightness = image.mean(dim=-1)[None]
    width = _SURROUNDINGS
    around = torch.nn.functional.avg_pool2d(brightness, width, 1, width // 2, count_include_pad=False)[0]
    return image / (around + 0.02 * float(brightness.mean()) + 1e-9)[..., None]


def _sweep_all(
    images: list[Float[Tensor, "H W B"]], cameras: Cameras, box: SceneBox
) -> Float[Tensor, "N h w"] | None:
    """Distances in all views, inf where unknown; None if the views are plain."""
    generator = torch.Generator().manual_seed(0)
    features = view_features(images, generator)
    pixels = torch.cat([image.flatten(0, 1) for image in features])
    drawn = pixels[torch.randperm(len(pixels), generator=generator)[:_CHANCE_PIXELS]]
    chance = float((drawn - drawn.roll(1, 0)).norm(dim=-1).median())
    if chance <= 0.0:
        return None
    poses = cameras.camera_to_world.double().numpy()
    neighbours = choose_neighbours(poses, len(images), _NUM_NEIGHBOURS)
    swept = [_sweep(view, neighbours[view], cameras, box, features, chance) for view in range(len(images))]
    return torch.stack(swept)


def _sweep(
    view: int,
    others: list[int],
    cameras: Cameras,
    box: SceneBox,
    features: list[Float[Tensor, "H W F"]],
    chance: float,
) -> Float[Tensor, "h w"]:
    """Distances of one view's pixels, inf where unknown."""
    first = _PIXEL_STRIDE // 2
    own = features[view][first::_PIXEL_STRIDE, first::_PIXEL_STRIDE]
    rows, columns = (torch.arange(side) * _PIXEL_STRIDE + first + 0.5 for side in own.shape[:2])
    coords = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1).flatten(0, 1)
    rays = cameras.generate_rays(torch.full((len(coords),), view), coords)
    pose = cameras.camera_to_world[view]
    along = rays.directions @ -pose[:, 2]
    distances = _planes(box, pose[:, 3], -pose[:, 2]) / along[:, None]
    seen = [
        _patch_means(
            view_differences(rays, distances, own.flatten(0, 1), features[other], cameras, other), own
        )
        for other in others
    ]
    costs = best_agreement(seen) / chance
    least, plane = costs.min(dim=1)
    is_beside = (torch.arange(costs.shape[1]) - plane[:, None]).abs() <= _BESIDE
    next_best = costs.masked_fill(is_beside, torch.inf).min(dim=1).values
    is_known = (least < _MOST_DISAGREEMENT) & (least < _CLEARLY * next_best)
    found = distances.gather(1, plane[:, None])[:, 0]
    return found.masked_fill(~is_known, torch.inf).view(own.shape[:2])


def _planes(box: SceneBox, origin: Float[Tensor, "3"], axis: Float[Tensor, "3"]) -> Float[Tensor, " D"]:
    """Depths along an optical axis, as far apart as samples in contracted space."""
    half, middle, found, depth = float(box.size.max()) / 2, box.aabb.mean(dim=0), [], 0.0
    while (radius := float((origin + depth * axis - middle).abs().max()) / half) <= _FARTHEST:
        near = max(radius, 1.0)
        length = _STEP * half * near * max(near / 2, 1.0)
        found.append(depth + length / 2)
        depth += length
    return torch.tensor(found)


def _patch_means(differences: Differences, own: Float[Tensor, "H W F"]) -> Differences:
    """Means over 3 x 3 pixels on the same plane; inf where most of them are not seen."""
    height, width = own.shape[:2]
    is_seen = torch.isfinite(differences)
    images = torch.stack([differences.masked_fill(~is_seen, 0.0), is_seen.float()]).transpose(1, 2)
    total, share = torch.nn.functional.avg_pool2d(images.unflatten(2, (height, width)), 3, 1, 1)
    means = torch.where(share > 0.5, total / share.clamp(min=0.1), torch.inf)
    return means.flatten(1).T


def seen_through(depths: SweptDepths, cameras: Cameras, box: SceneBox, cells: int) -> Bool[Tensor, "C C C"]:
    """Cells of the world contracted around a box that are empty, so many along each edge, by depths of views of
    `cameras`."""
    space = UnitSpace(box, is_unbounded=True)
    points = space.from_unit(unit_centres(cells))
    radii = space.centred(points).abs().amax(dim=-1).clamp(min=1.0)
    margins = _MARGIN * 4.0 / cells * float(space.half_edge) * radii.square()
    through, surfaces = torch.zeros(2, len(points))
    for view, distances in zip(depths.views, depths.distances, strict=True):
        # Of the pixel that a point falls on: its distance, and the least of those around it.
        pixels, _, is_seen = look_up(cameras, view, points)
        least = -torch.nn.functional.max_pool2d(-distances[None], 3, stride=1, padding=1)[0]
        columns, rows = (pixels / depths.stride).nan_to_num(0.0).clamp(0.0, 1e6).long().unbind(-1)
        rows, columns = rows.clamp(max=len(distances) - 1), columns.clamp(max=distances.shape[1] - 1)
        own, nearest = distances[rows, columns].masked_fill(~is_seen, torch.inf), least[rows, columns]
        away = (points - cameras.camera_to_world[view, :, 3]).norm(dim=-1)
        through += torch.isfinite(own) & (away + margins < nearest)
        surfaces += (away - own).abs() <= margins
    is_empty = (through >= _WITNESSES) & (surfaces <= _MOST_CONTRADICTION * through)
    return is_empty.view(cells, cells, cells)


def sweep_scene(scene: Scene) -> SweptDepths | None:
    """As `sweep_depths` of the training views; of rigs and line cameras, and of bounded scenes, nothing is known."""
    views = training_views(scene)
    is_compared = scene.is_unbounded and not scene.is_rig and views.cameras.key_poses is None
    return sweep_depths(views, scene.scene_box) if is_compared else None


class SurfaceEvidence:
    """Distances of pixels that views agree on, and the space that they show to be empty."""

    def __init__(self, scene: Scene, depths: SweptDepths | None, device: torch.device) -> None:
        """
        Args:
            depths: Of the scene, by `sweep_scene`.
            device: Of the pixels that will be asked for.
        """
        self._cameras, self._box = training_views(scene).cameras, scene.scene_box
        self._depths = depths
        if self._depths is not None:
            swept = torch.full((len(self._cameras),), -1)
            swept[list(self._depths.views)] = torch.arange(len(self._depths.views))
            self._placed = self._cameras.to(device), swept.to(device), self._depths.distances.to(device)

    def carved(self, reachable: Cells) -> Cells:
        """Cells that may be occupied, without those that views look through."""
        if self._depths is None:
            return reachable
        cells = min(len(reachable), _CELLS)
        empty = seen_through(self._depths, self._cameras, self._box, cells)
        return reachable & ~refined(empty, len(reachable)).numpy()

    def points(self, pixels: DrawnPixels) -> Float[Tensor, "R 3"] | None:
        """Places that drawn pixels show, model space, NaN where unknown; None where views could not be compared."""
        if self._depths is None:
            return None
        cameras, swept, distances = self._placed
        rays = cameras.generate_rays(pixels.cameras, pixels.corners + 0.5)
        columns, rows = (pixels.corners // self._depths.stride).unbind(-1)
        rows, columns = rows.clamp(max=distances.shape[1] - 1), columns.clamp(max=distances.shape[2] - 1)
        view = swept[pixels.cameras]
        found = distances[view, rows, columns].masked_fill(view < 0, torch.inf)
        known = torch.where(torch.isfinite(found), found, torch.nan)
        return rays.at(known)
