"""A view of a scene of any method, rendered bit by bit: rays, rows, or estimates that are averaged.

Whoever shows a scene while it renders asks here and need not know what kind of scene it is.

Notation: `P` pixels of a view, row after row.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.trained.model_scene import EstimatedScene, ModelView
from unmix_plugin.trained.protocol import RenderableScene, RenderedView
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene

_CPU_CHUNK, _CUDA_CHUNK = 4096, 1 << 16
"""Rays rendered at once: as many as the caches, or the device, have room for."""


class FrameRender:
    """A view under way. Blocks may come from different steps of a training; materials are those of the end."""

    def __init__(
        self,
        camera: Cameras,
        subpixels: int = 1,
        before: RenderedView | None = None,
        is_finished: bool = False,
    ) -> None:
        """`subpixels` rays along each edge of a pixel are averaged, and the view with estimates of the same, `before`;
        `is_finished` if it has to be as fine as the scene makes it, rather than an estimate."""
        self.camera = camera
        self._before = before if isinstance(before, ModelView) else None
        self._subpixels, self._is_finished = subpixels, is_finished
        self._num_pixels = camera.width * camera.height
        self._stride = max(1, round(self._num_pixels * 0.6180339887))
        """A step through the pixels that meets each once and that spreads any run of them evenly."""
        while math.gcd(self._stride, self._num_pixels) != 1:
            self._stride += 1
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
            is_mixed = isinstance(scene, TrainedScene)
            rendered = self._render_chunk(scene, count) if is_mixed else self._render_rows(scene, count)
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


def numbers_per_pixel(scene: RenderableScene) -> int:
    """How many numbers of a pixel a view of the scene keeps, about."""
    materials = scene.materials
    if materials is None:
        return 4 * len(scene.outputs)
    return 2 + 2 * len(materials.endmembers) + len(materials.specular_spectra)


def wants_more(view: RenderedView) -> bool:
    """Whether a view is an estimate that is to be averaged with others."""
    return isinstance(view, ModelView) and view.num_estimates < view.num_wanted


def shown_with(view: RenderedView, scene: RenderableScene) -> RenderedView:
    """What a view would be with the materials of another scene on the same shapes; itself where it has none."""
    if isinstance(view, MaterialView) and isinstance(scene, TrainedScene):
        return MaterialView(scene, view.camera, view.coefficients)
    return view
