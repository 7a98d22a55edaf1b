"""An object as rays meet it: mesh, light and materials together.

Notation: `R` rays, of which `N` meet the mesh; `C` colours.

Radiance that a mesh reflects under an environment, with gradients to its materials.

At each vertex of a path two directions are drawn: one by the environment's density, one by the material's. Both give
direct light, weighed by the power heuristic; the material's, where it meets the mesh again, carries the path on.
Directions, densities and weights have no gradient, reflectances do: the estimate of the radiance is unbiased, and so
is that of its derivative (detached sampling), since neither the visibility nor the densities of the integral depend
on the materials.

Notation: `N` points, `M` vertices of paths that are alive, `C` colours, `P` parameters, S samples a point.

Source: Veach 1997, Robust Monte Carlo Methods for Light Transport Simulation, chapter 9; Zeltner et al. 2021, Monte
Carlo Estimators for Differential Light Transport, for the name detached sampling.

Random numbers of paths: uniform for each path, evenly spread over the paths of a point.

A Sobol sequence over the samples is shifted by random numbers of each point (modulo 1), so that each path's numbers
are uniform and independent between points, dimensions and calls, but fill the unit cube evenly.

Source: Cranley and Patterson 1976, Randomization of Number Theoretic Methods for Multiple Integration.

Whole pictures by the path tracer.

Notation: `H x W` pixels, `C` colours, `K` rays that meet the mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from unmix_plugin.engine import Cameras
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.neumatex.tracing.microfacet import frames, to_local, to_world
from unmix_plugin.neumatex.tracing.rays import (
    Hits,
    PixelHits,
    RayMesh,
    SurfacePoints,
    pixel_hits,
    subpixel_offsets,
)
from unmix_plugin.neumatex.tracing.surface import Surface, decoded_once


@dataclass(frozen=True)
class SeenPoints:
    """Where rays meet the mesh."""

    found: Bool[Tensor, " R"]
    points: SurfacePoints
    """N of them, in the order of the rays that found one."""
    to_eye: Float[Tensor, "N 3"]
    """Unit vectors back along the rays."""
    distances: Float[Tensor, " N"]
    """Along the rays, model units."""

    @staticmethod
    def cat(parts: Sequence[SeenPoints]) -> SeenPoints:
        """One after the other."""
        points = [part.points for part in parts]
        return SeenPoints(
            torch.cat([part.found for part in parts]),
            SurfacePoints(
                torch.cat([point.positions for point in points]),
                torch.cat([point.normals for point in points]),
                torch.cat([point.geometric_normals for point in points]),
            ),
            torch.cat([part.to_eye for part in parts]),
            torch.cat([part.distances for part in parts]),
        )

    def scatter(self, values: Float[Tensor, "N *rest"]) -> Float[Tensor, "R *rest"]:
        """Values of points as those of rays; 0 where a ray meets nothing."""
        whole = values.new_zeros((len(self.found), *values.shape[1:]))
        return whole.index_put((self.found.nonzero(as_tuple=True)[0],), values)


@dataclass(frozen=True)
class TracedObject:
    """Mesh, light and materials."""

    ray_mesh: RayMesh
    environment: Environment
    surface: Surface

    def under(self, environment: Environment) -> TracedObject:
        """The same object under another light."""
        return replace(self, environment=environment)

    def seen(self, origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]) -> SeenPoints:
        """What rays of unit directions meet first."""
        with torch.no_grad():
            hits = self.ray_mesh.closest(origins, directions)
            rows = hits.found.nonzero(as_tuple=True)[0]
            along = directions[rows]
            met = hits.select(rows)
            return SeenPoints(hits.found, self.ray_mesh.points(met, along), -along, met.distances)

    def light(
        self, seen: SeenPoints, samples: int, bounces: int, generator: torch.Generator
    ) -> Float[Tensor, "N C"]:
        """Light that the points send to the eye, an estimate from so many paths; differentiable by the materials."""
        return reflected_radiance(
            self.surface,
            self.ray_mesh,
            self.environment,
            seen.points,
            seen.to_eye,
            samples=samples,
            bounces=bounces,
            generator=generator,
        )


class TracedObjectCache:
    """Keeps the tree over a mesh's triangles while the mesh stays the same tensors; copies start empty."""

    def __init__(self) -> None:
        self._vertices: Tensor | None = None
        self._version = -1
        self._found: TracedObject | None = None

    def __deepcopy__(self, memo: dict) -> TracedObjectCache:
        return TracedObjectCache()

    def get(self, mesh: Mesh, environment: Environment, surface: Surface) -> TracedObject:
        """The object, with what was kept where the vertices have not changed since."""
        vertices = mesh.vertices
        if self._found is None or self._vertices is not vertices or self._version != vertices._version:
            self._vertices, self._version = vertices, vertices._version
            self._found = TracedObject(RayMesh(mesh, vertices.device), environment, surface)
        return self._found


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
    numbers = _SamplePoints.draw(num_points, samples, bounces + 1, generator, device)
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


