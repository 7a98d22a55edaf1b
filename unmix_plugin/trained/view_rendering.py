"""One view of a trained scene, as every product and the evaluation want it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.figures.pictures import Picture, premultiplied_over_neutral
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix

if TYPE_CHECKING:
    from unmix_plugin.scenes.scene import Scene
    from unmix_plugin.trained.trained_scene import TrainedScene


MOST_SENSOR_SUBPIXELS = 4
"""Along an edge of a coarse sensor's pixel, in multiples of the finest sensor's."""


@dataclass(frozen=True)
class RenderedView:
    """What a scene shows from one camera, on black; on the CPU."""

    spectra: Float[Tensor, "H W B"]
    accumulation: Float[Tensor, "H W"]
    """Opacity, [0, 1]."""
    abundances: Float[Tensor, "H W K"]
    """Composited, so that they sum to the accumulation."""
    segmentation: UInt8[Tensor, "H W"]
    """Material ids, 255 where nothing is."""
    material_scores: Float[Tensor, "H W K"]
    """Cosine of the spectrum to each endmember."""
    has_sky: bool = False
    """Whether a sky is behind all that is seen."""

    @property
    def coverage(self) -> Float[Tensor, "H W"]:
        """How much of a pixel shows something, the sky included, [0, 1]."""
        return torch.ones_like(self.accumulation) if self.has_sky else self.accumulation

    @property
    def shares(self) -> Float[Tensor, "H W K"]:
        """Abundances of what is seen, summing to 1 wherever anything is."""
        return self.abundances / self.accumulation.clamp(min=1e-6)[..., None]


def render_view(scene: TrainedScene, camera: Cameras, subpixels: int | None = None) -> RenderedView:
    """Render all that is written about a view; `subpixels` squared rays a pixel, None for as many as in training."""
    names = ("spectral", "accumulation", "abundances", "segmentation", "material_scores")
    view = scene.look(camera, subpixels)
    has_sky = scene.renderer.is_unbounded
    return RenderedView(*(view[name].detach().cpu() for name in names), has_sky=has_sky)


def subpixels_for(scene: Scene, index: int, subpixels: int, pixel_size: float) -> int:
    """Rays along the edge of a pixel with which to render a view, so that coarse sensors' pixels are means too.

    Args:
        subpixels, pixel_size: Rays along the edge of a pixel of this size, in the middle of the scene.
    """
    if not scene.is_rig:
        return subpixels
    distance = scene.cameras.camera_to_world[index, :, 3] - scene.scene_box.aabb.mean(dim=0)
    edge = float(distance.norm() / scene.cameras.focal_px[index].mean())
    return subpixels * min(max(1, round(edge / pixel_size)), MOST_SENSOR_SUBPIXELS)


def picture(spectra: Float[Tensor, "H W B"], coverage: Float[Tensor, "H W"], bands: Bands) -> Picture:
    """Spectra seen on black as an sRGB picture over neutral grey."""
    return coloured_picture(spectra, coverage, rgb_matrix(bands))


def coloured_picture(
    spectra: Float[Tensor, "H W b"], coverage: Float[Tensor, "H W"], weights: Float[Tensor, "b 3"]
) -> Picture:
    """The same with other weights of the channels in red, green and blue."""
    linear = spectra.double().clamp(min=0) @ weights.double()
    return premultiplied_over_neutral(linear.clamp(0, 1).numpy(), as_numpy(coverage))


def as_numpy(values: Tensor) -> np.ndarray:
    """float64 for drawing."""
    return values.double().numpy()
