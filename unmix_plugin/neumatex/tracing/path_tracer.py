"""Radiance that a mesh reflects under an environment, with gradients to its materials.

At each vertex of a path two directions are drawn: one by the environment's density, one by the material's. Both give
direct light, weighed by the power heuristic; the material's, where it meets the mesh again, carries the path on.
Directions, densities and weights have no gradient, reflectances do: the estimate of the radiance is unbiased, and so
is that of its derivative (detached sampling), since neither the visibility nor the densities of the integral depend
on the materials.

Notation: `N` points, `M` vertices of paths that are alive, `C` colours, `P` parameters, S samples a point.

Source: Veach 1997, Robust Monte Carlo Methods for Light Transport Simulation, chapter 9; Zeltner et al. 2021, Monte
Carlo Estimators for Differential Light Transport, for the name detached sampling.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.neumatex.geometry.ray_mesh import Hits, RayMesh, SurfacePoints
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.materials.shading_frame import frames, to_local, to_world
from unmix_plugin.neumatex.surface import Surface, decoded_once
from unmix_plugin.neumatex.tracing.sample_points import SamplePoints


@dataclass(frozen=True)
class _World:
    """What light meets on its way."""

    surface: Surface
    ray_mesh: RayMesh
    environment: Environment


@dataclass(frozen=True)
class _Vertices:
    """Ends of the paths that are alive."""

    paths: Int[Tensor, " M"]
    """Which path, point after point and sample after sample."""
    points: SurfacePoints
    axes: Float[Tensor, "M 3 3"]
    """Frames of shading."""
    wo: Float[Tensor, "M 3"]
    """Direction back along the path, local."""
    parameters: Float[Tensor, "M P"]
    throughput: Float[Tensor, "M C"]
    """Light that reaches the eye from this vertex, a part of it, divided by the density of the path."""

    def front(self, directions: Float[Tensor, "M 3"], cosines: Float[Tensor, " M"]) -> Bool[Tensor, " M"]:
        """Whether directions (world) leave the surface: above the shading normal's horizon and the triangle's."""
        return (cosines > 0) & ((directions * self.points.geometric_normals).sum(dim=-1) > 0)


@dataclass(frozen=True)
class _Light:
    """Light that paths found at one vertex."""

    paths: Int[Tensor, " M"]
    radiance: Float[Tensor, "M C"]


def reflected_radiance(
    surface: Surface,
    ray_mesh: RayMesh,
    environment: Environment,
    points: SurfacePoints,
    to_eye: Float[Tensor, "N 3"],
    *,
    samples: int,
    bounces: int = 1,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "N C"]:
    """An unbiased estimate of the radiance that leaves points to the eye; two calls are independent.

    Args:
        surface: Materials of the mesh.
        ray_mesh: The mesh, on the device of the points.
        environment: Light from outside, with as many colours as the materials.
        points: Of `RayMesh.points`.
        to_eye: Unit vectors to the viewer.
        samples: Paths a point, spread evenly over what can be drawn.
        bounces: Reflections before the last one: 0 is direct light only.
        generator: Of torch's numbers, on the device of the points.
    Raises:
        ValueError: materials and environment differ in colours.
    """
    if environment.num_colours != surface.family.num_colours:
        raise ValueError(
            f"the environment has {environment.num_colours} colours, the materials have "
            f"{surface.family.num_colours}; they must be the same"
        )
    world = _World(decoded_once(surface), ray_mesh, environment)
    device, num_points = to_eye.device, len(to_eye)
    numbers = SamplePoints.draw(num_points, samples, bounces + 1, generator, device)
    vertices = _first_vertices(world, points, to_eye, samples)
    radiance = torch.zeros(num_points, environment.num_colours, device=device)
    for depth in range(bounces + 1):
        drawn = numbers.of(vertices.paths, depth)
        lights, vertices = _shade(world, vertices, drawn, is_last=depth == bounces)
        for light in lights:
            radiance = radiance.index_add(0, light.paths // samples, light.radiance)
    return radiance / samples


def _first_vertices(world: _World, points: SurfacePoints, to_eye: Tensor, samples: int) -> _Vertices:
    # Materials are looked up once a point, not once a sample.
    parameters = world.surface.parameters(points.positions)
    axes = frames(points.normals)
    wo = to_local(axes, to_eye)
    rows = torch.arange(len(to_eye), device=to_eye.device).repeat_interleave(samples)
    return _Vertices(
        torch.arange(len(rows), device=to_eye.device),
        points.select(rows),
        axes[rows],
        wo[rows],
        parameters[rows],
        torch.ones(len(rows), world.environment.num_colours, device=to_eye.device),
    )


def _shade(
    world: _World, vertices: _Vertices, drawn: Float[Tensor, "M D"], is_last: bool
) -> tuple[list[_Light], _Vertices]:
    """Direct light at vertices by both strategies, and the vertices that the paths reach next."""
    light = _light_by_environment(world, vertices, drawn[:, :2])
    wi = world.surface.family.sample(vertices.parameters.detach(), vertices.wo, drawn[:, 2:].float())
    directions = to_world(vertices.axes, wi)
    rows = vertices.front(directions, wi[:, 2]).nonzero()[:, 0]
    vertices, wi, directions = _select(vertices, rows), wi[rows], directions[rows]
    if is_last:
        free = ~world.ray_mesh.blocked(vertices.points.positions, directions)
        rows = free.nonzero()[:, 0]
        carried, density = _carried(world, _select(vertices, rows), wi[rows])
        escaped = _light_by_material(world, vertices.paths[rows], directions[rows], carried, density)
        return [light, escaped], _select(vertices, rows[:0])
    hits = world.ray_mesh.closest(vertices.points.positions, directions)
    carried, density = _carried(world, vertices, wi)
    free, met = (~hits.found).nonzero()[:, 0], hits.found.nonzero()[:, 0]
    escaped = _light_by_material(world, vertices.paths[free], directions[free], carried[free], density[free])
    reached = _reached(world, vertices.paths[met], hits.select(met), directions[met], carried[met])
    return [light, escaped], reached


def _light_by_environment(world: _World, vertices: _Vertices, drawn: Float[Tensor, "M 2"]) -> _Light:
    """Direct light from directions that the environment draws."""
    directions, density = world.environment.sample(drawn)
    cosines = (directions * vertices.points.normals).sum(dim=-1)
    rows = (vertices.front(directions, cosines) & (density > 0)).nonzero()[:, 0]
    rows = rows[~world.ray_mesh.blocked(vertices.points.positions[rows], directions[rows])]
    vertices, directions, density = _select(vertices, rows), directions[rows], density[rows]
    family, wi = world.surface.family, to_local(vertices.axes, directions)
    reflectance = family.evaluate(vertices.parameters, wi, vertices.wo)
    other = family.density(vertices.parameters.detach(), wi, vertices.wo)
    factor = (cosines[rows] * _power_heuristic(density, other) / density)[:, None]
    radiance = world.environment.radiance(directions)
    return _Light(vertices.paths, vertices.throughput * reflectance * (factor * radiance))


def _carried(
    world: _World, vertices: _Vertices, wi: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, "M C"], Float[Tensor, " M"]]:
    """Throughput behind a reflection into directions that the material drew, and their density."""
    family = world.surface.family
    density = family.density(vertices.parameters.detach(), wi, vertices.wo)
    usable = torch.isfinite(density) & (density > 0)
    factor = torch.where(usable, wi[:, 2] / density, 0.0)[:, None]
    reflectance = family.evaluate(vertices.parameters, wi, vertices.wo)
    return vertices.throughput * reflectance * factor, density


def _light_by_material(
    world: _World, paths: Tensor, directions: Tensor, carried: Tensor, density: Tensor
) -> _Light:
    """Direct light of paths that leave the scene in directions that the material drew."""
    weight = _power_heuristic(density, world.environment.density(directions))
    return _Light(paths, carried * (weight[:, None] * world.environment.radiance(directions)))


def _reached(world: _World, paths: Tensor, hits: Hits, directions: Tensor, carried: Tensor) -> _Vertices:
    """The next vertices of paths that met the mesh."""
    points = world.ray_mesh.points(hits, directions)
    axes = frames(points.normals)
    parameters = world.surface.parameters(points.positions)
    return _Vertices(paths, points, axes, to_local(axes, -directions), parameters, carried)


def _select(vertices: _Vertices, rows: Int[Tensor, " M"]) -> _Vertices:
    return _Vertices(
        vertices.paths[rows],
        vertices.points.select(rows),
        vertices.axes[rows],
        vertices.wo[rows],
        vertices.parameters[rows],
        vertices.throughput[rows],
    )


def _power_heuristic(chosen: Float[Tensor, " M"], other: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
    """Weight of a direction that one strategy drew, by the densities of both; of exponent 2."""
    # By the ratio, since squares of the densities of sharp lobes overflow.
    ratio = other / chosen
    return torch.where(torch.isfinite(ratio), 1 / (1 + ratio * ratio), 0.0)
