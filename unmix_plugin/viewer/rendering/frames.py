"""Views rendered block by block, so that nothing waits long for the device.

Notation: `P` pixels of a view, row after row.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.spectral.materials import Coefficients, Materials
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.trained.model_scene import ModelView
from unmix_plugin.trained.protocol import RenderableScene, RenderedView
from unmix_plugin.trained.relighting import EstimatedScene
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.view_cameras import pixel_rays

_CPU_CHUNK, _CUDA_CHUNK = 4096, 1 << 16
"""Rays rendered at once: as many as the caches, or the device, have room for."""


class FrameRender:
    """A view under way. Blocks may come from different steps of a training; materials are those of the end."""

    def __init__(
        self, camera: Cameras, subpixels: int = 1, before: ModelView | None = None, is_finished: bool = False
    ) -> None:
        """
        Args:
            camera: One camera.
            subpixels: Rays through a pixel along each of its edges, averaged.
            before: Estimates of the same view, which the new one is averaged with.
            is_finished: Whether the view has to be as fine as the scene makes it, rather than an estimate.
        """
        self.camera = camera
        self._subpixels, self._before, self._is_finished = subpixels, before, is_finished
        centres = [(index + 0.5) / subpixels for index in range(subpixels)]
        self._offsets = [(x, y) for y in centres for x in centres]
        self._num_pixels = camera.width * camera.height
        self._stride = _coprime_stride(self._num_pixels)
        self._rays_done = 0
        self._coefficients: Coefficients | None = None
        self._strips: list[dict[str, Tensor]] = []
        self._opacities: list[Tensor] = []
        self._num_wanted = 1

    @property
    def num_rays(self) -> int:
        """Rays of the whole view."""
        return self._num_pixels * len(self._offsets)

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
            if isinstance(scene, TrainedScene):
                done += self._render_chunk(scene, count)
            else:
                done += self._render_rows(scene, count)
        return done

    def _render_chunk(self, scene: TrainedScene, num_rays: int) -> int:
        turn, start = divmod(self._rays_done, self._num_pixels)
        end = min(start + num_rays, self._num_pixels)
        # Spread over the picture, so that every block has its share of what is empty and of what is costly.
        pixels = torch.arange(start, end, device=scene.device) * self._stride % self._num_pixels
        bundle = pixel_rays(self.camera.to(scene.device), pixels, self._offsets[turn])
        block = scene.renderer.composite(scene.field, bundle)
        if self._coefficients is None:
            self._coefficients = block.map(lambda packed: packed.new_zeros(self._num_pixels, packed.shape[1]))
        self._coefficients.packed[pixels] += block.packed / len(self._offsets)
        self._rays_done += end - start
        return end - start

    def _render_rows(self, scene: RenderableScene, num_rays: int) -> int:
        """Whole rows from top to bottom, of a scene that only renders views; one ray a pixel."""
        width, turns = self.camera.width, len(self._offsets)
        first = self._rays_done // (width * turns)
        last = min(first + max(1, num_rays // (width * turns)), self.camera.height)
        camera = self.camera.crop(0, first, width, last - first).to(scene.device)
        if isinstance(scene, EstimatedScene) and self._is_finished:
            strip = scene.look(camera, self._subpixels)
        elif isinstance(scene, EstimatedScene):
            number = 0 if self._before is None else self._before.num_estimates
            strip = scene.estimate(camera, self._subpixels, number)
            self._num_wanted = strip.num_wanted
        else:
            strip = scene.look(camera)
        self._strips.append({output.name: strip[output.name] for output in scene.outputs})
        self._opacities.append(strip.opacity)
        self._rays_done = last * width * turns
        return (last - first) * width * turns

    def frame(self, scene: RenderableScene) -> RenderedView:
        """The finished view, with the materials of a scene that has some."""
        assert self.rays_left == 0
        if not isinstance(scene, TrainedScene):
            names = (output.name for output in scene.outputs)
            tensors = {name: torch.cat([strip[name] for strip in self._strips]) for name in names}
            tensors = {"accumulation": torch.cat(self._opacities), **tensors}
            view = ModelView(self.camera, tensors, num_wanted=self._num_wanted)
            return view if self._before is None else self._before.averaged(view)
        assert self._coefficients is not None
        image = self._coefficients.unflatten(self.camera.height, self.camera.width)
        return MaterialView(scene, self.camera, image)


def num_channels(materials: Materials) -> int:
    """Coefficients of a pixel."""
    return 2 + 2 * len(materials.endmembers) + len(materials.specular_spectra)


def _coprime_stride(count: int) -> int:
    """A step through `count` pixels that meets each once and that spreads any run of them evenly."""
    stride = max(1, round(count * 0.6180339887))
    while math.gcd(stride, count) != 1:
        stride += 1
    return stride
