"""Radiance that a mesh reflects under an environment, with gradients to its materials.

At each vertex of a path two directions are drawn: one by the environment's density, one by the material's. Both give
direct light, weighed by the power heuristic; the material's, where it meets the mesh again, carries the path on.
Directions, densities and weights have no gradient; reflectances, shading normals and radiances of the environment do
where they are fitted: the estimate of the radiance is unbiased, and so is that of its derivative (detached sampling),
since neither the visibility nor the densities of the integral depend on them.

Random numbers are uniform for each path, and evenly spread over the paths of a point: a Sobol sequence over the samples
is shifted by random numbers of each point (modulo 1).

Notation: `R` rays, `N` points, S samples per point, `M` vertices of paths that are alive, `C` colours, `P` parameters,
`H x W` pixels, `K` rays of a picture that meet the mesh.

Source: Veach 1997, Robust Monte Carlo Methods for Light Transport Simulation, chapter 9; Zeltner et al. 2021, Monte
Carlo Estimators for Differential Light Transport, for the name detached sampling; Cranley and Patterson 1976,
Randomization of Number Theoretic Methods for Multiple Integration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.engine import Cameras
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import MaterialFamily
from unmix_plugin.neumatex.tracing.microfacet import frames, to_local, to_world
from unmix_plugin.neumatex.tracing.rays import PixelHits, RayMesh, SurfacePoints, pixel_hits
from unmix_plugin.neumatex.tracing.surface import Surface

_PATHS_AT_ONCE = 1 << 18
"""Paths of one call for a picture, which bounds the memory."""
_NUMBERS_A_VERTEX = 5
"""Two for the environment, three for the material."""
_Light = tuple[Tensor, Tensor]
"""Paths (M), and the radiance that they found at one vertex (M, C)."""


@dataclass(frozen=True)
class TracedObject:
    """Mesh, light and materials: what light meets on its way."""

    ray_mesh: RayMesh
    environment: Environment
    surface: Surface

    def light(
        self, points: SurfacePoints, samples: int, bounces: int = 1, generator: torch.Generator | None = None
    ) -> Float[Tensor, "N C"]:
        """Light that points send to the eye, an unbiased estimate, differentiable by the materials; two calls are
        independent.

        Args:
            samples: Paths a point, spread evenly over what can be drawn.
            bounces: Reflections before the last one: 0 is direct light only.
            generator: Of torch's numbers, on the device of the points.
        """
        num_points, num_colours = len(points.positions), self.environment.num_colours
        assert num_colours == self.surface.family.num_colours
        device, dimensions = points.positions.device, _NUMBERS_A_VERTEX * (bounces + 1)
        sequence = torch.quasirandom.SobolEngine(dimensions).draw(samples, dtype=torch.float64).to(device)
        shifts = torch.rand(num_points, dimensions, generator=generator, dtype=torch.float64, device=device)
        # Materials are looked up once a point, not once a sample.
        rows, white = (
            torch.arange(num_points, device=device),
            torch.ones(num_points, num_colours, device=device),
        )
        turned = None
        if self.environment.moves is not None:
            assert points.eyes is not None
            turned = self.environment.moves.axes(points.eyes)
        vertices = _Vertices.of(self.surface, rows, points, white, turned)
        vertices = vertices.select(rows.repeat_interleave(samples))
        vertices = replace(vertices, paths=torch.arange(num_points * samples, device=device))
        radiance = torch.zeros(num_points, num_colours, device=device)
        for depth in range(bounces + 1):
            part = slice(_NUMBERS_A_VERTEX * depth, _NUMBERS_A_VERTEX * (depth + 1))
            # Path p is sample p % S of point p // S.
            drawn = sequence[:, part][vertices.paths % samples] + shifts[:, part][vertices.paths // samples]
            drawn = (drawn - drawn.floor()).clamp(max=1 - 2.0**-24)  # rounded to float32 it must not be 1
            lights, vertices = _shade(self, vertices, drawn, is_last=depth == bounces)
            for paths, found in lights:
                radiance = radiance.index_add(0, paths // samples, found)
        return radiance / samples

    @torch.no_grad()
    def light_of_rays(
        self, hits: PixelHits, samples: int, bounces: int, generator: torch.Generator | None
    ) -> Float[Tensor, "K C"]:
        """Light along each ray of a picture, chunk after chunk; samples are those of a pixel. Without gradient."""
        samples_a_ray = max(1, -(-samples // hits.rays_a_pixel))
        device = self.ray_mesh.device
        parts = [
            self.light(hits.points.select(rows), samples_a_ray, bounces, generator)
            for rows in torch.arange(len(hits), device=device).split(max(1, _PATHS_AT_ONCE // samples_a_ray))
        ]
        return torch.cat(parts) if parts else torch.zeros(0, self.environment.num_colours, device=device)

    def picture(
        self,
        cameras: Cameras,
        index: int,
        samples: int,
        bounces: int = 1,
        subpixels: int = 2,
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
        """The picture of a camera, linear light multiplied by alpha, and the part of each pixel that the mesh covers.

        Args:
            cameras: In the mesh's space.
            index: Which of them.
            samples: Paths a pixel, spread over its rays; at least one a ray.
            subpixels: A pixel has subpixels x subpixels rays.
        """
        hits = pixel_hits(self.ray_mesh, cameras, index, subpixels)
        return hits.image(self.light_of_rays(hits, samples, bounces, generator)), hits.alpha()


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
    family: MaterialFamily
    """Of the parameters."""
    light_axes: Float[Tensor, "M 3 3"] | None
    """Of the environment, as seen from where each path ends; None: those of the world."""

    @staticmethod
    def of(
        surface: Surface, paths: Tensor, points: SurfacePoints, throughput: Tensor, light_axes: Tensor | None
    ) -> _Vertices:
        """Paths that have reached points."""
        axes = frames(points.normals)
        family, parameters = surface.family.decoded(surface.parameters(points.positions))
        wo = to_local(axes, points.to_eye)
        return _Vertices(paths, points, axes, wo, parameters, throughput, family, light_axes)

    def front(self, directions: Float[Tensor, "M 3"], cosines: Float[Tensor, " M"]) -> Bool[Tensor, " M"]:
        """Whether directions (world) leave the surface: above the shading normal's horizon and the triangle's."""
        return (cosines > 0) & ((directions * self.points.geometric_normals).sum(dim=-1) > 0)

    def reflection(self, wi: Float[Tensor, "M 3"]) -> tuple[Float[Tensor, "M C"], Float[Tensor, " M"]]:
        """Reflectance of light from local directions, and the density with which the material draws these."""
        density = self.family.density(self.parameters.detach(), wi, self.wo)
        return self.family.evaluate(self.parameters, wi, self.wo), density

    def select(self, rows: Int[Tensor, " M"]) -> _Vertices:
        names = ("paths", "axes", "wo", "parameters", "throughput", "light_axes")
        parts = {name: getattr(self, name) for name in names}
        chosen = {name: None if part is None else part[rows] for name, part in parts.items()}
        return replace(self, points=self.points.select(rows), **chosen)

    def in_light(self, directions: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """Directions of the world in the environment's axes."""
        return directions if self.light_axes is None else to_local(self.light_axes, directions)


