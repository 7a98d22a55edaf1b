"""What the training views agree on, before any training: do the poses mean what we take them for, and does the world go
on behind the scene box?

A point of the scene looks alike in all views that see it. So points along the rays of some pixels are projected into
neighbouring views, and the best agreement along each ray counts, against that of unrelated pixels. With the right
poses it is close, with wrong ones rarely better than by chance: what poses in OpenCV axes or from world to camera
really mean is the convention under which views agree. Where views agree on a place behind the box clearly better than
on any in it, something is there; where they agree on no place at all, they see more than the box holds, too far away or
too little overlapping to say where.

Notation: `N` views, `H x W` pixels of a view, `h x w` of it thinned out, `B` bands, `F` features of a pixel, `P` pixels
of one view, `D` points along a ray. Poses are camera to world with OpenGL axes, in world units, float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.scenes.scene import Scene

_MOST_BANDS = 32
"""Of what is compared."""
_MOST_POOLED = 4
"""Pixels along an edge that are averaged, if there are so many; of more, every second or third is left out."""
_NUM_REFERENCES, _NUM_NEIGHBOURS, NUM_AGREEING = 8, 4, 3
"""Views whose pixels are looked for, others that each is looked for in, and of these how many must agree: the one
that agrees least may be hidden by something."""
_NUM_PIXELS, _NUM_POINTS, _NUM_FEATURES = 150, 192, 4
_BUSIEST_SHARE = 0.3
"""Share of a view's pixels, those where it changes most, that are drawn from."""
LONGEST_SIDE_PX = 128
"""Of what is compared: larger views are thinned out."""
_DEPTHS = (0.4, 60.0)
"""Nearest and farthest point along a ray, in median distances between neighbouring cameras."""
_SMALLEST_TURN_DEG = 3.0
"""Neighbours are views that are turned against each other by at least this, if there are any."""
_MOST_DISAGREEMENT = 0.35
"""Of the right convention, against that of unrelated pixels: 0.06 to 0.24 on scenes with 5 to 36 views."""
_LEAST_RATIO = 1.5
"""Of the given convention's disagreement to the right one's: a wrong one has 1.7 and more."""

_SMALLEST_BASE = 2e-3
"""Distance between two cameras over that of what they see, below which it moves by hardly more than a pixel."""
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
_MOST_BEHIND = 0.15
"""Of the pixels that speak for one or the other, those that may show something behind a closed box."""
_LEAST_EXPLAINED = 0.6
"""Of all pixels, those that the inside of a closed box explains: 0.84 in a room, 0.26 in the open."""

_GIVEN = "camera to world, OpenGL axes"
_FLIP = np.diag([1.0, -1.0, -1.0])
_REMEDIES = {
    "camera to world, OpenCV axes": "multiply each from the right by diag(1, -1, -1, 1)",
    "world to camera, OpenGL axes": "invert each",
    "world to camera, OpenCV axes (as COLMAP writes them)": (
        "invert each, then multiply it from the right by diag(1, -1, -1, 1)"
    ),
}

_Poses = Float64[np.ndarray, "N 3 4"]
ReadView = Callable[[int, tuple[slice, ...]], Float32[np.ndarray, "H W B"]]
"""From a view, and the rows, columns and bands wanted, to its picture."""
ReadValid = Callable[[int], Bool[np.ndarray, "H W"]]
"""From a view to its pixels that count: the others show what is no part of the scene."""


