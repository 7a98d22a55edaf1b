"""From a camera to a picture: how fine it gets, its rays block by block, its paint and its depth.

While a camera moves each picture must come soon, so it is small; once it rests, pictures of twice the height follow
until the height asked for is reached. Blocks are so short that nothing waits long for the device.

Notation: `P` pixels of a view, row after row.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from unmix_plugin.figures.paint import Legend, as_bytes, background_of
from unmix_plugin.trained.gradual import FrameRender, numbers_per_pixel, shown_with, wants_more
from unmix_plugin.trained.open_run import require_materials
from unmix_plugin.trained.protocol import RenderableScene, RenderedView
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene, material_view
from unmix_plugin.viewer.rendering.aids import SceneAids
from unmix_plugin.viewer.rendering.painting import layer_named, layers_of, paint_layer
from unmix_plugin.viewer.rendering.scene import Edit, SceneSource
from unmix_plugin.viewer.rendering.settings import LayerSettings
from unmix_plugin.viewer.view_cameras import ViewPose, camera_of

HEIGHT_BOUNDS = (16, 2048)
DEFAULT_HEIGHT = 512
SUBPIXEL_BOUNDS = (1, 4)

_MOVING_S, _LONGEST_MOVING_S = 1 / 30, 0.07
"""Time for a moving picture: as on a fast device, and as on one that would otherwise show nothing but blur."""

_LEAST_MOVING_PIXELS, _FEWEST_PIXELS = 4096, 256
"""A moving picture has so many pixels if they take no longer than `_LONGEST_MOVING_S`, and never fewer than these."""

_BLOCK_S = 0.03
"""Time that a block takes: how long anything more urgent waits."""

_BLOCK_BOUNDS = (256, 1 << 17)
_MEMORY = 0.7


@dataclass
class Speedometer:
    """Rays a second, as measured recently."""

    rays_per_second: float = 20_000.0

    def add(self, rays: int, seconds: float) -> None:
        """Take in a measurement; short ones say less, but the least block counts still."""
        if rays > 0 and seconds > 0:
            # Geometric, since speeds of empty and of full parts of a picture differ by factors.
            self.rays_per_second = self.rays_per_second**_MEMORY * (rays / seconds) ** (1 - _MEMORY)

    @property
    def block_rays(self) -> int:
        """Rays to render in one go."""
        low, high = _BLOCK_BOUNDS
        return int(min(max(self.rays_per_second * _BLOCK_S, low), high))


def _moving_height(rays_per_second: float, aspect: float, largest_height: int) -> int:
    """Rows of a picture of a moving camera."""
    pixels = max(
        rays_per_second * _MOVING_S,
        min(_LEAST_MOVING_PIXELS, rays_per_second * _LONGEST_MOVING_S),
        _FEWEST_PIXELS,
    )
    return max(1, min(int(math.sqrt(pixels / aspect)), largest_height))


def _finer_height(height: int, largest_height: int) -> int | None:
    """Rows of the next picture of a camera at rest; None after the finest."""
    if height >= largest_height:
        return None
    return largest_height if 2 * height * 1.2 >= largest_height else 2 * height


_FAR = 160.0
"""Depth of what is transparent, scene units; the browser's own limit is 167."""

_DEPTH_STEP = 512e-5
"""Depths are rounded to so many scene units: the browser's unit is 1e-5, and with empty low bits the PNG that they are
packed into is made in a third of the time."""

_MOST_DEPTH_ROWS = 256
"""Finer pictures get the depth of every n-th pixel: edges of hidden objects need no more, and packing takes long."""


