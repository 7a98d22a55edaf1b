"""The surface as Gaussians, for viewers of splats: nothing is fitted, each vertex of the exported surface becomes one.

A Gaussian is flat along the surface, a tenth as thick as it is wide, and so wide that neighbours overlap without a gap:
its standard deviation is the edge of the square that has the vertex's share of the area.

Notation: `V` vertices, one Gaussian each.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from trimesh import triangles

from unmix_plugin.formats.meshes import Gaussians, least_turns, write_splats_glb, write_splats_ply
from unmix_plugin.products.mesh import gltf_content, say_units
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Splats
from unmix_plugin.trained.run_views import directions_to_world, positions_for_files, world_up
from unmix_plugin.trained.surface import SurfaceAppearance, look_at
from unmix_plugin.trained.surface_mesh import TriangleMesh, surface_of, vertex_areas

_WIDTH = 0.75
"""Standard deviation along the surface, relative to the square root of the vertex's area."""
_THICKNESS = 0.1
_OPACITY = 0.98
_WHAT = "surface of an unmix-nerf run as Gaussians"


def export(job: Job, asked: Splats) -> list[Path]:
    """Find the surface and make a Gaussian of each of its vertices."""
    paths = {kind: job.folder / f"splats.{kind}" for kind in asked.formats}
    job.claim(list(paths.values()))
    scene, frame = job.scene, job.frame
    mesh, _ = surface_of(scene, asked.resolution, follow=job.follow, working=job.working)
    with job.working("looking at the surface's points"):
        normals = mesh.normals
        seen = look_at(
            scene, torch.from_numpy(mesh.vertices).float(), torch.from_numpy(-normals).float()
        ).map(lambda packed: packed.cpu() / packed[:, :1].clamp(min=1e-6).cpu())
        materials = job.materials.to("cpu")  # gloss from straight above included
        looks = SurfaceAppearance(materials, seen.abundances, materials.spectra(seen), scene.scale)
    world = TriangleMesh(positions_for_files(frame.to_world(mesh.vertices)), mesh.faces)
    positions, numbers, extras = gltf_content(world, looks, _WHAT)
    areas = vertex_areas(triangles.area(world.vertices[mesh.faces]), mesh.faces, len(world.vertices))
    widths = _WIDTH * np.sqrt(np.maximum(areas, 0.01 * np.mean(areas)))
    splats = Gaussians(
        positions,
        least_turns(np.eye(3)[2:], directions_to_world(frame, normals)).astype(np.float32),
        np.stack([widths, widths, _THICKNESS * widths], axis=1).astype(np.float32),
        looks.srgb.astype(np.float32),
        _OPACITY,
    )
    axis = world_up(scene.views, frame) if asked.up == "y" else np.array([0.0, 1.0, 0.0])
    if "glb" in paths:
        write_splats_glb(paths["glb"], splats, numbers, extras, axis)
    if "ply" in paths:
        own = {name.lower().lstrip("_"): values for name, values in numbers.items()}
        comments = looks.comments(_WHAT)
        if "offset" in extras:
            comments.append(f"less the offset {extras['offset']}, since coordinates are large")
        if asked.up == "y":
            splats = _turned(splats, axis)
            comments.append("turned so that -y is up; --up z keeps the axes of the world")
        write_splats_ply(paths["ply"], splats, own, comments)
    job.say(f"{len(positions)} Gaussians")
    if "glb" in paths:
        say_units(job, "splats.glb")
    return list(paths.values())


def _turned(splats: Gaussians, up: Float[np.ndarray, "3"]) -> Gaussians:
    """The same with `up` turned to -y."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(least_turns(up, np.array([0.0, -1.0, 0.0])))
    return replace(
        splats,
        positions=turn.apply(splats.positions).astype(np.float32),
        rotations=(turn * Rotation.from_quat(splats.rotations)).as_quat().astype(np.float32),
    )
