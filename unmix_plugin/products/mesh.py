"""The scene's surface as triangles (PLY, glTF, OBJ): marching cubes through the density, trimmed to what cameras see.

The surface is where the density is that rays end at, softened a little since the field is trained on images and not
on surfaces. What no camera sees (insides, undersides) was never learnt: it is taken for solid and its surfaces are cut
away unless asked for, and so are stray pieces.

Notation: `V` vertices, `F` faces.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int

from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.formats.files import grey_png_bytes, indexed_png_bytes, rgba_png_bytes, write_file
from unmix_plugin.formats.meshes import obj_paths, write_glb, write_obj, write_ply
from unmix_plugin.products.atlas import Atlas, texels_of, unwrap
from unmix_plugin.products.product import Job
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.run_views import directions_to_world, positions_for_files, views_of, world_up
from unmix_plugin.trained.surface import (
    GridPoints,
    SeenSurface,
    SurfaceAppearance,
    SurfacePoints,
    look_at,
    look_from_above,
    may_be_solid,
    property_names,
    sample_densities,
    sample_slice,
)
from unmix_plugin.trained.trained_scene import TrainedScene

_END_QUANTILE = 0.07
"""Rays end inside what they hit: this part of them where the density is still lower than at the surface."""

_MOST_MOVED = 3.0
"""Pixels that a vertex is moved at most: deeper, a ray from above went through a hole."""
_RINGS = 3
"""Neighbours over which the way that vertices are moved is smoothed."""

_AREA_RINGS = 4
"""The same of normals, along which areas are taken."""

_HEALED_RINGS = 3
"""Gaps of this many vertices between what is seen are not cut: two cameras rarely agree at an edge."""

_SMALLEST_PART = 0.01
"""Pieces with fewer faces than this, relative to the largest, are stray."""

_LEAST_FACES = 8
"""So are pieces of fewer than these, where there is a larger one."""


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles that are seen from the side on which their corners go round counter-clockwise."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def select(self, chosen: Bool[np.ndarray, " F"]) -> TriangleMesh:
        """Some of the faces, and the vertices that they have."""
        faces = self.faces[chosen]
        used, renumbered = np.unique(faces, return_inverse=True)
        return TriangleMesh(self.vertices[used], renumbered.reshape(faces.shape))

    def smoothed(self, values: Float[np.ndarray, " V"], rings: int) -> Float64[np.ndarray, " V"]:
        """Numbers of vertices, each replaced as often as `rings` by the mean of itself and its neighbours."""
        links = _links(self)
        links.data[:] = 1.0  # an edge counts once, however many faces have it
        counts = 1 + np.asarray(links.sum(axis=1)).ravel()
        for _ in range(rings):
            values = (values + links @ values) / counts
        return values.astype(np.float64)

    @property
    def normals(self) -> Float[np.ndarray, "V 3"]:
        """Unit normals of the vertices: means over their faces, weighted by area."""
        a, b, c = self.vertices[self.faces].swapaxes(0, 1)
        across = np.cross(b - a, c - a)
        sums = np.zeros_like(self.vertices)
        for corner in self.faces.T:
            np.add.at(sums, corner, across)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1.0), [0.0, 0.0, 1.0])

    def areas(self) -> Float64[np.ndarray, " F"]:
        """Of the faces, as large as they are seen along the smoothed normal: rough surfaces of short trainings have
        more area than what they stand for."""
        smooth = np.stack([self.smoothed(axis, _AREA_RINGS) for axis in self.normals.T], axis=1)
        along = smooth[self.faces].sum(axis=1)
        along /= np.linalg.norm(along, axis=1, keepdims=True).clip(min=1e-12)
        a, b, c = self.vertices[self.faces].swapaxes(0, 1)
        return np.maximum((np.cross(b - a, c - a) * along).sum(axis=1) / 2, 0.0)


def _surface_density(scene: TrainedScene, ends: SurfacePoints) -> float:
    """Density per model unit at which the surface lies, from the densities where rays end."""
    densities = sample_densities(scene, ends.positions)
    densities = densities[densities > 0]
    if len(densities) == 0:
        raise RunError(
            "no ray of the run's cameras ends on a surface: train longer, or there is nothing to export"
        )
    return float(np.quantile(densities.double().numpy(), _END_QUANTILE))


def _extract_mesh(
    densities: Float32[np.ndarray, "X Y Z"],
    grid: GridPoints,
    threshold: float,
    softness: float,
    pixel_size: float,
) -> TriangleMesh:
    """Marching cubes where the density passes a threshold.

    The cubes go through the opacity of a pixel's length rather than the density itself, which differs by many orders
    of magnitude between neighbours.

    Source:
        Lewiner et al. 2003, as in scikit-image.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    opacities = np.pad(-np.expm1(-densities.astype(np.float64) * pixel_size), 1)
    if softness > 0:
        opacities = gaussian_filter(opacities, softness, mode="constant")
    level = -math.expm1(-threshold * pixel_size)
    if not opacities.min() < level < opacities.max():
        raise ConfigError(
            f"no surface: the greatest density on the grid is {densities.max() / threshold:.3g} times "
            "the density asked for; choose a lower --density or a finer --resolution"
        )
    vertices, faces, _, _ = marching_cubes(opacities, level, gradient_direction="ascent")
    # The padding put the grid's first point at index 1.
    return TriangleMesh((vertices.astype(np.float64) - 1) * grid.cell + grid.origin, faces.astype(np.int64))