def _picture_depth(frame: MaterialView) -> Float32[np.ndarray, "rows columns"]:
    """Depth along the viewing axis, scene units, of the pixels or of every n-th; far where they are half empty."""
    depth = (frame.depth * frame.scene.frame.scale).clamp(0, _FAR)
    depth = depth.where(frame.coefficients.is_occupied, _FAR)
    every = -(-depth.shape[0] // _MOST_DEPTH_ROWS)
    chosen = depth[every // 2 :: every, every // 2 :: every]
    return ((chosen / _DEPTH_STEP).round() * _DEPTH_STEP).cpu().numpy().astype(np.float32)


@dataclass(frozen=True)
class Picture:
    """A picture for one client."""

    picture: UInt8[np.ndarray, "H W 3"]
    """sRGB."""
    depth: Float32[np.ndarray, "rows columns"] | None
    """Along the viewing axis, scene units, far where nothing is, perhaps in fewer pixels; None where the client needs
    none."""
    legend: Legend
    is_moving: bool
    """Whether a finer picture follows at once."""
    is_labels: bool = False
    """Whether its colours are exact."""


RESTING_COST = 6.0
"""Credit that rendering for clients at rest takes while training, so that it may wait when someone moves."""

REFRESH_S = 2.0
"""How long one picture of a client at rest should take while training."""

LARGEST_FRAME_BYTES = 1 << 26
"""Coefficients that are kept for one client."""


class PictureMaker:
    """Renders and paints with one model; used by one thread at a time."""

    def __init__(self, source: SceneSource) -> None:
        self.source = source
        self.speed = Speedometer()
        with source.locked() as scene:
            self.layers = layers_of(scene)
            """What can be shown, by name."""
            self.aids = SceneAids(source)
            numbers = numbers_per_pixel(scene)
        self._largest_pixels = max(256, LARGEST_FRAME_BYTES // (4 * numbers))

    def first_render(self, pose: ViewPose, largest_height: int) -> FrameRender:
        """A small picture, for a camera that moved."""
        largest = self.target_height(pose, largest_height)
        height = _moving_height(self.speed.rays_per_second, pose.aspect, largest)
        return FrameRender(camera_of(pose, height, self._largest_pixels))

    def finer_render(
        self, pose: ViewPose, frame: RenderedView, largest_height: int, subpixels: int
    ) -> FrameRender:
        """The picture after `frame`: a finer one, another estimate of the same, or at the end the same again."""
        target = self.target_height(pose, largest_height)
        if frame.camera.height >= target and wants_more(frame):
            return FrameRender(frame.camera, subpixels, frame)
        height = _finer_height(frame.camera.height, target) or target
        is_last = height == target and not self.source.device.is_training
        return FrameRender(camera_of(pose, height, self._largest_pixels), subpixels if is_last else 1)

    def target_height(self, pose: ViewPose, largest_height: int) -> int:
        """Rows of the finest picture: as asked for, but while training no more than keep up with it."""
        largest = camera_of(pose, largest_height, self._largest_pixels).height
        if not self.source.device.is_training:
            return largest
        share = self.source.device.viewing_share
        speed = self.speed.rays_per_second * share / (share + RESTING_COST * (1 - share))
        return max(1, min(int(math.sqrt(speed * REFRESH_S / pose.aspect)), largest))

    def advance(self, render: FrameRender, edit: Edit, num_rays: int, cost: float) -> RenderedView | None:
        """Render a block; the frame if that was the last, an UnmixError if the edit does not fit the run."""
        with self.source.locked(cost) as scene, torch.no_grad():
            shown = edit.apply(scene, self.source.version, self.aids.see)
            started = time.perf_counter()
            rays = render.render_block(shown, num_rays)
            if shown.device.type == "cuda":
                torch.cuda.synchronize(shown.device)
            self.speed.add(rays, time.perf_counter() - started)
            return render.frame(shown) if render.rays_left == 0 else None

    def edited(self, edit: Edit) -> TrainedScene:
        """The scene after an edit; an UnmixError if the edit does not fit the run."""
        with self.locked_edit(edit) as (_, shown):
            return shown

    @contextmanager
    def locked_edit(self, edit: Edit) -> Iterator[tuple[TrainedScene, TrainedScene]]:
        """Context with the scene before and after an edit, and the device; an UnmixError if the edit does not fit."""
        with self.locked_view(edit) as (scene, shown):
            yield require_materials(scene, "of this run"), require_materials(shown, "of this run")

    @contextmanager
    def locked_view(self, edit: Edit) -> Iterator[tuple[RenderableScene, RenderableScene]]:
        """The same for the scene of any method."""
        with self.source.locked() as scene:
            yield scene, edit.apply(scene, self.source.version, self.aids.see)

    def with_materials_of(self, edit: Edit, frame: RenderedView) -> RenderedView:
        """What a frame would be with other materials on the same shapes; an UnmixError if the edit does not fit."""
        with self.locked_view(edit) as (_, shown):
            return shown_with(frame, shown)

    def paint(
        self, frame: RenderedView, settings: LayerSettings, with_depth: bool, is_moving: bool
    ) -> Picture:
        """A frame as a picture; an UnmixError if the layer can't be shown."""
        layer = layer_named(settings.layer, self.layers)
        seen = material_view(frame)
        aids = None if seen is None else self.aids.for_layers(seen.scene)
        with torch.no_grad():
            painted = paint_layer(layer, frame, settings, aids)
            picture = as_bytes(painted.over(background_of(settings))[:, :, 0])
        depth = None if seen is None or not with_depth else _picture_depth(seen)
        return Picture(picture, depth, painted.legend, is_moving, layer.is_labels)
