"""What all clients of a viewer share: the scene, the render loop, what was measured, the folder for files."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.editing import Light, Recipe
from unmix_plugin.editing.light import relighting_factors
from unmix_plugin.errors import SpectrumError
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_names, linear_to_srgb, rgb_matrix
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.relighting import LightChoice, RelightableScene, relit
from unmix_plugin.trained.run_views import RunView, recorded_views
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.failures import failures_said
from unmix_plugin.viewer.layers.layers import layers_of
from unmix_plugin.viewer.recipe_editor import numbered
from unmix_plugin.viewer.rendering.edits import Edit
from unmix_plugin.viewer.rendering.frames import num_channels
from unmix_plugin.viewer.rendering.measured import MeasuredViews, usable_views
from unmix_plugin.viewer.rendering.picture_maker import PictureMaker
from unmix_plugin.viewer.rendering.render_loop import RenderLoop
from unmix_plugin.viewer.rendering.scene_aids import SceneAids
from unmix_plugin.viewer.rendering.scene_source import SceneSource
from unmix_plugin.viewer.rendering.video_job import VideoQueue
from unmix_plugin.viewer.scene_objects import Thumbnail
from unmix_plugin.viewer.training_curve import TrainingCurve

_THUMBNAIL_HEIGHT = 96

SceneReader = Callable[[], Scene]
"""Reads the scene that a run was trained on.

Raises:
    UnmixError: it is not at hand, or another one.
"""


class Services:
    """Shared by the sessions of all clients."""

    def __init__(
        self,
        source: SceneSource,
        read_scene: SceneReader,
        recipe: Recipe | None = None,
        environments: Sequence[Path] = (),
    ) -> None:
        """Computes nothing yet; the scene is read beside everything else once `start` is called.

        Args:
            source: The model.
            read_scene: Reads the scene.
            recipe: What every client sees the scene with at first.
            environments: Files of lights to offer beside those of the scene.
        Raises:
            ConfigError: the recipe does not fit the run, or its method has no environments.
            SceneError: an environment map is missing, damaged or unusable.
        """
        self.source = source
        self.views = recorded_views(source.record)
        self.num_train = len(source.record.train_cameras)
        self.scene: Scene | None = None
        """The scene, once it is read."""
        self.videos = VideoQueue()
        self.curve = TrainingCurve()
        self._read_scene = read_scene
        self._reader = threading.Thread(target=self._read, name="unmix-viewer-scene", daemon=True)
        with source.borrowed() as scene:
            self.layers = layers_of(scene)
            self.has_materials = isinstance(scene, TrainedScene)
            self.lights = _lights(scene, environments)
            channels = (
                num_channels(scene.materials) if isinstance(scene, TrainedScene) else 4 * len(scene.outputs)
            )
        self.aids = SceneAids(source, self.has_materials)
        self.maker = PictureMaker(source, self.aids, channels, self.layers)
        self.loop = RenderLoop(self.maker)
        self.first_recipe = Recipe()
        """Every client's first recipe; endmembers are given by their numbers."""
        if recipe is not None:
            self.first_recipe = numbered(recipe, self.maker.edited(Edit()).materials.names)
            self.maker.edited(Edit(self.first_recipe))

    @property
    def folder(self) -> Path:
        """Where files go that clients ask for: in the run folder, and nowhere else."""
        return self.source.run.exports / "viewer"

    @property
    def recipes_folder(self) -> Path:
        """Where recipes of this run are kept."""
        return self.source.run.path / "recipes"

    @cached_property
    def usable_lights(self) -> tuple[str, ...]:
        """Names of the lights that the scene can be shown in."""
        scene = self.maker.edited(Edit())
        return tuple(name for name in illuminant_names() if _is_usable(name, scene.bands, scene.light_power))

    def start(self) -> None:
        """Begin to render, and to read the scene."""
        self.loop.start()
        self._reader.start()

    def tick(self) -> None:
        """Note how training goes; called twice a second."""
        if self.source.control is not None:
            self.curve.add(self.source.control.status)

    def stop(self) -> None:
        """End rendering; waits for the scene if it is still being read."""
        self.videos.stop()
        self.loop.stop()
        if self._reader.is_alive():
            # Not left behind: a thread in native code when the interpreter ends takes the process down with it.
            self._reader.join()

    def view_named(self, name: str) -> RunView | None:
        """A view of the scene by its name."""
        return next((view for view in self.views if view.name == name), None)

    def _read(self) -> None:
        """Read the scene; without it the viewer only lacks what was measured."""
        if self.has_materials:
            _ = self.usable_lights  # takes a second, which the first page need not wait for
        with failures_said("the scene could not be read", self._note_missing):
            scene = self._read_scene()
            self.scene = scene
            if self.has_materials and usable_views(scene):
                self.aids.set_measured(MeasuredViews(scene, self.source))
            elif self.has_materials:
                self.aids.set_measured(None, "no training view has all bands")

    def _note_missing(self, reason: str) -> None:
        self.aids.set_measured(None, f"the scene is not at hand: {reason}")


def _is_usable(light: str, bands: Bands, recorded: Float64[np.ndarray, " B"] | None) -> bool:
    try:
        relighting_factors(bands, recorded, Light(light))
    except SpectrumError:
        return False
    return True


def thumbnail(scene: Scene, name: str) -> Thumbnail | None:
    """A view as measured, in few pixels; None for a name that the scene does not have."""
    index = next((index for index, frame in enumerate(scene.frames) if frame.name == name), None)
    if index is None:
        return None
    picture = scene.srgb(index)
    if picture is not None:
        step = max(1, picture.shape[0] // _THUMBNAIL_HEIGHT)
        return np.ascontiguousarray((picture[::step, ::step] * 255 + 0.5).astype(np.uint8))
    cube = scene.cube(index)
    step = max(1, cube.shape[0] // _THUMBNAIL_HEIGHT)
    spectra = torch.from_numpy(np.ascontiguousarray(cube[::step, ::step]))
    sensor = scene.sensor_of(index)
    false_colours = torch.from_numpy(sensor.false_colours).to(spectra)
    weights = rgb_matrix(Bands.of(scene.wavelengths_nm)) if sensor.sees_all_bands else false_colours
    linear = (spectra @ weights).clamp(0, 1)
    return (linear_to_srgb(linear) * 255 + 0.5).to(torch.uint8).numpy()


def _lights(scene: RenderableScene, environments: Sequence[Path]) -> tuple[str, ...]:
    """Names of a scene's lights, and the paths of those that a user gives."""
    paths = tuple(str(path.resolve()) for path in environments)
    for path in paths:
        relit(scene, LightChoice(path), "of this run")
    return (*scene.lights, *paths) if isinstance(scene, RelightableScene) else ()
