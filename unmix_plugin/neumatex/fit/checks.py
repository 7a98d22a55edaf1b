"""Whether mesh, pictures and environment belong together.

A mesh has to lie where the cameras and alpha say that the object is. Pictures and environment must have one unit: a
white surface sends back at most four times the mean radiance around it, which a single lamp straight before it does;
dark ones in the shade send some thousandths.

Notation: `V` views that are compared, `F` triangles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.engine import Cameras, nearest_to_axes
from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.fit.pictures import PosedPictures
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.rays import RayMesh
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA

LONGEST_EDGE_PX = 64
"""Of the views whose outlines are compared."""
_SIDES_EDGE_PX = 128
"""Of the views that say which side of a triangle is its front."""
LEAST_OVERLAP = 0.5
"""Of silhouette and alpha, shared part over both: below it a view disagrees. Right meshes have 0.9 and more."""
DOUBTFUL_OVERLAP = 0.85
"""Of the median view: below it a mesh is somewhat off, which blurs materials."""
BOUNDS = (0.002, 4.0)
"""Of the object's pixels over the environment's mean radiance: 95 of 100 pixels darker than the one, or half of them
brighter than the other, are no surface's under this light."""
_USUAL = 0.3
_MOST_VIEWS = 24
_HALF_OPAQUE = 0.5


def outline_overlaps(
    ray_mesh: RayMesh, cameras: Cameras, alphas: Sequence[Float[np.ndarray, "_ _"] | None]
) -> Float64[np.ndarray, " V"]:
    """How well a mesh covers what pictures show of it: in each view that is compared, the part that silhouette and
    alpha share; without alpha 1 where the mesh is in the view. Raises SceneError: no pixel of any picture is opaque."""
    if all(alpha is not None and not (alpha > _HALF_OPAQUE).any() for alpha in alphas):
        raise SceneError(
            "alpha of all pictures is below one half everywhere, so that no pixel shows the object; write alpha "
            "that is 1 on the object, or pictures without alpha"
        )
    return np.array([_overlap(ray_mesh, cameras[view], alphas[view]) for view in _some_views(len(cameras))])


def _some_views(count: int) -> range:
    """Evenly spread."""
    return range(0, count, max(1, -(-count // _MOST_VIEWS)))


def _overlap(ray_mesh: RayMesh, camera: Cameras, alpha: Float[np.ndarray, "_ _"] | None) -> float:
    small = camera.shrunk(LONGEST_EDGE_PX**2)
    rays = small.image_rays(0).to(ray_mesh.device)
    seen = ray_mesh.blocked(rays.origins, rays.directions).cpu()
    if alpha is None:
        return float(seen.any())
    rows, columns = (
        np.minimum(((np.arange(count) + 0.5) * whole / count).astype(int), whole - 1)
        for count, whole in ((small.height, camera.height), (small.width, camera.width))
    )
    shown = torch.from_numpy(alpha[rows][:, columns] > _HALF_OPAQUE).flatten()
    union = int((seen | shown).sum())
    return float((seen & shown).sum()) / union if union else 1.0


def is_misplaced(overlaps: Float64[np.ndarray, " V"]) -> bool:
    """Whether most views do not see the mesh where their pictures show the object."""
    return 2 * int((overlaps < LEAST_OVERLAP).sum()) > len(overlaps)


def misplacement(
    overlaps: Float64[np.ndarray, " V"], cameras: Cameras, frame: Normalisation, where: str
) -> str:
    """How far off a misplaced mesh is, with places in the world."""
    wrong, edge, poses = int((overlaps < LEAST_OVERLAP).sum()), 2 / frame.scale, cameras.camera_to_world
    positions = frame.to_world(poses[:, :, 3].double().numpy())
    middle, target = frame.to_world(np.zeros(3)), frame.to_world(nearest_to_axes(poses.double().numpy()))
    away = float(np.median(np.linalg.norm(positions - target, axis=1)))
    unit = 10.0 ** math.floor(math.log10(1e-4 * max(away, edge)))  # beyond it, digits are of rounding
    middle, target = (np.round(point / unit) * unit + 0.0 for point in (middle, target))
    places = [f"({', '.join(f'{value:.4g}' for value in point)})" for point in (middle, target)]
    return (
        f"{where} is not where the pictures show the object: in {wrong} of {len(overlaps)} views it covers less "
        f"than half of what alpha shows, or is not in the view (median overlap {np.median(overlaps):.0%}). Its box "
        f"is {edge:.4g} long; its middle is {places[0]}, the cameras look at {places[1]}, "
        f"{np.linalg.norm(target - middle):.4g} away from there, and stand {away:.4g} from what they look at. Bring it "
        "into the world of the poses: the same origin, unit and axes. With y upwards it does not fit either"
    )


def outline_doubts(overlaps: Float64[np.ndarray, " V"], where: str) -> list[str]:
    """What to say of a mesh that is somewhat off."""
    median = float(np.median(overlaps))
    if median >= DOUBTFUL_OVERLAP:
        return []
    doubt = (
        f"{where} and alpha show different outlines: their overlap is {median:.0%} (median of {len(overlaps)} views; "
        "90% and more is usual), which blurs materials. Check size and place of the mesh, lenses and alpha"
    )
    return [doubt]


def sides_seen(ray_mesh: RayMesh, cameras: Cameras) -> Float[Tensor, " F"]:
    """How much cameras see each triangle from its front, less how much from behind: sums of cosines over rays."""
    mesh, seen = ray_mesh.mesh, torch.zeros(len(ray_mesh.mesh.faces))
    a, b, c = mesh.corners().unbind(dim=1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    for view in _some_views(len(cameras)):
        rays = cameras[view].shrunk(_SIDES_EDGE_PX**2).image_rays(0)
        hits = ray_mesh.closest(rays.origins, rays.directions)
        triangles = hits.triangles[hits.found]
        seen.index_add_(0, triangles, -(rays.directions[hits.found] * normals[triangles]).sum(dim=-1))
    return seen


def light_doubts(pictures: PosedPictures, environment: Environment) -> list[str]:
    """What to say of pictures that are much too bright or too dark for their light. Those that are not linear, or have
    no alpha, say nothing of a unit, or of what is background."""
    if pictures.tone != "linear":
        return []
    read = [pictures.read(view) for view in _some_views(len(pictures))]
    shown = [picture.numbers[picture.opacity >= OPAQUE_ALPHA] for picture in read if picture.has_alpha]
    found = np.concatenate(shown).mean(axis=1) if shown else np.zeros(0)
    mean = float(environment.mean_radiance().mean())
    if not (found.size and mean > 0):
        return []
    middle, bright = (float(np.quantile(found, share)) / mean for share in (0.5, 0.95))
    low, high = BOUNDS
    if middle > high:
        ratio, what = middle, "half of the object's pixels are more than"
    elif 0 < bright < low:
        ratio, what = bright, "95 % of the object's pixels are less than"
    else:
        return []
    doubt = (
        f"{what} {ratio:.2g} times as bright as the mean of the environment map; {low:g} to {high:g} times is usual. "
        "Pictures and map seem to have different units, and materials come out wrong then. Scale one of them: an "
        f"'environment_exposure_stops' {math.log2(ratio / _USUAL):.0f} higher would be about right"
    )
    return [doubt]
