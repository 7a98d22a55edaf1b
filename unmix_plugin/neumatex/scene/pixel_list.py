"""Pixels of training views that show the mesh and nothing else, to be drawn evenly.

Notation: `M` pixels, `R` of them drawn, `C` colours or bands.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.scene.object_scene import ObjectScene
from unmix_plugin.neumatex.scene.posed_pictures import opacity

OPAQUE = 0.99
"""Alpha from which a pixel shows the object alone."""
_CORNERS = ((0.02, 0.02), (0.98, 0.02), (0.02, 0.98), (0.98, 0.98), (0.5, 0.5))
"""Where in a pixel the mesh has to be seen, so that every place in it sees it."""


@dataclass(frozen=True)
class DrawnPixels:
    """Pixels of a batch."""

    views: Int[Tensor, " R"]
    """Which training view."""
    places: Float[Tensor, "R 2"]
    """A random place in each pixel, x and y in pixels of the view."""
    numbers: Float[Tensor, "R C"]
    """As the picture holds them."""


@dataclass(frozen=True)
class PixelList:
    """Pixels by view and place."""

    views: Int[Tensor, " M"]
    corners: Int[Tensor, "M 2"]
    """Column and row."""
    numbers: Float[Tensor, "M C"]

    @staticmethod
    def of(scene: ObjectScene, most: int, seed: int) -> PixelList:
        """Read the training views; of more pixels than `most`, so many are drawn.

        Raises:
            SceneError: no view shows the mesh.
        """
        ray_mesh, parts = RayMesh(scene.mesh), []
        generator = torch.Generator().manual_seed(seed)
        share = most // len(scene.split.train) + 1
        for row, view in enumerate(scene.split.train):
            picture = scene.pictures.read(view)
            shown = torch.from_numpy(opacity(picture) >= OPAQUE) & sees_mesh(ray_mesh, scene, view)
            rows, columns = shown.nonzero(as_tuple=True)
            if len(rows) > share:
                kept = torch.randperm(len(rows), generator=generator)[:share]
                rows, columns = rows[kept], columns[kept]
            numbers = torch.from_numpy(picture.numbers)[rows, columns]
            parts.append((torch.full_like(rows, row), torch.stack([columns, rows], dim=-1), numbers))
        found = PixelList(*(torch.cat(values) for values in zip(*parts, strict=True)))
        if not len(found.views):
            raise SceneError(f"{scene.root}: no training view shows the mesh and opaque alpha in one pixel")
        return found

    def draw(self, count: int, generator: torch.Generator) -> DrawnPixels:
        """Random pixels, each as likely as any other."""
        chosen = torch.randint(len(self.views), (count,), generator=generator)
        places = self.corners[chosen] + torch.rand(count, 2, generator=generator)
        return DrawnPixels(self.views[chosen], places, self.numbers[chosen])


def sees_mesh(ray_mesh: RayMesh, scene: ObjectScene, view: int) -> Bool[Tensor, "H W"]:
    """Pixels of a view that the mesh covers."""
    camera = scene.pictures.cameras[view].to(ray_mesh.device)
    seen = torch.ones(camera.height * camera.width, dtype=torch.bool)
    for place in _CORNERS:
        rays = camera.image_rays(0, place)
        seen &= ray_mesh.closest(rays.origins, rays.directions).found.cpu()
    return seen.reshape(camera.height, camera.width)
