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
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.figures.paint import Legend, as_bytes, background_of
from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.spectral.materials import Coefficients, Materials
from unmix_plugin.trained.model_scene import EstimatedScene, ModelView
from unmix_plugin.trained.open_run import require_materials
from unmix_plugin.trained.outputs import MaterialView
from unmix_plugin.trained.protocol import RenderableScene, RenderedView
from unmix_plugin.trained.trained_scene import TrainedScene
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
class _Speedometer:
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


_CPU_CHUNK, _CUDA_CHUNK = 4096, 1 << 16
"""Rays rendered at once: as many as the caches, or the device, have room for."""


class FrameRender:
    """A view under way. Blocks may come from different steps of a training; materials are those of the end."""

    def __init__(
        self, camera: Cameras, subpixels: int = 1, before: ModelView | None = None, is_finished: bool = False
    ) -> None:
        """`subpixels` rays along each edge of a pixel are averaged, and the view with estimates of the same, `before`;
        `is_finished` if it has to be as fine as the scene makes it, rather than an estimate."""
        self.camera = camera
        self._subpixels, self._before, self._is_finished = subpixels, before, is_finished
        self._num_pixels = camera.width * camera.height
        self._stride = _coprime_stride(self._num_pixels)
        self.num_rays = self._num_pixels * subpixels**2
        """Rays of the whole view."""
        self._rays_done = 0
        self._coefficients: Coefficients | None = None
        self._strips: list[dict[str, Tensor]] = []
        self._num_wanted = 1

    @property
    def rays_left(self) -> int:
        """Rays still to be rendered."""
        return self.num_rays - self._rays_done

    @torch.no_grad()
    def render_block(self, scene: RenderableScene, num_rays: int) -> int:
        """Render up to `num_rays` more; how many it were."""
        done, chunk = 0, _CUDA_CHUNK if scene.device.type == "cuda" else _CPU_CHUNK
        while done < num_rays and self.rays_left:
            count = min(num_rays - done, chunk)
            rendered = (
                self._render_chunk(scene, count)
                if isinstance(scene, TrainedScene)
                else self._render_rows(scene, count)
            )
            self._rays_done += rendered
            done += rendered
        return done

    def _render_chunk(self, scene: TrainedScene, num_rays: int) -> int:
        turn, start = divmod(self._rays_done, self._num_pixels)
        end = min(start + num_rays, self._num_pixels)
        # Spread over the picture, so that every block has its share of what is empty and of what is costly.
        pixels = torch.arange(start, end, device=scene.device) * self._stride % self._num_pixels
        rows, columns = pixels // self.camera.width, pixels % self.camera.width
        y, x = ((part + 0.5) / self._subpixels for part in divmod(turn, self._subpixels))
        coords = torch.stack([columns + x, rows + y], dim=-1).to(torch.float32)
        bundle = self.camera.to(scene.device).generate_rays(torch.zeros_like(pixels), coords)
        block = composite(scene.renderer, scene.field, bundle)
        if self._coefficients is None:
            self._coefficients = block.map(lambda packed: packed.new_zeros(self._num_pixels, packed.shape[1]))
        self._coefficients.packed[pixels] += block.packed / self._subpixels**2
        return end - start

    def _render_rows(self, scene: RenderableScene, num_rays: int) -> int:
        """Whole rows from top to bottom, of a scene that only renders views; one ray a pixel."""
        row_rays = self.camera.width * self._subpixels**2
        first = self._rays_done // row_rays
        count = min(max(1, num_rays // row_rays), self.camera.height - first)
        camera = self.camera.crop(0, first, self.camera.width, count).to(scene.device)
        if isinstance(scene, EstimatedScene) and self._is_finished:
            strip = scene.look(camera, self._subpixels)
        elif isinstance(scene, EstimatedScene):
            number = 0 if self._before is None else self._before.num_estimates
            strip = scene.estimate(camera, self._subpixels, number)
            self._num_wanted = strip.num_wanted
        else:
            strip = scene.look(camera)
        named = {output.name: strip[output.name] for output in scene.outputs}
        self._strips.append({"accumulation": strip.opacity, **named})
        return count * row_rays

    def frame(self, scene: RenderableScene) -> RenderedView:
        """The finished view, with the materials of a scene that has some."""
        assert self.rays_left == 0
        if isinstance(scene, TrainedScene):
            assert self._coefficients is not None
            image = self._coefficients.unflatten(self.camera.height, self.camera.width)
            return MaterialView(scene, self.camera, image)
        tensors = {name: torch.cat([strip[name] for strip in self._strips]) for name in self._strips[0]}
        view = ModelView(self.camera, tensors, num_wanted=self._num_wanted)
        return view if self._before is None else self._before.averaged(view)


def _num_channels(materials: Materials) -> int:
    return 2 + 2 * len(materials.endmembers) + len(materials.specular_spectra)


def _coprime_stride(count: int) -> int:
    """A step through `count` pixels that meets each once and that spreads any run of them evenly."""
    stride = max(1, round(count * 0.6180339887))
    while math.gcd(stride, count) != 1:
        stride += 1
    return stride


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
        self.speed = _Speedometer()
        with source.locked() as scene:
            self.layers = layers_of(scene)
            """What can be shown, by name."""
            self.aids = SceneAids(source)
            materials = scene.materials
            numbers = 4 * len(scene.outputs) if materials is None else _num_channels(materials)
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
        if isinstance(frame, ModelView) and frame.camera.height >= target and wants_more(frame):
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
        return replace(frame, scene=self.edited(edit)) if isinstance(frame, MaterialView) else frame

    def paint(
        self, frame: RenderedView, settings: LayerSettings, with_depth: bool, is_moving: bool
    ) -> Picture:
        """A frame as a picture; an UnmixError if the layer can't be shown."""
        layer = layer_named(settings.layer, self.layers)
        aids = self.aids.for_layers(frame.scene) if isinstance(frame, MaterialView) else None
        with torch.no_grad():
            painted = paint_layer(layer, frame, settings, aids)
            picture = as_bytes(painted.over(background_of(settings))[:, :, 0])
        depth = _picture_depth(frame) if with_depth and isinstance(frame, MaterialView) else None
        return Picture(picture, depth, painted.legend, is_moving, layer.is_labels)


def wants_more(frame: RenderedView) -> bool:
    """Whether a frame is an estimate that is to be averaged with others."""
    return isinstance(frame, ModelView) and frame.num_estimates < frame.num_wanted
