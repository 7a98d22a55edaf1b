"""The surface of a trained scene: where rays of its own cameras end and agree, what is there, and the field on a grid.

A ray that grazes an edge ends, on average, between what is before and what is behind it: in the air. And what no camera
sees was never learnt. Both are found by comparing with the other cameras: a point lies on the surface where cameras see
something at its distance, and few see through it. On a grid, only cells that are rendered are asked: elsewhere the
field was never trained, and what it says there is nothing.

Notation: `P` points, `X x Y x Z` grid points, `B` bands, `K` endmembers. Model space.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import numbered_apart
from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.scenes.geometry.views import look_up
from unmix_plugin.spectral.colour.conversion import describe_colour, rgb_matrix
from unmix_plugin.spectral.colour.srgb import encode_srgb
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients, Materials
from unmix_plugin.spectral.segmentation import material_ids
from unmix_plugin.trained.measures import Scale, describe_scale
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.trained_scene import TrainedScene

_SOLID_ACCUMULATION = 0.9
"""Rays of which at least this much ends on something give points."""
_TOLERANCE_PX = 2.0
"""Difference of distances, in pixels as large as they are at the point, that still counts as the same surface."""
_FEWEST_IMAGES = 3
"""In which a point is hidden that counts as inside: one alone may have it behind something at its edge."""
_MANY_IMAGES = 8
"""That have a point in them, of which more than one should see it: a third of those all around an object do."""
_SCALE_BOUNDS = (1 / 16, 4.0)
_SIDE_PX = 24
"""Least side of an image that surfaces are looked for in."""


@dataclass(frozen=True)
class SurfacePoints:
    """Ends of rays, on the CPU."""

    positions: Float[Tensor, "P 3"]
    directions: Float[Tensor, "P 3"]
    """Unit vectors away from the camera."""
    abundances: Float[Tensor, "P K"]
    """Of what the ray ends on, summing to 1."""
    scaled_abundances: Float[Tensor, "P K"]
    """What the endmembers are multiplied with; spectra would take far more memory."""

    def __len__(self) -> int:
        return len(self.positions)

    def diffuse(self, materials: Materials) -> Float[Tensor, "P B"]:
        """Spectra without the view-dependent part."""
        return self.scaled_abundances @ materials.endmembers.detach().cpu()

    def select(self, chosen: Bool[Tensor, " P"] | Int64[Tensor, " chosen"]) -> SurfacePoints:
        """Some of the points."""
        return SurfacePoints(**{name: values[chosen] for name, values in vars(self).items()})

    @staticmethod
    def concatenate(parts: Sequence[SurfacePoints]) -> SurfacePoints:
        """The points of all parts, in order."""
        return SurfacePoints(*map(torch.cat, zip(*(vars(part).values() for part in parts), strict=True)))


Follow: TypeAlias = Callable[[str, Sequence[Any]], Iterable[Any]]
"""The items given, while it is shown how many are done of what is said."""


class SeenSurface:
    """What the cameras of a run see."""

    def __init__(
        self,
        scene: TrainedScene,
        num_rays: int,
        cameras: Sequence[Cameras],
        follow: Follow = lambda _doing, items: items,
    ) -> None:
        """Look through single cameras, with about so many rays in all: images get more or fewer pixels for it."""
        self._scene = scene
        pixels = sum(camera.width * camera.height for camera in cameras)
        factor = min(max((num_rays / max(pixels, 1)) ** 0.5, _SCALE_BOUNDS[0]), _SCALE_BOUNDS[1])
        smallest = min((min(camera.width, camera.height) for camera in cameras), default=1)
        self._factor = max(factor, min(_SIDE_PX / smallest, 1.0))
        self._views: list[tuple[Cameras, Float[Tensor, "H W"]]] = []
        self._points: list[SurfacePoints] = []
        for camera in follow("looking at the surface", cameras):
            self._look(camera)

    @torch.no_grad()
    def _look(self, camera: Cameras) -> None:
        """Render what one camera sees."""
        width, height = (max(1, round(self._factor * side)) for side in (camera.width, camera.height))
        view = camera.resized(width, height).to("cpu")
        found = self._scene.look(view, subpixels=1).coefficients
        accumulation = found.accumulation.flatten().cpu()
        distances = found.distance.flatten().cpu() / accumulation.clamp(min=1e-6)
        distances[accumulation < OCCUPIED_ACCUMULATION] = torch.inf
        self._views.append((view, distances.unflatten(0, (view.height, view.width))))
        rays = view.image_rays(0)
        positions = rays.at(distances)
        solid = accumulation >= _SOLID_ACCUMULATION
        if self._scene.renderer.space.is_unbounded:  # a horizon would dwarf everything else
            solid &= self._scene.scene_box.to("cpu").contains(positions)
        self._points.append(SurfacePoints(positions[solid], rays.directions[solid], *_shares(found, solid)))

    def points(self) -> SurfacePoints:
        """Ends of all rays on whose place the cameras agree."""
        points = SurfacePoints.concatenate(self._points)
        confirmed, seen_through = self._votes(points.positions)
        # The camera that a point is from confirms it, so another one has to, unless there is none.
        needed = min(2, len(self._views))
        return points.select((confirmed >= needed) & (2 * seen_through <= confirmed))

    def shows(self, positions: Float[Tensor, "P 3"], tolerance: float = 0.0) -> Bool[Tensor, " P"]:
        """Which points lie on what the cameras see, to `_TOLERANCE_PX` or, where that is more, to a distance in model
        units."""
        confirmed, seen_through = self._votes(positions, tolerance)
        return (confirmed >= 1) & (seen_through <= confirmed)

    def signed_distance(
        self, positions: Float[Tensor, "P 3"], reach_px: float, is_closed: bool = False
    ) -> Float[Tensor, " P"]:
        """How far points lie before what the cameras see, means over those that see them or see what hides them by less
        than `reach_px` pixels of the scene's images, as parts of that, at most 1; -1 behind all that the
        images show, 1 where too few have the points in them. Of a closed solid, one camera alone opens no hollow that
        many don't look into: how far it sees there was never learnt.

        Source: Curless and Levoy 1996, A Volumetric Method for Building Complex Models from Range Images.
        """
        sums, counts = torch.zeros(len(positions)), torch.zeros(len(positions))
        images = torch.zeros(len(positions))
        for camera, distances in self._views:
            inside, excess = _excess_px(camera, distances, positions)
            images[inside] += 1
            parts = (excess / (self._factor * reach_px)).clamp(max=1)
            near = (parts > -1).nonzero()[:, 0]
            rows = inside[near]
            sums[rows] += parts[near]
            counts[rows] += 1
        if is_closed:
            counts[(counts == 1) & (images > _MANY_IMAGES)] = 0
        is_hidden = images >= min(_FEWEST_IMAGES, len(self._views))
        return torch.where(counts > 0, sums / counts.clamp(min=1), torch.where(is_hidden, -1.0, 1.0))

    def _votes(
        self, positions: Float[Tensor, "P 3"], tolerance: float = 0.0
    ) -> tuple[Int64[Tensor, " P"], Int64[Tensor, " P"]]:
        """How many cameras see something at each point, and how many see something only behind it."""
        confirmed = torch.zeros(len(positions), dtype=torch.int64)
        seen_through = torch.zeros_like(confirmed)
        for camera, distances in self._views:
            inside, excess = _excess_px(camera, distances, positions, tolerance / _TOLERANCE_PX)
            confirmed[inside] += excess.abs() <= _TOLERANCE_PX
            seen_through[inside] += excess > _TOLERANCE_PX
        return confirmed, seen_through


def in_image(
    camera: Cameras, positions: Float[Tensor, "P 3"]
) -> tuple[Bool[Tensor, " P"], Float[Tensor, "inside 2"], Float[Tensor, " inside"]]:
    """Which points are in a camera's image; of these the places in it, pixels, and the depths."""
    coords, depths, inside = look_up(camera, 0, positions)
    return inside, coords[inside], depths[inside]


