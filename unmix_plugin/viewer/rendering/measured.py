"""What the training views measured: spectra of points that they see, and errors of a rendered view.

Notation: `P` points, `B` bands. A training view sees a point if nothing that the model renders is in front of it.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.library_matches import relit
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.rendering.scene_source import SceneSource

_TOLERANCE = 0.03
"""Depths of a point and of what a view renders there may differ by so much of the depth."""

_VIEWS_KEPT = 4
_STEPS_KEPT = 200
"""Depths rendered so many training steps ago are rendered again."""

_VIEWS_TRIED = 6


@dataclass(frozen=True)
class Measurement:
    """What a training view measured of a point."""

    view: str
    """Name of the view."""
    spectrum: Float32[Tensor, "B"]
    """Radiance, [0, 1]."""


def usable_views(scene: Scene) -> list[int]:
    """Training views whose spectra can be put beside those of the model."""
    return [index for index in scene.train_indices if scene.sensor_of(index).sees_all_bands]


class MeasuredViews:
    """The training views of a scene that is at hand, of a rig those with all bands."""

    def __init__(self, scene: Scene, source: SceneSource) -> None:
        self._scene = scene
        self._source = source
        self._indices = usable_views(scene)
        self._cameras = scene.cameras[self._indices]
        self._distances: OrderedDict[int, tuple[int, Tensor]] = OrderedDict()
        self._lock = threading.Lock()

    def error(self, frame: MaterialView) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"], str]:
        """Mean absolute error of the bands against the nearest training view, where that sees the same point.

        Returns:
            Errors; where they are known; the name of the view.
        """
        index = int(self._by_nearness(frame.camera)[0])
        height, width = frame.camera.height, frame.camera.width
        errors = torch.zeros(height * width)
        is_known = torch.zeros(height * width, dtype=torch.bool)
        seen = (frame.coefficients.accumulation.flatten() > OCCUPIED_ACCUMULATION).nonzero()[:, 0]
        if len(seen):
            points = _end_points(frame)[seen]
            rows, columns, sees = self._pixels_of(points, index)
            cube = self._in_light(self._scene.cube(self._indices[index]), frame.scene.light_power)
            spectra = frame.materials.spectra(
                frame.coefficients.flatten().map(lambda packed: packed[seen[sees]])
            ).cpu()
            measured = cube[rows[sees], columns[sees]]
            places = seen[sees].cpu()
            errors[places] = (spectra - measured).abs().mean(dim=-1)
            is_known[places] = True
        device = frame.coefficients.accumulation.device
        name = self._scene.frames[self._indices[index]].name
        return errors.view(height, width).to(device), is_known.view(height, width).to(device), name

    def measurement(
        self,
        point: Float[Tensor, "3"],
        camera: Cameras,
        light: Float64[np.ndarray, " B"] | None,
        scene: TrainedScene,
    ) -> Measurement | None:
        """What the training view nearest to a camera measured of a point; None where no view tried sees it.

        Args:
            point: Model space.
            camera: One camera.
            light: In which the scene is shown, relative power; what was measured is relit to it. None if unknown.
            scene: The unedited scene, which is lent.
        """
        for index in self._by_nearness(camera)[:_VIEWS_TRIED].tolist():
            rows, columns, sees = self._pixels_of(point[None], index, scene)
            if bool(sees[0]):
                cube = self._scene.cube(self._indices[index])
                spectrum = self._in_light(cube[int(rows[0]), int(columns[0])].copy(), light)
                return Measurement(self._scene.frames[self._indices[index]].name, spectrum)
        return None

    def _in_light(
        self, measured: Float32[np.ndarray, "*pixels B"], light: Float64[np.ndarray, " B"] | None
    ) -> Float32[Tensor, "*pixels B"]:
        """Radiance as it is in the light that the scene is shown in."""
        recorded = self._source.record.summary.get("illuminant")
        is_same = light is None or (recorded is not None and np.allclose(light, recorded, rtol=1e-4))
        found = measured if is_same else relit(measured, recorded, light).astype(np.float32)
        return torch.from_numpy(found)

    def _by_nearness(self, camera: Cameras) -> Tensor:
        """Training views by the angle between their axis and the camera's, and by their distance to it."""
        middle = self._scene.scene_box.aabb.mean(dim=0)
        pose, poses = camera.camera_to_world[0].cpu(), self._cameras.camera_to_world
        reach = (pose[:, 3] - middle).norm().clamp(min=1e-3)
        offsets = (poses[:, :, 3] - pose[:, 3]).norm(dim=-1) / reach
        angles = (poses[:, :, 2] * pose[:, 2]).sum(dim=-1).clamp(-1, 1).arccos()
        return (offsets + angles).argsort()

    def _pixels_of(
        self, points: Float[Tensor, "P 3"], index: int, lent: TrainedScene | None = None
    ) -> tuple[Tensor, Tensor, Bool[Tensor, "P"]]:
        """Row and column of each point in a training view, and whether that view sees it."""
        camera = self._cameras[index]
        coords, depths = camera.project(points.cpu(), 0)
        columns, rows = coords.nan_to_num(-1.0).clamp(-1, 1e6).floor().long().unbind(-1)
        inside = (depths > 0) & (columns >= 0) & (rows >= 0)
        inside &= (columns < camera.width) & (rows < camera.height)
        rows, columns = rows.clamp(0, camera.height - 1), columns.clamp(0, camera.width - 1)
        places = camera.poses_at(torch.zeros_like(rows), coords[:, 1].nan_to_num(0.0))[:, :, 3]
        distance = (points.cpu() - places).norm(dim=-1)
        rendered = self._distance_of(index, lent)[rows, columns]
        return rows, columns, inside & ((distance - rendered).abs() < _TOLERANCE * distance)

    def _distance_of(self, index: int, lent: TrainedScene | None) -> Float[Tensor, "H W"]:
        """Distances along the rays of a training view as last rendered, infinite where nothing is."""
        step = self._source.version
        with self._lock:
            kept = self._distances.get(index)
        if kept is not None and step - kept[0] < _STEPS_KEPT:
            return kept[1]
        with self._source.borrowed_materials() if lent is None else nullcontext(lent) as scene:
            seen = scene.look(self._cameras[index], subpixels=1).coefficients
        distance = seen.ray_distance.where(seen.is_occupied, torch.inf).cpu()
        with self._lock:
            self._distances[index] = (step, distance)
            while len(self._distances) > _VIEWS_KEPT:
                self._distances.popitem(last=False)
        return distance


def _end_points(frame: MaterialView) -> Float[Tensor, "P 3"]:
    """Where the rays of all pixels end."""
    coefficients = frame.coefficients
    bundle = frame.camera.to(coefficients.accumulation.device).image_rays(0)
    distance = coefficients.ray_distance.flatten()
    return bundle.origins + distance[:, None] * bundle.directions