def _filled(
    densities: Float32[np.ndarray, "X Y Z"], grid: GridPoints, scene: TrainedScene, surface: SeenSurface
) -> Float32[np.ndarray, "X Y Z"]:
    """Densities with what no camera sees into as solid as the densest point, so that surfaces have no inner side."""
    result, solid = densities.copy(), densities.max()
    for index in range(len(result)):
        points = grid.slice_points(index)
        unknown = torch.from_numpy(result[index] == 0)
        unknown[unknown.clone()] = may_be_solid(scene, points[unknown])
        unknown[unknown.clone()] = surface.hides(points[unknown])
        result[index][unknown.numpy()] = solid
    return result


def _trim_unseen(mesh: TriangleMesh, surface: SeenSurface) -> TriangleMesh:
    """The parts of a mesh that the cameras see, with small gaps left whole."""
    seen = surface.shows(torch.from_numpy(mesh.vertices).float()).numpy()
    links = _links(mesh)
    for _ in range(_HEALED_RINGS):
        seen = seen | np.asarray(links @ seen.astype(np.float64) > 0)
    return mesh.select(np.all(seen[mesh.faces], axis=1, keepdims=False))


def _without_stray_pieces(mesh: TriangleMesh) -> TriangleMesh:
    """The pieces of a mesh, each joined by common edges, that have a hundredth of the faces of the largest or more."""
    if len(mesh.faces) == 0:
        return mesh
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.faces)
    ends = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, edges = np.unique(ends[:, 0] * len(mesh.vertices) + ends[:, 1], return_inverse=True)
    # Each face is joined to its edges, which are numbered after the faces.
    sides = (np.ones(len(edges)), (np.repeat(np.arange(count), 3), count + edges))
    size = count + int(edges.max()) + 1
    _, piece = connected_components(coo_matrix(sides, shape=(size, size)), directed=False)
    sizes = np.bincount(piece[:count])
    smallest = max(_SMALLEST_PART * float(sizes.max()), min(_LEAST_FACES, sizes.max()))
    return mesh.select(np.asarray(sizes[piece[:count]] >= smallest))


def _links(mesh: TriangleMesh):  # noqa: ANN202 - a sparse matrix of scipy, which is imported here only
    """Symmetric matrix (V, V) that is not 0 where an edge joins two vertices."""
    from scipy.sparse import coo_matrix

    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    both = np.concatenate([edges, edges[:, ::-1]])
    count = len(mesh.vertices)
    return coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()


@torch.no_grad()
def _where_rays_end(scene: TrainedScene, mesh: TriangleMesh) -> TriangleMesh:
    """The mesh with its vertices moved along their normals to where rays from above end on average.

    A surface of equal density lies up to a pixel before that, and seen aslant what is on it would be beside its place.
    """
    normals = mesh.normals
    positions, along = (torch.from_numpy(values).float() for values in (mesh.vertices, -normals))
    found = look_at(scene, positions, along)
    depths = (found.ray_distance - scene.pixel_size) * (found.accumulation > OCCUPIED_ACCUMULATION)
    most = _MOST_MOVED * scene.pixel_size
    moved = mesh.smoothed(depths.clamp(-most, most).double().cpu().numpy(), _RINGS)
    return TriangleMesh(mesh.vertices - moved[:, None] * normals, mesh.faces)


_MOST_SMOOTHING = 8.0
_NUM_RAYS = 300_000
"""Rays that tell what of the surface is seen."""


