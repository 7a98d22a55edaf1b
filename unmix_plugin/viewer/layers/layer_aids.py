"""What layers need to know of the run beside the view itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.viewer.rendering.reference import Reference

_MOST_REMEMBERED = 32
_ValueT = TypeVar("_ValueT")

ErrorOf = Callable[[MaterialView], tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"], str]]
"""A view's error against the nearest training view, where it is known, and that view's name."""


@dataclass(frozen=True)
class LayerAids:
    """What layers need to know of the run."""

    reference: Reference
    scene_box: SceneBox
    error_of: ErrorOf | None = None
    why_no_error: str = "the scene is not at hand"
    _kept: dict[tuple[str, bytes], Any] = field(default_factory=dict, repr=False, compare=False)

    def colours_of(self, materials: Materials) -> Float[Tensor, "K 3"]:
        """sRGB colours that stand for the materials, as in all pictures of a run."""
        return self._remembered(
            "colours",
            materials,
            lambda: torch.as_tensor(endmember_colours(materials)).to(materials.endmembers),
        )

    def pca_of(self, materials: Materials) -> PcaColours:
        """Principal components of what the reference rays show with the materials."""
        return self._remembered("pca", materials, lambda: PcaColours.fit(self.reference.spectra(materials)))

    def depth_range(self, frame: MaterialView) -> tuple[float, float]:
        """Distances between which the scene box lies, world units."""
        aabb, scale = self.scene_box.aabb.cpu(), frame.scene.frame.scale
        middle, radius = aabb.mean(dim=0), float((aabb[1] - aabb[0]).norm()) / 2
        distance = float((frame.camera.camera_to_world[0, :, 3].cpu() - middle).norm())
        return (max(0.0, distance - radius) / scale, (distance + radius) / scale)

    def _remembered(self, what: str, materials: Materials, make: Callable[[], _ValueT]) -> _ValueT:
        """What `make` gives, kept for the materials that clients look at."""
        spectra = torch.cat([materials.endmembers, materials.specular_spectra])
        key = (what, spectra.cpu().numpy().tobytes())
        found = self._kept.get(key)  # looked up once: another thread may clear what is kept at any moment
        if found is None:
            if len(self._kept) >= _MOST_REMEMBERED:
                self._kept.clear()
            found = self._kept[key] = make()
        return found
