"""What layers and edits need to know of the scene beside the view itself.

Notation: `N` reference rays that end on something, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.editing import sample_seen
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.spectral.materials import Coefficients, Materials
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.outputs import MaterialView
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.rendering.scene import STEPS_KEPT, CachedByVersion, MeasuredViews, SceneSource

_NUM_CAMERAS = 6
_NUM_RAYS = 6000


@torch.no_grad()
def render_reference(scene: TrainedScene, cameras: Cameras) -> tuple[Coefficients, Float[Tensor, "N 3"]]:
    """Coefficients of rays through some of the cameras, spread over all, and where the rays end, model space."""
    step, cameras = max(1, len(cameras) // _NUM_CAMERAS), cameras.one_size()
    chosen = range(0, len(cameras), step)[:_NUM_CAMERAS]
    aspect = cameras.width / cameras.height
    height = max(1, min(cameras.height, int((_NUM_RAYS / len(chosen) / aspect) ** 0.5)))
    parts, points = [], []
    for index in chosen:
        camera = cameras[index].resized(max(1, round(aspect * height)), height)
        seen = scene.look(camera, subpixels=1).coefficients.flatten()
        rays = camera.to(scene.device).image_rays(0)
        parts.append(seen.map(lambda packed, is_seen=seen.is_occupied: packed[is_seen]))
        points.append((rays.origins + seen.ray_distance[:, None] * rays.directions)[seen.is_occupied])
    return Coefficients.concatenate(parts), torch.cat(points)


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
    """Colours and principal components, by the materials that clients look at."""

    def reference_spectra(self, materials: Materials) -> Float[Tensor, "N B"]:
        """What the rays show with the given materials, as if each ended fully on what it ended on."""
        return materials.spectra(self.reference) / self.reference.accumulation[:, None]

    def colours_of(self, materials: Materials) -> Float[Tensor, "K 3"]:
        """sRGB colours that stand for the materials, as in all pictures of a run."""
        return self._kept.get(
            ("colours", _bytes_of(materials)),
            0,
            lambda: torch.as_tensor(endmember_colours(materials)).to(materials.endmembers),
        )

    def pca_of(self, materials: Materials) -> PcaColours:
        """Principal components of what the reference rays show with the materials."""
        return self._kept.get(
            ("pca", _bytes_of(materials)), 0, lambda: PcaColours.fit(self.reference_spectra(materials))
        )

    def depth_range(self, frame: MaterialView) -> tuple[float, float]:
        """Distances between which the scene box lies, world units."""
        aabb, scale = self.scene_box.aabb.cpu(), frame.scene.frame.scale
        middle, radius = aabb.mean(dim=0), float((aabb[1] - aabb[0]).norm()) / 2
        distance = float((frame.camera.camera_to_world[0, :, 3].cpu() - middle).norm())
        return (max(0.0, distance - radius) / scale, (distance + radius) / scale)


def _bytes_of(materials: Materials) -> bytes:
    return torch.cat([materials.endmembers, materials.specular_spectra]).cpu().numpy().tobytes()


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
                return LayerAids(*render_reference(scene, record.train_cameras), record.scene_box)

        # What a training has ended with is looked at for long.
        steps = STEPS_KEPT if is_training else 1
        aids = self._for_layers.get(scene.visibility, self._source.version, make, steps)
        return replace(aids, measured=self.measured)

    def see(self, scene: TrainedScene) -> Coefficients:
        """What the training cameras see of the scene, or of what edits leave of it, not long ago; called while the
        device is locked."""
        return self._seen.get(scene.visibility, self._source.version, lambda: sample_seen(scene))
