"""Whether a mesh lies where the cameras and alpha say that the object is.

Notation: `N` cameras.

Whether pictures are about as bright as the environment can make an object.

Pictures and environment must have one unit. A white surface sends back at most four times the mean radiance around it,
which a single lamp straight before it does; dark ones in the shade send some thousandths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine import Cameras
from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.fit.pictures import PosedPictures, opacity
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.scene import Normalisation

LONGEST_EDGE_PX = 64
"""Of the views that are compared."""
LEAST_OVERLAP = 0.5
"""Of silhouette and alpha, shared part over both: below it a view disagrees. Right meshes have 0.9 and more."""
DOUBTFUL_OVERLAP = 0.85
"""Of the median view: below it a mesh is somewhat off, which blurs materials."""
MOST_VIEWS = 24
_OPAQUE = 0.5


@dataclass(frozen=True)
class _MeshFit:
    """How well the silhouettes of a mesh agree with alpha."""

    overlaps: list[float]
    """Of the views that were compared."""
    misplaced: str | None
    """How far off the mesh is, where most views do not see it where their pictures show the object."""

    def doubt(self, where: str) -> str | None:
        """What to say of a mesh that is somewhat off; None if it is right."""
        median = float(np.median(self.overlaps))
        if median >= DOUBTFUL_OVERLAP:
            return None
        return (
            f"{where} and alpha show different outlines: their overlap is {median:.0%} (median of "
            f"{len(self.overlaps)} views; 90% and more is usual), which blurs materials. Check size and place of the "
            "mesh, lenses and alpha"
        )


def mesh_fit(
    ray_mesh: RayMesh,
    cameras: Cameras,
    alphas: Sequence[Float[np.ndarray, "_ _"] | None],
    frame: Normalisation,
    where: str,
) -> _MeshFit:
    """Compare a mesh with what pictures show of it.

    Args:
        ray_mesh: The mesh in model space.
        cameras: Of the pictures, model space.
        alphas: Opacity of each picture, None where it has none: then the mesh has only to be in the view.
        frame: To give places in the world.
        where: What messages call the mesh.
    Raises:
        SceneError: no pixel of any picture is opaque.
    """
    if all(alpha is not None and not (alpha > _OPAQUE).any() for alpha in alphas):
        raise SceneError(
            "alpha of all pictures is below one half everywhere, so that no pixel shows the object; write alpha "
            "that is 1 on the object, or pictures without alpha"
        )
    step = max(1, -(-len(cameras) // MOST_VIEWS))
    overlaps = [_overlap(ray_mesh, cameras[view], alphas[view]) for view in range(0, len(cameras), step)]
    wrong = sum(overlap < LEAST_OVERLAP for overlap in overlaps)
    if 2 * wrong <= len(overlaps):
        return _MeshFit(overlaps, None)
    edge = 2 / frame.scale
    message = (
        f"{where} is not where the pictures show the object: in {wrong} of {len(overlaps)} views it covers less than "
        f"half of what alpha shows, or is not in the view (median overlap {np.median(overlaps):.0%}). Its box is "
        f"{edge:.4g} long; {_places(cameras, frame)}. Bring it into the world of the poses: the same origin, unit and "
        "axes. With y upwards it does not fit either"
    )
    return _MeshFit(overlaps, message)


def _places(cameras: Cameras, frame: Normalisation) -> str:
    """Where the mesh and the cameras are in the world, without digits that rounding made."""
    positions = frame.to_world(cameras.camera_to_world[:, :, 3].double().numpy())
    middle, target = frame.to_world(np.zeros(3)), frame.to_world(looked_at(cameras).numpy())
    away = float(np.median(np.linalg.norm(positions - target, axis=1)))
    unit = 10.0 ** math.floor(math.log10(1e-4 * max(away, 2 / frame.scale)))
    middle, target = (np.round(point / unit) * unit + 0.0 for point in (middle, target))
    distance = float(np.linalg.norm(target - middle))
    return (
        f"its middle is {_place(middle)}, the cameras look at {_place(target)}, {distance:.4g} away from there, and "
        f"stand {away:.4g} from what they look at"
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
    shown = torch.from_numpy(alpha[rows][:, columns] > _OPAQUE).flatten()
    union = int((seen | shown).sum())
    return float((seen & shown).sum()) / union if union else 1.0


def _place(point: np.ndarray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"


BOUNDS = (0.002, 4.0)
"""Of the object's pixels over the environment's mean radiance: 95 of 100 pixels darker than the one, or half of them
brighter than the other, are no surface's under this light."""
_USUAL = 0.3
_MOST_VIEWS = 24
_OPAQUE_LIGHT_CHECK = 0.99


def light_doubt(pictures: PosedPictures, environment: Environment) -> str | None:
    """What to say of pictures that are much too bright or too dark for their light; None if they are right.

    Only pictures of linear light with alpha are compared: others say nothing of a unit, or of what is background.
    """
    if pictures.tone != "linear":
        return None
    step = max(1, -(-len(pictures) // _MOST_VIEWS))
    read = [pictures.read(view) for view in range(0, len(pictures), step)]
    shown = [
        picture.numbers[opacity(picture) >= _OPAQUE_LIGHT_CHECK]
        for picture in read
        if picture.alpha is not None
    ]
    found = np.concatenate(shown).mean(axis=1) if shown else np.zeros(0)
    mean = float(environment.mean_radiance().mean())
    if not (found.size and mean > 0):
        return None
    middle, bright = (float(np.quantile(found, share)) / mean for share in (0.5, 0.95))
    if middle > BOUNDS[1]:
        ratio, what, bound = (
            middle,
            "half of the object's pixels are more than",
            f"at most {BOUNDS[1]:g} times",
        )
    elif 0 < bright < BOUNDS[0]:
        ratio, what, bound = (
            bright,
            "95 % of the object's pixels are less than",
            f"at least {BOUNDS[0]:g} times",
        )
    else:
        return None
    return (
        f"{what} {ratio:.2g} times as bright as the mean of the environment map; {bound} is usual. Pictures and map "
        "seem to have different units, and materials come out wrong then. Scale one of them: an "
        f"'environment_exposure_stops' {math.log2(ratio / _USUAL):.0f} higher would be about right"
    )
