"""What the training views agree on, before any training: do the poses mean what we take them for, and does the world go
on behind the scene box?

Along the rays of some pixels the best agreement with neighbouring views is sought, against that of unrelated pixels.
With the right poses it is close, with wrong ones rarely better than by chance: what poses in OpenCV axes or from world
to camera really mean is the convention under which views agree. Where views agree on a place behind the box clearly
better than on any in it, something is there; where they agree on no place at all, they see more than the box holds, too
far away or too little overlapping to say where.

Notation: as in `views`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from unmix_plugin.engine.decisions import UNDECIDED, Decision
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.scenes.geometry.views import (
    NUM_AGREEING,
    Differences,
    Image,
    ThinnedViews,
    Views,
    best_agreement,
    choose_neighbours,
    commonest,
    view_differences,
    view_features,
)
from unmix_plugin.scenes.scene import Scene

_NUM_REFERENCES, _NUM_NEIGHBOURS = 8, 4
"""Views whose pixels are looked for, and others that each is looked for in."""
_NUM_PIXELS, _NUM_POINTS = 150, 192
_BUSIEST_SHARE = 0.3
"""Share of a view's pixels, those where it changes most, that are drawn from."""
_DEPTHS = (0.4, 60.0)
"""Nearest and farthest point along a ray, in median distances between neighbouring cameras."""
MOST_DISAGREEMENT = 0.35
"""Of the right convention, against that of unrelated pixels: 0.06 to 0.24 on scenes with 5 to 36 views."""
LEAST_RATIO = 1.5
"""Of the given convention's disagreement to the right one's: a wrong one has 1.7 and more."""

_TILES = 12
"""Along each side of a view: a pixel of each part is asked, since what is far away may be a small part of a view."""
_NUM_DEPTHS = 160
_WORLD_DEPTHS = (0.1, 60.0)
"""Nearest and farthest point along a ray, in half edges of the box."""
_BOX_MARGIN = 1.15
"""The box is widened by this for what still counts as in it: agreement has the width of a pixel's patch."""
_CLEARLY = 0.7
"""Disagreement behind the box over that in it, below which a pixel counts as evidence of a world there; and the
reverse."""
_MOST_UNEXPLAINED = 0.3
"""Of a pixel that is explained, against that of unrelated pixels."""
_MOST_BEHIND = 0.05
"""Of the pixels that speak for one or the other, those that may show something behind a closed box: 0.02 where it holds
all walls, 0.09 to 0.14 where some that few views see lie beyond it."""
_MOST_OUTSIDE = 0.15
"""Of the places matched between views, those that may lie outside a closed box, as wrong matches do."""
_LEAST_EXPLAINED = 0.6
"""Of all pixels, those that the inside of a closed box explains: 0.84 in a room, 0.26 in the open."""

GIVEN = "camera to world, OpenGL axes"
_FLIP = np.diag([1.0, -1.0, -1.0])
CONVENTIONS = {
    "camera to world, OpenCV axes": (False, True, "multiply each from the right by diag(1, -1, -1, 1)"),
    "world to camera, OpenGL axes": (True, False, "invert each"),
    "world to camera, OpenCV axes (as COLMAP writes them)": (
        True,
        True,
        "invert each, then multiply it from the right by diag(1, -1, -1, 1)",
    ),
}
"""What a matrix may be other than `GIVEN`: whether inverted, whether with flipped axes, and what to do with it."""
_Poses = Float64[np.ndarray, "N 3 4"]


def training_views(scene: Scene, with_lines: bool = True) -> Views:
    """Those of the sensor that took most, if asked for without those of line cameras."""
    sensors = [scene.frames[view].sensor for view in scene.train_indices]
    chosen = [scene.train_indices[row] for row in commonest(sensors)]
    chosen = [view for view in chosen if with_lines or not scene.cameras.is_line_camera(view)]
    return Views(
        scene.cameras[chosen],
        lambda row, part: scene.cube(chosen[row], part),
        lambda row: scene.valid_mask(chosen[row]),
    )


