"""One pixel of a view or one point of space: the spectrum that a model predicts there, and what it is made of.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.model import UnmixModel
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.density_grid import is_rendered


@dataclass(frozen=True)
class Probe:
    """What a model says of a place."""

    spectra: dict[str, Float64[np.ndarray, " B"]]
    """`predicted`, radiance on black; of a pixel also its parts, `diffuse` and `specular`."""
    abundances: Float64[np.ndarray, " K"]
    """Of what is there, summing to 1; 0 where nothing is."""
    opacity: float
    """Of the pixel, or of a pixel's length at the point, [0, 1]."""
    world_position: Float64[np.ndarray, "3"] | None
    """Of the surface in the pixel, or of the point; None where the pixel shows nothing."""


@torch.no_grad()
def probe_pixel(model: UnmixModel, camera: Cameras, pixel: tuple[int, int], frame: Normalisation) -> Probe:
    """What is seen in a pixel, as a render of the whole view has it.

    Args:
        model: Trained.
        camera: Of the view.
        pixel: Column and row.
        frame: Of the run.
    Raises:
        ConfigError: the pixel is outside the image.
    """
    one = one_pixel(camera, *pixel)
    found, materials = model.get_image_coefficients(one), model.materials
    opacity = float(found.accumulation)
    diffuse, specular = materials.diffuse(found), materials.specular(found)
    place = None
    if opacity > 0:
        rays = one.to("cpu").image_rays(0)
        distance = float(found.distance) / opacity
        place = frame.to_world((rays.origins + distance * rays.directions).double().numpy())[0]
    return Probe(
        {"predicted": _row(diffuse + specular), "diffuse": _row(diffuse), "specular": _row(specular)},
        _row(found.abundances) / max(opacity, 1e-6),
        opacity,
        place,
    )


@torch.no_grad()
def probe_point(model: UnmixModel, point: tuple[float, float, float], frame: Normalisation) -> Probe:
    """What a point of space is made of: its spectrum as lit there, without the view-dependent part.

    Args:
        model: Trained.
        point: World coordinates.
        frame: Of the run.
    Raises:
        ConfigError: the point is outside the scene box.
    """
    world = np.array(point, dtype=np.float64)
    inside = torch.from_numpy(frame.to_model(world)).float()[None].to(model.device)
    low, high = model.renderer.aabb
    if not bool(((inside >= low) & (inside <= high)).all()):
        corners = frame.to_world(np.stack(np.meshgrid(*model.renderer.aabb.T.cpu().double().numpy()), -1))
        least, greatest = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
        raise ConfigError(
            f"the point {_text(world)} is outside the scene box, which lies between {_text(least)} and "
            f"{_text(greatest)} of the world"
        )
    density, features = model.field.get_density(inside)
    outputs = model.field.get_outputs(inside, torch.zeros_like(inside), features)
    there = is_rendered(model, inside).to(density)
    opacity = float(there * -torch.expm1(-density * float(model.metadata["pixel_size"])))
    diffuse = there[:, None] * (outputs["scaled_abundances"] @ model.materials.endmembers)
    abundances = there[:, None] * outputs["abundances"]
    return Probe({"predicted": _row(diffuse)}, _row(abundances), opacity, world)


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
    corner = camera.center_px.new_tensor([float(column), float(row)])
    return Cameras(
        camera.camera_to_world, camera.focal_px, camera.center_px - corner, camera.distortion, 1, 1
    )


def _row(values: Tensor) -> Float64[np.ndarray, " n"]:
    return values.detach().reshape(-1).double().cpu().numpy()


def _text(point: Float64[np.ndarray, "3"]) -> str:
    return ",".join(f"{value:.4g}" for value in point)
