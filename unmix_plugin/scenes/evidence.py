"""What the pixels of training views tell: confidence in alpha, the brightness of places, weights of bands.

The rules for single pixels are in `spectral.evidence`; here they are applied sensor by sensor.

Notation: `B` bands of the scene, `G` groups, `R` pixels.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.scenes.geometry.carving import Masks
from unmix_plugin.scenes.geometry.lighting import Pictures, local_log_brightness
from unmix_plugin.scenes.pixel_block import PixelBlock
from unmix_plugin.scenes.pixel_table import PixelTable
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bad_values import BandNoise, judge_bands
from unmix_plugin.spectral.evidence import (
    OPAQUE_ALPHA,
    background_level,
    brightness,
    may_show_foreground,
    relative_power_of,
)

_PIXELS_OF_BACKGROUND = 100_000
"""Pixels of a sensor by which the brightness of its background is judged."""
_PIXELS_TO_GROUP = 20_000
_COLOUR_GROUPS = 24
_LIT_BEST = 0.9
"""Quantile of a group's brightness that stands for full light."""
_PIXELS_TO_JUDGE_BY = 20_000


class AlphaEvidence:
    """How sure alpha is, and which pixels may show something."""

    def __init__(self, table: PixelTable, has_alpha: bool) -> None:
        """Judge the background of each sensor; without alpha nothing contradicts anything."""
        self._blocks = table.blocks
        self.levels: dict[int, float | None] = {block.sensor: None for block in self._blocks}
        """Of each sensor the brightness of its background, as `alpha_confidence` takes it."""
        for block in self._blocks if has_alpha else ():
            stride = max(1, int(block.valid.sum()) // _PIXELS_OF_BACKGROUND)
            is_whole = bool(block.valid.all())  # then a list of all of them would take eight bytes per pixel
            pixels = torch.arange(0, len(block), stride) if is_whole else block.valid.nonzero()[::stride, 0]
            chosen = pixels.to(block.alpha.device)
            self.levels[block.sensor] = background_level(block.spectra(chosen), block.alpha[chosen])

    def foreground(self) -> Masks:
        """For each training view True on pixels that may show something, or are not valid."""
        found: dict[int, np.ndarray] = {}
        for block in self._blocks:
            level = self.levels[block.sensor]

            def shows(spectra: Tensor, alpha: Tensor, valid: Tensor, level: float | None = level) -> Tensor:
                return may_show_foreground(spectra, alpha, level) | ~valid

            for camera, picture in zip(block.cameras, block.pictures(shows), strict=True):
                found[camera] = picture.numpy()
        return [found[camera] for camera in sorted(found)]

    def log_brightness(self) -> tuple[list[int], Pictures]:
        """The views of the sensor that took most, and of each the logarithm of its brightness; NaN where a pixel is not
        opaque, not valid or saturated."""
        block = self._largest_block
        return list(block.cameras), [local_log_brightness(seen) for seen in block.pictures(_clear_brightness)]

    def log_shading(self) -> Pictures:
        """The same without the brightness of what pixels show, by groups of pixels of like spectra."""
        block = self._largest_block
        return [local_log_brightness(seen) for seen in block.pictures(_ColourGroups(block).shading)]

    @property
    def _largest_block(self) -> PixelBlock:
        return max(self._blocks, key=lambda block: len(block.cameras))


class _ColourGroups:
    """Groups of pixels whose spectra are multiples of each other, more or less."""

    def __init__(self, block: PixelBlock) -> None:
        """From some of a block's opaque pixels; none if these are too few."""
        from scipy.cluster.vq import kmeans2  # slow to import

        chosen = torch.arange(0, len(block), max(1, len(block) // _PIXELS_TO_GROUP))
        valid, chosen = block.valid[chosen].to(block.alpha.device), chosen.to(block.alpha.device)
        spectra = block.spectra(chosen)
        spectra = spectra[_is_clear(spectra, block.alpha[chosen], valid)]
        self._middles: Float[Tensor, "G B"] = spectra[:0]
        if len(spectra) < _COLOUR_GROUPS:
            return
        directions, rng = normalize(spectra, dim=-1).cpu().numpy(), np.random.default_rng(0)
        middles, group = kmeans2(directions, _COLOUR_GROUPS, minit="++", rng=rng)
        bright, groups = brightness(spectra), torch.from_numpy(group).to(spectra.device)
        own = [bright[groups == k] for k in range(_COLOUR_GROUPS)]
        best = [torch.quantile(each, _LIT_BEST) if len(each) else 1.0 for each in own]
        self._middles, self._brightest = torch.from_numpy(middles).to(spectra), torch.tensor(best).to(spectra)

    def shading(self, spectra: Tensor, alpha: Tensor, valid: Tensor) -> Tensor:
        """Brightness in that of the best lit pixels of the same group; 0 for pixels that say nothing."""
        if len(self._middles) == 0:
            return torch.zeros_like(alpha)
        group = torch.cdist(normalize(spectra, dim=-1), self._middles).argmin(dim=-1)
        return _clear_brightness(spectra, alpha, valid) / self._brightest[group].clamp(min=1e-6)


def _is_clear(spectra: Tensor, alpha: Tensor, valid: Tensor) -> Tensor:
    return (alpha > OPAQUE_ALPHA) & valid & (spectra.amax(dim=-1) < 1)


def _clear_brightness(spectra: Tensor, alpha: Tensor, valid: Tensor) -> Tensor:
    """Of pixels that are opaque, valid and not saturated; 0 for others."""
    return torch.where(_is_clear(spectra, alpha, valid), brightness(spectra), 0.0)


def judge_sensors(scene: Scene, table: PixelTable, seed: int) -> dict[int, BandNoise]:
    """The bands of each sensor that has bands of the scene for channels."""
    found = {}
    for sensor in table.shares:
        if scene.sensors[sensor].bands is not None:
            found[sensor] = judge_bands(table.sample_opaque(sensor, _PIXELS_TO_JUDGE_BY, seed))
    return found


def band_weights(scene: Scene, noise: dict[int, BandNoise]) -> Float[np.ndarray, " B"]:
    """Of squared errors in each band; where several sensors see a band, the least."""
    weights = np.full(len(scene.wavelengths_nm), np.inf, dtype=np.float32)
    for sensor, found in noise.items():
        bands = list(scene.sensors[sensor].bands or ())
        weights[bands] = np.minimum(weights[bands], found.weights.numpy())
    return np.where(np.isfinite(weights), weights, 1.0).astype(np.float32)


def relative_power(scene: Scene, opaque: Float[Tensor, "R B"]) -> float:
    """Of brightness, by which squared errors are divided. Without alpha black may be nothing at all, so that errors of
    dark pixels must not count more: 0."""
    knows_empty = scene.has_alpha and not scene.is_unbounded
    return relative_power_of(opaque) if knows_empty else 0.0
