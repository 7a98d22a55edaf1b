"""Another light: what it multiplies every spectrum of a scene with.

A spectrum under the new light is the one seen, divided by the light that the scene was recorded in, times the new one.
That is right where the recorded light has one spectrum everywhere; shadows, shading and gloss stay as they are.

Brightness. The power of a new light is chosen so that a perfect white is as bright as before: as luminous where the
bands see colours (CIE Y), else of the same mean radiance. So single bands may exceed 1, the full scale of the sensor.

Notation: `B` bands.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from unmix_plugin.editing.recipe import Light
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.illuminants import brightness, illuminant_power
from unmix_plugin.spectral.library.material_library import DARK_LIGHT


def relighting_factors(
    bands: Bands, recorded: Float64[np.ndarray, " B"] | None, light: Light
) -> Float64[np.ndarray, " B"]:
    """What radiance is multiplied with, band by band, to be seen in another light.

    Args:
        bands: Of the scene.
        recorded: Light that the scene was recorded in, relative power; None where it is unknown: taken as flat, CIE E.
        light: The new one.
    Raises:
        SpectrumError: the new light is not known at all bands, or is invisible; or the recorded one left bands dark.
    """
    before = np.ones(len(bands)) if recorded is None else recorded
    is_dark = before <= DARK_LIGHT * before.max()
    if is_dark.any():
        dark_nm = bands.centers_nm[is_dark]
        raise SpectrumError(
            f"the scene's own light has no power in {len(dark_nm)} bands ({dark_nm[0]:g} to {dark_nm[-1]:g} nm), so "
            "nobody knows how it looks there in another light; train on the other bands only"
        )
    after = _power(light, bands)
    new_brightness = brightness(after, bands)
    if not new_brightness > 0:
        raise SpectrumError(f"light {light.light} is invisible in {bands}; choose one with visible power")
    return after / before * (brightness(before, bands) / new_brightness)


def _power(light: Light, bands: Bands) -> Float64[np.ndarray, " B"]:
    held = illuminant_power(light.light, bands, "hold")
    if light.extrapolate:
        return held
    try:
        return illuminant_power(light.light, bands)
    except SpectrumError as error:
        raise SpectrumError(
            f"{error}; in a recipe, illuminant: {{light: {light.light}, extrapolate: true}} holds its outermost values"
        ) from error
