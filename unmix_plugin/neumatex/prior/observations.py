"""What the prior looks at: posed views, points of the mesh, the light that reaches them, and numbers made of all that.

A known light is sent into lobes: a cosine-weighted one for the diffuse part, narrower ones about a mirrored direction.
All light is divided by the environment's mean, so that exposure does not matter.

Notation: `V` views of `H` x `W` pixels, `B` objects, `N` points in model space, where the mesh lies in [-1, 1]^3, `K`
lobes, `C` colours, `F` features.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from unmix_plugin.engine import Cameras
from unmix_plugin.neumatex.tracing.environment import Environment, directions_of_pixels, solid_angles
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.neumatex.tracing.rays import RayMesh, SurfacePoints
from unmix_plugin.neumatex.tracing.surface import encode

SHARPNESSES = (128.0, 20.0, 4.0)
"""Of the blurred lobes exp(k cos): about what GGX of roughness 0.25, 0.4 and 0.6 reflects."""
_MIRROR_ROWS = 64
_BLURRED_ROWS = 32
_LEAST_COSINE = 0.08
"""Views that graze a point more than this say little of it."""
_OFF_SURFACE = 2e-5
"""Distance from the surface at which rays start, model units."""
_SHADOW_RAYS = 32
_BRIGHTEST = 8.0
"""Light above this is cut: a sample of a path tracer or a clipped picture says no more."""
_RIDGE = 0.02
"""Variance that is added to that of the light in a fit, so that light that hardly varies explains little."""


_LEAST_ALPHA = 0.9


@dataclass(frozen=True)
class PosedViews:
    """Pictures with their cameras; sizes may differ."""

    cameras: Cameras
    """V of them, in model space."""
    pictures: Sequence[Float[Tensor, "H W 3"]]
    """Linear radiance in the unit of the environment, not multiplied by alpha; a tone curve is undone before."""
    alphas: Sequence[Float[Tensor, "H W"]]
    """1 where the object is, 0 beside it; observations below 0.9 are not used."""

    def __getitem__(self, indices: list[int]) -> PosedViews:
        """Some of the views, in the order asked for."""
        chosen = [self.pictures[index] for index in indices], [self.alphas[index] for index in indices]
        return PosedViews(self.cameras[indices], *chosen)

    def at(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N V 3"], Bool[Tensor, "N V"]]:
        """Colours of points in each picture, bilinear, and whether the object is there."""
        colours, shown = [], []
        for index, (picture, alpha) in enumerate(zip(self.pictures, self.alphas, strict=True)):
            pixels, depths = self.cameras.project(positions, index)
            size = pixels.new_tensor([picture.shape[1], picture.shape[0]])
            places = (2 * pixels / size - 1)[None, None]
            planes = torch.cat([picture, alpha[..., None]], dim=-1).permute(2, 0, 1)[None]
            found = functional.grid_sample(planes, places, padding_mode="zeros", align_corners=False)[
                0, :, 0
            ].T
            colours.append(found[:, :3])
            shown.append((depths > 0) & (found[:, 3] >= _LEAST_ALPHA))
        return torch.stack(colours, dim=1), torch.stack(shown, dim=1)


def well_spread(positions: Float[Tensor, "V 3"], count: int) -> list[int]:
    """Which cameras to take, in increasing order: the first, then always the one that is farthest in direction, seen
    from the origin of model space, from all taken."""
    directions = torch.nn.functional.normalize(positions, dim=-1)
    chosen = [0]
    nearest = directions @ directions[0]
    while len(chosen) < min(count, len(positions)):
        nearest[chosen] = torch.inf
        chosen.append(int(nearest.argmin()))
        nearest = torch.maximum(nearest, directions @ directions[chosen[-1]])
    return sorted(chosen)


NUM_LOBES = 1 + len(SHARPNESSES)
"""K: the nearly unblurred light and the blurred lobes."""


def _light_lobes(environment: Environment) -> list[Environment]:
    """Blurred once, so that lobes are look-ups: irradiance over pi of a surface by the direction of its normal, nothing
    in the way; then the mean radiance of each lobe by its direction, sharpest first."""
    coarse = _shrunk(environment, _BLURRED_ROWS)
    blurred = [(kernel.to(coarse) @ coarse.flatten(0, 1)).reshape(coarse.shape) for kernel in _kernels()]
    images = [blurred[0], _shrunk(environment, _MIRROR_ROWS), *blurred[1:]]
    return [Environment(image, environment.rotation_deg) for image in images]


@functools.cache
def _kernels() -> list[Float[Tensor, "P P"]]:
    """Weights of every pixel's light in the lobe about every pixel, the diffuse lobe first; they belong to no light."""
    directions = directions_of_pixels(_BLURRED_ROWS, 2 * _BLURRED_ROWS).reshape(-1, 3)
    cosines = directions @ directions.T
    areas = solid_angles(_BLURRED_ROWS, 2 * _BLURRED_ROWS).repeat_interleave(2 * _BLURRED_ROWS).to(cosines)
    shapes = [cosines.clamp(min=0), *(torch.exp(sharpness * (cosines - 1)) for sharpness in SHARPNESSES)]
    return [functional.normalize(shape * areas, p=1, dim=1) for shape in shapes]


