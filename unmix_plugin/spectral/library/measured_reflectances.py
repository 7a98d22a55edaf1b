"""Reflectances of real surfaces that colour-science carries, each over the range in which it was measured.

The tables of `cqs` and `cie2017` go on beyond what was measured by repeating the outermost value; these flat ends are
cut off here, so that they are not taken for data.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin.spectral.bands import Bands

Measured = tuple[str, Bands, Float64[np.ndarray, " B"], str]
"""Name, sampling, reflectance and source."""

_CRI_NAMES = (
    "light greyish red",
    "dark greyish yellow",
    "strong yellow green",
    "moderate yellowish green",
    "light bluish green",
    "light blue",
    "light violet",
    "light reddish purple",
    "strong red",
    "strong yellow",
    "strong green",
    "strong blue",
    "light yellowish pink",
    "moderate olive green leaf",
    "Asian skin",
)
"""Appearance under daylight of the test colour samples of CIE 13.3:1995 and the one added in 2024, in their order."""


def measured_reflectances() -> Iterator[Measured]:
    """Every measured surface of colour-science: name `set/sample`, sampling, reflectance in [0, 1], source.

    Sets: `pmc`, skin, fruit, vegetables, leaves and paints; `checker`, the ColorChecker; `cri`, test colour samples of
    CIE 13.3; `cqs`, saturated ones of NIST's colour quality scale; `cie2017`, the 99 samples of CIE 224:2017.
    """
    # Guarded because importing colour-science changes how NumPy prints.
    with np.printoptions():
        from colour import SpectralShape
        from colour.characterisation import SDS_COLOURCHECKERS
        from colour.quality.cfi2017 import load_TCS_CIE2017
        from colour.quality.datasets import SDS_TCS, SDS_VS

    yield from _each("pmc", SDS_COLOURCHECKERS["PMC"], "Preferred Memory Color chart")
    yield from _each("checker", SDS_COLOURCHECKERS["ColorChecker N Ohta"], "ColorChecker, Ohta 1997")
    known = SDS_TCS.get("CIE 2024", SDS_TCS)  # colour-science below 0.4.7 has the fourteen of 1995 alone
    samples: dict[str, Any] = dict(zip(_CRI_NAMES, known.values(), strict=False))
    yield from _each("cri", samples, "test colour samples, CIE 13.3:1995 and CIE 2024")
    for name, bands, values, source in _each("cqs", SDS_VS["NIST CQS 9.0"], "colour quality scale 9.0, NIST"):
        yield name, *_without_flat_ends(bands, values), source
    table = load_TCS_CIE2017(SpectralShape(380, 780, 5))
    bands, source = Bands.of(np.asarray(table.wavelengths)), "test colour samples, CIE 224:2017"
    for index, values in enumerate(np.asarray(table.values, dtype=np.float64).T):
        yield f"cie2017/{index + 1:02d}", *_without_flat_ends(bands, values), source


def _each(group: str, distributions: Mapping[str, Any], source: str) -> Iterator[Measured]:
    for sample, found in distributions.items():
        bands = Bands.of(np.asarray(found.wavelengths))
        yield f"{group}/{sample}", bands, np.asarray(found.values, dtype=np.float64), source


def _without_flat_ends(
    bands: Bands, values: Float64[np.ndarray, " B"]
) -> tuple[Bands, Float64[np.ndarray, " C"]]:
    changes = np.flatnonzero(np.diff(values))
    inside = slice(changes[0], changes[-1] + 2)
    return Bands.of(bands.centers_nm[inside]), values[inside]
