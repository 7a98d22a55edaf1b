"""Pictures rendered block by block: coefficients of a view, with what is needed to show any layer of them.

Notation: `P` pixels of a view, row after row; `C` channels: accumulation, distance, K abundances, K scaled abundances,
J specular coefficients.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.model import UnmixModel
from unmix_plugin.spectral.composition import Coefficients, Materials
from unmix_plugin.viewer.view_cameras import pixel_rays

_CPU_CHUNK, _CUDA_CHUNK = 4096, 1 << 16
"""Rays rendered at once: as many as the caches, or the device, have room for."""


@dataclass(frozen=True)
class Frame:
    """A rendered view: every layer follows from it, and nothing of it changes when training goes on."""

    camera: Cameras
    coefficients: Coefficients
    """(H, W, ...)."""
    materials: Materials
    """Detached from the model's parameters."""

    @property
    def num_pixels(self) -> int:
        """How fine the picture is."""
        return self.camera.width * self.camera.height


class FrameRender:
    """A view under way. Blocks may come from different steps of a training; the materials are those of the end."""

    def __init__(self, camera: Cameras, subpixels: int = 1) -> None:
        """
        Args:
            camera: One camera.
            subpixels: Rays through a pixel along each of its edges, averaged.
        """
        self.camera = camera
        centres = [(index + 0.5) / subpixels for index in range(subpixels)]
        self._offsets = [(x, y) for y in centres for x in centres]
        self._num_pixels = camera.width * camera.height
        self._stride = _coprime_stride(self._num_pixels)
        self._rays_done = 0
        self._channels: Float[Tensor, "P C"] | None = None

    @property
    def num_rays(self) -> int:
        """Rays of the whole view."""
        return self._num_pixels * len(self._offsets)

    @property
    def rays_left(self) -> int:
        """Rays still to be rendered."""
        return self.num_rays - self._rays_done

    @torch.no_grad()
    def render_block(self, model: UnmixModel, num_rays: int) -> int:
        """Render up to `num_rays` more; how many it were."""
        done, chunk = 0, _CUDA_CHUNK if model.device.type == "cuda" else _CPU_CHUNK
        while done < num_rays and self.rays_left:
            done += self._render_chunk(model, min(num_rays - done, chunk))
        return done

    def _render_chunk(self, model: UnmixModel, num_rays: int) -> int:
        turn, start = divmod(self._rays_done, self._num_pixels)
        end = min(start + num_rays, self._num_pixels)
        # Spread over the picture, so that every block has its share of what is empty and of what is costly.
        pixels = torch.arange(start, end, device=model.device) * self._stride % self._num_pixels
        bundle = pixel_rays(self.camera.to(model.device), pixels, self._offsets[turn])
        block = channels_of(model.renderer(model.field, bundle).coefficients) / len(self._offsets)
        if self._channels is None:
            self._channels = block.new_zeros(self._num_pixels, block.shape[1])
        self._channels[pixels] += block
        self._rays_done += end - start
        return end - start

    def frame(self, materials: Materials) -> Frame:
        """The finished view."""
        assert self._channels is not None
        assert self.rays_left == 0
        coefficients = coefficients_of(self._channels, len(materials.endmembers))
        image = coefficients.unflatten(self.camera.height, self.camera.width)
        return Frame(self.camera, image, detached(materials))


def render_frame(model: UnmixModel, camera: Cameras) -> Frame:
    """A whole view at once."""
    render = FrameRender(camera)
    render.render_block(model, render.num_rays)
    return render.frame(model.materials)


def channels_of(coefficients: Coefficients) -> Float[Tensor, "P C"]:
    """All coefficients of rays side by side."""
    values = [getattr(coefficients, entry.name) for entry in fields(coefficients)]
    return torch.cat([value[:, None] if value.ndim == 1 else value for value in values], dim=-1)


def coefficients_of(channels: Float[Tensor, "P C"], num_endmembers: int) -> Coefficients:
    """The inverse of `channels_of`: views of the same memory."""
    rest = channels.shape[1] - 2 - 2 * num_endmembers
    accumulation, distance, abundances, scaled, specular = channels.split(
        [1, 1, num_endmembers, num_endmembers, rest], dim=-1
    )
    return Coefficients(accumulation[:, 0], distance[:, 0], abundances, scaled, specular)


def detached(materials: Materials) -> Materials:
    """Materials that no later training step or edit changes."""
    return replace(
        materials,
        endmembers=materials.endmembers.detach().clone(),
        specular_spectra=materials.specular_spectra.detach().clone(),
    )


def num_channels(model: UnmixModel) -> int:
    """C of a model."""
    materials = model.materials
    return 2 + 2 * len(materials.endmembers) + len(materials.specular_spectra)


def _coprime_stride(count: int) -> int:
    """A step through `count` pixels that meets each once and that spreads any run of them evenly."""
    stride = max(1, round(count * 0.6180339887))
    while math.gcd(stride, count) != 1:
        stride += 1
    return stride
