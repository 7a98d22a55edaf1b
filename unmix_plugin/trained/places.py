"""What is at a place of a scene: in a pixel of a view, at a point of the world, or in a region of the surface; as it is
rendered, and as the training views measured it.

One rule says what was measured at a place: the mean over all training views with all bands that see it. A view sees a
place if its ray through the middle of the pixel that the place lies in ends within two pixels of the place, as large as
pixels are there, and if that pixel counts and shows nothing but the object. The same numbers stand in the viewer, in
exports and in Python.

Notation: `N` views that see a place, `P` points, `B` bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.scenes.geometry.views import look_up
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.measured_surface import MeasuredRegion, MeasuredSurface
from unmix_plugin.trained.protocol import Probe
from unmix_plugin.trained.regions import Region
from unmix_plugin.trained.run_materials import relit
from unmix_plugin.trained.trained_scene import TrainedScene

_SAME_PLACE_PX = 2.0
"""How far from a place a view may end, in its pixels, so that it is taken to see it."""
_WHOLE_ALPHA = 0.95
"""Alpha from which a pixel shows one thing."""


class Pixel(NamedTuple):
    """Of one camera's image, counted from 0 at the top left."""

    camera: Cameras
    column: int
    row: int


class Point(NamedTuple):
    """In the world of the scene's poses."""

    x: float
    y: float
    z: float


class NamedRegion(NamedTuple):
    """A part of the surface that measured regions are looked for in."""

    name: str
    region: Region
    surface: MeasuredSurface


Place: TypeAlias = Pixel | Point | NamedRegion


@dataclass(frozen=True)
class MeasuredSpectra:
    """What training views measured at a place, in the light and with the exposure that the scene is shown in."""

    views: tuple[str, ...]
    """Names of the views that see it, one or more."""
    spectra: Float64[np.ndarray, "N B"]

    @cached_property
    def mean(self) -> Float64[np.ndarray, " B"]:
        """Over the views."""
        return self.spectra.mean(axis=0)

    @cached_property
    def spread(self) -> Float64[np.ndarray, " B"] | None:
        """Standard deviation over the views: noise, gloss, light that moves, and what poses or the surface are off;
        None of one view."""
        return self.spectra.std(axis=0, ddof=1) if len(self.spectra) > 1 else None


@dataclass(frozen=True)
class PlaceSpectrum:
    """What is at a place."""

    probe: Probe
    """As it is rendered."""
    measured: MeasuredSpectra | None = None
    """None where no training view at hand sees the place; of regions always."""
    region: MeasuredRegion | None = None
    """Of a region: its area, and the spread of what is rendered."""


class SeenPixel(NamedTuple):
    """Where a view shows a place."""

    view: int
    """Its number among the frames of the measured scene."""
    column: int
    row: int


