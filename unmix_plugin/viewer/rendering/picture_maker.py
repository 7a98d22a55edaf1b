"""The work of the render loop: what size a picture gets, rendering its blocks, painting it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import torch

from unmix_plugin.editing.edited_field import EditedField
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.trained.model_scene import ModelView
from unmix_plugin.trained.open_run import require_materials
from unmix_plugin.trained.protocol import RenderedView
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.layers.layer import Layer, layer_named
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.layers.layers import LAYERS
from unmix_plugin.viewer.layers.painting import as_bytes
from unmix_plugin.viewer.probing import ProbedPoint, probe_through
from unmix_plugin.viewer.rendering.edits import Edit
from unmix_plugin.viewer.rendering.frames import FrameRender
from unmix_plugin.viewer.rendering.measured import MeasuredViews
from unmix_plugin.viewer.rendering.pacing import Speedometer, affordable_height, finer_height, moving_height
from unmix_plugin.viewer.rendering.picture_depth import picture_depth
from unmix_plugin.viewer.rendering.scene_aids import SceneAids
from unmix_plugin.viewer.rendering.scene_source import SceneSource
from unmix_plugin.viewer.rendering.view import Shown
from unmix_plugin.viewer.view_cameras import ViewPose, camera_of

RESTING_COST = 6.0
"""Credit that rendering for clients at rest takes while training, so that it may wait when someone moves."""

REFRESH_S = 2.0
"""How long one picture of a client at rest should take while training."""

_LONGEST_WAIT_S = 1.0
"""How long rendering waits for pages that ask for the device."""

_TRACE_OPACITY = 0.25
"""Opacity under which a pixel counts as empty once materials are removed."""

LARGEST_FRAME_BYTES = 1 << 26
"""Coefficients that are kept for one client."""


class PictureMaker:
    """Renders and paints with one model; used by one thread at a time."""

    def __init__(
        self,
        source: SceneSource,
        aids: SceneAids,
        num_channels: int,
        layers: Mapping[str, Layer] = LAYERS,
    ) -> None:
        """
        Args:
            source: The model.
            aids: What layers and edits need of it.
            num_channels: Numbers a pixel that a frame keeps.
            layers: What can be shown, by name.
        """
        self.speed = Speedometer()
        self.source = source
        self._aids = aids
        self._queue, self._num_asking = threading.Condition(), 0
        self._layers = layers
        self._largest_pixels = max(256, LARGEST_FRAME_BYTES // (4 * num_channels))

    def first_render(self, pose: ViewPose, largest_height: int) -> FrameRender:
        """A small picture, for a camera that moved."""
        largest = self.target_height(pose, largest_height)
        height = moving_height(self.speed.rays_per_second, pose.aspect, largest)
        return FrameRender(camera_of(pose, height, self._largest_pixels))

    def finer_render(
        self, pose: ViewPose, frame: RenderedView, largest_height: int, subpixels: int
    ) -> FrameRender:
        """The picture after `frame`: a finer one, another estimate of the same, or at the end the same again."""
        target = self.target_height(pose, largest_height)
        if isinstance(frame, ModelView) and frame.camera.height >= target and wants_more(frame):
            return FrameRender(frame.camera, subpixels, frame)
        height = finer_height(frame.camera.height, target) or target
        is_last = height == target and not self.source.is_changing
        return FrameRender(camera_of(pose, height, self._largest_pixels), subpixels if is_last else 1)

    def target_height(self, pose: ViewPose, largest_height: int) -> int:
        """Rows of the finest picture: as asked for, but while training no more than keep up with it."""
        largest = camera_of(pose, largest_height, self._largest_pixels).height
        if not self.source.is_changing:
            return largest
        share = self.source.device.guest_share
        speed = self.speed.rays_per_second * share / (share + RESTING_COST * (1 - share))
        return affordable_height(speed, REFRESH_S, pose.aspect, largest)

    def advance(self, render: FrameRender, edit: Edit, num_rays: int, cost: float) -> RenderedView | None:
        """Render a block; the frame if that was the last.

        Raises:
            UnmixError: the edit does not fit the run.
        """
        with self._queue:
            self._queue.wait_for(lambda: self._num_asking == 0, _LONGEST_WAIT_S)
        with self.source.borrowed(cost) as scene, torch.no_grad():
            shown = edit.apply(scene, self.source.version, self._aids.see)
            started = time.perf_counter()
            rays = render.render_block(shown, num_rays)
            if shown.device.type == "cuda":
                torch.cuda.synchronize(shown.device)
            self.speed.add(rays, time.perf_counter() - started)
            return render.frame(shown) if render.rays_left == 0 else None

    def probe(
        self,
        edit: Edit,
        camera: Cameras,
        place: tuple[float, float],
        number: int,
        measured: MeasuredViews | None = None,
    ) -> ProbedPoint:
        """What is seen through a point of a camera's picture, and what a training view measured there.

        Args:
            edit: What is changed.
            camera: One camera.
            place: Column and row, pixels.
            number: Of the probe.
            measured: The training views, if they are at hand.
        Raises:
            UnmixError: nothing is there, or the edit does not fit the run.
        """
        with self._edited(edit) as (scene, shown):
            taken = probe_through(shown, camera, *place, number)
            found = measured and measured.measurement(taken.position, camera, shown.light_power, scene)
        if found is None:
            return taken
        view = f"{found.view}, before the edits" if edit.recipe.operations else found.view
        return replace(taken, measured=found.spectrum.double().numpy(), measured_in=view)

    def edited(self, edit: Edit) -> TrainedScene:
        """The scene after an edit.

        Raises:
            UnmixError: the edit does not fit the run.
        """
        with self._edited(edit) as (_, shown):
            return shown

    def _ask(self, change: int) -> None:
        """Note that a page waits for the device, or no longer: otherwise the render loop would take turn after turn."""
        with self._queue:
            self._num_asking += change
            self._queue.notify_all()

    @contextmanager
    def _edited(self, edit: Edit) -> Iterator[tuple[TrainedScene, TrainedScene]]:
        """Context with the scene before and after an edit, and the device."""
        self._ask(1)
        with ExitStack() as stack:
            try:
                scene = stack.enter_context(self.source.borrowed_materials())
            finally:
                self._ask(-1)
            shown = edit.apply(scene, self.source.version, self._aids.see)
            yield scene, require_materials(shown, "of this run")

    def with_materials_of(self, edit: Edit, frame: RenderedView) -> RenderedView:
        """What a frame would be with other materials on the same shapes.

        Raises:
            UnmixError: the edit does not fit the run.
        """
        return replace(frame, scene=self.edited(edit)) if isinstance(frame, MaterialView) else frame

    def paint(self, frame: RenderedView, settings: LayerSettings, with_depth: bool, is_moving: bool) -> Shown:
        """A frame as a picture.

        Raises:
            UnmixError: the layer can't be shown.
        """
        layer, aids = layer_named(settings.layer, self._layers), self._aids.for_layers()
        with torch.no_grad():
            frame = _without_traces(frame)
            picture, legend = layer.paint(frame, settings, aids)
        depth = picture_depth(frame) if with_depth and isinstance(frame, MaterialView) else None
        return Shown(as_bytes(picture), depth, legend, is_moving, layer.is_labels)


def wants_more(frame: RenderedView) -> bool:
    """Whether a frame is an estimate that is to be averaged with others."""
    return isinstance(frame, ModelView) and frame.num_estimates < frame.num_wanted


def _without_traces(frame: RenderedView) -> RenderedView:
    """A frame without the faint specks that removed materials leave where they were mixed with others."""
    if not isinstance(frame, MaterialView):
        return frame
    field = frame.scene.field
    if not isinstance(field, EditedField) or bool(field.is_kept.all()):
        return frame
    is_left = (frame.opacity >= _TRACE_OPACITY)[..., None]
    return frame.map(lambda packed: packed * is_left)
