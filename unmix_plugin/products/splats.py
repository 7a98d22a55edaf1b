"""Gaussians that look like the run, for viewers of splats: their fit is `splat_fit`, their files are made here.

Notation: `P` Gaussians.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.meshes import Gaussians, least_turns, write_splats_glb, write_splats_ply
from unmix_plugin.products.mesh import gltf_content, say_units
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Splats
from unmix_plugin.products.splat_fit import fit_splats, seen_splats, start_splats
from unmix_plugin.trained.run_views import positions_for_files, world_up
from unmix_plugin.trained.surface import SurfaceAppearance
from unmix_plugin.trained.surface_mesh import TriangleMesh

_BYTES = 4 * (14 + 1)
"""Of a Gaussian in PLY, with its material, before abundances of 4 bytes each."""
_MEGABYTES, _MOST_STEPS = (0.01, 1000.0), 100_000
_WHAT = "Gaussians fitted to an unmix-nerf run"


def export(job: Job, asked: Splats) -> list[Path]:
    """Find the surface, fit Gaussians that start on it, and write those that are seen."""
    low, high = _MEGABYTES
    if not low <= asked.megabytes <= high:
        raise ConfigError(f"--megabytes is {asked.megabytes:g}; choose {low:g} to {high:g}")
    if not 0 <= asked.steps <= _MOST_STEPS:
        raise ConfigError(f"--steps is {asked.steps}; choose 0 to {_MOST_STEPS}")
    paths = {kind: job.folder / f"splats.{kind}" for kind in asked.formats}
    job.claim(list(paths.values()))
    scene, frame, materials = job.scene, job.frame, job.materials.to("cpu")
    count = int(1e6 * asked.megabytes / (_BYTES + 4 * len(materials.names)))
    fitted = start_splats(scene, count, job.follow)
    if asked.steps > 0:
        generator = torch.Generator().manual_seed(0)
        fitted = fit_splats(scene, fitted, asked.steps, generator, job.follow)
    fitted, seen = seen_splats(scene, fitted, job.follow)

    looks = SurfaceAppearance(materials, seen.abundances, materials.spectra(seen), scene.scale)
    places = frame.to_world(fitted.positions.double().numpy())
    no_faces = np.zeros((0, 3), dtype=np.int64)
    positions, numbers, extras = gltf_content(
        TriangleMesh(positions_for_files(places), no_faces), looks, _WHAT
    )
    to_world = Rotation.from_matrix(frame.rotation.T)
    splats = Gaussians(
        positions,
        (to_world * Rotation.from_quat(fitted.rotations.numpy())).as_quat().astype(np.float32),
        fitted.log_scales.exp().numpy() / np.float32(frame.scale),
        fitted.srgb.numpy(),
        torch.sigmoid(fitted.opacity_logits).clamp(max=1 - 1e-6).numpy(),
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
    turn = Rotation.from_quat(least_turns(up, np.array([0.0, -1.0, 0.0])))
    return replace(
        splats,
        positions=turn.apply(splats.positions).astype(np.float32),
        rotations=(turn * Rotation.from_quat(splats.rotations)).as_quat().astype(np.float32),
    )