class MeasuredScene:
    """The scene that a run was trained on, whose pixels stand beside what the run renders."""

    def __init__(self, scene: Scene, recorded_light: Sequence[float] | None) -> None:
        """The light is that of the run's record, relative power; None where it is unknown."""
        self.scene, self._recorded_light = scene, recorded_light

    @cached_property
    def usable_views(self) -> tuple[int, ...]:
        """Training views whose spectra can be put beside those of the run: of a rig those with all bands."""
        scene = self.scene
        return tuple(index for index in scene.train_indices if scene.sensor_of(index).sees_all_bands)

    def camera(self, index: int, trained: TrainedScene) -> Cameras:
        """The camera of a training view as training corrected it, on the CPU."""
        return trained.views[self.scene.train_indices.index(index)].camera.to("cpu")

    @torch.no_grad()
    def pixels_that_see(
        self, position: Float64[np.ndarray, "3"], trained: TrainedScene
    ) -> tuple[SeenPixel, ...]:
        """The pixel of each usable training view that sees a point of model space as the run was trained: what edits
        removed was there when it was measured."""
        as_trained = trained.as_trained
        point = torch.from_numpy(position).float()[None]
        found: list[SeenPixel] = []
        sizes, rays = [], []
        for index in self.usable_views:
            camera = self.camera(index, as_trained)
            coords, depths, inside = look_up(camera, 0, point)
            if inside[0]:
                column, row = coords[0].long().tolist()
                found.append(SeenPixel(index, column, row))
                sizes.append(pixel_size(camera, depths)[0])
                rays.append(_pixel_rays(camera, coords))
        if not found:
            return ()
        joined = RayBundle.join(rays)
        seen = composite(as_trained.renderer, as_trained.field, joined.to(as_trained.device))
        distance = seen.ray_distance.where(seen.is_occupied, torch.inf).cpu()
        is_there = _ends_near(joined, distance, point, torch.stack(sizes))
        return tuple(pixel for pixel, is_near in zip(found, is_there.tolist(), strict=True) if is_near)

    def spectra(self, pixels: Sequence[SeenPixel], trained: TrainedScene) -> MeasuredSpectra | None:
        """What these pixels measured; those that don't count or show more than one thing are left out, None where none
        is left. Reads files."""
        scene, names, found = self.scene, [], []
        for pixel in pixels:
            alpha = (
                scene.alpha(pixel.view) if self.counts(pixel) else np.zeros((pixel.row + 1, pixel.column + 1))
            )
            if alpha is None or alpha[pixel.row, pixel.column] >= _WHOLE_ALPHA:
                names.append(scene.frames[pixel.view].name)
                found.append(self.spectrum(pixel, trained))
        return MeasuredSpectra(tuple(names), np.stack(found)) if found else None

    def counts(self, pixel: SeenPixel) -> bool:
        """Whether a pixel has a valid value that no mask leaves out."""
        return bool(self.scene.valid_mask(pixel.view, _window(pixel)).all())

    def spectrum(self, pixel: SeenPixel, trained: TrainedScene) -> Float64[np.ndarray, " B"]:
        """What a view with all bands measured in one pixel, in the light that the scene is shown in and, of a training
        view, as exposed as the scene."""
        measured = self.scene.cube(pixel.view, _window(pixel))[0, 0]
        return self.comparable(pixel.view, measured, trained)

    def comparable(
        self, index: int, measured: Float[np.ndarray, "*pixels B"], trained: TrainedScene
    ) -> Float64[np.ndarray, "*pixels B"]:
        """Radiance of a view as it is in the light that the scene is shown in and, of a training view, as exposed as
        the scene."""
        gains, training = trained.view_gains, self.scene.train_indices
        exposed = measured
        if gains is not None and index in training:
            exposed = measured / gains[training.index(index)].numpy()
        light, recorded = trained.light_power, self._recorded_light
        is_same = light is not None and recorded is not None and np.allclose(light, recorded, rtol=1e-4)
        return exposed.astype(np.float64) if is_same else relit(exposed, recorded, light)


def spectrum_at(scene: TrainedScene, place: Place, measured: MeasuredScene | None = None) -> PlaceSpectrum:
    """What is at a place, and what training views measured there where their scene is at hand; a ConfigError where the
    place is outside of the image or the scene box, or the region has nothing in it."""
    if isinstance(place, NamedRegion):
        found = place.surface.measure(place.region, place.name)
        return PlaceSpectrum(found.probe, region=found)
    probe = scene.probe(*place) if isinstance(place, Pixel) else scene.probe_point(*place)
    if measured is None or probe.position is None or probe.opacity < OCCUPIED_ACCUMULATION:
        return PlaceSpectrum(probe)
    pixels = measured.pixels_that_see(probe.position, scene)
    return PlaceSpectrum(probe, measured.spectra(pixels, scene))


def same_places(
    camera: Cameras,
    points: Float[Tensor, "P 3"],
    coords: Float[Tensor, "P 2"],
    depths: Float[Tensor, " P"],
    distances: Float[Tensor, "H W"],
) -> Bool[Tensor, " P"]:
    """Which points a camera sees, on the CPU; `coords` and `depths` are as `look_up` has them, and `distances` how far
    along the rays of its pixels what it sees is."""
    columns, rows = coords.long().unbind(-1)
    return _ends_near(
        _pixel_rays(camera, coords), distances[rows, columns], points, pixel_size(camera, depths)
    )


def pixel_size(camera: Cameras, depths: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
    """How large a pixel is at these depths, model units."""
    return depths / camera.focal_px[0].min()


def _pixel_rays(camera: Cameras, coords: Float[Tensor, "P 2"]) -> RayBundle:
    """Rays through the middles of the pixels that places of an image lie in."""
    return camera.generate_rays(torch.zeros(len(coords), dtype=torch.int64), coords.floor() + 0.5)


def _ends_near(
    rays: RayBundle,
    distances: Float[Tensor, " P"],
    points: Float[Tensor, "#P 3"],
    pixels: Float[Tensor, " P"],
) -> Bool[Tensor, " P"]:
    return (rays.at(distances) - points).norm(
        dim=-1
    ) <= _SAME_PLACE_PX * pixels  # False where a ray ends nowhere, at infinity


def _window(pixel: SeenPixel) -> tuple[slice, slice]:
    return slice(pixel.row, pixel.row + 1), slice(pixel.column, pixel.column + 1)