def _excess_px(
    camera: Cameras, distances: Float[Tensor, "H W"], positions: Float[Tensor, "P 3"], least: float = 0.0
) -> tuple[Int64[Tensor, " inside"], Float[Tensor, " inside"]]:
    """Indices of the points in the image, and by how many pixels, as large as they are there and at least so many
    model units, it sees farther than each."""
    coords, depths, is_inside = look_up(camera, 0, positions)
    inside = is_inside.nonzero()[:, 0]
    coords, depths = coords[inside], depths[inside]
    columns, rows = coords.long().unbind(-1)
    places = camera.poses_at(torch.zeros_like(rows), coords[:, 1])[:, :, 3]
    own = (positions[inside] - places).norm(dim=-1)
    return inside, (distances[rows, columns] - own) / (depths / camera.focal_px[0].min()).clamp(min=least)


@torch.no_grad()
def look_at(
    scene: TrainedScene, positions: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"]
) -> Coefficients:
    """What rays see that start a pixel's size before each point of a surface and go along these unit vectors; where
    a lamp moves with the camera, `lit_head_on`."""
    indices = torch.zeros(len(positions), dtype=torch.int64)
    rays = RayBundle(positions - scene.pixel_size * directions, directions, indices).to(scene.device)
    return composite(scene.lit_head_on.renderer, scene.field, rays)


