"""The scene that a viewer shows: of a run or of a training, edited; what training views measured of it.

Notation: `P` points, `B` bands. A training view sees a point if nothing that the model renders is in front of it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.editing import Recipe, changes_geometry, edit_scene
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.runs.loading import SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.engine.training.training_control import DeviceLock, TrainingControl
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients
from unmix_plugin.trained.measures import Scale, read_measures, recorded_scale
from unmix_plugin.trained.model_scene import LightChoice, relit
from unmix_plugin.trained.open_run import LoadedRun, require_materials, snapshot
from unmix_plugin.trained.places import MeasuredScene, same_places
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.surface import in_image
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene

_ValueT = TypeVar("_ValueT")

STEPS_KEPT = 200
"""What was rendered so many training steps ago is rendered again."""


class CachedByVersion:
    """Values by key, made again once training has changed the scene."""

    def __init__(self, most: int) -> None:
        """The `most` that were made last are kept."""
        self._most = most
        self._kept: dict[Any, tuple[int, Any]] = {}

    def get(self, key: Any, version: int, make: Callable[[], _ValueT], steps: int = STEPS_KEPT) -> _ValueT:
        """The value of a key as of a version of the scene, or of fewer steps of a training before."""
        made_at, value = self._kept.get(key, (version - steps, None))
        if version - made_at < steps:
            return value  # type: ignore[return-value]
        made = make()
        others = [one for one in self._kept.items() if one[0] != key]
        self._kept = dict([*others, (key, (version, made))][-self._most :])
        return made


@dataclass(frozen=True)
class SceneSource:
    """A scene, renewed after each training step in which it is asked for."""

    run: RunFolder
    """Where what the viewer writes goes."""
    record: SceneRecord
    """What the run keeps of its input."""
    device: DeviceLock
    """Turns with training, if there is one."""
    take: Callable[[], RenderableScene]
    """The scene at this moment; called while training waits."""
    control: TrainingControl | None = None
    """The training under way; None for a finished run."""
    _taken: CachedByVersion = field(default_factory=lambda: CachedByVersion(1), repr=False)

    @contextmanager
    def locked(self, cost: float = 1.0) -> Iterator[RenderableScene]:
        """Context with the scene and the device to render it; `cost` as `DeviceLock.viewing_turn` has it. Turns do not
        nest: whoever has the device must not ask for it again."""
        with self.device.viewing_turn(cost):
            yield self._taken.get(None, self.version, self.take, steps=1)

    @contextmanager
    def locked_materials(self) -> Iterator[TrainedScene]:
        """The same for a scene that must have endmembers; a ConfigError if it has none."""
        with self.locked() as scene:
            yield require_materials(scene, "of this run")

    @property
    def scale(self) -> Scale | None:
        """How long a unit of the world is, as kept with the run by now or as its scene says, None where unknown; a
        RunError if what is kept is damaged."""
        return read_measures(self.run).scale or recorded_scale(self.record.summary)

    def require_final(self, what: str) -> None:
        """Refuse with a ConfigError what is kept with a run while training still changes it, to be done afterwards."""
        control = self.control
        if control is not None and (control.is_running or control.status is None):
            raise ConfigError(f"the scene still changes; {what} when training has ended")

    @property
    def version(self) -> int:
        """Rises with each change of the scene: training steps that it has seen."""
        return self.device.training_turns


def source_of_run(run: LoadedRun) -> SceneSource:
    """The scene of a finished run."""
    return SceneSource(run.folder, run.record, DeviceLock(), lambda: run.scene)


def source_of_training(trainer: Trainer, record: SceneRecord) -> SceneSource:
    """The scene of a training, before or while it runs; a ConfigError if its method offers none."""
    name, model = trainer.config.method_name, trainer.pipeline.model

    def take() -> RenderableScene:
        averages = None if trainer.average is None else trainer.average.values
        return snapshot(model, name, record, averages)

    source = SceneSource(trainer.run, record, trainer.control.device, take, trainer.control)
    with source.locked():
        pass  # refuses a method without a scene before the page is served
    return source


_EDIT_RENEWAL_S = 0.5
"""Seconds between two edited scenes while training changes the unedited one."""


@dataclass(frozen=True, eq=False)
class Edit:
    """A recipe or another light, and the scene that it last gave; compared by identity."""

    recipe: Recipe = Recipe()
    light: LightChoice = LightChoice()
    """For scenes whose light can be exchanged; such scenes have no recipes."""
    _kept: list[tuple[RenderableScene, int, float]] = field(default_factory=list, repr=False)
    """The edited scene made last, the version that it was made of, and when."""
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def has_recipe(self) -> bool:
        """Whether materials, or the light of a scene of mixed materials, are changed."""
        return bool(self.recipe.operations) or self.recipe.illuminant is not None

    def reuses(self, other: Edit) -> bool:
        """Whether what was rendered with `other` can be shown with this edit's materials."""
        is_same_shape = not changes_geometry(self.recipe) and not changes_geometry(other.recipe)
        return self is other or (is_same_shape and self.light == other.light)

    def apply(
        self, scene: RenderableScene, version: int, see: Callable[[TrainedScene], Coefficients]
    ) -> RenderableScene:
        """The edited scene, a ConfigError if the recipe does not fit the run; to be called while the device is locked.
        `version` rises as training changes it; `see` is asked what cameras see if the recipe depends on pictures."""
        if not self.has_recipe and self.light == LightChoice():
            return scene
        with self._lock:
            if self._kept:
                edited, kept_version, made_at = self._kept[0]
                if kept_version == version or time.monotonic() - made_at < _EDIT_RENEWAL_S:
                    return edited
            if self.light != LightChoice():
                edited = relit(scene, self.light, "of this run")
            else:
                edited = edit_scene(require_materials(scene, "of this run"), self.recipe, see)
            self._kept[:] = [(edited, version, time.monotonic())]
            return edited


