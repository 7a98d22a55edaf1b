"""What alpha and light of the training views are evidence of, sensor by sensor; see `spectral.evidence`."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.scenes.geometry.hull_places import local_log_brightness
from unmix_plugin.scenes.pixel_table import DrawnPixels, PixelTable
from unmix_plugin.scenes.pixel_table.block import PixelBlock
from unmix_plugin.spectral.evidence import alpha_trust, background_level, brightness, may_show_matter

_PIXELS_OF_BACKGROUND = 100_000
"""Pixels of a sensor by which the brightness of its background is judged."""
_OPAQUE_ALPHA = 0.99


class AlphaEvidence:
    """Where alpha is to be believed, and what may show something."""

    def __init__(self, table: PixelTable, has_alpha: bool) -> None:
        """Judge the background of each sensor; without alpha nothing contradicts anything."""
        self._blocks = table.blocks
        self._levels = {block.sensor: _level(block) if has_alpha else None for block in self._blocks}

    def trust(self, pixels: DrawnPixels) -> Float[Tensor, " R"]:
        """How far the alpha of drawn pixels is to be believed, 0 or 1."""
        return alpha_trust(pixels.spectra, pixels.alpha, self._levels[pixels.sensor])

    def foreground(self) -> list[Bool[np.ndarray, "_ _"]]:
        """For each training view True on pixels that may show something, or are not valid."""
        found: dict[int, np.ndarray] = {}
        for block in self._blocks:
            level = self._levels[block.sensor]

            def shows(spectra: Tensor, alpha: Tensor, valid: Tensor, level: float | None = level) -> Tensor:
                return may_show_matter(spectra, alpha, level) | ~valid

            for camera, picture in zip(block.cameras, block.pictures(shows), strict=True):
                found[camera] = picture.numpy()
        return [found[camera] for camera in sorted(found)]

    def log_brightness(self) -> tuple[list[int], list[Float[np.ndarray, "H W"]]]:
        """The views of the sensor that took most, and of each the logarithm of its brightness.

        NaN where a pixel is not opaque, not valid or saturated.
        """
        block = max(self._blocks, key=lambda block: len(block.cameras))
        return list(block.cameras), [local_log_brightness(seen) for seen in block.pictures(_clear_brightness)]


def _clear_brightness(spectra: Tensor, alpha: Tensor, valid: Tensor) -> Tensor:
    """Of pixels that are opaque, valid and not saturated; 0 for others."""
    is_clear = (alpha > _OPAQUE_ALPHA) & valid & (spectra.amax(dim=-1) < 1)
    return torch.where(is_clear, brightness(spectra), 0.0)


def _level(block: PixelBlock) -> float | None:
    stride = max(1, int(block.valid.sum()) // _PIXELS_OF_BACKGROUND)
    is_whole = bool(block.valid.all())  # then a list of all of them would take eight bytes a pixel
    pixels = torch.arange(0, len(block), stride) if is_whole else block.valid.nonzero()[::stride, 0]
    chosen = pixels.to(block.alpha.device)
    return background_level(block.spectra(chosen), block.alpha[chosen])
