"""What alpha and light of the training views are evidence of, sensor by sensor; see `spectral.evidence`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.scenes.geometry.lighting import local_log_brightness
from unmix_plugin.scenes.pixel_table import DrawnPixels, PixelTable
from unmix_plugin.scenes.pixel_table.block import PixelBlock
from unmix_plugin.spectral.evidence import alpha_trust, background_level, brightness, may_show_matter

_PIXELS_OF_BACKGROUND = 100_000
"""Pixels of a sensor by which the brightness of its background is judged."""
_OPAQUE_ALPHA = 0.99
_PIXELS_TO_GROUP = 20_000
_COLOUR_GROUPS = 24
_LIT_BEST = 0.9
"""Quantile of a group's brightness that stands for full light."""


class AlphaEvidence:
    """Where alpha can be trusted, and what may show something."""

    def __init__(self, table: PixelTable, has_alpha: bool) -> None:
        """Judge the background of each sensor; without alpha nothing contradicts anything."""
        self._blocks = table.blocks
        self._levels = {block.sensor: _level(block) if has_alpha else None for block in self._blocks}

    def trust(self, pixels: DrawnPixels) -> Float[Tensor, " R"]:
        """How far the alpha of drawn pixels can be trusted, 0 or 1."""
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
        block = self._largest_block
        return list(block.cameras), [local_log_brightness(seen) for seen in block.pictures(_clear_brightness)]

    @property
    def _largest_block(self) -> PixelBlock:
        """Of the sensor that took most views."""
        return max(self._blocks, key=lambda block: len(block.cameras))

    def log_shading(self) -> list[Float[np.ndarray, "H W"]]:
        """The same without the brightness of what pixels show, by groups of pixels of like spectra."""
        block = self._largest_block
        colours = ColourGroups.of(block)
        return [local_log_brightness(seen) for seen in block.pictures(colours.shading)]


@dataclass(frozen=True)
class ColourGroups:
    """Groups of pixels whose spectra are multiples of each other, more or less."""

    middles: Float[Tensor, "G B"]
    """Spectra of length 1."""
    brightest: Float[Tensor, " G"]
    """Brightness of those of each group that are lit best."""

    @staticmethod
    def of(block: PixelBlock) -> ColourGroups:
        """From some of a block's opaque pixels."""
        from scipy.cluster.vq import kmeans2  # slow to import

        stride = max(1, len(block) // _PIXELS_TO_GROUP)
        chosen = torch.arange(0, len(block), stride)
        valid, on_device = block.valid[chosen], chosen.to(block.alpha.device)
        spectra = block.spectra(on_device)
        spectra = spectra[_is_clear(spectra, block.alpha[on_device], valid.to(spectra.device))]
        if len(spectra) < _COLOUR_GROUPS:
            return ColourGroups(spectra.new_zeros(0, spectra.shape[1]), spectra.new_zeros(0))
        rng = np.random.default_rng(0)
        middles, group = kmeans2(
            normalize(spectra, dim=-1).cpu().numpy(), _COLOUR_GROUPS, minit="++", rng=rng
        )
        bright = brightness(spectra)
        best = [
            torch.quantile(bright[mask], _LIT_BEST)
            if bool((mask := torch.from_numpy(group == k)).any())
            else 1.0
            for k in range(_COLOUR_GROUPS)
        ]
        return ColourGroups(torch.from_numpy(middles).to(spectra), torch.tensor(best).to(spectra))

    def shading(self, spectra: Tensor, alpha: Tensor, valid: Tensor) -> Tensor:
        """Brightness in that of the best lit pixels of the same group; 0 for pixels that say nothing."""
        if len(self.middles) == 0:
            return torch.zeros_like(alpha)
        group = torch.cdist(normalize(spectra, dim=-1), self.middles).argmin(dim=-1)
        return _clear_brightness(spectra, alpha, valid) / self.brightest[group].clamp(min=1e-6)


def _is_clear(spectra: Tensor, alpha: Tensor, valid: Tensor) -> Tensor:
    return (alpha > _OPAQUE_ALPHA) & valid & (spectra.amax(dim=-1) < 1)


def _clear_brightness(spectra: Tensor, alpha: Tensor, valid: Tensor) -> Tensor:
    """Of pixels that are opaque, valid and not saturated; 0 for others."""
    return torch.where(_is_clear(spectra, alpha, valid), brightness(spectra), 0.0)


def _level(block: PixelBlock) -> float | None:
    stride = max(1, int(block.valid.sum()) // _PIXELS_OF_BACKGROUND)
    is_whole = bool(block.valid.all())  # then a list of all of them would take eight bytes a pixel
    pixels = torch.arange(0, len(block), stride) if is_whole else block.valid.nonzero()[::stride, 0]
    chosen = pixels.to(block.alpha.device)
    return background_level(block.spectra(chosen), block.alpha[chosen])