def _shrunk(environment: Environment, rows: int) -> Float[Tensor, "H W C"]:
    """Means of an environment's radiance over larger pixels."""
    picture = (environment.image.float() * 2.0**environment.exposure_stops).permute(2, 0, 1)
    return functional.adaptive_avg_pool2d(picture, (rows, 2 * rows)).permute(1, 2, 0)


@dataclass(frozen=True)
class Observations:
    """What is known of points of objects and what views show of them; light is divided by the environment's mean."""

    positions: Float[Tensor, "*B N 3"]
    colours: Float[Tensor, "*B N V 3"]
    """What the views show; 0 before any picture is read."""
    visible: Bool[Tensor, "*B N V"]
    """Whether a view's camera sees a point."""
    cosines: Float[Tensor, "*B N V"]
    """Between the normal and the direction to the camera."""
    mirrored: Float[Tensor, "*B N V K 3"]
    """Light in lobes about the mirrored direction of each view, as if nothing were in the way."""
    mirror_open: Float[Tensor, "*B N V"]
    """1 where the mirrored direction leaves the object, 0 where it meets it again."""
    irradiance: Float[Tensor, "*B N 3"]
    """Over pi, as if nothing were in the way."""
    unshadowed: Float[Tensor, "*B N 3"]
    """Share of the irradiance that the object itself does not block."""

    @property
    def reaching(self) -> Float[Tensor, "*B N 3"]:
        """Irradiance over pi after shadows."""
        return self.irradiance * self.unshadowed

    def alone(self) -> Observations:
        """Those of one object, as a batch of one."""
        return Observations(**{name: part[None] for name, part in vars(self).items()})


def sample_surface(mesh: Mesh, count: int, generator: torch.Generator) -> SurfacePoints:
    """Points of a mesh, uniform by area, a little above the surface, as seen from straight above."""
    corners = mesh.corners()
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    crossed = torch.linalg.cross(*edges)
    faces = torch.multinomial(crossed.norm(dim=-1), count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, 1, generator=generator).unbind()
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    weights = torch.stack([1 - u - v, u, v], dim=1)
    geometric = functional.normalize(crossed[faces], dim=-1)
    positions = (weights * corners[faces]).sum(dim=1)
    normals = (weights * mesh.normals[mesh.faces[faces].long()]).sum(dim=1)
    normals = functional.normalize(normals, dim=-1)
    # A file's normals may disagree with the winding of its triangles; the normals say which side is outside.
    geometric = torch.where((geometric * normals).sum(dim=-1, keepdim=True) < 0, -geometric, geometric)
    return SurfacePoints(positions + _OFF_SURFACE * geometric, normals, geometric, geometric)


def known_light(
    points: SurfacePoints,
    eyes: Float[Tensor, "V 3"],
    ray_mesh: RayMesh,
    environment: Environment,
    generator: torch.Generator,
) -> Observations:
    """What is known of points of one object, seen from outside the mesh, before any picture is read."""
    diffuse, *lobes = _light_lobes(environment)
    mean = environment.mean_radiance().mean().clamp(min=1e-12)
    to_eye = functional.normalize(eyes - points.positions[:, None], dim=-1)
    cosines = (to_eye * points.normals[:, None]).sum(dim=-1)
    above = (to_eye * points.geometric_normals[:, None]).sum(dim=-1)
    facing = (cosines > _LEAST_COSINE) & (above > _LEAST_COSINE)
    mirrored = functional.normalize(2 * cosines[..., None] * points.normals[:, None] - to_eye, dim=-1)
    shape = facing.shape
    in_lobes = torch.stack([lobe.radiance(mirrored.reshape(-1, 3)) for lobe in lobes], dim=1)
    return Observations(
        positions=points.positions,
        colours=torch.zeros(*shape, 3),
        visible=facing & _open(points, to_eye, facing, ray_mesh),
        cosines=cosines.clamp(0, 1),
        mirrored=in_lobes.unflatten(0, shape) / mean,
        mirror_open=_open(points, mirrored, facing, ray_mesh).float(),
        irradiance=diffuse.radiance(points.normals) / mean,
        unshadowed=_unshadowed(points, ray_mesh, environment, generator),
    )