def compare_scene_conventions(scene: Scene) -> dict[str, float]:
    """How little the training views agree under each convention of poses; see `compare_conventions`."""
    views = training_views(scene, with_lines=False)  # of which no single pose tells what they saw
    poses = views.cameras.camera_to_world.double().numpy()
    placement = scene.placement  # conventions are those of the matrices in transforms.json
    rotations = placement.rotation @ scene.normalisation.rotation.T @ poses[:, :, :3]
    positions = placement.to_scene(scene.normalisation.to_world(poses[:, :, 3]))
    return compare_conventions(np.concatenate([rotations, positions[:, :, None]], axis=-1), views)


def convention_decision(disagreements: dict[str, float]) -> Decision:
    """What the matrices are taken for, against what they could be; undecided where views share too little to tell."""
    best = min(disagreements, key=lambda name: disagreements[name], default=GIVEN)
    is_clear = bool(disagreements) and disagreements[best] <= MOST_DISAGREEMENT
    fits = disagreements.get(GIVEN, 0.0) < LEAST_RATIO * disagreements.get(best, 0.0)
    return Decision(
        "poses",
        UNDECIDED if not is_clear else "fit" if fits or best == GIVEN else f"look like {best}",
        {f"views differ as {name}": value for name, value in disagreements.items() if np.isfinite(value)},
        f"the views differ {LEAST_RATIO:g} times less under another convention, and clearly",
    )


def compare_conventions(poses: _Poses, views: Views) -> dict[str, float]:
    """How little the views agree under each convention, against unrelated pixels (1); inf where they share nothing.

    Of line cameras nothing is said. Poses are those given, not the cameras'.
    """
    found = None if views.cameras.key_poses is not None else _compare(poses, views, _busy_pixels)
    if found is None:
        return {}
    nearest, farthest = _DEPTHS
    disagreements = {}
    for name, meant in _meanings(poses).items():
        meant = meant.copy()  # brought to coordinates of order 1
        meant[:, :, 3] -= meant[:, :, 3].mean(axis=0)
        meant[:, :, 3] /= max(float(np.linalg.norm(meant[:, :, 3], axis=-1).max()), 1e-30)
        cameras = replace(found.cameras, camera_to_world=torch.from_numpy(meant).float())
        positions = cameras.camera_to_world[:, :, 3]
        pairs = [(view, other) for view, others in found.neighbours.items() for other in others]
        gap = float(np.median([float((positions[view] - positions[other]).norm()) for view, other in pairs]))
        depths = gap / torch.linspace(1.0 / nearest, 1.0 / farthest, _NUM_POINTS)
        least = [found.disagreements(view, depths, cameras).min(dim=-1).values for view in found.neighbours]
        disagreements[name] = float(torch.cat(least).median()) / found.chance if gap > 0.0 else float("inf")
    return disagreements