@dataclass(frozen=True)
class Thinning:
    """Which pixels of a view are averaged to one."""

    fine: int
    """Of so many pixels along an edge one is read."""
    pooled: int
    """Of so many that are read along an edge the mean is taken."""
    band_step: int
    """Of so many bands one is read."""

    @classmethod
    def to(
        cls, longest_side_px: int, cameras: Cameras, read_view: ReadView, most_pooled: int = _MOST_POOLED
    ) -> Thinning:
        """Of views that show the same bands to at most so many pixels along their longer side, and `_MOST_BANDS`."""
        stride = -(-max(cameras.width, cameras.height) // longest_side_px)
        fine = max(1, stride // most_pooled)
        bands = read_view(0, (slice(1), slice(1))).shape[2]
        return cls(fine, stride // fine, -(-bands // _MOST_BANDS))

    @property
    def stride(self) -> int:
        """Pixels of the whole view from one pixel of the thinned-out one to the next."""
        return self.fine * self.pooled

    @property
    def first(self) -> float:
        """Where in the whole view the first lies, from the centre of its first pixel on."""
        return self.fine * (self.pooled - 1) / 2

    def read(self, read_view: ReadView, view: int) -> Float[Tensor, "h w B"]:
        """A view thinned out."""
        some = slice(None, None, self.fine)
        picture = read_view(view, (some, some, slice(None, None, self.band_step)))
        image = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)
        return torch.nn.functional.avg_pool2d(image, self.pooled).permute(1, 2, 0)

    def valid_share(self, valid: Bool[np.ndarray, "H W"]) -> Float[Tensor, "h w"]:
        """Of what is averaged to each pixel of a view thinned out, the share that is valid."""
        some = torch.from_numpy(valid[:: self.fine, :: self.fine].astype(np.float32))
        return torch.nn.functional.avg_pool2d(some[None], self.pooled)[0]

    def whole(self, coords: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Coordinates in the whole view of those in the thinned-out one; pixel centres are at + 0.5 in both."""
        return (coords - 0.5) * self.stride + self.first + 0.5


def check_scene_poses(scene: Scene) -> str | None:
    """A warning if the training views agree much better under another convention than the one expected."""
    sensors = [scene.frames[index].sensor for index in scene.train_indices]
    train = [scene.train_indices[row] for row in commonest(sensors)]
    # Of a line camera no single pose tells what it saw.
    train = [view for view in train if not scene.cameras.is_line_camera(view)]
    poses = scene.cameras.camera_to_world[train].double().numpy()
    placement = scene.placement  # conventions are those of the matrices in transforms.json
    rotations = placement.rotation @ scene.normalisation.rotation.T @ poses[:, :, :3]
    positions = placement.to_scene(scene.normalisation.to_world(poses[:, :, 3]))
    world = np.concatenate([rotations, positions[:, :, None]], axis=-1)
    lenses = scene.cameras[train]
    return describe(compare_conventions(world, lenses, lambda view, part: scene.cube(train[view], part)))


def commonest(sensors: list[int]) -> list[int]:
    """Which views to compare, given the sensor of each: those of the sensor with most, since bands must agree."""
    most = max(sensors, key=sensors.count)
    return [row for row, sensor in enumerate(sensors) if sensor == most]


def compare_conventions(poses: _Poses, lenses: Cameras, read_view: ReadView) -> dict[str, float]:
    """How little the views agree under each convention, against unrelated pixels (1); inf where they share nothing.

    Args:
        poses: As the scene gives them.
        lenses: Cameras of these views; only their lenses count. Of line cameras nothing is said.
        read_view: Reads a part of a view.
    """
    found = None if lenses.key_poses is not None else _compare(poses, lenses, read_view, _busy_pixels)
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
        least = [_disagreements(found, cameras, view, depths).min(dim=-1).values for view in found.neighbours]
        disagreements[name] = float(torch.cat(least).median()) / found.chance if gap > 0.0 else float("inf")
    return disagreements


@dataclass(frozen=True)
class _Comparison:
    """Pixels of some views and what these and their neighbours show, in few pixels."""

    neighbours: dict[int, list[int]]
    features: dict[int, Float[Tensor, "H W F"]]
    pixels: dict[int, Int[Tensor, " P"]]
    """Row-major numbers."""
    cameras: Cameras
    """Of all views, with lenses of so few pixels."""
    chance: float
    """Difference of unrelated pixels."""


def _compare(
    poses: _Poses,
    lenses: Cameras,
    read_view: ReadView,
    choose: Callable[[Float[Tensor, "H W F"], torch.Generator], Int[Tensor, " P"]],
) -> _Comparison | None:
    """None if there are too few views, or nothing in them changes."""
    if len(poses) < NUM_AGREEING + 1:
        return None
    neighbours = choose_neighbours(poses)
    generator = torch.Generator().manual_seed(0)
    used = sorted({*neighbours, *(other for others in neighbours.values() for other in others)})
    thinning = Thinning.to(LONGEST_SIDE_PX, lenses, read_view, most_pooled=1)
    views = [thinning.read(read_view, view) for view in used]
    features = dict(zip(used, view_features(views, generator), strict=True))
    pixels = {view: choose(features[view], generator) for view in neighbours}
    drawn = torch.cat([features[view].flatten(0, 1)[pixels[view]] for view in neighbours])
    chance = float((drawn - drawn[torch.randperm(len(drawn), generator=generator)]).norm(dim=-1).median())
    if chance <= 0.0:
        return None
    cameras = thinned_lenses(lenses, features[used[0]], thinning.stride)
    return _Comparison(neighbours, features, pixels, cameras, chance)


def _disagreements(
    found: _Comparison, cameras: Cameras, view: int, depths: Float[Tensor, " D"]
) -> Float[Tensor, "P D"]:
    """Of a view's pixels with those neighbours that agree best, along their rays; inf where too few see a point."""
    rays = _rays(cameras, view, found.pixels[view])
    points = (rays.origins[:, None] + rays.directions[:, None] * depths[:, None]).flatten(0, 1)
    own = found.features[view].flatten(0, 1)[found.pixels[view]]
    seen = [
        view_differences(points, own, found.features[other], cameras, other)
        for other in found.neighbours[view]
    ]
    return torch.stack(seen, dim=-1).sort(dim=-1).values[..., :NUM_AGREEING].mean(dim=-1)


def _rays(cameras: Cameras, view: int, pixels: Int[Tensor, " P"]) -> RayBundle:
    coords = torch.stack([pixels % cameras.width, pixels // cameras.width], dim=-1).float() + 0.5
    return cameras.generate_rays(torch.full((len(pixels),), view), coords)


def describe(disagreements: dict[str, float]) -> str | None:
    """A warning, if another convention fits much better than the one expected."""
    best = min(disagreements, key=lambda name: disagreements[name], default=_GIVEN)
    if best == _GIVEN or disagreements[best] > _MOST_DISAGREEMENT:
        return None
    if disagreements[_GIVEN] < _LEAST_RATIO * disagreements[best]:
        return None
    found = disagreements[_GIVEN]
    given = "they share nothing" if found == float("inf") else f"they differ by {found:.2f}"
    return (
        f"the poses look like {best}: read so, the training views differ by {disagreements[best]:.2f} of what "
        f"unrelated pixels do; read as {_GIVEN}, as expected, {given}. If so, take each 'transform_matrix' of "
        f"transforms.json: {_REMEDIES[best]}"
    )


def _meanings(poses: _Poses) -> dict[str, _Poses]:
    """What the given matrices are as camera to world with OpenGL axes, under each convention."""
    rotations, positions = poses[:, :, :3], poses[:, :, 3:]
    inverse = rotations.transpose(0, 2, 1)
    origins = -(inverse @ positions)
    opencv, world_to_camera, colmap = _REMEDIES
    return {
        _GIVEN: poses,
        opencv: np.concatenate([rotations @ _FLIP, positions], axis=-1),
        world_to_camera: np.concatenate([inverse, origins], axis=-1),
        colmap: np.concatenate([inverse @ _FLIP, origins], axis=-1),
    }


def choose_neighbours(
    poses: _Poses, num_references: int = _NUM_REFERENCES, num_neighbours: int = _NUM_NEIGHBOURS
) -> dict[int, list[int]]:
    """For some views the others that are turned least against them; the same under every convention."""
    rotations, positions = poses[:, :, :3], poses[:, :, 3]
    cosines = (np.einsum("iab,jab->ij", rotations, rotations) - 1.0) / 2.0
    turns = np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0)))
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    ranks = turns + 0.1 * distances / max(float(distances.max()), 1e-30)
    ranks[turns < _SMALLEST_TURN_DEG] += 360.0
    np.fill_diagonal(ranks, np.inf)
    chosen = np.linspace(0, len(poses) - 1, min(num_references, len(poses))).round().astype(int)
    count = min(num_neighbours, len(poses) - 1)
    return {int(view): np.argsort(ranks[view])[:count].tolist() for view in chosen}


def view_features(
    views: list[Float[Tensor, "H W B"]], generator: torch.Generator
) -> list[Float[Tensor, "H W F"]]:
    """Principal components of the spectra of all views, the first with a spread of 1, smoothed a little."""
    spectra = torch.cat([view.flatten(0, 1) for view in views])
    some = spectra[torch.randperm(len(spectra), generator=generator)[:5000]]
    mean = some.mean(dim=0)
    _, spreads, axes = torch.linalg.svd(some - mean, full_matrices=False)
    axes = axes[:_NUM_FEATURES].T / (spreads[0] / len(some) ** 0.5).clamp(min=1e-12)
    images = [((view - mean) @ axes).permute(2, 0, 1) for view in views]
    smoothed = [torch.nn.functional.avg_pool2d(image, 3, 1, 1, count_include_pad=False) for image in images]
    return [image.permute(1, 2, 0).contiguous() for image in smoothed]


def _busy_pixels(image: Float[Tensor, "H W F"], generator: torch.Generator) -> Int[Tensor, " P"]:
    """Random pixels among those where the image changes most, row-major numbers."""
    change = _local_change(image)
    order = change.flatten().argsort(descending=True)
    busy = order[: max(_NUM_PIXELS, int(_BUSIEST_SHARE * int((change > 0).sum())))]
    return busy[torch.randperm(len(busy), generator=generator)[:_NUM_PIXELS]]


def _local_change(image: Float[Tensor, "H W F"]) -> Float[Tensor, "H W"]:
    """How much an image changes around each pixel, along its rows and columns; 0 on its border."""
    change = torch.zeros(image.shape[:2])
    across = (image[1:-1, 2:] - image[1:-1, :-2]).norm(dim=-1)
    change[1:-1, 1:-1] = across + (image[2:, 1:-1] - image[:-2, 1:-1]).norm(dim=-1)
    return change


def thinned_lenses(
    cameras: Cameras, image: Float[Tensor, "H W F"], stride: int, first: float = 0.0
) -> Cameras:
    """The same poses with lenses of thinned-out views: every `stride`-th pixel from `first` on."""
    height, width = image.shape[:2]
    # Pixel (c, r) of a thinned-out view is pixel (c stride, r stride) + first of the whole; centres are at + 0.5.
    center = (cameras.center_px - 0.5 - first) / stride + 0.5
    return Cameras(
        cameras.camera_to_world, cameras.focal_px / stride, center, cameras.distortion, width, height
    )


def view_differences(
    points: Float[Tensor, "PD 3"],
    own: Float[Tensor, "P F"],
    image: Float[Tensor, "H W F"],
    cameras: Cameras,
    view: int,
) -> Float[Tensor, "P D"]:
    """Between a pixel and what another view shows of each point of its ray; inf where that does not see it."""
    coords, depths = cameras.project(points, view)
    size = torch.tensor([cameras.width, cameras.height])
    is_seen = (depths > 0.0) & ((coords > 0.5) & (coords < size - 0.5)).all(dim=-1)
    grid = (coords / size * 2.0 - 1.0).clamp(-2.0, 2.0)[None, :, None]
    sampled = torch.nn.functional.grid_sample(image.permute(2, 0, 1)[None], grid, align_corners=False)
    # Features first: a norm along a last axis of a few numbers takes ten times as long.
    shown = sampled[0, :, :, 0].view(own.shape[-1], len(own), -1)
    differences = (shown - own.T[:, :, None]).square_().sum(dim=0).sqrt_()
    return differences.masked_fill(~is_seen.reshape(differences.shape), torch.inf)


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


@dataclass(frozen=True)
class _WorldEvidence:
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

    def with_places(self, box: SceneBox, places: Float[Tensor, "P 3"]) -> _WorldEvidence:
        """With what places say that features matched between views stand at."""
        outside = ((places - box.aabb.mean(dim=0)).abs() > _BOX_MARGIN * box.size / 2).any(dim=-1)
        return replace(self, num_places=len(places), num_outside=int(outside.sum()))

    @property
    def goes_on(self) -> bool:
        """Whether the views show more than a closed box would."""
        return self._shows_more or self._is_unexplained or self._has_places_outside

    @property
    def _shows_more(self) -> bool:
        return self.num_behind > _MOST_BEHIND * (self.num_behind + self.num_inside)

    @property
    def _is_unexplained(self) -> bool:
        return self.num_explained < _LEAST_EXPLAINED * self.num_pixels

    @property
    def _has_places_outside(self) -> bool:
        return self.num_outside > _MOST_BEHIND * self.num_places

    def in_words(self) -> str:
        """Which it is and why, and how to say otherwise."""
        behind = (
            f"{self.num_behind} of {self.num_behind + self.num_inside} pixels that tell show places behind it"
        )
        explained = f"its inside explains {self.num_explained} of {self.num_pixels} pixels"
        outside = f"{self.num_outside} of {self.num_places} places matched between views lie outside it"
        if not self.goes_on:
            known = [explained, behind] + ([outside] if self.num_places else [])
            return f"the scene is taken to end with its box: {', '.join(known)} (--world unbounded if not)"
        why = behind if self._shows_more else explained if self._is_unexplained else outside
        return f"the world is taken to go on behind the scene box: {why} (--world bounded if not)"


def find_world_evidence(box: SceneBox, cameras: Cameras, read_view: ReadView) -> _WorldEvidence:
    """Ask where the views agree.

    Args:
        box: In the cameras' space.
        cameras: Of the training views.
        read_view: Reads a part of a view.
    """
    found = _compare(cameras.camera_to_world.double().numpy(), cameras, read_view, _spread_pixels)
    if found is None:
        return _WorldEvidence(0, 0, 0, 0)
    nearest, farthest = _WORLD_DEPTHS
    depths = float(box.size.max()) / 2 / torch.linspace(1 / nearest, 1 / farthest, _NUM_DEPTHS)
    sides = []
    for view in found.neighbours:
        costs = _disagreements(found, found.cameras, view, depths)
        is_behind, is_inside = _sides(box, _rays(found.cameras, view, found.pixels[view]), depths)
        sides.append(
            [costs.masked_fill(~side, torch.inf).min(dim=1).values for side in (is_behind, is_inside)]
        )
    behind, inside = (torch.cat(parts) / found.chance for parts in zip(*sides, strict=True))
    is_clear = torch.minimum(behind, inside) < _MOST_UNEXPLAINED
    return _WorldEvidence(
        len(inside),
        int((is_clear & (inside < _CLEARLY * behind)).sum()),
        int((is_clear & (behind < _CLEARLY * inside)).sum()),
        int((inside < _MOST_UNEXPLAINED).sum()),
    )


def _spread_pixels(image: Float[Tensor, "H W F"], _: torch.Generator) -> Int[Tensor, " P"]:
    """Of each of `_TILES` x `_TILES` parts of an image the pixel where it changes most; row-major numbers (P,).

    An image of fewer pixels along an edge has as many parts there as pixels.
    """
    change = _local_change(image)
    down, across = (min(_TILES, side) for side in change.shape)
    height, width = change.shape[0] // down, change.shape[1] // across
    tiles = change[: down * height, : across * width].reshape(down, height, across, width)
    best = tiles.permute(0, 2, 1, 3).flatten(2).argmax(dim=-1)
    rows = torch.arange(down)[:, None] * height + best // width
    columns = torch.arange(across)[None, :] * width + best % width
    return (rows * change.shape[1] + columns).flatten()


def _sides(box: SceneBox, rays: RayBundle, depths: Float[Tensor, " D"]) -> tuple[Tensor, Tensor]:
    """Which points along rays are behind the box or beside it, and which are in it; bool (P, D)."""
    middle, half = box.aabb.mean(dim=0), _BOX_MARGIN * box.size / 2
    wide = SceneBox(torch.stack([middle - half, middle + half]))
    t_near, t_far = (t[:, None] for t in wide.intersect(rays.origins, rays.directions))
    misses = t_far <= t_near
    return misses | (depths > t_far), ~misses & (depths >= t_near) & (depths <= t_far)
