"""Regions measured on the surface of a scene: how large they are, their mean spectrum with its spread, and what they
are made of.

All is weighted by area (`TriangleMesh.areas`), on the surface that `unmix-export mesh` exports.

Notation: `V` vertices, `F` faces, `P` points, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.intervals import COVERAGE, UNDETERMINED, Interval, width_factor
from unmix_plugin.trained.intervals import TOO_FEW_VIEWS
from unmix_plugin.trained.measures import Scale, describe_area
from unmix_plugin.trained.place_errors import LocalErrors, PlaceErrors
from unmix_plugin.trained.protocol import Probe
from unmix_plugin.trained.regions import Box, InView, OfMaterial, Region
from unmix_plugin.trained.surface import Follow, SeenSurface, SurfaceAppearance, in_image, look_from_above
from unmix_plugin.trained.surface_mesh import TriangleMesh, Working, surface_of
from unmix_plugin.trained.trained_scene import TrainedScene

_MOST_RAYS = 1 << 20
"""By which it is found what of a region a camera sees."""
_PARTS = ((2, 2, 2), (4, 1, 1), (1, 4, 1), (1, 1, 4))
"""Points of a triangle that tell how much of it is in a region, by their shares of its corners, in sixths."""


@dataclass(frozen=True)
class MeasuredRegion:
    """What a part of a surface is."""

    area: float
    """Square units of the world."""
    mean: Float64[np.ndarray, " B"]
    """Spectrum without the view-dependent part."""
    spread: Float64[np.ndarray, " B"]
    """Standard deviation over the area."""
    abundances: Float64[np.ndarray, " K"]
    """Summing to 1."""
    faces: Bool[np.ndarray, " F"]
    """Triangles of which more than half is in it."""
    vertex_areas: Float64[np.ndarray, " V"]
    """Its part of what each vertex stands for, a third of its triangles; square units of the world."""
    errors: LocalErrors | str
    """How far its means are expected to be off, or why that is unknown, for people."""
    area_interval: Interval
    """Where its area lies: as far as a material's outline, or a region's edges on the surface, may be elsewhere."""

    @property
    def probe(self) -> Probe:
        """Its means, as what a place shows."""
        return Probe({"predicted": self.mean, "abundances": self.abundances}, 1.0, None, None, self.errors)

    def in_words(self, names: Sequence[str], scale: Scale | None) -> str:
        """Area and largest shares for people."""
        largest = np.argsort(-self.abundances)[:3]
        shares = ", ".join(f"{names[index]} {self.abundances[index]:.2f}" for index in largest)
        return f"{describe_area(self.area, scale)}: {shares}"


class MeasuredSurface:
    """The surface of a scene, in which any region can be measured."""

    def __init__(self, scene: TrainedScene, mesh: TriangleMesh) -> None:
        """Of a scene, unedited or edited, whose surface is the mesh in model space."""
        self.scene, self.mesh = scene, mesh
        positions, normals = (torch.from_numpy(values).float() for values in (mesh.vertices, mesh.normals))
        self._abundances, self._diffuse = look_from_above(scene, positions, normals)
        self._materials = SurfaceAppearance(scene.materials, self._abundances, self._diffuse).material_ids

    @classmethod
    def of(
        cls,
        scene: TrainedScene,
        follow: Follow = lambda _doing, items: items,
        working: Working = lambda _doing: nullcontext(),
    ) -> MeasuredSurface:
        """The surface that `mesh` exports, as `surface_of` finds it."""
        mesh, _ = surface_of(scene, follow=follow, working=working)
        with working("looking at the surface's points"):
            return cls(scene, mesh)

    @cached_property
    def areas(self) -> Float64[np.ndarray, " F"]:
        """Of the triangles, square units of the world."""
        return self.mesh.areas() / self.scene.frame.scale**2

    def measure(self, region: Region, name: str) -> MeasuredRegion:
        """What a region is; a ConfigError where it has nothing of the surface, or the scene no such material."""
        # How much of each third of a triangle, that of a corner, is in the region: 0 to 1.
        faces, names = self.mesh.faces, self.scene.materials.names
        if isinstance(region, OfMaterial):
            if region.material >= len(names):
                raise ConfigError(
                    f"the region {name} can't be found: the scene has no material {region.material}; it has "
                    f"{len(names)}"
                )
            fractions = (self._materials == region.material)[faces].astype(np.float64)
        else:
            corners, weights = self.mesh.vertices[faces], np.array(_PARTS) / 6
            points = np.einsum("pc,fcx->fpx", weights, corners).reshape(-1, 3)
            inside = points_in(self.scene, region, torch.from_numpy(points).float())
            fractions = inside.reshape(len(faces), len(_PARTS)) @ weights / weights.sum(axis=0)

        of_corners = fractions * (self.areas / 3)[:, None]
        weights = np.bincount(faces.ravel(), of_corners.ravel(), len(self.mesh.vertices))
        area = float(weights.sum())
        if area <= 0:
            world = self.scene.frame.to_world(self.mesh.vertices).round(3)
            raise ConfigError(
                f"the region {name} has nothing of the surface in it, which lies between "
                f"{' '.join(f'{x:g}' for x in world.min(axis=0))} and {' '.join(f'{x:g}' for x in world.max(axis=0))} "
                "of the world"
            )
        errors, area_interval = self._uncertainty(region, weights)
        share = weights / area
        spectra = self._diffuse.double().numpy()
        mean = share @ spectra
        spread = np.sqrt(share @ (spectra - mean) ** 2)
        abundances = share @ self._abundances.double().numpy()
        is_inside = fractions.mean(axis=1) > 0.5
        return MeasuredRegion(area, mean, spread, abundances, is_inside, weights, errors, area_interval)

    def _uncertainty(
        self, region: Region, weights: Float64[np.ndarray, " V"]
    ) -> tuple[LocalErrors | str, Interval]:
        """Errors of means over a region, from its part of what each vertex stands for, and the interval of its area."""
        errors, area = self.scene.errors, np.asarray(weights.sum())
        if isinstance(errors, str):
            return errors, Interval.unknown(area, COVERAGE, errors)
        edge = float(area) ** 0.5 * self.scene.frame.scale
        inside = torch.from_numpy(weights > 0)
        within = (torch.from_numpy(self.mesh.vertices).float(), self._abundances, self._diffuse)
        found = errors.over_region(errors.at(*(one[inside] for one in within)), weights[inside.numpy()], edge)
        if not bool(found.spectra.isfinite()):
            return found, Interval.unknown(area, COVERAGE, TOO_FEW_VIEWS)
        whole = np.bincount(self.mesh.faces.ravel(), np.repeat(self.areas / 3, 3), len(weights))
        least = most = weights / np.maximum(whole, 1e-30)
        if isinstance(region, OfMaterial):
            if not bool(errors.is_determined[region.material]):
                return found, Interval.unknown(area, COVERAGE, UNDETERMINED)
            margins = self._margins(region.material, errors, edge)
            least, most = (margins > 1).astype(np.float64), (margins > -1).astype(np.float64)
        # Outlines are known to about half a pixel, which is how far neighbouring vertices are apart.
        low, high = (
            np.asarray(whole @ self._of_neighbours(part, extreme))
            for part, extreme in ((least, np.minimum), (most, np.maximum))
        )
        low, high = (np.asarray(end) for end in (np.minimum(low, area), np.maximum(high, area)))
        return found, Interval(low, high, COVERAGE)

    def _of_neighbours(
        self, values: Float64[np.ndarray, " V"], extreme: np.ufunc
    ) -> Float64[np.ndarray, " V"]:
        """The least or greatest value of each vertex and those that share a triangle with it."""
        found = values.copy()
        of_faces = extreme.reduce(values[self.mesh.faces], axis=1)
        for corner in range(3):
            extreme.at(found, self.mesh.faces[:, corner], of_faces)
        return found

    def _margins(self, material: int, errors: PlaceErrors, edge: float) -> Float64[np.ndarray, " V"]:
        """How far a material is above the largest other one at each vertex, in half widths of the interval that errors
        shared by a region with this edge (model units) leave; where errors are unknown, beyond any."""
        local = errors.at(torch.from_numpy(self.mesh.vertices).float(), self._abundances, self._diffuse)
        deviations = local.abundances.cpu().double().numpy()
        abundances = self._abundances.double().numpy()
        others = np.where(np.arange(abundances.shape[1]) == material, -1.0, abundances)
        second = others.argmax(axis=1)
        rows = np.arange(len(abundances))
        # What one has too much the other has too little: their errors add up.
        half = deviations[:, material] + deviations[rows, second]
        half *= width_factor(errors.abundance_factors, COVERAGE) * errors.alike(edge)[0] ** 0.5
        margins = abundances[:, material] - others[rows, second]
        beyond = np.where(margins > 0, np.inf, -np.inf)
        return np.where(np.isfinite(half), margins / np.maximum(half, 1e-9), beyond)


def points_in(
    scene: TrainedScene, region: Box | InView, positions: Float[Tensor, "P 3"]
) -> Bool[np.ndarray, " P"]:
    """Which points of a scene's surface (model space, on the CPU) are in a box or in a part of a view."""
    if isinstance(region, Box):
        world = scene.frame.to_world(positions.double().numpy())
        return np.all((world >= region.low) & (world <= region.high), axis=1, keepdims=False)
    camera, mask = region.camera.to("cpu"), region.mask()
    inside, coords, _ = in_image(camera, positions)
    columns, rows = coords.long().numpy().T
    inside[inside.clone()] = torch.from_numpy(mask[rows, columns])
    if bool(inside.any()):
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        height, width = int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1
        part = camera.crop(int(columns[0]), int(rows[0]), width, height)
        # Pages and views from near have pixels far smaller than the surface is known; more than a million pixels of a
        # camera tell nothing more of what is before it, and a file may name a camera of any size.
        seen = SeenSurface(scene, min(width * height, _MOST_RAYS), [part])
        inside[inside.clone()] = seen.shows(positions[inside], scene.pixel_size)
    return inside.numpy()