def export_mesh(
    job: Job,
    formats: Sequence[str],
    resolution: int,
    density: float | None,
    smoothing: float,
    keeps_unseen: bool,
    up: Literal["y", "z"] = "y",
    texture_size: int | None = 0,
) -> list[Path]:
    """Sample the density, march through it, trim and colour the surface.

    Args:
        job: The run and where to write.
        formats: Of `ply`, `glb`, `obj`.
        resolution: Cells along the longest edge of the scene box.
        density: Per world unit at which the surface lies; None: that at which rays end.
        smoothing: Standard deviation of the blur, cells.
        keeps_unseen: Whether surfaces that no camera sees stay.
        up: What is up in GLB; `z` turns nothing.
        texture_size: Texels along the edges of the textures of GLB and OBJ; 0: none, None: as many as the charts need.
    """
    _require_sound(density, smoothing)
    if texture_size is None and importlib.util.find_spec("xatlas") is None:
        texture_size = 0
        job.say("no textures, since xatlas is not installed: GLB and OBJ have colours of vertices")
    names = job.materials.names if texture_size != 0 and {"glb", "obj"} & set(formats) else None
    job.claim(_mesh_paths(job.folder, formats, names))
    mesh, threshold = find_surface(job, resolution, density, smoothing, keeps_unseen)
    textures = None
    if names is not None:
        with job.working("making textures"):
            textures = _textures(job.scene, mesh, texture_size)
        job.say(f"textures of {textures.size} x {textures.size} texels")
    with job.working("making the mesh"):
        written = _write_mesh(job.folder, formats, mesh, job.scene, job.frame, up, textures)
    job.say(
        f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, "
        f"at a density of {threshold * job.frame.scale:.4g} per world unit"
    )
    if "glb" in formats:
        say_units(job, "mesh.glb")
    return written


def say_units(job: Job, file: str) -> None:
    """Say what lengths in a glTF file are: metres, as it prescribes, only where the run has a scale."""
    scale = job.loaded.scale
    unknown = "in units of the scene, of unknown size, where glTF has metres: unmix-export scale sets one"
    job.say(f"lengths in {file} are {unknown if scale is None else f'in metres: {scale.said}'}")


def find_surface(
    job: Job,
    resolution: int,
    density: float | None = None,
    smoothing: float = 1.0,
    keeps_unseen: bool = False,
) -> tuple[TriangleMesh, float]:
    """The surface in model space, and the density per model unit at which it lies; arguments as in `export_mesh`.

    Raises:
        ConfigError: nothing is as dense as was asked for.
        RunError: no camera of the run sees a surface.
    """
    return surface_of(
        job.scene, resolution, density, smoothing, keeps_unseen, follow=job.follow, working=job.working
    )


def surface_of(
    scene: TrainedScene,
    resolution: int,
    density: float | None = None,
    smoothing: float = 1.0,
    keeps_unseen: bool = False,
    follow: Callable[[str, Sequence[Any]], Iterable[Any]] = lambda _doing, items: items,
    working: Callable[[str], AbstractContextManager[None]] = lambda _doing: nullcontext(),
) -> tuple[TriangleMesh, float]:
    """`find_surface` of a scene alone; `follow` and `working` show how far it is."""
    cameras = [view.camera for view in views_of(scene.views, "all")]
    surface = SeenSurface(scene, _NUM_RAYS, cameras)
    for camera in follow("looking at the surface", cameras):
        surface.look(camera)
    grid = GridPoints.over(scene.scene_box.aabb, resolution)
    slices = follow("sampling the density", range(grid.shape[0]))
    densities = np.stack([sample_slice(scene, grid.slice_points(index))[0] for index in slices])
    with working("finding the surface"):
        ends = surface.points()
        threshold = _surface_density(scene, ends) if density is None else density / scene.frame.scale
        solid = densities if keeps_unseen else _filled(densities, grid, scene, surface)
        mesh = _extract_mesh(solid, grid, threshold, smoothing, scene.pixel_size)
        if density is None:
            mesh = _where_rays_end(scene, mesh)
        mesh = _without_stray_pieces(mesh if keeps_unseen else _trim_unseen(mesh, surface))
    return _not_empty(mesh), threshold


