"""What the demo scene is made of: measured reflectances, the lamp's spectrum, and how two materials blend on a surface.

Notation: `B` bands, `K` materials, `P` points. Reflectances are in [0, 1]; the lamp's power is relative, largest
band 1. Abundances of a point are fractions of its area, >= 0, summing to 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.illuminants import illuminant_power

MATERIALS = ("white", "red", "yellow", "green", "cyan", "purple")
"""Six patches of the ColorChecker chart; the spectral angle between any two under the lamp is at least 0.45 rad."""

_PATCHES = ("white 9.5 (.05 D)", "red", "yellow", "green", "cyan", "purple")

RANGE_NM = (400.0, 700.0)

LAMP = "D50"
"""CIE illuminant of the lamp and of the sky."""

Blend = Callable[[Float[np.ndarray, "P 3"]], Float[np.ndarray, " P"]]
"""Share of the second material at points in a shape's own coordinates."""


def band_centers_nm(bands: int) -> Float[np.ndarray, " B"]:
    """Evenly spaced band centres over 400-700 nm, ends included."""
    return np.linspace(*RANGE_NM, bands)


def reflectances(wavelengths_nm: Float[np.ndarray, " B"]) -> Float[np.ndarray, "K B"]:
    """Reflectance of every material, in the order of `MATERIALS`.

    Source:
        The average of 30 ColorChecker charts measured by BabelColor, 380-730 nm in steps of 10 nm.
    """
    # Imported here because colour-science takes more than a second.
    from colour.characterisation import SDS_COLOURCHECKERS

    chart = SDS_COLOURCHECKERS["BabelColor Average"]
    return np.stack(
        [np.interp(wavelengths_nm, chart[name].wavelengths, chart[name].values) for name in _PATCHES]
    )


def lamp_power(
    wavelengths_nm: Float[np.ndarray, " B"], illuminant: str | Path = LAMP
) -> Float[np.ndarray, " B"]:
    """Relative power of the lamp and of the sky, which share one spectrum: largest value 1.

    Args:
        wavelengths_nm: Band centres.
        illuminant: Name of a known light, or a CSV file, as `spectral.colour.illuminants.illuminant_power` takes it.
    Raises:
        SpectrumError: an unknown light, or one that is not known at all bands.
    """
    return illuminant_power(illuminant, Bands.of(wavelengths_nm))


@dataclass(frozen=True)
class Surface:
    """Two materials and where on a shape which of them shows."""

    first: str
    second: str
    blend: Blend
    roughness: float | None = None
    """GGX alpha of the clear coat; None is matt."""

    def abundances(self, local_points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P K"]:
        """Abundances at points in the shape's own coordinates."""
        share = self.blend(local_points)
        result = np.zeros((len(local_points), len(MATERIALS)), dtype=local_points.dtype)
        result[:, MATERIALS.index(self.first)] += 1 - share
        result[:, MATERIALS.index(self.second)] += share
        return result


def smooth_step(values: Float[np.ndarray, " P"], low: float, high: float) -> Float[np.ndarray, " P"]:
    """0 below `low`, 1 above `high`, a cubic with level ends between."""
    t = ((values - low) / (high - low)).clip(0, 1)
    return t * t * (3 - 2 * t)


def gingham(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
    """Woven squares: warp and weft each carry half of the second material; a plain rim below the top."""
    stripes = [smooth_step(np.sin(points[:, axis] * 10.5 + 0.8), -0.25, 0.25) for axis in (0, 1)]
    on_top = points[:, 2] > 0.999
    return np.where(on_top, (stripes[0] + stripes[1]) / 2, 1)


def blush(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
    """A slow gradient over one side."""
    return smooth_step(points @ np.array([0.75, 0.5, 0.43], dtype=points.dtype), -0.15, 1.1)


def ribbon(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
    """A parcel's crossed ribbons, with slightly soft borders."""
    across = np.minimum(np.abs(points[:, 0]), np.abs(points[:, 1]))
    return 1 - smooth_step(across, 0.2, 0.27)


def candy_stripes(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
    """A soft helix around the side; a plain top."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    share = smooth_step(np.sin(2 * angle + points[:, 2] * 4.5), -0.45, 0.45)
    return np.where(np.abs(points[:, 2]) > 0.999, 0, share)


def plain(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
    """The first material alone."""
    return np.zeros(len(points), dtype=points.dtype)
