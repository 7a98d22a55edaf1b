"""One capture of an object: a run, its surface, and what each of its views measured at places of a surface.

Notation: `P` places, `V` views, `B` bands, `K` endmembers; "world" is that of the capture's own poses.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.sampling import evenly_spaced
from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.scenes.geometry.views import look_up
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.open_run import find_scene, load_run
from unmix_plugin.trained.places import MeasuredScene
from unmix_plugin.trained.regions import Region
from unmix_plugin.trained.run_views import directions_to_world
from unmix_plugin.trained.surface import Follow, look_from_above
from unmix_plugin.trained.surface_mesh import TriangleMesh, Working, surface_of, vertex_areas
from unmix_plugin.trained.trained_scene import TrainedScene

_RESOLUTIONS = (32, 192)
"""Least and most cells along the longest edge of the scene box; between them a cell is as large as a pixel."""
_SAME_SURFACE_PX = 3.0
"""By which the end of a view's ray may be before or behind a place that the view is said to see, pixels."""
_LEAST_COSINE = 0.35
"""Of the angle between a ray and the normal, below which a pixel shows too much at once."""
_SOLID = 0.95
"""Opacity, and measured alpha, from which a pixel shows one thing."""
_LARGEST_ARRAY = 1 << 28
"""Most numbers of all views' spectra at once."""


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface of a capture: vertices with what they look like, in its world."""

    positions: Float64[np.ndarray, "P 3"]
    normals: Float64[np.ndarray, "P 3"]
    areas: Float64[np.ndarray, " P"]
    """Square units of the world."""
    faces: Int64[np.ndarray, "F 3"]
    spectra: Float64[np.ndarray, "P B"]
    """As the field has them, without the view-dependent part."""
    abundances: Float64[np.ndarray, "P K"]


@dataclass(frozen=True, eq=False)
class Observed:
    """What each view of a capture says of places; NaN where it does not see one."""

    spectra: Float32[np.ndarray, "V P B"]
    """Measured, with the view-dependent part, as the run renders it, of the middle of the views that see the place."""
    heights: Float32[np.ndarray, "V P"]
    """How far along the place's normal the view's ray ends, pixels as large as they are in the middle of the scene."""


@dataclass(frozen=True, eq=False)
class Capture:
    """A run of an object, with what it was trained on."""

    name: str
    path: Path
    scene: TrainedScene
    measured: MeasuredScene
    scale: Scale | None
    regions: Mapping[str, Region] = field(default_factory=dict)
    """Kept with the run, by name."""
    markers: Mapping[str, Float64[np.ndarray, "n 3"]] = field(default_factory=dict)
    """World points of what was marked, by name, as the scene has them."""

    @property
    def bands(self) -> Bands:
        """Of its spectra."""
        return self.scene.bands

    @property
    def pixel(self) -> float:
        """Edge of a pixel in the middle of the scene, units of the world."""
        return self.scene.pixel_size / self.scene.frame.scale

    @cached_property
    def usable_views(self) -> tuple[tuple[int, Cameras], ...]:
        """Number among the frames and camera (model space, on the CPU) of each view whose spectra can be compared:
        those with all bands, and only training views where each view's pose or exposure was fitted."""
        scene, names = self.measured.scene, {view.name: view for view in self.scene.views}
        found = []
        for index, frame in enumerate(scene.frames):
            view = names.get(frame.name)
            if view is None or not scene.sensor_of(index).sees_all_bands:
                continue
            if view.split == "train" or not self.scene.fitted:
                found.append((index, view.camera.to("cpu")))
        return tuple(found)

    def surface(
        self,
        follow: Follow = lambda _doing, items: items,
        working: Working = lambda _doing: nullcontext(),
    ) -> Surface:
        """Triangles whose corners are about a pixel apart, and what is there; a RunError where there is no surface."""
        scene = self.scene
        cells = round(float(scene.scene_box.size.max()) / scene.pixel_size)
        resolution = min(max(cells, _RESOLUTIONS[0]), _RESOLUTIONS[1])
        mesh, _ = surface_of(scene, resolution, follow=follow, working=working)
        normals = np.stack([mesh.smoothed(axis, 2) for axis in mesh.normals.T], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-12)
        return self._looked_at(mesh, normals)

    @torch.no_grad()
    def _looked_at(self, mesh: TriangleMesh, normals: Float64[np.ndarray, "P 3"]) -> Surface:
        scene = self.scene
        positions = torch.from_numpy(mesh.vertices).float()
        abundances, spectra = look_from_above(scene, positions, torch.from_numpy(normals).float())
        return Surface(
            scene.frame.to_world(mesh.vertices),
            directions_to_world(scene.frame, normals),
            vertex_areas(mesh.areas(), mesh.faces, len(mesh.vertices)) / scene.frame.scale**2,
            mesh.faces,
            spectra.double().numpy(),
            abundances.double().numpy(),
        )

    @torch.no_grad()
    def observe(
        self,
        positions: Float64[np.ndarray, "P 3"],
        normals: Float64[np.ndarray, "P 3"],
        follow: Follow = lambda _doing, items: items,
        largest_height: float = 6.0,
    ) -> Observed:
        """What the views say of places of its world with these unit normals."""
        frame, views = self.scene.frame, self.usable_views
        most = max(8, _LARGEST_ARRAY // max(1, len(positions) * len(self.bands)))
        views = [views[index] for index in evenly_spaced(len(views), min(most, len(views)))]
        points = torch.from_numpy(frame.to_model(positions)).float()
        along = torch.from_numpy(normals @ frame.rotation.T).float()
        spectra = np.full((len(views), len(points), len(self.bands)), np.nan, np.float32)
        heights = np.full((len(views), len(points)), np.nan, np.float32)
        dictionary = self.scene.materials.specular_spectra.cpu().numpy()
        specular = np.full((len(views), len(points), len(dictionary)), np.nan, np.float32)
        for row, (index, camera) in enumerate(follow(f"looking at the views of {self.name}", views)):
            shown = self._sample(index, camera, points, along)
            heights[row, shown.rows] = shown.heights.clip(-largest_height, largest_height)
            seen = shown.rows[shown.is_seen]
            spectra[row, seen] = shown.spectra[shown.is_seen]
            specular[row, seen] = shown.specular[shown.is_seen]
        # What is the same in all views may be told as diffuse by one run and as specular by the other.
        ever = np.isfinite(specular).any(axis=(0, 2))
        if ever.any():
            usual = np.nanmedian(specular[:, ever], axis=0)
            for row in range(len(views)):
                spectra[row, ever] -= (specular[row, ever] - usual) @ dictionary
        return Observed(spectra, heights)

    def _sample(
        self, index: int, camera: Cameras, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]
    ) -> _Sampled:
        """One view at the places that lie in its image and face it."""
        coords, depths, inside = look_up(camera, 0, points)
        height, width = camera.height, camera.width
        places = camera.poses_at(torch.zeros(len(points), dtype=torch.int64), coords[:, 1])[:, :, 3]
        away = points - places
        own = away.norm(dim=-1)
        cosines = -(away / own[:, None] * normals).sum(dim=-1)
        inside &= cosines >= _LEAST_COSINE
        inside &= (coords >= 1).all(dim=-1) & (coords <= torch.tensor([width - 1.0, height - 1.0])).all(
            dim=-1
        )
        rows = inside.nonzero()[:, 0]
        coords, own, cosines = coords[rows], own[rows], cosines[rows]
        pixel = depths[rows] / camera.focal_px[0].min()

        view = self.scene.look(camera)
        found = view.coefficients
        distances = found.ray_distance.where(found.accumulation >= OCCUPIED_ACCUMULATION, torch.inf).cpu()
        scene = self.measured.scene
        measured = self.measured.comparable(index, scene.cube(index), self.scene)
        alpha, counts = scene.alpha(index), scene.valid_mask(index)
        solid = found.accumulation.cpu().numpy() >= _SOLID
        solid &= counts if alpha is None else counts & (alpha >= _SOLID)

        corners, weights = _corners(coords, width)
        excess = (distances.flatten()[corners] - own[:, None]) / pixel[:, None]
        near = excess.abs() <= _SAME_SURFACE_PX / cosines[:, None]
        is_seen = (near & torch.from_numpy(solid).flatten()[corners]).all(dim=1)
        spectra, specular = (
            np.einsum(
                "nc,ncx->nx",
                weights.numpy(),
                values.reshape(height * width, values.shape[-1])[corners.numpy()],
            )
            for values in (measured, found.specular.cpu().numpy())
        )
        # What is hidden behind something else says nothing of the place; where the ray goes on, matter is gone.
        middle = excess.gather(1, weights.argmax(dim=1, keepdim=True))[:, 0]
        mean = torch.where(is_seen, (weights * excess.nan_to_num(posinf=0.0)).sum(dim=1), middle)
        in_front = mean < -_SAME_SURFACE_PX / cosines
        offsets = -(mean * cosines) * pixel / self.scene.pixel_size
        offsets[in_front] = torch.nan
        return _Sampled(rows.numpy(), is_seen.numpy(), spectra, specular, offsets.numpy())


