"""Does the world go on behind the scene box? Asked of what the training views agree on.

Points along the rays of some pixels are projected into neighbouring views, as for the check of poses. Where views agree
on a place behind the box clearly better than on any in it, something is there; where they agree on no place at
all, they see more than the box holds, too far away or too little overlapping to say where.

Notation: `N` views, `P` pixels of one view, `D` points along a ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.scenes.geometry.pose_check import (
    LONGEST_SIDE_PX,
    NUM_AGREEING,
    ReadView,
    Thinning,
    choose_neighbours,
    local_change,
    thinned_lenses,
    view_differences,
    view_features,
)

TILES = 12
"""Along each side of a view: a pixel of each part is asked, since what is far away may be a small part of a view."""
NUM_DEPTHS = 160
DEPTHS = (0.1, 60.0)
"""Nearest and farthest point along a ray, in half edges of the box."""
BOX_MARGIN = 1.15
"""The box is widened by this for what still counts as in it: agreement has the width of a pixel's patch."""
CLEARLY = 0.7
"""Disagreement behind the box over that in it, below which a pixel counts as evidence of a world there; and the
reverse."""
MOST_DISAGREEMENT = 0.3
"""Of a pixel that is explained, against that of unrelated pixels."""
MOST_BEHIND = 0.15
"""Of the pixels that speak for one or the other, those that may show something behind a closed box."""
LEAST_EXPLAINED = 0.6
"""Of all pixels, those that the inside of a closed box explains: 0.84 in a room, 0.26 in the open."""


@dataclass(frozen=True)
class WorldEvidence:
    """What pixels of the training views say."""

    num_pixels: int
    """Asked; 0 where too few views or too little texture leave nothing to ask."""
    num_inside: int
    """Clearly better explained by the inside of the box."""
    num_behind: int
    """Clearly better explained by places behind it."""
    num_explained: int
    """On which views agree somewhere in the box."""

    @property
    def goes_on(self) -> bool:
        """Whether the views show more than a closed box would."""
        shows_more = self.num_behind > MOST_BEHIND * (self.num_behind + self.num_inside)
        return shows_more or self.num_explained < LEAST_EXPLAINED * self.num_pixels


def find_world_evidence(box: SceneBox, cameras: Cameras, read_view: ReadView) -> WorldEvidence:
    """Ask where the views agree.

    Args:
        box: In the cameras' space.
        cameras: Of the training views.
        read_view: Reads a part of a view.
    """
    poses = cameras.camera_to_world.double().numpy()
    if len(poses) < NUM_AGREEING + 1:
        return WorldEvidence(0, 0, 0, 0)
    neighbours = choose_neighbours(poses)
    generator = torch.Generator().manual_seed(0)
    used = sorted({*neighbours, *(other for others in neighbours.values() for other in others)})
    thinning = Thinning.to(LONGEST_SIDE_PX, cameras, read_view, most_pooled=1)
    views = [thinning.read(read_view, view) for view in used]
    features = dict(zip(used, view_features(views, generator), strict=True))
    pixels = {view: _spread_pixels(features[view]) for view in neighbours}
    drawn = torch.cat([features[view].flatten(0, 1)[pixels[view]] for view in neighbours])
    chance = float((drawn - drawn[torch.randperm(len(drawn), generator=generator)]).norm(dim=-1).median())
    if chance <= 0.0:  # nothing in the views changes
        return WorldEvidence(0, 0, 0, 0)
    own = thinned_lenses(cameras, features[used[0]], thinning.stride)
    found = [
        _least_disagreements(box, own, features, pixels[view], view, others)
        for view, others in neighbours.items()
    ]
    behind, inside = torch.cat(found, dim=1) / chance
    is_clear = torch.minimum(behind, inside) < MOST_DISAGREEMENT
    return WorldEvidence(
        len(inside),
        int((is_clear & (inside < CLEARLY * behind)).sum()),
        int((is_clear & (behind < CLEARLY * inside)).sum()),
        int((inside < MOST_DISAGREEMENT).sum()),
    )


def _spread_pixels(image: Float[Tensor, "H W F"]) -> Tensor:
    """Of each of `TILES` x `TILES` parts of an image the pixel where it changes most; row-major numbers (P,).

    An image of fewer pixels along an edge has as many parts there as pixels.
    """
    change = local_change(image)
    down, across = (min(TILES, side) for side in change.shape)
    height, width = change.shape[0] // down, change.shape[1] // across
    tiles = change[: down * height, : across * width].reshape(down, height, across, width)
    best = tiles.permute(0, 2, 1, 3).flatten(2).argmax(dim=-1)
    rows = torch.arange(down)[:, None] * height + best // width
    columns = torch.arange(across)[None, :] * width + best % width
    return (rows * change.shape[1] + columns).flatten()


def _least_disagreements(
    box: SceneBox,
    cameras: Cameras,
    features: dict[int, Float[Tensor, "H W F"]],
    chosen: Tensor,
    view: int,
    others: list[int],
) -> Float[Tensor, "2 P"]:
    """Behind the box and in it, along the rays of some pixels of one view; inf where too few views see a place."""
    coords = torch.stack([chosen % cameras.width, chosen // cameras.width], dim=-1).float() + 0.5
    rays = cameras.generate_rays(torch.full((len(chosen),), view), coords)
    nearest, farthest = DEPTHS
    depths = float(box.size.max()) / 2 / torch.linspace(1 / nearest, 1 / farthest, NUM_DEPTHS)
    points = (rays.origins[:, None] + rays.directions[:, None] * depths[:, None]).flatten(0, 1)
    own = features[view].flatten(0, 1)[chosen]
    seen = [view_differences(points, own, features[other], cameras, other) for other in others]
    ranked = torch.stack(seen, dim=-1).sort(dim=-1).values[..., :NUM_AGREEING].mean(dim=-1)
    is_behind, is_inside = _sides(box, rays, depths)
    return torch.stack(
        [ranked.masked_fill(~side, torch.inf).min(dim=1).values for side in (is_behind, is_inside)]
    )


def _sides(box: SceneBox, rays: RayBundle, depths: Float[Tensor, " D"]) -> tuple[Tensor, Tensor]:
    """Which points along rays are behind the box or beside it, and which are in it; bool (P, D)."""
    middle, half = box.aabb.mean(dim=0), BOX_MARGIN * box.size / 2
    wide = SceneBox(torch.stack([middle - half, middle + half]))
    t_near, t_far = (t[:, None] for t in wide.intersect(rays.origins, rays.directions))
    misses = t_far <= t_near
    return misses | (depths > t_far), ~misses & (depths >= t_near) & (depths <= t_far)
