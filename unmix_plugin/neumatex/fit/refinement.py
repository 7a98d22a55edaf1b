"""What is fitted together with materials where it was estimated: the light, and the normals of a run's mesh.

A radiance field gives a surface whose places are right within a part of a pixel, and whose normals are not: highlights
leave dents, noise leaves bumps. What surfaces face decides how bright they are, so that pictures tell normals better
than they tell places. The light was estimated from shading alone, which a highlight tells more sharply.

Notation: `V` vertices, `F` triangles, `L` parts of a lamp, `M` patches of sky.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from unmix_plugin.neumatex.tracing.lamp_and_sky import NUM_PARTS, NUM_PATCHES, LampAndSky
from unmix_plugin.trained.surface_mesh import TriangleMesh

_NARROWEST_DEG = 2.2
"""Of a part of the lamp: less is a part of a pixel of the map."""
_LEAST_PATCH = 0.03
"""Part of the sky that a patch begins with: from nothing none can grow."""
_SHARP_AT_FIRST = 0.9
"""Part of the lamp that begins as its sharp lobe. Shading takes the glow about the sun, and light between surfaces, for
a soft lamp; highlights tell, but only from a lamp that is sharp: begun as shading had it, the sun of an object stayed
14 degrees wide."""
_FIRST_SHARP_DEG = 5.0
"""With which a sharp part begins at least: a narrower one sees no gradient where highlights are wide."""
_SMOOTHINGS, _WIDE = 6, 24
"""How often what is fitted at the vertices is averaged with that of their neighbours, since a vertex alone is seen by
few pixels of a batch, whose noise would be fitted; and how often again for what is taken away from it: a field has the
shape at large right, and what is wrong with the light would bend it."""


class FittedLight(nn.Module):
    """A lamp and a sky that are fitted, the brightness of white kept: pictures tell the product of light and
    reflectance alone."""

    def __init__(self) -> None:
        """Parameters that `start_from` fills."""
        super().__init__()
        self.towards = nn.Parameter(torch.tensor([0.0, 0.0, 1.0]))
        self.log_widths = nn.Parameter(torch.zeros(NUM_PARTS))
        self.log_lamp = nn.Parameter(torch.zeros(NUM_PARTS))
        self.log_sky = nn.Parameter(torch.zeros(NUM_PATCHES))
        self.register_buffer("white", torch.ones(()))

    @torch.no_grad()
    def start_from(self, light: LampAndSky) -> None:
        """Begin with a light that was found."""
        self.get_buffer("white").copy_(light.white_facing_the_lamp())
        self.towards.copy_(normalize(light.towards, dim=0))
        self.log_widths.copy_(light.widths_deg.clamp(min=_FIRST_SHARP_DEG).log())
        parts = torch.tensor([_SHARP_AT_FIRST, 1 - _SHARP_AT_FIRST]).to(light.lamp)
        self.log_lamp.copy_((float(light.lamp.sum()) * parts).clamp(min=1e-6).log())
        self.log_sky.copy_(light.sky.clamp(min=_LEAST_PATCH * float(light.sky.sum())).log())

    def light(self) -> LampAndSky:
        """As it is now."""
        widths = self.log_widths.exp().clamp(min=_NARROWEST_DEG)
        free = LampAndSky(self.towards, widths, self.log_lamp.exp(), self.log_sky.exp())
        factor = self.get_buffer("white") / free.white_facing_the_lamp()
        return LampAndSky(self.towards, widths, factor * free.lamp, factor * free.sky)


class FittedNormals(nn.Module):
    """Shading normals of a mesh's vertices: those of the mesh and what is added to them, dents and bumps between two
    sizes.

    Source:
        Nicolet et al. 2021, Large Steps in Inverse Rendering of Geometry, for the smoothing inside the parameters.
    """

    def __init__(self, num_vertices: int) -> None:
        """Nothing is added at first."""
        super().__init__()
        self.offsets = nn.Parameter(torch.zeros(num_vertices, 3))
        self._links: tuple[Tensor, Tensor, Tensor] | None = None

    def forward(self, normals: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
        """Unit normals, given those of the mesh."""
        if self._links is None or self._links[0].device != faces.device:
            self._links = _averaging(faces, len(normals))
        rows, columns, shares = self._links

        def averaged(offsets: Tensor, times: int) -> Tensor:
            for _ in range(times):
                offsets = torch.zeros_like(offsets).index_add(0, rows, shares * offsets[columns])
            return offsets

        offsets = averaged(self.offsets, _SMOOTHINGS)
        return normalize(normals + offsets - averaged(offsets, _WIDE), dim=1)


def _averaging(faces: Int[Tensor, "F 3"], num_vertices: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rows, columns and values (n 1) of the matrix that gives each vertex the mean of itself and its neighbours."""
    from scipy.sparse import identity

    mesh = TriangleMesh(np.zeros((num_vertices, 3)), faces.cpu().numpy().astype(np.int64))
    links = (mesh.links + identity(num_vertices)).tocoo()
    rows, columns = (torch.from_numpy(part).long().to(faces.device) for part in (links.row, links.col))
    counts = torch.bincount(rows, minlength=num_vertices).float()
    return rows, columns, (1 / counts)[rows, None]