def _shade(
    world: TracedObject, vertices: _Vertices, drawn: Float[Tensor, "M D"], is_last: bool
) -> tuple[list[_Light], _Vertices]:
    """Direct light at vertices by both strategies, and the vertices that the paths reach next; none from the last."""
    light = _light_by_environment(world, vertices, drawn[:, :2])
    wi = vertices.family.sample(vertices.parameters.detach(), vertices.wo, drawn[:, 2:].float())
    directions = to_world(vertices.axes.detach(), wi)
    if vertices.axes.requires_grad:  # the direction stays where it is in the world, the frame turns
        wi = to_local(vertices.axes, directions)
    rows = vertices.front(directions, wi[:, 2]).nonzero()[:, 0]
    vertices, wi, directions = vertices.select(rows), wi[rows], directions[rows]
    hits = world.ray_mesh.closest(vertices.points.positions, directions)
    if is_last:  # what is hit sends no more light
        rows = (~hits.found).nonzero()[:, 0]
        vertices, wi, directions, hits = vertices.select(rows), wi[rows], directions[rows], hits.select(rows)
    free, hit = (~hits.found).nonzero()[:, 0], hits.found.nonzero()[:, 0]
    reflectance, density = vertices.reflection(wi)
    usable = torch.isfinite(density) & (density > 0)
    carried = vertices.throughput * reflectance * torch.where(usable, wi[:, 2] / density, 0.0)[:, None]
    towards = vertices.in_light(directions)[free]
    weight = _power_heuristic(density[free], world.environment.density(towards))
    escaped = carried[free] * (weight[:, None] * world.environment.radiance(towards))
    points = world.ray_mesh.points(hits.select(hit), directions[hit])
    turned = None if vertices.light_axes is None else vertices.light_axes[hit]
    reached = _Vertices.of(world.surface, vertices.paths[hit], points, carried[hit], turned)
    return [light, (vertices.paths[free], escaped)], reached


def _light_by_environment(world: TracedObject, vertices: _Vertices, drawn: Float[Tensor, "M 2"]) -> _Light:
    """Direct light from directions that the environment draws."""
    towards, density = world.environment.sample(drawn)
    directions = towards if vertices.light_axes is None else to_world(vertices.light_axes, towards)
    cosines = (directions * vertices.points.normals).sum(dim=-1)
    rows = (vertices.front(directions, cosines) & (density > 0)).nonzero()[:, 0]
    rows = rows[~world.ray_mesh.blocked(vertices.points.positions[rows], directions[rows])]
    vertices, directions, towards, density = (
        vertices.select(rows),
        directions[rows],
        towards[rows],
        density[rows],
    )
    reflectance, other = vertices.reflection(to_local(vertices.axes, directions))
    factor = (cosines[rows] * _power_heuristic(density, other) / density)[:, None]
    radiance = world.environment.radiance(towards)
    return vertices.paths, vertices.throughput * reflectance * (factor * radiance)


def _power_heuristic(chosen: Float[Tensor, " M"], other: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
    """Weight of a direction that one strategy drew, by the densities of both; of exponent 2."""
    # By the ratio, since squares of the densities of sharp lobes overflow.
    ratio = other / chosen
    return torch.where(torch.isfinite(ratio), 1 / (1 + ratio * ratio), 0.0)