def _open(points: SurfacePoints, directions: Tensor, wanted: Tensor, ray_mesh: RayMesh) -> Tensor:
    """Whether rays leave the object; False where they are not wanted."""
    found = torch.zeros_like(wanted)
    rows = wanted.nonzero()[:, 0]
    found[wanted] = ~ray_mesh.blocked(points.positions[rows], directions[wanted])
    return found


def _unshadowed(
    points: SurfacePoints, ray_mesh: RayMesh, environment: Environment, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """Ratio of two estimates from the same directions: with and without the object in the way."""
    repeated = points.select(torch.arange(len(points.positions)).repeat_interleave(_SHADOW_RAYS))
    directions, density = environment.sample(torch.rand(len(repeated.positions), 2, generator=generator))
    cosines = (directions * repeated.normals).sum(dim=-1).clamp(min=0)
    light = environment.radiance(directions) * (cosines / density.clamp(min=1e-12))[:, None]
    is_open = _open(repeated, directions[:, None], (cosines > 0)[:, None], ray_mesh)
    total, reaching = (
        values.unflatten(0, (-1, _SHADOW_RAYS)).sum(dim=1) for values in (light, light * is_open)
    )
    return torch.where(total > 0, reaching / total.clamp(min=1e-12), 1.0)


NUM_VIEW_FEATURES = 3 + 3 * NUM_LOBES + 3 + 3 + 3
NUM_POINT_FEATURES = 3 + 3 + 1 + 3 + 18 + 7 * NUM_LOBES


def view_features(o: Observations) -> Float[Tensor, "B N V F"]:
    """What each view shows of a point and what light it could reflect to that view."""
    apparent = o.colours / (o.reaching[..., None, :] + 0.02)
    single = torch.stack([o.cosines, (1 - o.cosines) ** 5, o.mirror_open], dim=-1)
    light = _compressed(o.reaching)[..., None, :].expand_as(o.colours)
    lobes = _compressed(o.mirrored).flatten(-2)
    return torch.cat([_compressed(o.colours), lobes, light, _compressed(apparent), single], dim=-1)


def point_features(o: Observations) -> Float[Tensor, "B N F"]:
    """What all views together show of a point: fits of its colours by each lobe of light, and where it is."""
    weights = o.visible * (0.2 + 0.8 * o.mirror_open)
    fits = _lobe_fits(o.colours, o.mirrored, weights, o.reaching)
    seen = o.visible.sum(dim=-1, keepdim=True) / 8
    known = [_compressed(o.irradiance), o.unshadowed, seen, o.positions, encode(o.positions), fits]
    return torch.cat(known, dim=-1)


def _lobe_fits(
    colours: Float[Tensor, "*n V 3"],
    mirrored: Float[Tensor, "*n V K 3"],
    weights: Float[Tensor, "*n V"],
    reaching: Float[Tensor, "*n 3"],
) -> Float[Tensor, "*n 7*K"]:
    """A constant plus a share of each lobe's light, fitted to a point's colours over the views: for each lobe the
    shares of the three colours, the constants over the light that reaches the point (an albedo), and the part of the
    colours' variance that is left."""
    colours = colours.clamp(max=_BRIGHTEST)[..., None, :]
    light = mirrored.clamp(max=_BRIGHTEST)
    weights = weights[..., None, None]
    total = weights.sum(dim=-3).clamp(min=1e-6)

    def _mean(values: Tensor) -> Tensor:
        return (values * weights).sum(dim=-3) / total

    mean_colour, mean_light = _mean(colours), _mean(light)
    spread = light - mean_light[..., None, :, :]
    difference = colours - mean_colour[..., None, :, :]
    share = _mean(spread * difference) / (_mean(spread.square()) + _RIDGE)
    constant = (mean_colour - share * mean_light) / (reaching[..., None, :] + 0.02)
    residual = _mean((difference - share[..., None, :, :] * spread).square()).sum(dim=-1, keepdim=True)
    residual = residual / (_mean(difference.square()).sum(dim=-1, keepdim=True) + 1e-3)
    return torch.cat([share.clamp(-1, 2), constant.clamp(-1, 2), residual.clamp(0, 2)], dim=-1).flatten(-2)


def _compressed(light: Tensor) -> Tensor:
    """Light from 0 to `_BRIGHTEST` on a logarithmic scale from 0 to 1."""
    return torch.log1p(8 * light.clamp(0, _BRIGHTEST)) / torch.log1p(torch.tensor(8 * _BRIGHTEST))
