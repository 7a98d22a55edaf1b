"""The prior that is shipped: trained on procedural objects, small enough to run on a processor in a second or two.

It has the interface of the published one (views in; planes, and networks that read them, out), but knows the mesh and
the light, which the published one has to guess from the pictures. It works on the CPU.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.prior.plane_fit import Estimates, fit_planes
from unmix_plugin.neumatex.prior.small_network import MaterialName, Observations, SmallPrior
from unmix_plugin.neumatex.prior.small_weights import read_small_prior
from unmix_plugin.neumatex.prior.surface_samples import known_light, sample_surface
from unmix_plugin.neumatex.prior.views import PosedViews, well_spread
from unmix_plugin.neumatex.triplane import Triplane

MOST_VIEWS = 12
"""Views that are looked at; of more, those whose directions are farthest apart."""
_NUM_POINTS = 3072
_LEAST_ALPHA = 0.9


def predict(
    views: PosedViews,
    ray_mesh: RayMesh,
    environment: Environment,
    material: MaterialName,
    *,
    resolution: int = 128,
    generator: torch.Generator,
    prior: SmallPrior | None = None,
) -> Triplane:
    """Planes of an object, and the networks that read them, on the CPU.

    Args:
        views: RGB pictures of the object, on the CPU; the training views of a scene.
        ray_mesh: The mesh in model space.
        environment: The light of the pictures, with three colours.
        material: `neural`: base colour and six latents; `pbr`: base colour, roughness, metallicity.
        resolution: Texels along an edge of the planes.
        generator: Draws surface points and shadow rays, on the CPU.
        prior: Instead of the shipped one.
    Raises:
        SceneError: no view shows the mesh.
        RunError: the shipped weights are damaged, or were made for another decoder than the shipped one.
    """
    prior = read_small_prior(material) if prior is None else prior
    if ray_mesh.device.type != "cpu":
        ray_mesh = RayMesh(ray_mesh.mesh.to("cpu"))
    environment = environment.to("cpu")
    chosen = views[well_spread(views.cameras.camera_to_world[:, :, 3], MOST_VIEWS)]
    with torch.no_grad():
        observations = observe(chosen, ray_mesh, environment, _NUM_POINTS, generator)
        said = prior.estimate(prior(observations), material)
    planes = fit_planes(prior.readers_of(material), Estimates(observations.positions, *said))[0]
    return filled_triplane(prior, planes, material, resolution)


def observe(
    views: PosedViews,
    ray_mesh: RayMesh,
    environment: Environment,
    num_points: int,
    generator: torch.Generator,
) -> Observations:
    """What views show of points of the mesh; B is 1.

    Raises:
        SceneError: no view shows any of the points.
    """
    points = sample_surface(ray_mesh.mesh, num_points, generator)
    eyes = views.cameras.camera_to_world[:, :, 3]
    known = known_light(points, eyes, ray_mesh, environment, generator)
    colours, shown = read_colours(views, points.positions)
    visible = known.visible & shown
    if not bool(visible.any()):
        raise SceneError(
            f"none of {len(eyes)} views shows the mesh: {int(known.visible.sum())} of its points face a camera, but "
            "the object is at none of their pixels; are mesh and cameras in the same world, and are alpha and masks "
            "right?"
        )
    mean = environment.mean_radiance().mean().clamp(min=1e-12)
    return Observations(
        positions=points.positions[None],
        colours=torch.where(visible[..., None], colours / mean, 0.0)[None],
        visible=visible[None],
        cosines=known.cosines[None],
        mirrored=known.mirrored[None],
        mirror_open=known.mirror_open[None],
        irradiance=known.irradiance[None],
        unshadowed=known.unshadowed[None],
    )


def read_colours(
    views: PosedViews, positions: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N V 3"], Bool[Tensor, "N V"]]:
    """Colours of points in each picture, bilinear, and whether the object is there."""
    colours, shown = [], []
    for index, (picture, alpha) in enumerate(zip(views.pictures, views.alphas, strict=True)):
        pixels, depths = views.cameras.project(positions, index)
        size = pixels.new_tensor([picture.shape[1], picture.shape[0]])
        places = (2 * pixels / size - 1)[None, None]
        planes = torch.cat([picture, alpha[..., None]], dim=-1).permute(2, 0, 1)[None]
        found = functional.grid_sample(planes, places, padding_mode="zeros", align_corners=False)[0, :, 0].T
        colours.append(found[:, :3])
        shown.append((depths > 0) & (found[:, 3] >= _LEAST_ALPHA))
    return torch.stack(colours, dim=1), torch.stack(shown, dim=1)


def filled_triplane(
    prior: SmallPrior, planes: Float[Tensor, "3 C R R"], material: MaterialName, resolution: int
) -> Triplane:
    """Planes in another resolution with copies of the prior's networks for a material."""
    readers = prior.readers_of(material)
    triplane = Triplane(readers.num_parameters, resolution, planes.shape[1])
    triplane.readers.load_state_dict(readers.state_dict())
    enlarged = functional.interpolate(
        planes, size=(resolution, resolution), mode="bilinear", align_corners=True
    )
    with torch.no_grad():
        triplane.planes.copy_(enlarged)
    return triplane
