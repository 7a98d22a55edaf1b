"""Rays through the foreground of pictures, and whether a hull explains them."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.engine.geometry.scene_box import SceneBox

MAX_RAYS = 20_000
"""Pixels that are asked for whether a hull explains them."""
MIN_EXPLAINED = 0.999
"""Share of the foreground pixels whose rays must cross what is kept."""


def foreground_rays(cameras: Cameras, foreground: list[Bool[np.ndarray, "_ _"]]) -> RayBundle:
    """Rays through foreground pixels, evenly thinned out to at most `MAX_RAYS`."""
    flat = np.flatnonzero(np.concatenate([mask.reshape(-1) for mask in foreground]))
    chosen = flat[:: max(1, -(-len(flat) // MAX_RAYS))]
    starts = np.cumsum([0, *(mask.size for mask in foreground)])
    views = np.searchsorted(starts, chosen, side="right") - 1
    widths = np.array([mask.shape[1] for mask in foreground])[views]
    rows, columns = np.divmod(chosen - starts[views], widths)
    coords = torch.from_numpy(np.stack([columns, rows], axis=-1)).float() + 0.5
    return cameras.generate_rays(torch.from_numpy(views), coords)


def share_through(rays: RayBundle, box: SceneBox, hull: Bool[np.ndarray, "R R R"]) -> float:
    """Share of the rays that meet a cell of the hull; 0 without rays."""
    if len(rays) == 0:
        return 0.0
    cells = hull.shape[0]
    t_near, t_far = box.intersect(rays.origins, rays.directions)
    kept = torch.from_numpy(hull)
    meets = torch.zeros(len(rays), dtype=torch.bool)
    for step in torch.linspace(0.0, 1.0, 2 * cells):
        points = rays.origins + (t_near + step * (t_far - t_near))[:, None] * rays.directions
        x, y, z = (box.normalise(points) * cells).long().clamp(0, cells - 1).unbind(-1)
        meets |= kept[x, y, z] & (t_far > t_near)
    return float(meets.double().mean())


def without_specks(foreground: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Foreground that has neighbours: single pixels in the air need no hull behind them."""
    from scipy.ndimage import binary_opening  # slow to import, and most commands carve nothing

    return binary_opening(foreground, np.ones((2, 2), dtype=bool))
