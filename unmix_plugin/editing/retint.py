"""The smoothest change of a spectrum that gives it a wanted colour.

Notation: `B` bands; `r` a reflectance, `L` the light, M (B, 3) the matrix from radiance to linear RGB. The changed
reflectance is r + (r + f) d with a floor f, so that d is a relative change that still reaches where r is 0. Of all d
with M^T L (r + (r + f) d) = colour and bounds on the result, the one is taken whose

    integral of d'^2 + (d / reach)^2 over wavelength

is least: it turns with wavelength as little as the colour allows, and fades to no change far from where colour is seen.
Leaving the colour as it is leaves the spectrum as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix

_FLOOR = 0.05
"""f: reflectance below which a change counts as absolute rather than relative."""

_REACH_NM = 300.0
"""Distance over which a change fades that no colour asks for."""

_EXACTNESS = 1e5
"""Weight of the colour against smoothness: what it misses by vanishes as the inverse square."""

_TOLERANCE = 1e-3
"""Greatest error of linear RGB with which a colour still counts as reached."""


@dataclass(frozen=True)
class Surface:
    """A spectrum to change, and the light that it is seen in."""

    bands: Bands
    reflectance: Float64[np.ndarray, " B"]
    light: Float64[np.ndarray, " B"]
    """Relative power."""


def retinted(
    surface: Surface, linear_rgb: Float64[np.ndarray, "3"], greatest: float = 1.0
) -> Float64[np.ndarray, " B"]:
    """The reflectance nearest in kind to a surface's that has a colour under its light.

    Args:
        surface: What is changed.
        linear_rgb: The wanted colour as `spectral.colour.rgb_matrix` makes it, of the light that the surface sends.
        greatest: Upper bound of the reflectance; the lower one is 0.
    Raises:
        SpectrumError: no reflectance within the bounds has that colour in this light; the message has the nearest that
            can be had.
    """
    from scipy.optimize import lsq_linear

    reflectance = surface.reflectance
    base = reflectance + _FLOOR
    to_rgb = surface.light[:, None] * rgb_matrix(surface.bands, torch.float64).numpy()
    colour_rows = _EXACTNESS * (to_rgb * base[:, None]).T
    wanted = _EXACTNESS * (linear_rgb - reflectance @ to_rgb)
    smoothness = _smoothness(surface.bands)
    lower, upper = -reflectance / base, np.maximum(greatest - reflectance, 0.0) / base
    solution = lsq_linear(
        np.concatenate([smoothness, colour_rows]),
        np.concatenate([np.zeros(len(smoothness)), wanted]),
        (lower, np.maximum(upper, lower + 1e-12)),
        method="bvls",
    )
    changed = np.clip(reflectance + base * solution.x, 0.0, max(greatest, float(reflectance.max())))
    reached = changed @ to_rgb
    if np.abs(reached - linear_rgb).max() > _TOLERANCE:
        raise SpectrumError(
            f"no surface has the colour {hexadecimal(linear_rgb)} in this light; "
            f"the nearest that one can have is about {hexadecimal(reached)}"
        )
    return changed


def hexadecimal(linear_rgb: Float[np.ndarray, "3"]) -> str:
    """A linear colour as it is written, sRGB in hexadecimal digits.

    >>> hexadecimal(np.array([1.0, 0.0, 0.2159]))
    '#ff0080'
    """
    srgb = linear_to_srgb(torch.from_numpy(np.clip(linear_rgb, 0, 1).astype(np.float64))).numpy()
    return "#" + "".join(f"{round(255 * float(value)):02x}" for value in srgb)


def _smoothness(bands: Bands) -> Float64[np.ndarray, "rows B"]:
    """Rows whose squares sum to the integral that is minimised, wavelengths in units of the reach."""
    centers, widths = bands.centers_nm / _REACH_NM, bands.widths_nm / _REACH_NM
    slopes = np.diff(np.eye(len(bands)), axis=0) / np.sqrt(np.diff(centers))[:, None]
    return np.concatenate([slopes, np.diag(np.sqrt(widths))])
