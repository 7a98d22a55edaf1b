"""The scene of `neumatex_tracer` for Mitsuba 3, and lights and cameras of ours as Mitsuba has them."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.mesh import Mesh

_ENVIRONMENT_ROWS = 512


class Scene:
    """One mesh of one material under an environment, seen by one camera."""

    def __init__(
        self, folder: Path, mesh: Mesh, parameters: list[float], light: Environment, cameras: Cameras
    ) -> None:
        """Files that Mitsuba reads are written into a folder.

        Args:
            parameters: Of `_reference_materials.ConductorBlend`.
        """
        import drjit  # pyright: ignore[reportMissingImports] - of the extra "reference"
        import mitsuba  # pyright: ignore[reportMissingImports]

        mitsuba.set_variant("scalar_rgb")
        drjit.set_thread_count(1)
        self._mitsuba: Any = mitsuba
        solid = trimesh.Trimesh(
            mesh.vertices.numpy(), mesh.faces.numpy(), vertex_normals=mesh.normals.numpy(), process=False
        )
        solid.export(folder / "mesh.ply", vertex_normal=True)
        self._scene = mitsuba.load_dict(
            {
                "type": "scene",
                "mesh": {"type": "ply", "filename": str(folder / "mesh.ply"), "bsdf": _material(parameters)},
                "light": environment_light(mitsuba, light),
                "sensor": sensor(mitsuba, cameras),
            }
        )

    def render(self, bounces: int, paths: int) -> tuple[np.ndarray, float]:
        """Radiance (H, W, 3) and processor time in seconds."""
        integrator = self._mitsuba.load_dict(
            {"type": "path", "max_depth": bounces + 2, "rr_depth": 1000, "hide_emitters": True}
        )
        started = time.process_time()
        image = self._mitsuba.render(self._scene, integrator=integrator, spp=paths, seed=3)
        return np.array(image)[..., :3].astype(np.float64), time.process_time() - started


def environment_light(mitsuba: Any, light: Environment) -> dict[str, Any]:
    """An environment of three colours, with rows and axes as Mitsuba places them; +z is up in its scene."""
    # Its first and last row lie at the poles, its y axis is up, and it looks along -z at the middle.
    rows, columns = _ENVIRONMENT_ROWS, 2 * _ENVIRONMENT_ROWS
    polar = torch.linspace(0, math.pi, rows, dtype=torch.float64)
    azimuth = 2 * math.pi * (0.5 - (torch.arange(columns, dtype=torch.float64) + 0.5) / columns)
    polar, azimuth = torch.meshgrid(polar, azimuth, indexing="ij")
    flat = polar.sin()
    directions = torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), polar.cos()], dim=-1)
    radiance = light.radiance(directions.reshape(-1, 3).float()).reshape(rows, columns, 3)
    to_world = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    return {
        "type": "envmap",
        "bitmap": mitsuba.Bitmap(radiance.numpy()),
        "to_world": mitsuba.ScalarTransform4f(to_world),
    }


def sensor(mitsuba: Any, cameras: Cameras) -> dict[str, Any]:
    """The first camera, whose centre has to be that of its picture; with alpha."""
    pose = cameras.camera_to_world[0].double().numpy()
    origin, up, back = pose[:, 3], pose[:, 1], pose[:, 2]
    focal = float(cameras.focal_px[0, 0])
    look_at = mitsuba.ScalarTransform4f().look_at(origin.tolist(), (origin - back).tolist(), up.tolist())
    return {
        "type": "perspective",
        "fov": math.degrees(2 * math.atan(cameras.width / 2 / focal)),
        "to_world": look_at,
        "film": {
            "type": "hdrfilm",
            "width": cameras.width,
            "height": cameras.height,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
        },
    }


def _material(parameters: list[float]) -> dict[str, Any]:
    colour = {"type": "rgb", "value": parameters[:3]}
    diffuse = {"type": "diffuse", "reflectance": colour}
    conductor = {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha": parameters[3],
        "specular_reflectance": colour,
    }
    return {"type": "blendbsdf", "weight": parameters[4], "first": diffuse, "second": conductor}
