"""Views with fewer pixels, for what is sought in them before training.

Notation: `H x W` pixels of a view, `h x w` of it thinned out, `B` bands.

Do the poses mean what we take them for? Views are compared under this convention and under three common others.

A point of the scene looks alike in all views that see it. So points along the rays of some pixels are projected into
neighbouring views, and the best agreement along each ray counts. With the right poses it is close, with wrong ones
rarely better than between unrelated pixels: what poses in OpenCV axes or from world to camera really mean is the
convention under which views agree.

Notation: `N` views, `F` features of a pixel, `P` pixels of one view, `D` points along a ray. Poses are camera to world
with OpenGL axes, in world units, float64.

Whether the cameras stand far enough apart to tell how far away things are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.scenes.scene import Scene

MOST_BANDS = 32
"""Of what is compared."""
MOST_POOLED = 4
"""Pixels along an edge that are averaged, if there are so many; of more, every second or third is left out."""

ReadView = Callable[[int, tuple[slice, ...]], Float32[np.ndarray, "H W B"]]
"""From a view, and the rows, columns and bands wanted, to its picture."""


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
        cls, longest_side_px: int, cameras: Cameras, read_view: ReadView, most_pooled: int = MOST_POOLED
    ) -> Thinning:
        """Of views that show the same bands to at most so many pixels along their longer side, and `MOST_BANDS`."""
        stride = -(-max(cameras.width, cameras.height) // longest_side_px)
        fine = max(1, stride // most_pooled)
        bands = read_view(0, (slice(1), slice(1))).shape[2]
        return cls(fine, stride // fine, -(-bands // MOST_BANDS))

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

    def whole(self, coords: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Coordinates in the whole view of those in the thinned-out one; pixel centres are at + 0.5 in both."""
        return (coords - 0.5) * self.stride + self.first + 0.5


NUM_REFERENCES, NUM_NEIGHBOURS, NUM_AGREEING = 8, 4, 3
"""Views whose pixels are looked for, others that each is looked for in, and of these how many must agree: the one
that agrees least may be hidden by something."""
NUM_PIXELS, NUM_POINTS, NUM_FEATURES = 150, 192, 4
BUSIEST_SHARE = 0.3
"""Share of a view's pixels, those where it changes most, that are drawn from."""
LONGEST_SIDE_PX = 128
"""Of what is compared: larger views are thinned out."""
DEPTHS = (0.4, 60.0)
"""Nearest and farthest point along a ray, in median distances between neighbouring cameras."""
SMALLEST_TURN_DEG = 3.0
"""Neighbours are views that are turned against each other by at least this, if there are any."""
MOST_DISAGREEMENT = 0.35
"""Of the right convention, against that of unrelated pixels: 0.06 to 0.24 on scenes with 5 to 36 views."""
LEAST_RATIO = 1.5
"""Of the given convention's disagreement to the right one's: a wrong one has 1.7 and more."""

GIVEN = "camera to world, OpenGL axes"
_FLIP = np.diag([1.0, -1.0, -1.0])
_REMEDIES = {
    "camera to world, OpenCV axes": "multiply each from the right by diag(1, -1, -1, 1)",
    "world to camera, OpenGL axes": "invert each",
    "world to camera, OpenCV axes (as COLMAP writes them)": (
        "invert each, then multiply it from the right by diag(1, -1, -1, 1)"
    ),
}

Poses = Float64[np.ndarray, "N 3 4"]


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


def compare_conventions(poses: Poses, lenses: Cameras, read_view: ReadView) -> dict[str, float]:
    """How little the views agree under each convention, against unrelated pixels (1); inf where they share nothing.

    Args:
        poses: As the scene gives them.
        lenses: Cameras of these views; only their lenses count. Of line cameras nothing is said.
        read_view: Reads a part of a view.
    """
    if len(poses) < NUM_AGREEING + 1 or lenses.key_poses is not None:
        return {}
    neighbours = choose_neighbours(poses)
    generator = torch.Generator().manual_seed(0)
    used = sorted({*neighbours, *(other for others in neighbours.values() for other in others)})
    thinning = Thinning.to(LONGEST_SIDE_PX, lenses, read_view, most_pooled=1)
    views = [thinning.read(read_view, view) for view in used]
    features = dict(zip(used, view_features(views, generator), strict=True))
    pixels = {view: _busy_pixels(features[view], generator) for view in neighbours}
    drawn = torch.cat([features[view].flatten(0, 1)[pixels[view]] for view in neighbours])
    chance = float((drawn - drawn[torch.randperm(len(drawn), generator=generator)]).norm(dim=-1).median())
    if chance <= 0.0:  # nothing in the views changes
        return {}
    return {
        name: _disagreement(
            thinned_cameras(meant, lenses, features[used[0]], thinning.stride), features, pixels, neighbours
        )
        / chance
        for name, meant in _meanings(poses).items()
    }


def describe(disagreements: dict[str, float]) -> str | None:
    """A warning, if another convention fits much better than the one expected."""
    best = min(disagreements, key=lambda name: disagreements[name], default=GIVEN)
    if best == GIVEN or disagreements[best] > MOST_DISAGREEMENT:
        return None
    if disagreements[GIVEN] < LEAST_RATIO * disagreements[best]:
        return None
    found = disagreements[GIVEN]
    given = "they share nothing" if found == float("inf") else f"they differ by {found:.2f}"
    return (
        f"the poses look like {best}: read so, the training views differ by {disagreements[best]:.2f} of what "
        f"unrelated pixels do; read as {GIVEN}, as expected, {given}. If so, take each 'transform_matrix' of "
        f"transforms.json: {_REMEDIES[best]}"
    )


