"""The one probe: the spectrum that a scene shows in a pixel, or has at a point, and what it is made of.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.protocol import Probe

if TYPE_CHECKING:
    from unmix_plugin.trained.trained_scene import TrainedScene


@torch.no_grad()
def probe_pixel(scene: TrainedScene, camera: Cameras, pixel: tuple[int, int]) -> Probe:
    """What is seen in a pixel (column, row), as a render of the whole view has it: radiance on black.

    Raises:
        ConfigError: the pixel is outside the image.
    """
    one = one_pixel(camera, *pixel).to(scene.device)
    found, materials = scene.look(one).coefficients.flatten(), scene.materials
    opacity = float(found.accumulation)
    diffuse, specular = materials.diffuse(found), materials.specular(found)
    place = None
    if opacity > 0:
        rays = one.image_rays(0)
        place = _row(rays.origins + found.ray_distance[:, None] * rays.directions)
    return Probe(
        {
            "predicted": _row(diffuse + specular),
            "diffuse": _row(diffuse),
            "specular": _row(specular),
            "abundances": _row(found.abundances) / max(opacity, 1e-6),
            "scaled_abundances": _row(found.scaled_abundances),
        },
        opacity,
        place,
        None if place is None else scene.frame.to_world(place[None])[0],
    )


@torch.no_grad()
def probe_point(scene: TrainedScene, point: tuple[float, float, float]) -> Probe:
    """What a point of the world is made of: its spectrum, lit squarely where the light moves with the camera, without
    the view-dependent part.

    Raises:
        ConfigError: the point is outside the scene box.
    """
    world = np.array(point, dtype=np.float64)
    place = scene.frame.to_model(world)
    inside = torch.from_numpy(place).float()[None].to(scene.device)
    if not bool(scene.scene_box.contains(inside).all()):
        corners = np.stack(np.meshgrid(*scene.scene_box.aabb.T.cpu().double().numpy()), -1).reshape(-1, 3)
        world_corners = scene.frame.to_world(corners)
        least, greatest = world_corners.min(axis=0), world_corners.max(axis=0)
        raise ConfigError(
            f"the point {_text(world)} is outside the scene box, which lies between {_text(least)} and "
            f"{_text(greatest)} of the world"
        )
    density, features = scene.field.get_density(inside)
    none = torch.zeros(1, dtype=torch.int64, device=scene.device)
    here = RayBundle(inside, torch.zeros_like(inside), none)
    normals = scene.renderer.normals(scene.field, here, inside.new_zeros(1))
    outputs = scene.field.get_outputs(inside, -normals, features)
    is_there = scene.renderer.is_occupied(inside).to(density)
    predicted = is_there[:, None] * (outputs["scaled_abundances"] @ scene.materials.endmembers)
    return Probe(
        {
            "predicted": _row(predicted),
            "abundances": _row(is_there[:, None] * outputs["abundances"]),
            "scaled_abundances": _row(is_there[:, None] * outputs["scaled_abundances"]),
        },
        float(is_there * -torch.expm1(-density * scene.pixel_size)),
        place,
        world,
    )


def one_pixel(camera: Cameras, column: int, row: int) -> Cameras:
    """A view of one pixel of an image: what is rendered of it is that pixel.

    Raises:
        ConfigError: the pixel is outside the image.
    """
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise ConfigError(
            f"pixel {column},{row} (column, row) is outside the image; "
            f"columns are 0 to {camera.width - 1}, rows 0 to {camera.height - 1}"
        )
    return camera.crop(column, row, 1, 1)


def _row(values: Tensor) -> Float64[np.ndarray, " n"]:
    return values.detach().reshape(-1).double().cpu().numpy()


def _text(point: Float64[np.ndarray, "3"]) -> str:
    return ",".join(f"{value:.9g}" for value in point)