_VIEWS_KEPT = 4


class MeasuredViews:
    """The training views of a scene that is at hand, of a rig those with all bands."""

    def __init__(self, scene: Scene, source: SceneSource) -> None:
        self.measured = MeasuredScene(scene, source.record.summary.get("illuminant"))
        """What places measured, as exports have it."""
        self._source = source
        self._distances = CachedByVersion(_VIEWS_KEPT)

    def error(self, frame: MaterialView) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"], str]:
        """Mean absolute error of the bands against the nearest training view, where that measured the same point; where
        it is known; the name of the view."""
        scene, index = self.measured.scene, self._nearest(frame.camera, frame.scene)
        coefficients, device = frame.coefficients.flatten(), frame.coefficients.accumulation.device
        errors = torch.zeros(frame.camera.height * frame.camera.width)
        is_known = torch.zeros(len(errors), dtype=torch.bool)
        seen = (coefficients.accumulation > OCCUPIED_ACCUMULATION).nonzero()[:, 0]
        if len(seen):
            rays = frame.camera.to(device).image_rays(0)
            points = rays.at(coefficients.ray_distance)[seen]
            pixels, sees = self._pixels_of(points.cpu(), index, self.measured.camera(index, frame.scene))
            measured = self.measured.comparable(index, scene.cube(index, pixels), frame.scene)
            spectra = frame.materials.spectra(coefficients.map(lambda packed: packed[seen[sees]])).cpu()
            places = seen[sees].cpu()
            errors[places] = (spectra - torch.from_numpy(measured).float()).abs().mean(dim=-1)
            is_known[places] = True
        shape = (frame.camera.height, frame.camera.width)
        return errors.view(shape).to(device), is_known.view(shape).to(device), scene.frames[index].name

    def _nearest(self, camera: Cameras, scene: TrainedScene) -> int:
        """The training view that is nearest by the angle between its axis and the camera's, and its distance to it."""
        usable = self.measured.usable_views
        poses = torch.cat([self.measured.camera(index, scene).camera_to_world for index in usable])
        pose, middle = camera.camera_to_world[0].cpu(), self.measured.scene.scene_box.aabb.mean(dim=0)
        reach = (pose[:, 3] - middle).norm().clamp(min=1e-3)
        offsets = (poses[:, :, 3] - pose[:, 3]).norm(dim=-1) / reach
        angles = (poses[:, :, 2] * pose[:, 2]).sum(dim=-1).clamp(-1, 1).arccos()
        return usable[int((offsets + angles).argmin())]

    def _pixels_of(
        self, points: Float[Tensor, "P 3"], index: int, camera: Cameras
    ) -> tuple[tuple[Int[np.ndarray, " seen"], Int[np.ndarray, " seen"]], Bool[Tensor, "P"]]:
        """Which points a training view sees in a pixel that counts, and the rows and columns of these."""
        sees, coords, depths = in_image(camera, points)
        is_near = same_places(camera, points[sees], coords, depths, self._distance_of(index, camera))
        columns, rows = coords[is_near].long().numpy().T
        sees[sees.clone()] = is_near
        if len(rows):
            counts = self.measured.scene.valid_mask(index, (rows, columns))
            rows, columns = rows[counts], columns[counts]
            sees[sees.clone()] = torch.from_numpy(counts)
        return (rows, columns), sees

    def _distance_of(self, index: int, camera: Cameras) -> Float[Tensor, "H W"]:
        """Distances along the rays of a training view as last rendered, infinite where nothing is."""

        def render() -> Float[Tensor, "H W"]:
            with self._source.locked_materials() as scene:
                seen = scene.look(camera, subpixels=1).coefficients
            return seen.ray_distance.where(seen.is_occupied, torch.inf).cpu()

        return self._distances.get(index, self._source.version, render)
