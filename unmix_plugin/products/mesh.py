"""The scene's surface as files of triangles (PLY, glTF, OBJ), with colours of vertices and textures.

Notation: `V` vertices, `F` faces.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64

from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.paint import id_palette
from unmix_plugin.formats.files import (
    eight_bits,
    indexed_png_bytes,
    rgba_png_bytes,
    write_file,
)
from unmix_plugin.formats.meshes import (
    obj_paths,
    turn_to_y,
    turned_by,
    with_scalar_fields,
    write_glb,
    write_obj,
    write_ply,
)
from unmix_plugin.products.atlas import Atlas, texels_of, unwrap
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Mesh
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.run_views import directions_to_world, gltf_positions, positions_for_files, world_up
from unmix_plugin.trained.surface import SurfaceAppearance, look_from_above, property_names
from unmix_plugin.trained.surface_mesh import TriangleMesh, surface_of
from unmix_plugin.trained.trained_scene import TrainedScene

_MOST_SMOOTHING = 8.0


def export(job: Job, asked: Mesh) -> list[Path]:
    """Find the surface, colour it, and write it."""
    formats = asked.formats
    if not 0 <= asked.smoothing <= _MOST_SMOOTHING:
        raise ConfigError(f"--smoothing is {asked.smoothing:g}; choose 0 to {_MOST_SMOOTHING:g} pixels")
    has_textures = asked.texture_size != 0 and bool({"glb", "obj"} & set(formats))
    if asked.texture_size is None and importlib.util.find_spec("xatlas") is None:
        has_textures = False
        job.say("no textures, since xatlas is not installed: GLB and OBJ have colours of vertices")
    job.claim(_mesh_paths(job.folder, formats, job.materials.names if has_textures else None))
    keeps_unseen = asked.unseen == "keep"
    mesh, unseen = surface_of(
        job.scene, asked.resolution, asked.smoothing, keeps_unseen, follow=job.follow, working=job.working
    )
    textures = None
    if has_textures:
        with job.working("making textures"):
            textures = textures_of(job.scene, mesh, asked.texture_size)
        job.say(f"textures of {textures.size} x {textures.size} texels")
    with job.working("making the mesh"):
        written = write_mesh(job.folder, formats, mesh, job.scene, job.frame, asked.up, textures)
    fate = "is a guess that closes it" if keeps_unseen else "was cut away"
    found = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles"
    job.say(f"{found}; {unseen:.0%} of the closed surface no camera sees, which {fate}")
    if "glb" in formats:
        say_units(job, "mesh.glb")
    return written


def say_units(job: Job, file: str) -> None:
    """Say what lengths in a glTF file are: metres, as it prescribes, only where the run has a scale."""
    scale = job.loaded.scale
    unknown = "in units of the scene, of unknown size, where glTF has metres: unmix-export scale sets one"
    job.say(f"lengths in {file} are {unknown if scale is None else f'in metres: {scale.in_words}'}")


def _mesh_paths(folder: Path, formats: Sequence[str], textured: Sequence[str] | None) -> list[Path]:
    """Files that `write_mesh` makes; `textured` are the names of the materials if there are textures."""
    paths = [path for kind in formats for path in _paths(folder, kind)]
    if textured is not None and "obj" in formats:
        names = ("colour", "segmentation", *property_names(tuple(textured)))
        paths += [_texture_path(folder, name) for name in names]
    return paths


def _texture_path(folder: Path, name: str) -> Path:
    return folder / f"mesh_{name}.png"


_TEXTURE_SIZES = (1024, 2048, 4096)
"""Tried one after the other until the charts fit."""
_TEXELS = 1 << 16
"""Looked at together."""


@dataclass(frozen=True)
class Textures:
    """Texture coordinates of a mesh, and what its surface looks like at every texel."""

    atlas: Atlas
    size: int
    pictures: dict[str, bytes]
    """PNG: `colour` (sRGB), `segmentation` (ids with a palette), `abundance_NAME` of each material (8 bits)."""


def textures_of(scene: TrainedScene, mesh: TriangleMesh, size: int | None) -> Textures:
    """Unwrap the mesh and look at the surface from straight above each texel."""
    low, high = 16, 8192
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
        colours.append(eight_bits(looks.srgb))
        ids.append(looks.material_ids)
        shares.append(eight_bits(looks.abundances.numpy()))
    share_pictures = texels.texture(np.concatenate(shares))
    names = scene.materials.names
    palette = id_palette(endmember_colours(scene.materials))
    id_picture = texels.texture(np.concatenate(ids)[:, None])[..., 0]
    pictures = {
        "colour": rgba_png_bytes(texels.texture(np.concatenate(colours)), "diffuse colour, sRGB"),
        "segmentation": indexed_png_bytes(id_picture, palette, description="material of each texel"),
    }
    for index, name in enumerate(property_names(names)):
        about = f"share of {names[index]}: 0 to 255 are 0 to 1"
        pictures[name] = rgba_png_bytes(np.ascontiguousarray(share_pictures[..., index]), about)
    return Textures(atlas, size, pictures)


def _unwrapped(mesh: TriangleMesh, sizes: Sequence[int]) -> tuple[Atlas, int]:
    """Charts in the smallest texture that they fit into."""
    for size in sizes[:-1]:
        with suppress(ConfigError):
            return unwrap(mesh.vertices, mesh.faces, size), size
    return unwrap(mesh.vertices, mesh.faces, sizes[-1]), sizes[-1]


def write_mesh(
    folder: Path,
    formats: Sequence[str],
    mesh: TriangleMesh,
    scene: TrainedScene,
    frame: Normalisation,
    up: Literal["y", "z"] = "y",
    textures: Textures | None = None,
) -> list[Path]:
    """Write a mesh with the colour, material and abundances of each vertex, seen from straight above it.

    PLY carries all of it; glTF positions, normals, colours (linear), `_MATERIAL` and abundances; OBJ positions,
    normals, colours (sRGB) and the material of each face. Textures, if any, replace the colours of glTF and lie beside
    an OBJ, whose vertices are turned as glTF's node turns its mesh, since importers take y for up there, too. Large
    coordinates are float64 in PLY and OBJ; glTF has them less `offset` in the extras of its mesh, in the
    world's units; its node makes them metres where the scene has a scale.
    """
    normals = mesh.normals
    positions = torch.from_numpy(mesh.vertices).float()
    seen = look_from_above(scene, positions, torch.from_numpy(normals).float())
    looks = SurfaceAppearance(scene.materials, *seen, scale=scene.scale)
    world = TriangleMesh(positions_for_files(frame.to_world(mesh.vertices)), mesh.faces)
    turned = directions_to_world(frame, normals).astype(np.float32)
    axis = world_up(scene.views, frame) if up == "y" else np.array([0.0, 1.0, 0.0])
    written: list[Path] = []
    for kind in formats:
        path = _paths(folder, kind)[0]
        if kind == "ply":
            vertices = xyz_columns(world.vertices) | xyz_columns(turned, "n") | looks.properties()
            named, comments = with_scalar_fields(vertices, looks.comments(_WHAT))
            written.append(write_ply(path, named, world.faces, comments))
        elif kind == "obj":
            written += _write_obj(path, world, turned, looks, axis, textures)
        else:
            points, numbers, extras = gltf_content(world, looks, _WHAT)
            faces, uv, pictures, arrows, colours = world.faces, None, None, turned, looks.linear_rgb
            if textures is not None:
                chosen, faces, uv = textures.atlas.vertices, textures.atlas.faces, textures.atlas.uv
                points, arrows, colours = points[chosen], turned[chosen], colours[chosen]
                numbers = {name: values[chosen] for name, values in numbers.items()}
                pictures = textures.pictures
            written.append(
                write_glb(path, points, arrows, colours, faces, numbers, extras, axis, uv, pictures)
            )
    return written


def xyz_columns(vectors: Float[np.ndarray, "P 3"], prefix: str = "") -> dict[str, np.ndarray]:
    """Vectors as three properties of a PLY."""
    return {f"{prefix}{name}": vectors[:, axis] for axis, name in enumerate("xyz")}


_WHAT = "surface of an unmix-nerf run"


def _write_obj(
    path: Path,
    mesh: TriangleMesh,
    normals: Float32[np.ndarray, "V 3"],
    looks: SurfaceAppearance,
    up: Float64[np.ndarray, "3"],
    textures: Textures | None,
) -> list[Path]:
    turn = turn_to_y(up)
    comments = looks.comments(_WHAT)
    if not np.array_equal(turn, np.eye(3)):
        rows = "; ".join(" ".join(f"{value:.9g}" for value in row) for row in turn)
        comments.append(f"turned so that y is up: these coordinates are the world's times the matrix {rows}")
    # The material that most corners of a face have, that of the first where all differ.
    corners = looks.material_ids.astype(np.int64)[mesh.faces]
    materials = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
    pictures, shown = [], None
    if textures is not None:
        for name, content in textures.pictures.items():
            pictures.append(write_file(_texture_path(path.parent, name), content))
        shown = (textures.atlas.uv, textures.atlas.faces, pictures[0].name)
    vertices = (turned_by(turn, mesh.vertices), turned_by(turn, normals), looks.srgb)
    names, palette = looks.materials.names, looks.palette
    if (materials == NOTHING_ID).any():
        materials, names = materials.clip(max=len(names)), (*names, "nothing")
        palette = np.concatenate([palette, id_palette(())[:1]])
    named = (names, palette, comments)
    written = write_obj(path.with_suffix(""), *vertices, mesh.faces, materials, *named, shown)
    return [*written, *pictures]


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
    positions, offset = gltf_positions(mesh.vertices)
    return positions, numbers, {**extras, **offset}


def _paths(folder: Path, kind: str) -> list[Path]:
    return obj_paths(folder / "mesh") if kind == "obj" else [folder / f"mesh.{kind}"]