@dataclass(frozen=True, eq=False)
class _Sampled:
    """One view at the places that it may see."""

    rows: Int64[np.ndarray, " n"]
    is_seen: Bool[np.ndarray, " n"]
    spectra: Float[np.ndarray, "n B"]
    specular: Float[np.ndarray, "n J"]
    heights: Float[np.ndarray, " n"]


def _corners(coords: Float[Tensor, "n 2"], width: int) -> tuple[Tensor, Float[Tensor, "n 4"]]:
    """The four pixels around each place of an image, as numbers in it, and their weights in bilinear interpolation."""
    low = (coords - 0.5).floor()
    x, y = (coords - 0.5 - low).unbind(dim=-1)
    column, row = low.long().unbind(dim=-1)
    first = row * width + column
    corners = torch.stack([first, first + 1, first + width, first + width + 1], dim=1)
    weights = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], dim=1)
    return corners, weights


def open_capture(
    path: str | Path, data: str | Path | None = None, device: str = "auto", *, asked_by: str = "data"
) -> Capture:
    """A run with the scene that it was trained on.

    Args:
        data: The scene, where it is no longer where the run was trained.
        asked_by: How a caller names `data` to users, such as `--after-data`.
    Raises:
        RunError: the run is missing or damaged, or the scene is another than the run's.
        SceneError: the scene is no longer there.
        ConfigError: the run's method makes no scene of mixed materials, or none of its views can be compared.
    """
    run = load_run(path, device)
    trained, summary = run.materials_scene, run.record.summary
    scene = find_scene(summary, run.folder.path, None if data is None else Path(data))
    if scene is None:
        raise SceneError(
            f"how sure a change is follows from the views of {path}, and there is no scene, or no longer the same, at "
            f"{summary.get('root')}; name its folder with {asked_by}"
        )
    measured = MeasuredScene(scene, summary.get("illuminant"))
    found = Capture(
        run.scene_name, run.folder.path, trained, measured, run.scale, run.measures.regions, scene.markers
    )
    if len(found.usable_views) < LEAST_VIEWS:
        raise ConfigError(
            f"{path} has {len(found.usable_views)} views with all bands; a change is told from noise by at least "
            f"{LEAST_VIEWS}"
        )
    return found


LEAST_VIEWS = 6
"""Of a capture: each of its halves has to tell a spread."""
