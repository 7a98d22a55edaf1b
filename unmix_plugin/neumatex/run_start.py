"""Endmembers and abundances of a run of unmix-nerf, as a start for materials on a mesh.

Notation: `N` points, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.trained.open_run import open_run
from unmix_plugin.trained.surface import look_from_above
from unmix_plugin.trained.trained_scene import TrainedScene

_LEAST_FOUND = 0.5
"""Share of points at which the run must have something."""


@dataclass(frozen=True)
class RunMaterials:
    """What a run says of materials."""

    path: Path
    scene: TrainedScene

    @staticmethod
    def open(path: Path) -> RunMaterials:
        """Of a run folder; it is read once.

        Raises:
            RunError: the run is missing or damaged.
            ConfigError: its method does not unmix spectra.
        """
        return RunMaterials(path, _scene(path))

    @property
    def num_endmembers(self) -> int:
        """K."""
        return len(self.scene.materials.endmembers)

    def reflectances(
        self, bands: Bands | None, lamp: Float64[np.ndarray, " B"], count: int
    ) -> Float[Tensor, "K B"]:
        """Endmembers over the light that they were seen in, of any brightness.

        Args:
            bands: That the run must have.
            lamp: For a run that does not know its light.
            count: How many endmembers it must have.
        Raises:
            ConfigError: other bands, or another number of endmembers.
        """
        materials = self.scene.materials
        if bands is None or materials.bands != bands:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has {materials.bands}, the pictures {bands}; they must be "
                "the same"
            )
        if self.num_endmembers != count:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has {self.num_endmembers} endmembers, num-endmembers is "
                f"{count}; leave it out"
            )
        light = torch.from_numpy(lamp).float() if materials.light is None else materials.light.cpu()
        return materials.endmembers.detach().cpu() / light.clamp(min=1e-3)

    def abundances(
        self,
        positions: Float[Tensor, "N 3"],
        normals: Float[Tensor, "N 3"],
        world_corners: Float64[np.ndarray, "4 3"],
    ) -> Float[Tensor, "N K"]:
        """Abundances at surface points, summing to 1; equal ones where the run has nothing.

        Args:
            positions, normals: In the mesh's model space.
            world_corners: Where its origin and the ends of its unit vectors are in the world.
        Raises:
            ConfigError: the run has nothing at most of the points.
        """
        origin, axes = world_corners[0], world_corners[1:] - world_corners[0]
        world = positions.cpu().double().numpy() @ axes + origin
        outwards = normals.cpu().double().numpy() @ axes @ self.scene.frame.rotation.T
        found, _ = look_from_above(
            self.scene,
            torch.from_numpy(self.scene.frame.to_model(world)).float(),
            torch.nn.functional.normalize(torch.from_numpy(outwards).float(), dim=1),
        )
        total = found.sum(dim=1, keepdim=True)
        share = float((total > _LEAST_FOUND).float().mean())
        if share < _LEAST_FOUND:
            raise ConfigError(
                f"--pipeline.model.from-run {self.path}: has something at {share:.0%} of the mesh's surface only; give "
                "a run of the same object in the same world"
            )
        usual = torch.full_like(found, 1 / found.shape[1])
        return torch.where(total > _LEAST_FOUND, found / total.clamp(min=1e-6), usual).to(positions)


@lru_cache(maxsize=1)
def _scene(path: Path) -> TrainedScene:
    return open_run(path, "cpu")
