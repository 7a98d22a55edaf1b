"""The smoothest change of a spectrum that gives it a wanted colour, or the nearest colour that a surface can have.

Notation: `B` bands; `r` a reflectance, `L` the light, M (B, 3) the matrix from radiance to linear RGB. The changed
reflectance is r + (r + f) d with a floor f, so that d is a relative change that still reaches where r is 0. Of all d
with M^T L (r + (r + f) d) = colour and bounds on the result, the one is taken whose

    integral of d'^2 + (d / reach)^2 over wavelength

is least: it changes with wavelength as little as the colour allows, and fades far from where colour is seen. Asking
for the colour that a surface has leaves its spectrum as it is. The equation is solved in least squares, with a large
weight: exactly if the bounds allow it, otherwise as nearly as they do. Channels count by the slope of the sRGB curve at
the wanted colour, so that "near" is near on a display.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix

_FLOOR = 0.05
"""f: reflectance below which a change counts as absolute rather than relative."""

_REACH_NM = 300.0
"""Distance over which the change fades outside the wavelengths that make the colour."""

_EXACTNESS = 1e5
"""Weight of the colour against smoothness; the error of the colour falls with its square."""


@dataclass(frozen=True)
class LitReflectance:
    """A spectrum to change, and the light that it is seen in."""

    bands: Bands
    reflectance: Float64[np.ndarray, " B"]
    light: Float64[np.ndarray, " B"]
    """Relative power."""

    @property
    def to_linear_rgb(self) -> Float64[np.ndarray, "B 3"]:
        """Matrix from reflectance to linear RGB of the light that the surface sends."""
        return self.light[:, None] * rgb_matrix(self.bands, torch.float64).numpy()


def retinted(
    surface: LitReflectance, linear_rgb: Float64[np.ndarray, "3"], greatest: float = 1.0
) -> Float64[np.ndarray, " B"]:
    """The reflectance most like a surface's own that has the wanted colour in its light, or comes nearest to it.

    Args:
        surface: What is changed.
        linear_rgb: The wanted colour, as `spectral.colour.rgb_matrix` makes it of the light that the surface sends.
        greatest: Upper bound of the reflectance; the lower one is 0.
    """
    from scipy.optimize import lsq_linear

    reflectance, to_rgb = surface.reflectance, surface.to_linear_rgb
    base = reflectance + _FLOOR
    weights = (_EXACTNESS * _srgb_slope(linear_rgb))[:, None]
    smoothness = _smoothness(surface.bands)
    lower, upper = -reflectance / base, np.maximum(greatest - reflectance, 0.0) / base
    solution = lsq_linear(
        np.concatenate([smoothness, weights * (to_rgb * base[:, None]).T]),
        np.concatenate([np.zeros(len(smoothness)), weights[:, 0] * (linear_rgb - reflectance @ to_rgb)]),
        (lower, np.maximum(upper, lower + 1e-12)),
        method="bvls",
    )
    return np.clip(reflectance + base * solution.x, 0.0, max(greatest, float(reflectance.max())))


def _srgb_slope(linear_rgb: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Slope of the sRGB curve at each channel: 12.92 in the dark, 0.44 at white."""
    linear = np.clip(linear_rgb, 0.0031308, 1.0)
    return np.where(linear_rgb <= 0.0031308, 12.92, 1.055 / 2.4 * linear ** (1 / 2.4 - 1))


def _smoothness(bands: Bands) -> Float64[np.ndarray, "rows B"]:
    """Rows whose squares sum to the integral that is minimised, wavelengths in units of the reach."""
    centers, widths = bands.centers_nm / _REACH_NM, bands.widths_nm / _REACH_NM
    slopes = np.diff(np.eye(len(bands)), axis=0) / np.sqrt(np.diff(centers))[:, None]
    return np.concatenate([slopes, np.diag(np.sqrt(widths))])