def _not_empty(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh; a RunError where nothing is left of it."""
    if len(mesh.faces) == 0:
        raise RunError(
            "nothing is left of the surface: no camera of the run sees it; keep it with --unseen keep"
        )
    return mesh


def _mesh_paths(folder: Path, formats: Sequence[str], textured: Sequence[str] | None = None) -> list[Path]:
    """Files that `_write_mesh` makes; `textured` are the names of the materials if there are textures."""
    paths = [path for kind in formats for path in _paths(folder, kind)]
    if textured is not None and "obj" in formats:
        names = ("colour", "segmentation", *property_names(tuple(textured)))
        paths += [_texture_path(folder, name) for name in names]
    return paths


def _texture_path(folder: Path, name: str) -> Path:
    return folder / f"mesh_{name}.png"


_TEXTURE_SIZES = (1024, 2048, 4096)
"""Tried one after the other until the charts fit."""
_TEXTURE_BOUNDS = (16, 8192)
_TEXELS = 1 << 16
"""Looked at together."""


@dataclass(frozen=True)
class _Textures:
    """Texture coordinates of a mesh, and what its surface looks like at every texel."""

    atlas: Atlas
    size: int
    pictures: dict[str, bytes]
    """PNG: `colour` (sRGB), `segmentation` (ids with a palette), `abundance_NAME` of each material (8 bits)."""


def _textures(scene: TrainedScene, mesh: TriangleMesh, size: int | None) -> _Textures:
    """Unwrap the mesh and look at the surface from straight above each texel.

    Raises:
        ConfigError: xatlas is not installed, or the charts don't fit into a texture of the size asked for.
    """
    low, high = _TEXTURE_BOUNDS
    if size is not None and not low <= size <= high:
        raise ConfigError(f"--texture-size is {size}; choose {low} to {high} texels, or 0 for no textures")
    atlas, size = _unwrapped(mesh, _TEXTURE_SIZES if size is None else (size,))
    texels, corners = texels_of(atlas, size), atlas.vertices[atlas.faces]
    positions = torch.from_numpy(texels.of_corners(mesh.vertices, corners)).float()
    normals = torch.from_numpy(texels.of_corners(mesh.normals, corners)).float()
    normals = torch.nn.functional.normalize(normals, dim=1)
    colours, ids, shares = [], [], []
    for part in torch.arange(len(positions)).split(_TEXELS):
        looks = SurfaceAppearance(scene.materials, *look_from_above(scene, positions[part], normals[part]))
        colours.append(np.round(255 * looks.srgb).astype(np.uint8))
        ids.append(looks.material_ids)
        shares.append(np.round(255 * looks.abundances.numpy()).astype(np.uint8))
    share_pictures = texels.texture(np.concatenate(shares))
    names, palette = scene.materials.names, endmember_colours(scene.materials)
    id_picture = texels.texture(np.concatenate(ids)[:, None])[..., 0]
    pictures = {
        "colour": rgba_png_bytes(texels.texture(np.concatenate(colours)), "diffuse colour, sRGB"),
        "segmentation": indexed_png_bytes(id_picture, palette, description="material of each texel"),
    }
    for index, name in enumerate(property_names(names)):
        about = f"share of {names[index]}: 0 to 255 are 0 to 1"
        shown = np.ascontiguousarray(share_pictures[..., index])
        pictures[name] = grey_png_bytes(shown, about)
    return _Textures(atlas, size, pictures)


def _unwrapped(mesh: TriangleMesh, sizes: Sequence[int]) -> tuple[Atlas, int]:
    """Charts in the smallest texture that they fit into."""
    for size in sizes[:-1]:
        with suppress(ConfigError):
            return unwrap(mesh.vertices, mesh.faces, size), size
    return unwrap(mesh.vertices, mesh.faces, sizes[-1]), sizes[-1]


def _require_sound(density: float | None, smoothing: float) -> None:
    """Refuse impossible settings."""
    if density is not None and not 0 < density < math.inf:
        raise ConfigError(f"--density is {density:g}; it must be greater than 0")
    if not 0 <= smoothing <= _MOST_SMOOTHING:
        raise ConfigError(f"--smoothing is {smoothing:g}; choose 0 to {_MOST_SMOOTHING:g} cells")


def _write_mesh(
    folder: Path,
    formats: Sequence[str],
    mesh: TriangleMesh,
    scene: TrainedScene,
    frame: Normalisation,
    up: Literal["y", "z"] = "y",
    textures: _Textures | None = None,
) -> list[Path]:
    """Write a mesh with the colour, material and abundances of each vertex, seen from straight above it.

    PLY carries all of it; glTF positions, normals, colours (linear), `_MATERIAL` and abundances; OBJ positions,
    normals, colours (sRGB) and the material of each face. Textures, if any, replace the colours of glTF and lie beside
    an OBJ. Large coordinates are float64 in PLY and OBJ; glTF has them less `offset` in the extras of its mesh, in the
    world's units; its node makes them metres where the scene has a scale.
    """
    normals = mesh.normals
    positions = torch.from_numpy(mesh.vertices).float()
    seen = look_from_above(scene, positions, torch.from_numpy(normals).float())
    looks = SurfaceAppearance(scene.materials, *seen, scale=scene.scale)
    world = TriangleMesh(positions_for_files(frame.to_world(mesh.vertices)), mesh.faces)
    turned = directions_to_world(frame, normals).astype(np.float32)
    glb = partial(
        _write_glb,
        up=world_up(scene.views, frame) if up == "y" else np.array([0.0, 1.0, 0.0]),
        textures=textures,
    )
    writers = {"ply": _write_ply, "obj": partial(_write_obj, textures=textures), "glb": glb}
    return [path for kind in formats for path in writers[kind](_paths(folder, kind)[0], world, turned, looks)]


_WHAT = "surface of an unmix-nerf run"


def _write_ply(
    path: Path, mesh: TriangleMesh, normals: Float32[np.ndarray, "V 3"], looks: SurfaceAppearance
) -> list[Path]:
    vertices = {
        **{name: mesh.vertices[:, axis] for axis, name in enumerate("xyz")},
        **{f"n{name}": normals[:, axis] for axis, name in enumerate("xyz")},
        **looks.properties(),
    }
    return [write_ply(path, vertices, mesh.faces, looks.comments(_WHAT))]


def _write_obj(
    path: Path,
    mesh: TriangleMesh,
    normals: Float32[np.ndarray, "V 3"],
    looks: SurfaceAppearance,
    textures: _Textures | None,
) -> list[Path]:
    # The material that most corners of a face have, that of the first where all differ.
    corners = looks.material_ids.astype(np.int64)[mesh.faces]
    materials = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
    pictures, shown = [], None
    if textures is not None:
        for name, content in textures.pictures.items():
            pictures.append(write_file(_texture_path(path.parent, name), content))
        shown = (textures.atlas.uv, textures.atlas.faces, pictures[0].name)
    written = write_obj(
        path.with_suffix(""),
        mesh.vertices,
        normals,
        looks.srgb,
        mesh.faces,
        materials,
        looks.materials.names,
        looks.palette,
        looks.comments(_WHAT),
        shown,
    )
    return [*written, *pictures]


def _write_glb(
    path: Path,
    mesh: TriangleMesh,
    normals: Float32[np.ndarray, "V 3"],
    looks: SurfaceAppearance,
    up: Float64[np.ndarray, "3"],
    textures: _Textures | None,
) -> list[Path]:
    positions, numbers, extras = gltf_content(mesh, looks, _WHAT)
    faces, uv, pictures, colours = mesh.faces, None, None, looks.linear_rgb
    if textures is not None:
        chosen, faces, uv = textures.atlas.vertices, textures.atlas.faces, textures.atlas.uv
        positions, normals, colours = positions[chosen], normals[chosen], colours[chosen]
        numbers = {name: values[chosen] for name, values in numbers.items()}
        pictures = textures.pictures
    return [write_glb(path, positions, normals, colours, faces, numbers, extras, up, uv, pictures)]


def gltf_content(
    mesh: TriangleMesh, looks: SurfaceAppearance, what: str
) -> tuple[Float32[np.ndarray, "V 3"], dict[str, np.ndarray], dict[str, Any]]:
    """Positions as float32, which glTF has alone; numbers of vertices under names that it allows; extras."""
    numbers = {"_MATERIAL": looks.material_ids.astype(np.float32)}
    for name, values in looks.properties().items():
        if name.startswith("abundance_"):
            numbers[f"_{name.upper()}"] = values
    extras: dict[str, Any] = {"materials": list(looks.materials.names), "about": looks.comments(what)[:3]}
    if looks.scale is not None:
        extras["metres_per_unit"] = looks.scale.metres_per_unit
    vertices = mesh.vertices
    if vertices.dtype == np.float64:
        extras["offset"] = np.round(vertices.mean(axis=0)).tolist()
        vertices = vertices - extras["offset"]
    return vertices.astype(np.float32), numbers, extras


def _paths(folder: Path, kind: str) -> list[Path]:
    return obj_paths(folder / "mesh") if kind == "obj" else [folder / f"mesh.{kind}"]
