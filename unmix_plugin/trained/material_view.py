"""One rendered view of a scene of mixed materials: coefficients, from which every output follows.

Notation: `H x W` pixels, `B` bands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.spectral.materials import Coefficients, Materials

if TYPE_CHECKING:
    from unmix_plugin.trained.trained_scene import TrainedScene


@dataclass(frozen=True)
class MaterialView:
    """What one camera sees of a scene."""

    scene: TrainedScene
    """With the materials to show; the coefficients may be rendered with others on the same shapes."""
    camera: Cameras
    coefficients: Coefficients
    """(H, W, ...)."""

    @property
    def materials(self) -> Materials:
        """The spectra that the coefficients are multiplied with."""
        return self.scene.materials

    @property
    def opacity(self) -> Float[Tensor, "H W"]:
        """[0, 1]."""
        return self.coefficients.accumulation

    @property
    def coverage(self) -> Float[Tensor, "H W"]:
        """How much of a pixel shows something, [0, 1]: where the world has no end, the sky is behind all."""
        return torch.ones_like(self.opacity) if self.scene.renderer.is_unbounded else self.opacity

    @property
    def spectra(self) -> Float[Tensor, "H W B"]:
        """Radiance on black."""
        return self.materials.spectra(self.coefficients)

    @property
    def ray_distance(self) -> Float[Tensor, "H W"]:
        """Along the ray, world units; 0 where nothing is."""
        return self.coefficients.ray_distance / self.scene.frame.scale

    @property
    def depth(self) -> Float[Tensor, "H W"]:
        """Along the viewing axis, world units; 0 where nothing is."""
        camera = self.camera.to(self.coefficients.packed.device)
        rays = camera.image_rays(0)
        assert rays.axes is not None
        along_axis = (rays.directions * rays.axes).sum(dim=-1)
        return self.ray_distance * along_axis.view_as(self.opacity)

    @property
    def normals(self) -> Float[Tensor, "H W 3"]:
        """Unit vectors in world axes; 0 where nothing is."""
        scene, seen = self.scene, self.coefficients
        rays = self.camera.to(scene.device).image_rays(0)
        normals = scene.renderer.normals(scene.field, rays, seen.ray_distance.flatten())
        turned = normals @ torch.as_tensor(scene.frame.rotation, dtype=normals.dtype).to(normals)
        return turned.view(*seen.accumulation.shape, 3) * seen.is_occupied[..., None]

    def map(self, function: Callable[[Tensor], Tensor]) -> MaterialView:
        """The same view with its coefficients on another device, or of some rows."""
        return MaterialView(self.scene, self.camera, self.coefficients.map(function))

    @torch.no_grad()
    def __getitem__(self, name: str) -> Tensor:
        """An output by its name.

        Raises:
            ConfigError: there is none, or its argument can't be read.
            SpectrumError: the bands don't cover what it needs.
        """
        return self.scene.output(name).compute(self)