def look_from_above(
    scene: TrainedScene, positions: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P K"], Float[Tensor, "P B"]]:
    """Abundances, summing to 1, and diffuse spectra of points of a surface with these unit normals, seen from above."""
    if len(positions) == 0:
        return torch.zeros(0, len(scene.materials.names)), torch.zeros(0, len(scene.bands))
    found = look_at(scene, positions, -normals)
    abundances, scaled_abundances = _shares(found, torch.ones(len(positions), dtype=torch.bool))
    return abundances, scaled_abundances @ scene.materials.endmembers.detach().cpu()


def _shares(
    found: Coefficients, chosen: Bool[Tensor, " R"]
) -> tuple[Float[Tensor, "P K"], Float[Tensor, "P K"]]:
    """Abundances of what the chosen rays end on, and the same scaled; on the CPU."""
    rows = chosen.to(found.accumulation.device)
    opacity = found.accumulation.flatten()[rows].clamp(min=1e-6)[:, None]
    abundances, scaled_abundances = (
        (values.flatten(0, -2)[rows] / opacity).cpu()
        for values in (found.abundances, found.scaled_abundances)
    )
    return abundances, scaled_abundances


_RESOLUTIONS = (8, 1024)
_CHUNK = 1 << 16


@dataclass(frozen=True)
class GridPoints:
    """Points of a regular grid over a scene box; the outermost lie on its faces, but for a fraction of a cell."""

    origin: Float32[np.ndarray, "3"]
    """First point."""
    cell: float
    """Distance of neighbours along each axis."""
    shape: tuple[int, int, int]
    """Points along x, y and z."""

    @staticmethod
    def over(aabb: Float[Tensor, "2 3"], resolution: int) -> GridPoints:
        """A grid with `resolution` cells, from 8 to 1024, along the longest edge of a box."""
        low, high = _RESOLUTIONS
        if not low <= resolution <= high:
            raise ConfigError(
                f"--resolution is {resolution}; choose {low} to {high} cells along the longest edge"
            )
        corners = aabb.detach().cpu().double().numpy()
        size = corners[1] - corners[0]
        cell = float(size.max()) / resolution
        x, y, z = (int(np.floor(edge / cell + 1e-6)) + 1 for edge in size)
        return GridPoints(corners[0].astype(np.float32), cell, (x, y, z))

    def slice_points(self, index: int) -> Float[Tensor, "Y Z 3"]:
        """Points of the slice at `index` along x."""
        return self.slab_points(range(index, index + 1))[0]

    def slab_points(self, indices: range) -> Float[Tensor, "X Y Z 3"]:
        """Points of some slices along x."""
        _, num_y, num_z = self.shape
        cells = torch.cartesian_prod(torch.tensor(indices), torch.arange(num_y), torch.arange(num_z))
        return self.points_at(cells.numpy()).view(len(indices), num_y, num_z, 3)

    def points_at(self, indices: Int64[np.ndarray, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points by their indices along x, y and z."""
        points = torch.from_numpy(self.origin).double() + self.cell * torch.from_numpy(indices)
        return points.float()

    def slabs(self, most_points: int) -> list[range]:
        """Slices along x, as many at a time as hold at most so many points, but at least one."""
        num_x, num_y, num_z = self.shape
        thickness = max(1, most_points // (num_y * num_z))
        return [range(begin, min(begin + thickness, num_x)) for begin in range(0, num_x, thickness)]


@torch.no_grad()
def sample_field(
    scene: TrainedScene, points: Float[Tensor, "*grid 3"], with_abundances: bool = True
) -> tuple[Float[Tensor, "*grid"], Float[Tensor, "*grid K"]]:
    """Densities per model unit, and abundances, which sum to 1 (K is 0 without); both 0 in cells that are never
    rendered. On the CPU."""
    flat = points.flatten(0, -2).to(scene.device)
    densities = torch.zeros(len(flat), device=scene.device)
    abundances = torch.zeros(len(flat), with_abundances * len(scene.materials.names), device=scene.device)
    for chosen in scene.renderer.is_occupied(flat).nonzero()[:, 0].split(_CHUNK):
        densities[chosen], features = scene.field.get_density(flat[chosen])
        if with_abundances:
            abundances[chosen] = scene.field.abundances_of(features)
    shape = points.shape[:-1]
    return densities.cpu().view(shape), abundances.cpu().view(*shape, abundances.shape[1])


@dataclass(frozen=True)
class SurfaceAppearance:
    """Colour, material and abundances of points."""

    materials: Materials
    abundances: Float[Tensor, "P K"]
    """Summing to 1."""
    diffuse: Float[Tensor, "P B"]
    """Spectra without the view-dependent part."""
    scale: Scale | None = None
    """Of the world that the points are written in."""

    @property
    def linear_rgb(self) -> Float32[np.ndarray, "P 3"]:
        """Linear light in sRGB primaries, [0, 1]."""
        # Clamped after the colours are made, as in renders: in another light a band may exceed full scale.
        matrix = rgb_matrix(self.materials.bands, torch.float64)
        return (self.diffuse.double() @ matrix).clamp(0, 1).float().numpy()

    @property
    def srgb(self) -> Float64[np.ndarray, "P 3"]:
        """Colours for displays, [0, 1]."""
        return encode_srgb(self.linear_rgb.astype(np.float64))

    @property
    def material_ids(self) -> UInt8[np.ndarray, " P"]:
        """Material of each point, chosen as in segmentations; 255 where nothing is seen, whose abundances are 0."""
        scores = self.materials.scores_of(self.diffuse, self.abundances)
        return material_ids(scores, self.abundances.sum(dim=-1)).numpy()

    @property
    def palette(self) -> Float64[np.ndarray, "K 3"]:
        """sRGB colours that stand for the materials."""
        return endmember_colours(self.materials)

    def properties(self) -> dict[str, np.ndarray]:
        """red, green, blue (uint8), material (uint8) and `abundance_NAME` (float32) of each point."""
        colours = np.round(255 * self.srgb).astype(np.uint8)
        named = {name: colours[:, axis] for axis, name in enumerate(("red", "green", "blue"))}
        shares = self.abundances.numpy().astype(np.float32)
        columns = {name: shares[:, index] for index, name in enumerate(property_names(self.materials.names))}
        return {**named, "material": self.material_ids, **columns}

    def comments(self, what: str) -> list[str]:
        """What a file says of itself."""
        colours = describe_colour(self.materials.bands)
        materials = [f"material id {index}: {name}" for index, name in enumerate(self.materials.names)]
        return [
            what,
            f"coordinates: world of the given poses, or of transforms.json if they were estimated; {colours}",
            describe_scale(self.scale),
            *materials,
        ]


def property_names(names: tuple[str, ...]) -> list[str]:
    """Names of abundances as formats without spaces take them, all different even without capitals.

    >>> property_names(("red clay", "red-clay", "leaf"))
    ['abundance_red_clay', 'abundance_red_clay_1', 'abundance_leaf']
    """
    plain = [re.sub(r"[^0-9A-Za-z]+", "_", name).strip("_") or str(index) for index, name in enumerate(names)]
    return numbered_apart(f"abundance_{name}" for name in plain)