@dataclass(frozen=True)
class _Comparison:
    """Pixels of some views and what these and their neighbours show, in few pixels."""

    neighbours: dict[int, list[int]]
    features: dict[int, Image]
    pixels: dict[int, Int[Tensor, " P"]]
    """Row-major numbers."""
    cameras: Cameras
    """Of all views, with lenses of so few pixels."""
    chance: float
    """Difference of unrelated pixels."""

    def rays(self, view: int, cameras: Cameras) -> RayBundle:
        """Through a view's pixels."""
        pixels = self.pixels[view]
        coords = torch.stack([pixels % cameras.width, pixels // cameras.width], dim=-1).float() + 0.5
        return cameras.generate_rays(torch.full((len(pixels),), view), coords)

    def disagreements(self, view: int, depths: Float[Tensor, " D"], cameras: Cameras) -> Differences:
        """Of a view's pixels with its neighbours, along rays."""
        rays, own = self.rays(view, cameras), self.features[view].flatten(0, 1)[self.pixels[view]]
        others = [
            view_differences(rays, depths, own, self.features[other], cameras, other)
            for other in self.neighbours[view]
        ]
        return best_agreement(others)


def _compare(
    poses: _Poses, views: Views, choose: Callable[[Image, torch.Generator], Int[Tensor, " P"]]
) -> _Comparison | None:
    """None if there are too few views, or nothing in them changes."""
    if len(poses) < NUM_AGREEING + 1:
        return None
    neighbours = choose_neighbours(poses, _NUM_REFERENCES, _NUM_NEIGHBOURS)
    generator = torch.Generator().manual_seed(0)
    used = sorted({*neighbours, *(other for others in neighbours.values() for other in others)})
    thinned = ThinnedViews(views, most_pooled=1)
    read = []
    for view in used:
        image, share = thinned.read(view), thinned.valid_share(view)
        read.append(image if share is None else image.masked_fill((share < 1)[..., None], torch.nan))
    if not any(bool(image.isfinite().any()) for image in read):
        return None
    images = view_features(read, generator)
    features = dict(zip(used, images, strict=True))
    pixels = {view: choose(features[view], generator) for view in neighbours}
    shown = {view: features[view].flatten(0, 1)[chosen] for view, chosen in pixels.items()}
    pixels = {view: pixels[view][own.isfinite().all(dim=-1)] for view, own in shown.items()}
    drawn = torch.cat([features[view].flatten(0, 1)[pixels[view]] for view in neighbours])
    chance = float((drawn - drawn[torch.randperm(len(drawn), generator=generator)]).norm(dim=-1).median())
    if not chance > 0.0:  # NaN where no pixel counts
        return None
    return _Comparison(neighbours, features, pixels, thinned.cameras(images[0]), chance)


def _meanings(poses: _Poses) -> dict[str, _Poses]:
    """What the given matrices are as camera to world with OpenGL axes, under each convention."""
    rotations, positions = poses[:, :, :3], poses[:, :, 3:]
    inverse = rotations.transpose(0, 2, 1)
    found = {GIVEN: poses}
    for name, (is_inverted, is_flipped, _) in CONVENTIONS.items():
        axes, places = (inverse, -(inverse @ positions)) if is_inverted else (rotations, positions)
        found[name] = np.concatenate([axes @ _FLIP if is_flipped else axes, places], axis=-1)
    return found


def _busy_pixels(image: Image, generator: torch.Generator) -> Int[Tensor, " P"]:
    """Random pixels among those where the image changes most, row-major numbers."""
    change = _local_change(image)
    order = change.flatten().argsort(descending=True)
    busy = order[: max(_NUM_PIXELS, int(_BUSIEST_SHARE * int((change > 0).sum())))]
    return busy[torch.randperm(len(busy), generator=generator)[:_NUM_PIXELS]]


def _local_change(image: Image) -> Float[Tensor, "h w"]:
    """How much an image changes around each pixel, along its rows and columns; 0 on its border and beside gaps."""
    change = torch.zeros(image.shape[:2])
    across = (image[1:-1, 2:] - image[1:-1, :-2]).norm(dim=-1)
    change[1:-1, 1:-1] = across + (image[2:, 1:-1] - image[:-2, 1:-1]).norm(dim=-1)
    return change.nan_to_num(0.0)


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
    num_places: int = 0
    """Matched between views, where those were looked for."""
    num_outside: int = 0
    """Of these, outside the box."""
    has_plain_sides: bool = False
    """Whether plain surfaces that are no backdrop reach the borders of the views."""

    def with_places(self, box: SceneBox, places: Float[Tensor, "P 3"]) -> WorldEvidence:
        """With what places say that features matched between views stand at."""
        outside = ((places - box.aabb.mean(dim=0)).abs() > _BOX_MARGIN * box.size / 2).any(dim=-1)
        return replace(self, num_places=len(places), num_outside=int(outside.sum()))

    @property
    def goes_on(self) -> bool:
        """Whether the views show more than a closed box would."""
        return any(tells for tells, _ in self._reasons)

    def in_words(self) -> str:
        """Which it is and why, and how to say otherwise."""
        if self.goes_on:
            why = next(text for tells, text in self._reasons if tells)
            return f"the world is taken to go on behind the scene box: {why} (--world bounded if not)"
        known = ", ".join(text for _, text in self._reasons)
        return f"the scene is taken to end with its box: {known} (--world unbounded if not)"

    @property
    def decision(self) -> Decision:
        """The same with its numbers."""
        return Decision(
            "world",
            UNDECIDED if not self.num_pixels else "unbounded" if self.goes_on else "bounded",
            {
                "pixels that show places behind the box": self.num_behind,
                "pixels that show places in it": self.num_inside,
                "pixels asked": self.num_pixels,
                "explained by its inside": self.num_explained,
                "matched places": self.num_places,
                "matched places outside": self.num_outside,
            },
            f"more than {_MOST_BEHIND:.0%} of pixels or {_MOST_OUTSIDE:.0%} of matched places behind the box, or its "
            f"inside explains less than {_LEAST_EXPLAINED:.0%}",
            "--world",
        )

    @property
    def _reasons(self) -> list[tuple[bool, str]]:
        """What was asked, whether it tells of a world behind the box, and the answer in words."""
        telling = self.num_behind + self.num_inside
        behind = f"{self.num_behind} of {telling} pixels that tell show places behind it"
        explained = f"its inside explains {self.num_explained} of {self.num_pixels} pixels"
        outside = f"{self.num_outside} of {self.num_places} places matched between views lie outside it"
        plain = "plain surfaces reach the borders of the views, and pixels of such tell little of how far away they are"
        reasons = [
            (self.num_behind > _MOST_BEHIND * telling, behind),
            (self.num_explained < _LEAST_EXPLAINED * self.num_pixels, explained),
            (self.num_outside > _MOST_OUTSIDE * self.num_places, outside),
        ]
        known = reasons if self.num_places else reasons[:2]
        # Unbounded training of a room that the box holds costs little; bounded, other walls are cut off (6 to 13 dB).
        return [*known, (True, plain)] if self.has_plain_sides else known


def find_world_evidence(box: SceneBox, views: Views) -> WorldEvidence:
    """Ask where training views agree; the box is in their cameras' space."""
    found = _compare(views.cameras.camera_to_world.double().numpy(), views, _spread_pixels)
    if found is None:
        return WorldEvidence(0, 0, 0, 0)
    nearest, farthest = _WORLD_DEPTHS
    depths = float(box.size.max()) / 2 / torch.linspace(1 / nearest, 1 / farthest, _NUM_DEPTHS)
    half = _BOX_MARGIN * box.size / 2
    wide = SceneBox(torch.stack([box.aabb.mean(dim=0) - half, box.aabb.mean(dim=0) + half]))
    sides = []
    for view in found.neighbours:
        costs, rays = found.disagreements(view, depths, found.cameras), found.rays(view, found.cameras)
        t_near, t_far = (t[:, None] for t in wide.intersect(rays.origins, rays.directions))
        is_behind = (t_far <= t_near) | (depths > t_far)  # or beside it
        is_inside = (t_far > t_near) & (depths >= t_near) & (depths <= t_far)
        sides.append(
            [costs.masked_fill(~side, torch.inf).min(dim=1).values for side in (is_behind, is_inside)]
        )
    behind, inside = (torch.cat(parts) / found.chance for parts in zip(*sides, strict=True))
    is_clear = torch.minimum(behind, inside) < _MOST_UNEXPLAINED
    return WorldEvidence(
        len(inside),
        int((is_clear & (inside < _CLEARLY * behind)).sum()),
        int((is_clear & (behind < _CLEARLY * inside)).sum()),
        int((inside < _MOST_UNEXPLAINED).sum()),
    )


def _spread_pixels(image: Image, _: torch.Generator) -> Int[Tensor, " P"]:
    """Of each of `_TILES` x `_TILES` parts of an image, or as many as it has pixels along an edge, the pixel where it
    changes most; row-major numbers."""
    change = _local_change(image)
    down, across = (min(_TILES, side) for side in change.shape)
    height, width = change.shape[0] // down, change.shape[1] // across
    tiles = change[: down * height, : across * width].reshape(down, height, across, width)
    best = tiles.permute(0, 2, 1, 3).flatten(2).argmax(dim=-1)
    rows = torch.arange(down)[:, None] * height + best // width
    columns = torch.arange(across)[None, :] * width + best % width
    return (rows * change.shape[1] + columns).flatten()
