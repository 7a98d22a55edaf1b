"""Spectral OpenEXR: one channel a band, named for its wavelength.

Notation: `H x W` pixels, `B` bands.

Source: Fichet et al. 2021, An OpenEXR Layout for Spectral Images, JCGT 10(3). Channels are emissive and unpolarised:
`S0.<wavelength>nm` with a decimal comma, since a dot parts layers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from unmix_plugin.formats.exr import write_exr
from unmix_plugin.spectral.bands import Bands


def channel_name(wavelength_nm: float) -> str:
    """Channel of a band.

    >>> channel_name(450.0)
    'S0.450,000000nm'
    """
    return f"S0.{wavelength_nm:.6f}nm".replace(".", ",").replace(",", ".", 1)


def write_spectral_exr(
    path: Path,
    spectra: Float32[np.ndarray, "H W B"],
    bands: Bands,
    rgb: Float32[np.ndarray, "H W 3"] | None,
    alpha: Float32[np.ndarray, "H W"] | None = None,
    comments: str = "",
) -> Path:
    """Write spectra with their wavelengths, float32.

    Args:
        path: File; its folder is made.
        spectra: Radiance on black, bands last.
        bands: Their wavelengths.
        rgb: Preview for viewers that know no spectra, linear light in sRGB primaries.
        alpha: Opacity, [0, 1]; spectra and preview are multiplied by it already, as OpenEXR wants it.
        comments: What the numbers are.
    Raises:
        ValueError: another number of wavelengths than of bands.
    """
    if spectra.shape[2] != len(bands):
        raise ValueError(f"{len(bands)} wavelengths for spectra of shape {spectra.shape}")
    channels = {channel_name(nm): spectra[..., i] for i, nm in enumerate(bands.centers_nm.tolist())}
    if rgb is not None:
        channels.update({name: rgb[..., i] for i, name in enumerate("RGB")})
    if alpha is not None:
        channels["A"] = alpha
    # The unit is the layout's for emissive images; what 1 means depends on the sensor.
    attributes = {"spectralLayoutVersion": "1.0", "emissiveUnits": "W.m^-2.sr^-1"}
    if comments:
        attributes["comments"] = comments
    return write_exr(path, channels, attributes)
