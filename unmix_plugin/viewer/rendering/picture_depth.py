"""Depth pictures for the browser, which hides its own objects behind what is rendered."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float32

from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.viewer.view_cameras import depth_along_axis

FAR = 160.0
"""Depth of what is transparent, scene units; the browser's own limit is 167."""

_STEP = 512e-5
"""Depths are rounded to so many scene units: the browser's unit is 1e-5, and with empty low bits the PNG that they are
packed into is made in a third of the time."""


_MOST_ROWS = 256
"""Finer pictures get the depth of every n-th pixel: edges of hidden objects need no more, and packing takes long."""


def picture_depth(frame: MaterialView) -> Float32[np.ndarray, "rows columns"]:
    """Depth along the viewing axis, scene units, of the pixels or of every n-th; `FAR` where less than half of the
    light ends."""
    coefficients = frame.coefficients
    distance = coefficients.distance / coefficients.accumulation.clamp(min=1e-6)
    depth = depth_along_axis(frame.camera, distance).clamp(0, FAR)
    depth = torch.where(coefficients.accumulation > OCCUPIED_ACCUMULATION, depth, FAR)
    every = -(-depth.shape[0] // _MOST_ROWS)
    chosen = depth[every // 2 :: every, every // 2 :: every]
    return ((chosen / _STEP).round() * _STEP).cpu().numpy().astype(np.float32)
