"""An object whose surface, materials and views are known exactly, and captures of it with a planted change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import torch
import trimesh

from tests.factories.models import make_scene
from unmix_plugin.comparing.captured import Capture, Observed, Surface
from unmix_plugin.comparing.registration import Similarity
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.trained.places import MeasuredScene
from unmix_plugin.trained.surface import Follow

BANDS = Bands.of([450.0, 520.0, 600.0, 680.0])
LEAF, CLAY, CHALK = ([0.1, 0.5, 0.1, 0.6], [0.2, 0.3, 0.5, 0.6], [0.7, 0.75, 0.8, 0.8])
PIXEL = 0.05
MOVED = Similarity(
    1.3,
    np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]),
    np.array([2.0, -1.0, 0.5]),
)
"""From the first world to the second."""


def nothing(_doing: str, items: Any) -> Any:
    """Show nothing of how far it is."""
    return items


Shape = Callable[[np.ndarray], np.ndarray]


def lumpy(directions: np.ndarray) -> np.ndarray:
    """Distance from the middle along each direction: no two sides are alike."""
    x, y, z = directions.T
    return 1.0 + 0.25 * x + 0.2 * np.sin(3 * y + 1) * np.cos(2 * z) + 0.15 * np.sin(4 * x * z)


def abundances_of(directions: np.ndarray) -> np.ndarray:
    """Of leaf, clay and chalk: patches with soft borders."""
    x, y, z = directions.T
    leaf = 1 / (1 + np.exp(-8 * np.sin(3 * x + 2 * y)))
    chalk = (1 - leaf) / (1 + np.exp(-8 * np.sin(4 * z - x)))
    return np.stack([leaf, 1 - leaf - chalk, chalk], axis=1)


def surface_of_shape(
    shape: Shape = lumpy, subdivisions: int = 4, spectra: np.ndarray | None = None
) -> Surface:
    """In the first world."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    directions = np.asarray(ball.vertices, dtype=np.float64)
    mesh = trimesh.Trimesh(directions * shape(directions)[:, None], ball.faces, process=False)
    areas = np.bincount(mesh.faces.ravel(), np.repeat(mesh.area_faces / 3, 3), len(directions))
    abundances = abundances_of(directions)
    known = abundances @ np.array([LEAF, CLAY, CHALK]) if spectra is None else spectra
    return Surface(
        np.asarray(mesh.vertices, np.float64).copy(),
        np.asarray(mesh.vertex_normals, np.float64).copy(),
        areas,
        np.asarray(mesh.faces, np.int64).copy(),
        known,
        abundances,
    )


def in_world(surface: Surface, world: Similarity) -> Surface:
    """The surface in another world."""
    return replace(
        surface,
        positions=world.apply(surface.positions),
        normals=world.turn(surface.normals),
        areas=surface.areas * world.scale**2,
    )


@dataclass(frozen=True, eq=False)
class KnownCapture(Capture):
    """A capture whose views see every place with noise."""

    own_surface: Surface = field(kw_only=True)
    own_bands: Bands = BANDS
    own_pixel: float = PIXEL
    num_views: int = 12
    noise: float = 0.01
    height_noise: float = 0.1
    seed: int = 0

    @property
    def bands(self) -> Bands:
        return self.own_bands

    @property
    def pixel(self) -> float:
        return self.own_pixel

    def surface(self, follow: Follow = nothing, working: Any = None) -> Surface:
        return self.own_surface

    def observe(
        self,
        positions: np.ndarray,
        normals: np.ndarray,
        follow: Follow = nothing,
        largest_height: float = 6.0,
    ) -> Observed:
        """What is nearest to each place, by views that each see two places of three."""
        from scipy.spatial import KDTree

        generator, own = np.random.default_rng(self.seed), self.own_surface
        _, nearest = KDTree(own.positions).query(positions)
        shape = (self.num_views, len(positions))
        spectra = own.spectra[nearest] * (1 + self.noise * generator.normal(size=(*shape, 1)))
        spectra = spectra + self.noise * 0.2 * generator.normal(size=(*shape, len(self.bands)))
        along = ((own.positions[nearest] - positions) * normals).sum(axis=1) / self.own_pixel
        heights = along + self.height_noise * generator.normal(size=shape)
        heights += self.height_noise * generator.normal(
            size=len(positions)
        )  # of the field, the same in all views
        unseen = generator.random(shape) < 1 / 3
        spectra[unseen], heights[unseen] = np.nan, np.nan
        return Observed(spectra.astype(np.float32), heights.astype(np.float32))


def capture(
    surface: Surface,
    name: str = "object",
    endmembers: list[list[float]] | None = None,
    bands: Bands = BANDS,
    **settings: object,
) -> KnownCapture:
    """A capture of a surface in its own world."""
    scene = make_scene()
    spectra = torch.tensor([LEAF, CLAY, CHALK] if endmembers is None else endmembers)
    names = ("leaf", "clay", "chalk", "soot")[: len(spectra)]
    materials = replace(
        scene.materials, bands=bands, endmembers=spectra, names=names, light=None,
        specular_spectra=torch.zeros(1, len(bands)),
    )  # fmt: skip
    scene = replace(scene, materials=materials)
    if len(spectra) != surface.abundances.shape[1]:
        padded = np.zeros((len(surface.abundances), len(spectra)))
        padded[:, : surface.abundances.shape[1]] = surface.abundances
        surface = replace(surface, abundances=padded)
    values = {"scale": None, **settings}
    measured = MagicMock(spec=MeasuredScene)
    return KnownCapture(name, Path(name), scene, measured, own_surface=surface, own_bands=bands, **values)


def later(surface: Surface, light: float = 1.2, seed: int = 1, **settings: object) -> KnownCapture:
    """A capture of the surface in another world and in more light."""
    moved = in_world(replace(surface, spectra=surface.spectra * light), MOVED)
    endmembers = [[light * value for value in one] for one in (LEAF, CLAY, CHALK)]
    values = {"endmembers": endmembers, **settings}
    return capture(moved, "later", own_pixel=PIXEL * MOVED.scale, seed=seed, **values)
