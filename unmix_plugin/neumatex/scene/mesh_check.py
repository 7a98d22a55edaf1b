"""Whether a mesh lies where the cameras and alpha say that the object is.

Notation: `N` cameras.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.scenes.scene import Normalisation

LONGEST_EDGE_PX = 64
"""Of the views that are compared."""
LEAST_OVERLAP = 0.5
"""Of silhouette and alpha, shared part over both: below it a view disagrees. Right meshes have 0.9 and more."""
MOST_VIEWS = 24


def misplacement(
    ray_mesh: RayMesh,
    cameras: Cameras,
    alphas: Sequence[Float[np.ndarray, "_ _"] | None],
    frame: Normalisation,
    where: str,
) -> str | None:
    """How far off a mesh is that most views do not see where their pictures show the object; None if it is right.

    Args:
        ray_mesh: The mesh in model space.
        cameras: Of the pictures, model space.
        alphas: Opacity of each picture, None where it has none: then the mesh has only to be in the view.
        frame: To give places in the world.
        where: What the message calls the mesh.
    """
    step = max(1, -(-len(cameras) // MOST_VIEWS))
    views = range(0, len(cameras), step)
    overlaps = [_overlap(ray_mesh, cameras[view], alphas[view]) for view in views]
    wrong = sum(overlap < LEAST_OVERLAP for overlap in overlaps)
    if 2 * wrong <= len(overlaps):
        return None
    middle, target = frame.to_world(np.zeros(3)), frame.to_world(looked_at(cameras).numpy())
    distance, edge = float(np.linalg.norm(target - middle)), 2 / frame.scale
    return (
        f"{where} is not where the pictures show the object: in {wrong} of {len(overlaps)} views it covers less than "
        f"half of what alpha shows, or is not in the view (median overlap {np.median(overlaps):.0%}). Its box is "
        f"centred at {_place(middle)} and {edge:.4g} long; the cameras look at {_place(target)}, {distance:.4g} away. "
        "Bring it into the world of the poses: the same origin, unit and axes. With y upwards it does not fit either"
    )


def looked_at(cameras: Cameras) -> Float[Tensor, "3"]:
    """The point nearest to the optical axes of all cameras, least squares."""
    poses = cameras.camera_to_world.double()
    axes = -poses[:, :, 2]
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None]
    sought = (across @ poses[:, :, 3:]).sum(dim=0)
    return torch.linalg.lstsq(across.sum(dim=0), sought, driver="gelsd").solution[:, 0]


def _overlap(ray_mesh: RayMesh, camera: Cameras, alpha: Float[np.ndarray, "_ _"] | None) -> float:
    """Shared part of silhouette and alpha; without alpha 1 where the mesh is in the view."""
    small = camera.shrunk(LONGEST_EDGE_PX**2)
    rays = small.image_rays(0).to(ray_mesh.device)
    seen = ray_mesh.closest(rays.origins, rays.directions).found.cpu()
    if alpha is None:
        return float(seen.any())
    rows = np.minimum(
        ((np.arange(small.height) + 0.5) * camera.height / small.height).astype(int), camera.height - 1
    )
    columns = np.minimum(
        ((np.arange(small.width) + 0.5) * camera.width / small.width).astype(int), camera.width - 1
    )
    shown = torch.from_numpy(alpha[rows][:, columns] > 0.5).flatten()
    union = int((seen | shown).sum())
    return float((seen & shown).sum()) / union if union else 1.0


def _place(point: np.ndarray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"