def _meanings(poses: Poses) -> dict[str, Poses]:
    """What the given matrices are as camera to world with OpenGL axes, under each convention."""
    rotations, positions = poses[:, :, :3], poses[:, :, 3:]
    inverse = rotations.transpose(0, 2, 1)
    origins = -(inverse @ positions)
    opencv, world_to_camera, colmap = _REMEDIES
    return {
        GIVEN: poses,
        opencv: np.concatenate([rotations @ _FLIP, positions], axis=-1),
        world_to_camera: np.concatenate([inverse, origins], axis=-1),
        colmap: np.concatenate([inverse @ _FLIP, origins], axis=-1),
    }


def choose_neighbours(
    poses: Poses, num_references: int = NUM_REFERENCES, num_neighbours: int = NUM_NEIGHBOURS
) -> dict[int, list[int]]:
    """For some views the others that are turned least against them; the same under every convention."""
    rotations, positions = poses[:, :, :3], poses[:, :, 3]
    cosines = (np.einsum("iab,jab->ij", rotations, rotations) - 1.0) / 2.0
    turns = np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0)))
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    ranks = turns + 0.1 * distances / max(float(distances.max()), 1e-30)
    ranks[turns < SMALLEST_TURN_DEG] += 360.0
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
    axes = axes[:NUM_FEATURES].T / (spreads[0] / len(some) ** 0.5).clamp(min=1e-12)
    return [_smooth((view - mean) @ axes) for view in views]


def _smooth(image: Float[Tensor, "H W F"]) -> Float[Tensor, "H W F"]:
    pooled = torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), 3, 1, 1, count_include_pad=False)
    return pooled.permute(1, 2, 0).contiguous()


def _busy_pixels(image: Float[Tensor, "H W F"], generator: torch.Generator) -> Int[Tensor, " P"]:
    """Random pixels among those where the image changes most, row-major numbers."""
    change = local_change(image)
    order = change.flatten().argsort(descending=True)
    busy = order[: max(NUM_PIXELS, int(BUSIEST_SHARE * int((change > 0).sum())))]
    return busy[torch.randperm(len(busy), generator=generator)[:NUM_PIXELS]]


def local_change(image: Float[Tensor, "H W F"]) -> Float[Tensor, "H W"]:
    """How much an image changes around each pixel, along its rows and columns; 0 on its border."""
    change = torch.zeros(image.shape[:2])
    across = (image[1:-1, 2:] - image[1:-1, :-2]).norm(dim=-1)
    change[1:-1, 1:-1] = across + (image[2:, 1:-1] - image[:-2, 1:-1]).norm(dim=-1)
    return change


def thinned_cameras(poses: Poses, lenses: Cameras, image: Float[Tensor, "H W F"], stride: int) -> Cameras:
    """Cameras of thinned-out views, in coordinates of order 1."""
    poses = poses.copy()
    poses[:, :, 3] -= poses[:, :, 3].mean(axis=0)
    poses[:, :, 3] /= max(float(np.linalg.norm(poses[:, :, 3], axis=-1).max()), 1e-30)
    matrices = torch.from_numpy(poses).float()
    return thinned_lenses(replace(lenses, camera_to_world=matrices), image, stride)


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


def _disagreement(
    cameras: Cameras,
    features: dict[int, Float[Tensor, "H W F"]],
    pixels: dict[int, Int[Tensor, " P"]],
    neighbours: dict[int, list[int]],
) -> float:
    """Median over pixels of the least difference along their rays; inf where too few neighbours see a ray."""
    positions = cameras.camera_to_world[:, :, 3]
    gaps = [
        float((positions[view] - positions[other]).norm())
        for view in neighbours
        for other in neighbours[view]
    ]
    if np.median(gaps) <= 0.0:
        return float("inf")
    nearest, farthest = DEPTHS
    depths = float(np.median(gaps)) / torch.linspace(1.0 / nearest, 1.0 / farthest, NUM_POINTS)
    least = []
    for view, others in neighbours.items():
        chosen = pixels[view]
        coords = torch.stack([chosen % cameras.width, chosen // cameras.width], dim=-1).float() + 0.5
        rays = cameras.generate_rays(torch.full((len(chosen),), view), coords)
        points = (rays.origins[:, None] + rays.directions[:, None] * depths[:, None]).flatten(0, 1)
        own = features[view].flatten(0, 1)[chosen]
        seen = [view_differences(points, own, features[other], cameras, other) for other in others]
        ranked = torch.stack(seen, dim=-1).sort(dim=-1).values[..., :NUM_AGREEING]
        least.append(ranked.mean(dim=-1).min(dim=-1).values)
    return float(torch.cat(least).median())


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
    shown = sampled[0, :, :, 0].T.reshape(len(own), -1, own.shape[-1])
    differences = (shown - own[:, None]).norm(dim=-1)
    return differences.masked_fill(~is_seen.reshape(differences.shape), torch.inf)


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
