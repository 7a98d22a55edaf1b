"""Another light: what it multiplies every spectrum of a scene with.

A spectrum in the new light is the one seen, divided by the light that the scene was recorded in, times the new one.
That is right if the recorded light has one spectrum everywhere; shadows, shading and gloss stay as they are. Bands
that either light does not reach become 0: nothing is known of them.

Brightness. The power of a new light is chosen so that a perfect white is as bright as before: as luminous if the bands
see colours (CIE Y), otherwise of the same mean radiance. So single bands may exceed 1, the full scale of the sensor.

Notation: `B` bands.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.editing.recipe import Light
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import brightness, covered_bands, illuminant_power
from unmix_plugin.spectral.library.material_library import DARK_LIGHT


def relighting_factors(
    bands: Bands, recorded: Float64[np.ndarray, " B"] | None, light: Light
) -> tuple[Float64[np.ndarray, " B"], list[str]]:
    """What radiance is multiplied with, band by band, to be seen in another light; and what a user has to be told.

    Args:
        bands: Of the scene.
        recorded: Light that the scene was recorded in, relative power; None if unknown: taken as flat, CIE E.
        light: The new one.
    Raises:
        SpectrumError: the new light is unknown or invisible in all bands that the recorded one reaches.
    """
    before = np.ones(len(bands)) if recorded is None else recorded
    is_lit = before > DARK_LIGHT * before.max()
    is_covered = covered_bands(light.light, bands) | light.extrapolate
    notes = []
    if not is_lit.all():
        notes.append(
            f"the scene's own light does not reach {_listed(bands, ~is_lit)}: black in any other light"
        )
    if not is_covered.all():
        dark = _listed(bands, ~is_covered)
        notes.append(f"light {light.light} is not known at {dark}: black there; in a recipe, {_hold(light)}")
    is_known = is_lit & is_covered
    if not is_known.any():
        raise SpectrumError(f"light {light.light} is not known in {bands}; in a recipe, {_hold(light)}")
    after = np.where(is_known, illuminant_power(light.light, bands, "hold"), 0.0)
    new_brightness = brightness(after, bands)
    if not new_brightness > 0:
        raise SpectrumError(f"light {light.light} is invisible in {bands}; choose one with visible power")
    scale = brightness(np.where(is_known, before, 0.0), bands) / new_brightness
    return np.divide(after * scale, before, out=np.zeros(len(bands)), where=is_known), notes


def _listed(bands: Bands, chosen: Bool[np.ndarray, " B"]) -> str:
    found = bands.centers_nm[chosen]
    return f"{len(found)} of {bands} ({found[0]:g} to {found[-1]:g} nm)"


def _hold(light: Light) -> str:
    return f"illuminant: {{light: {light.light}, extrapolate: true}} holds its outermost values"
