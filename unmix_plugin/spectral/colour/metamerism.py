"""Pairs of surfaces that look alike in one light and differ in another: what spectra tell apart and colours do not.

Notation: `N` surfaces, `B` bands, `L` lights, `P` pairs. Colours are those that an eye adapted to each light sees;
their differences are CIEDE2000.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import colour_mode
from unmix_plugin.spectral.colour.difference import ciede2000, reflectance_to_lab


@dataclass(frozen=True)
class MetamericPair:
    """Two surfaces and how different they look."""

    first: int
    second: int
    differences: tuple[float, ...]
    """CIEDE2000 in each light."""

    @property
    def alike_in(self) -> int:
        """The light in which they look most alike."""
        return int(np.argmin(self.differences))

    @property
    def different_in(self) -> int:
        """The light in which they differ most."""
        return int(np.argmax(self.differences))


def metameric_pairs(
    reflectance: Float64[np.ndarray, "N B"],
    lights: Float64[np.ndarray, "L B"],
    bands: Bands,
    alike: float = 2.0,
    different: float = 4.0,
) -> list[MetamericPair]:
    """All pairs that look alike in one of the lights and different in another, those that differ most first.

    Args:
        reflectance, lights: Of each surface; relative power of each light, none of them invisible.
        bands: Of both.
        alike: CIEDE2000 up to which two surfaces look alike.
        different: CIEDE2000 from which they look different.
    Raises:
        SpectrumError: fewer than two lights, bands in which colours can't be told, or thresholds the wrong way round.
    """
    if len(lights) < 2:
        raise SpectrumError(f"metamerism needs at least two lights; found {len(lights)}")
    if colour_mode(bands) != "true-colour":
        raise SpectrumError(
            f"{bands} can't tell colours apart as an eye does, so nothing is known of metamerism"
        )
    if not 0 <= alike < different:
        raise SpectrumError(
            "the difference of surfaces that look alike must be below that of those that look different; "
            f"found {alike:g} and {different:g}"
        )
    first, second = np.triu_indices(len(reflectance), k=1)
    differences = pair_differences(reflectance, lights, bands)
    chosen = (differences.min(axis=1) <= alike) & (differences.max(axis=1) >= different)
    order = np.flatnonzero(chosen)[np.argsort(-differences[chosen].max(axis=1), kind="stable")]
    return [
        MetamericPair(int(first[row]), int(second[row]), tuple(differences[row].tolist())) for row in order
    ]


def pair_differences(
    reflectance: Float64[np.ndarray, "N B"], lights: Float64[np.ndarray, "L B"], bands: Bands
) -> Float64[np.ndarray, "P L"]:
    """CIEDE2000 of every pair of surfaces in every light; pairs in the order of `numpy.triu_indices(N, 1)`."""
    first, second = np.triu_indices(len(reflectance), k=1)
    labs = [reflectance_to_lab(reflectance, light, bands) for light in lights]
    return np.stack([ciede2000(lab[first], lab[second]) for lab in labs], axis=1)
