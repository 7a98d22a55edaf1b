"""What layers and edits need to know of the scene beside the view itself.

Notation: `N` reference rays that end on something, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.editing import sample_seen
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.spectral.materials import Coefficients, Materials
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.mixture_view import components_of
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene, reference_rays
from unmix_plugin.viewer.rendering.scene import STEPS_KEPT, CachedByVersion, MeasuredViews, SceneSource

_MOST_REMEMBERED = 32
_EDITS_KEPT = 4
"""Edits of shapes or gloss whose reference rays are kept."""


@dataclass(frozen=True)
class LayerAids:
    """What layers need to know of the run."""

    reference: Coefficients
    """Of some rays through the whole scene, as it is edited, that stay the same while the camera moves: colour scales
    and principal axes are taken from them, so that colours mean the same from everywhere. (N, ...)."""
    reference_points: Float[Tensor, "N 3"]
    """Where the rays end, model space."""
    scene_box: SceneBox
    measured: MeasuredViews | str = "the scene is not at hand"
    """What the training views measured, or why that is unknown."""
    _kept: CachedByVersion = field(
        default_factory=lambda: CachedByVersion(_MOST_REMEMBERED), repr=False, compare=False
    )
    """Principal components, by the materials that clients look at."""

    def reference_spectra(self, materials: Materials) -> Float[Tensor, "N B"]:
        """What the rays show with the given materials, as if each ended fully on what it ended on."""
        return materials.spectra(self.reference) / self.reference.accumulation[:, None]

    def components_of(self, materials: Materials) -> PcaColours:
        """Principal components of what the reference rays show with the materials."""
        key = torch.cat([materials.endmembers, materials.specular_spectra]).cpu().numpy().tobytes()
        return self._kept.get(key, 0, lambda: components_of(materials, self.reference))

    def reference_view(self, frame: MaterialView) -> MaterialView:
        """What the reference rays show with the materials of a frame, as a view of one row."""
        return replace(frame, coefficients=self.reference.unflatten(1, len(self.reference.packed)))

    def depth_range(self, frame: MaterialView) -> tuple[float, float]:
        """Distances between which the scene box lies, world units."""
        aabb, scale = self.scene_box.aabb.cpu(), frame.scene.frame.scale
        middle, radius = aabb.mean(dim=0), float((aabb[1] - aabb[0]).norm()) / 2
        distance = float((frame.camera.camera_to_world[0, :, 3].cpu() - middle).norm())
        return (max(0.0, distance - radius) / scale, (distance + radius) / scale)


class SceneAids:
    """What layers and edits need of the scene beside the view itself: made again as training goes on."""

    def __init__(self, source: SceneSource) -> None:
        self.measured: MeasuredViews | str = "the scene is still being read"
        """What the training views measured, or why that is unknown: noted by another thread at any moment."""
        self._source = source
        self._for_layers, self._seen = CachedByVersion(_EDITS_KEPT), CachedByVersion(2)

    def for_layers(self, scene: TrainedScene) -> LayerAids:
        """What layers of a scene, unedited or edited, need. Must not be called while the device is locked."""
        record, is_training = self._source.record, self._source.device.is_training

        def make() -> LayerAids:
            with self._source.locked():
                return LayerAids(*reference_rays(scene, record.train_cameras), record.scene_box)

        # What a training has ended with is looked at for long.
        steps = STEPS_KEPT if is_training else 1
        aids = self._for_layers.get(scene.visibility, self._source.version, make, steps)
        return replace(aids, measured=self.measured)

    def see(self, scene: TrainedScene) -> Coefficients:
        """What the training cameras see of the scene, or of what edits leave of it, not long ago; called while the
        device is locked."""
        return self._seen.get(scene.visibility, self._source.version, lambda: sample_seen(scene))