NUMBERS_A_VERTEX = 5
"""Two for the environment, three for the material."""


@dataclass(frozen=True)
class _SamplePoints:
    """Numbers in [0, 1) of N points, S samples each."""

    sequence: Float64[Tensor, "S D"]
    """Common to the points."""
    shifts: Float64[Tensor, "N D"]
    """Of each point."""

    @staticmethod
    def draw(
        num_points: int,
        samples: int,
        vertices: int,
        generator: torch.Generator | None,
        device: torch.device,
    ) -> _SamplePoints:
        """Numbers for paths of so many vertices.

        Raises:
            ValueError: there is no sample.
        """
        if samples < 1:
            raise ValueError(f"samples must be at least 1; got {samples}")
        dimensions = NUMBERS_A_VERTEX * vertices
        sequence = torch.quasirandom.SobolEngine(dimensions).draw(samples, dtype=torch.float64)
        shifts = torch.rand(num_points, dimensions, generator=generator, dtype=torch.float64, device=device)
        return _SamplePoints(sequence.to(device), shifts)

    def of(self, paths: Int[Tensor, " M"], vertex: int) -> Float[Tensor, "M 5"]:
        """Numbers of a vertex of paths; path p is sample p % S of point p // S."""
        samples = len(self.sequence)
        part = slice(NUMBERS_A_VERTEX * vertex, NUMBERS_A_VERTEX * (vertex + 1))
        moved = self.sequence[:, part][paths % samples] + self.shifts[:, part][paths // samples]
        # Rounding to float32 later must not reach 1.
        return (moved - moved.floor()).clamp(max=1 - 2.0**-24)


_PATHS_AT_ONCE = 1 << 18
"""Paths of one call, which bounds the memory."""


def render_view(
    surface: Surface,
    ray_mesh: RayMesh,
    environment: Environment,
    cameras: Cameras,
    index: int = 0,
    *,
    samples: int = 64,
    bounces: int = 1,
    subpixels: int = 2,
    background: Literal["black", "environment"] = "black",
    generator: torch.Generator | None = None,
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
    """The picture of one camera, and the part of each pixel that the mesh covers.

    Args:
        cameras: In the mesh's space.
        index: Which of them.
        samples: Paths a pixel, spread over its rays; at least one a ray.
        subpixels: A pixel has subpixels x subpixels rays.
        background: What is seen where the mesh is not. With black, the colours are multiplied by alpha.
    Returns:
        Linear radiance and alpha; without gradient.
    """
    hits = pixel_hits(ray_mesh, cameras, index, subpixels)
    radiance = rays_radiance(
        surface, ray_mesh, environment, hits, samples=samples, bounces=bounces, generator=generator
    )
    image, alpha = hits.image(radiance), hits.alpha()
    if background == "environment":
        image = image + _background(ray_mesh, environment, cameras, index, subpixels)
    return image, alpha


@torch.no_grad()
def rays_radiance(
    surface: Surface,
    ray_mesh: RayMesh,
    environment: Environment,
    hits: PixelHits,
    *,
    samples: int,
    bounces: int = 1,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "K C"]:
    """Radiance along each ray of an image, chunk after chunk; samples are those of a pixel. Without gradient."""
    samples_a_ray = max(1, -(-samples // hits.rays_a_pixel))
    rows = torch.arange(len(hits), device=ray_mesh.device).split(max(1, _PATHS_AT_ONCE // samples_a_ray))
    parts = [
        reflected_radiance(
            surface,
            ray_mesh,
            environment,
            hits.points.select(part),
            hits.to_eye[part],
            samples=samples_a_ray,
            bounces=bounces,
            generator=generator,
        )
        for part in rows
    ]
    colours = environment.num_colours
    return torch.cat(parts) if parts else torch.zeros(0, colours, device=ray_mesh.device)


def _background(
    ray_mesh: RayMesh, environment: Environment, cameras: Cameras, index: int, subpixels: int
) -> Float[Tensor, "H W C"]:
    """Radiance of the environment where rays miss the mesh, as a mean over each pixel's rays."""
    width, height = cameras.size(index)
    total = torch.zeros(height * width, environment.num_colours, device=ray_mesh.device)
    for offset in subpixel_offsets(subpixels):
        rays = cameras.to(ray_mesh.device).image_rays(index, offset)
        missed = ~ray_mesh.blocked(rays.origins, rays.directions)
        total[missed] += environment.radiance(rays.directions[missed])
    return (total / subpixels**2).reshape(height, width, -1)
