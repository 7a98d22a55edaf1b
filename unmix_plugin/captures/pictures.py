"""Pictures of views for people, and how sharp they are.

Notation: `H x W` pixels, `B` bands; values in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from unmix_plugin.spectral.bands import Bands

BRIGHT_PERCENTILE = 99.0
"""Of sampled pixels; shown as white."""


@dataclass(frozen=True)
class Colours:
    """How spectra become sRGB, the same for all views of a sensor."""

    matrix: Float32[np.ndarray, "B 3"]
    """To linear red, green and blue."""
    gain: float
    """Brings bright pixels to white."""
    description: str
    """True colour, or which bands are shown as red, green and blue."""

    @staticmethod
    def of(bands: Bands, sample: Float32[np.ndarray, "N B"]) -> Colours:
        """Colours for spectra like those of the sample."""
        from unmix_plugin.spectral.colour.conversion import describe_colour, rgb_matrix

        matrix = rgb_matrix(bands).numpy()
        brightest = np.percentile((sample @ matrix).max(axis=1), BRIGHT_PERCENTILE) if len(sample) else 0.0
        return Colours(matrix, 1.0 / float(brightest) if brightest > 0 else 1.0, describe_colour(bands))

    def linear_rgb(self, values: Float32[np.ndarray, "*pixels B"]) -> Float32[np.ndarray, "*pixels 3"]:
        """Linear light, 1 is white; not clipped."""
        return np.asarray((values @ self.matrix) * np.float32(self.gain), dtype=np.float32)

    def srgb(self, linear_rgb: Float32[np.ndarray, "*pixels 3"]) -> UInt8[np.ndarray, "*pixels 3"]:
        """Encoded for a display (IEC 61966-2-1:1999)."""
        light = np.clip(linear_rgb, 0.0, 1.0)
        encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        return np.rint(encoded * 255).astype(np.uint8)


def detail(brightness: Float32[np.ndarray, "H W"], seen: Bool[np.ndarray, "H W"]) -> float:
    """Contrast of the finest structures against those twice as large; falls when a picture is blurred.

    Both are root mean squares of differences between a pixel and the mean of its neighbours, at full and at half
    resolution, over pixels of matter; 0 where there is too little of it.
    """
    fine, fine_inside = _residual(brightness, seen)
    height, width = (length // 2 * 2 for length in brightness.shape)
    halved = brightness[:height, :width].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    inside = np.all(seen[:height, :width].reshape(height // 2, 2, width // 2, 2), axis=(1, 3))
    coarse, coarse_inside = _residual(halved, inside)
    if not fine_inside.any() or not coarse_inside.any():
        return 0.0
    size = _root_mean_square(coarse[coarse_inside])
    return _root_mean_square(fine[fine_inside]) / size if size > 0 else 0.0


def _residual(
    picture: Float32[np.ndarray, "H W"], seen: Bool[np.ndarray, "H W"]
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Pixels less the mean of their four neighbours, without the border; and where all five are matter."""
    around = [(slice(0, -2), slice(1, -1)), (slice(2, None), slice(1, -1))]
    around += [(columns, rows) for rows, columns in around]
    middle = (slice(1, -1), slice(1, -1))
    inside = np.logical_and.reduce([seen[middle], *(seen[place] for place in around)])
    mean = sum((picture[place] for place in around), np.zeros_like(picture[middle])) / 4
    return picture[middle] - mean, inside


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def mean_spectrum(spectra: list[list[float]], weights: list[float]) -> Float64[np.ndarray, " B"]:
    """Weighted mean of spectra with the same bands."""
    return np.average(np.array(spectra), axis=0, weights=np.array(weights) + 1e-12)
