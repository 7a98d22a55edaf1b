"""A scene whose field is known exactly: a hollow ball, its upper half of one material and its lower half of another."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.factories.cameras import cameras_at
from tests.factories.models import make_model, scene_of
from tests.factories.scenes import look_at
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.field import CoefficientField
from unmix_plugin.light.lamp import Lamp, MovingLamp
from unmix_plugin.light.shading import Lamplight
from unmix_plugin.settings import RendererConfig
from unmix_plugin.trained.surface import SeenSurface
from unmix_plugin.trained.trained_scene import TrainedScene

RADIUS, INNER_RADIUS = 0.6, 0.35
DENSITY = 300.0
SHADE = 0.8
EDGE = 0.004


class BallField(CoefficientField):
    """Matter between two spheres around the origin; and, if asked for, a wall behind it and gloss."""

    def __init__(self, has_wall: bool = False, gloss: float | None = None) -> None:
        super().__init__()
        self.has_wall, self.gloss = has_wall, gloss

    def encode(self, positions: Tensor, known: Tensor | None = None) -> Tensor:
        return positions if known is None else known

    def get_density(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        return self.density_of(positions)

    def density_of(self, encoded: Tensor) -> tuple[Tensor, Tensor]:
        """A density that rises steeply at the spheres."""
        radius = encoded.norm(dim=-1)
        solid = torch.sigmoid((RADIUS - radius) / EDGE) * torch.sigmoid((radius - INNER_RADIUS) / EDGE)
        if self.has_wall:
            solid = torch.maximum(solid, torch.sigmoid((encoded[:, 0] - 0.8) / EDGE))
        return DENSITY * solid, encoded

    def abundances_of(self, features: Tensor) -> Tensor:
        """Endmember 0 above the equator, 1 below it, never 2."""
        above = (features[:, 2] > 0).float()
        return torch.stack([above, 1 - above, torch.zeros_like(above)], dim=-1)

    def get_outputs(
        self, positions: Tensor, directions: Tensor, features: Tensor, light: Lamplight | None = None
    ) -> dict[str, Tensor]:
        """The same shade everywhere; gloss where one looks from straight above."""
        abundances = self.abundances_of(features)
        specular = features.new_zeros(len(features), 0)
        if self.gloss is not None:
            cosines = (torch.nn.functional.normalize(features, dim=1) * directions).sum(dim=1, keepdim=True)
            specular = self.gloss * cosines**2
        mixture = {"abundances": abundances, "scaled_abundances": SHADE * abundances}
        return {**mixture, "specular_coefficients": specular}


def ball_scene(has_wall: bool = False, gloss: float | None = None, **settings: Any) -> TrainedScene:
    """A scene that renders the ball in steps of a hundredth."""
    renderer = RendererConfig(samples_per_pixel=8.7, smallest_weight=0.0)
    kind = "none" if gloss is None else "dictionary"
    model = make_model(specular=kind, num_specular_spectra=1, renderer=renderer, **settings)
    model.field = BallField(has_wall, gloss)  # type: ignore[assignment]
    return scene_of(model)


LAMPLIT_RADIUS, LAMPLIT_MIDDLE = 0.25, (0.45, 0.0, 0.0)


class LamplitBallField(BallField):
    """A matt ball beside the axis about which a lamp turns with the camera, close to it."""

    def __init__(self) -> None:
        super().__init__()
        self.lamp = MovingLamp(Lamp("turntable", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.3, 4.0)))

    @property
    def moving_lamp(self) -> MovingLamp:
        return self.lamp

    def density_of(self, encoded: Tensor) -> tuple[Tensor, Tensor]:
        radius = (encoded - torch.tensor(LAMPLIT_MIDDLE)).norm(dim=-1)
        return DENSITY * torch.sigmoid((LAMPLIT_RADIUS - radius) / EDGE), encoded

    def get_outputs(
        self, positions: Tensor, directions: Tensor, features: Tensor, light: Lamplight | None = None
    ) -> dict[str, Tensor]:
        """As bright as the lamp stands above the surface."""
        outputs = super().get_outputs(positions, directions, features, light)
        if light is not None:
            normals = torch.nn.functional.normalize(positions - torch.tensor(LAMPLIT_MIDDLE), dim=1)
            outputs["scaled_abundances"] *= (normals * light.towards).sum(dim=1, keepdim=True).clamp(min=0)
        return outputs


def lamplit_ball_scene() -> TrainedScene:
    """A scene of that ball, in which nothing casts a shadow."""
    scene = ball_scene()
    renderer = replace(scene.renderer, opaque_skips=torch.full_like(scene.renderer.skips, 8))
    return replace(scene, field=LamplitBallField(), renderer=renderer)


def cameras_around(directions: list[tuple[float, float, float]], side_px: int = 40) -> list[Cameras]:
    """Cameras that look at the origin from a distance of 3 along each direction."""
    poses = []
    for direction in directions:
        away = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
        poses.append(look_at(3 * away.numpy(), torch.zeros(3, dtype=torch.float64).numpy()))
    cameras = cameras_at(poses, side_px, side_px, focal=1.6 * side_px)
    return [cameras[index] for index in range(len(poses))]


def seen_surface(
    scene: TrainedScene, directions: list[tuple[float, float, float]], num_rays: int
) -> SeenSurface:
    """What the cameras along some directions see of a scene."""
    return SeenSurface(scene, num_rays, cameras_around(directions))


ALL_ROUND = [(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.5, 1.5)]
FROM_ABOVE = [(x, y, 1.5) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]


@contextmanager
def few_rays(num_rays: int) -> Iterator[None]:
    """Context in which a surface is looked at with so many rays, and pages have small pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("unmix_plugin.trained.surface_mesh._NUM_RAYS", num_rays)
        patch.setattr("unmix_plugin.products.page.page._PICTURE_PX", 48)
        yield
