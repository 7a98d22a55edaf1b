"""An object as rays meet it: mesh, light and materials together.

Notation: `R` rays, of which `N` meet the mesh; `C` colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh, SurfacePoints
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.surface import Surface
from unmix_plugin.neumatex.tracing.path_tracer import reflected_radiance


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
