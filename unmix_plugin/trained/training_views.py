"""Training views beside what a trained scene renders of them, thinned out: looked at once when a training ends, and
handed to all that judges it (`view_fit`, `unexplained`, `measured_errors`).

Notation: `h x w` pixels of a view thinned out, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64

from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA, is_blown_out
from unmix_plugin.trained.places import MeasuredScene
from unmix_plugin.trained.trained_scene import TrainedScene

_LONGEST_SIDE_PX = 64
"""Of what is rendered of a view."""
_FOREGROUND_ALPHA = 0.5
"""Alpha above which a pixel counts as one of the object."""


@dataclass(frozen=True)
class ThinnedView:
    """Every n-th pixel of a training view, and what is rendered of these."""

    name: str
    measured: Float64[np.ndarray, "h w B"]
    """In the light and with the exposure that the scene is shown in."""
    rendered: Float64[np.ndarray, "h w B"]
    counts: Bool[np.ndarray, "h w"]
    """Which pixels are valid, in no mask, and show the object."""
    is_whole: Bool[np.ndarray, "h w"]
    """Those of them that show nothing but the object."""
    blown_out: Bool[np.ndarray, "h w"]
    """Which may have been brighter than what the sensor can tell."""
    opacity: Float64[np.ndarray, "h w"]
    """Of what is rendered, [0, 1]."""
    abundances: Float64[np.ndarray, "h w K"]
    """The same, summing to the opacity."""
    points: Float64[np.ndarray, "h w 3"]
    """Where the rays end, model space."""
    pixel: Float64[np.ndarray, "h w"]
    """Distance between neighbouring pixels of the thinned view at that depth, model units."""


@torch.no_grad()
def thinned_views(trained: TrainedScene, scene: MeasuredScene) -> Iterator[ThinnedView]:
    """The training views with all bands, at most 64 pixels along a side; reads their cubes."""
    for index in scene.usable_views:
        camera = scene.camera(index, trained)
        stride = -(-max(camera.size(0)) // _LONGEST_SIDE_PX)
        every = slice(stride // 2, None, stride)
        cube = scene.scene.cube(index, (every, every))
        height, width = size = cube.shape[:2]
        counts, alpha = scene.scene.valid_mask(index, (every, every)), scene.scene.alpha(index)
        is_whole = counts
        if alpha is not None:
            is_whole = counts & (alpha[every, every] > OPAQUE_ALPHA)
            counts = counts & (alpha[every, every] > _FOREGROUND_ALPHA)
        rows, columns = np.mgrid[:height, :width] * stride + stride // 2 + 0.5
        coords = torch.from_numpy(np.stack([columns.ravel(), rows.ravel()], axis=1)).float()
        rays = camera.generate_rays(torch.zeros(len(coords), dtype=torch.int64), coords)
        seen = composite(trained.renderer, trained.field, rays.to(trained.device))
        distance = seen.ray_distance.cpu()
        yield ThinnedView(
            name=scene.scene.frames[index].name,
            measured=scene.comparable(index, cube, trained),
            rendered=trained.materials.spectra(seen).cpu().double().numpy().reshape(cube.shape),
            counts=counts,
            is_whole=is_whole,
            blown_out=is_blown_out(torch.from_numpy(cube)).numpy(),
            opacity=seen.accumulation.cpu().double().numpy().reshape(size),
            abundances=seen.abundances.cpu().double().numpy().reshape(*size, -1),
            points=rays.at(distance).double().numpy().reshape(*size, 3),
            pixel=(stride * distance / camera.focal_px[0].min()).double().numpy().reshape(size),
        )
