"""Training views beside what a trained scene renders of them, thinned out, for checks of a finished training.

Notation: `h x w` pixels of a view thinned out, `B` bands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64

from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.evidence import is_blown_out
from unmix_plugin.trained.run_views import views_of
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
    """With the exposure that the scene is shown in."""
    rendered: Float64[np.ndarray, "h w B"]
    counts: Bool[np.ndarray, "h w"]
    """Which pixels are valid, in no mask, and show the object."""
    blown_out: Bool[np.ndarray, "h w"]
    """Which may have been brighter than what the sensor can tell."""
    opacity: Float64[np.ndarray, "h w"]
    """Of what is rendered, [0, 1]."""
    points: Float64[np.ndarray, "h w 3"]
    """Where the rays end, model space."""
    pixel: Float64[np.ndarray, "h w"]
    """Distance between neighbouring pixels of the thinned view at that depth, model units."""


@torch.no_grad()
def thinned_views(trained: TrainedScene, scene: Scene) -> Iterator[ThinnedView]:
    """The training views with all bands, at most 64 pixels along a side; reads their cubes."""
    for row, (index, view) in enumerate(
        zip(scene.train_indices, views_of(trained.views, "train"), strict=True)
    ):
        if not scene.sensor_of(index).sees_all_bands:
            continue
        stride = -(-max(view.camera.size(0)) // _LONGEST_SIDE_PX)
        every = slice(stride // 2, None, stride)
        measured = scene.cube(index, (every, every)).astype(np.float64)
        blown_out = is_blown_out(torch.from_numpy(measured)).numpy()
        if trained.view_gains is not None:
            measured = measured / trained.view_gains[row].double().numpy()
        height, width = measured.shape[:2]
        counts, alpha = scene.valid_mask(index, (every, every)), scene.alpha(index)
        if alpha is not None:
            counts = counts & (alpha[every, every] > _FOREGROUND_ALPHA)
        rows, columns = np.mgrid[:height, :width] * stride + stride // 2 + 0.5
        coords = torch.from_numpy(np.stack([columns.ravel(), rows.ravel()], axis=1)).float()
        rays = view.camera.generate_rays(torch.zeros(len(coords), dtype=torch.int64), coords)
        seen = composite(trained.renderer, trained.field, rays.to(trained.device))
        distance = seen.ray_distance.cpu()
        yield ThinnedView(
            name=view.name,
            measured=measured,
            rendered=trained.materials.spectra(seen).cpu().double().numpy().reshape(measured.shape),
            counts=counts,
            blown_out=blown_out,
            opacity=seen.accumulation.cpu().double().numpy().reshape(height, width),
            points=(rays.origins + distance[:, None] * rays.directions)
            .double()
            .numpy()
            .reshape(height, width, 3),
            pixel=(stride * distance / view.camera.focal_px[0].min()).double().numpy().reshape(height, width),
        )
