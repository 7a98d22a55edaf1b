"""What alpha and light of the training views are evidence of, sensor by sensor; see `spectral.evidence`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.scenes.geometry.hull_places import local_log_brightness
from unmix_plugin.scenes.pixel_table import DrawnPixels, PixelTable
from unmix_plugin.scenes.pixel_table.block import PixelBlock
from unmix_plugin.spectral.evidence import alpha_trust, background_level, may_show_matter

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
            for camera, (spectra, alpha, valid) in zip(block.cameras, block.images(), strict=True):
                level = self._levels[block.sensor]
                shows = may_show_matter(spectra.flatten(0, 1), alpha.flatten(), level).view(alpha.shape)
                found[camera] = (shows | ~valid).numpy()
        return [found[camera] for camera in sorted(found)]

    def log_brightness(self) -> tuple[list[int], list[Float[np.ndarray, "H W"]]]:
        """The views of the sensor that took most, and of each the logarithm of its brightness.

        NaN where a pixel is not opaque, not valid or saturated.
        """
        block = max(self._blocks, key=lambda block: len(block.cameras))
        seen = [
            local_log_brightness(spectra, (alpha > _OPAQUE_ALPHA) & valid & (spectra.amax(dim=-1) < 1))
            for spectra, alpha, valid in block.images()
        ]
        return list(block.cameras), seen


def _level(block: PixelBlock) -> float | None:
    pixels = block.valid.nonzero()[:, 0]
    chosen = pixels[:: max(1, len(pixels) // _PIXELS_OF_BACKGROUND)].to(block.alpha.device)
    return background_level(block.spectra(chosen), block.alpha[chosen])
