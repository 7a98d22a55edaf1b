"""OpenEXR images: named channels of one size, losslessly compressed, with attributes; and spectra as channels.

Source: Fichet et al. 2021, An OpenEXR Layout for Spectral Images, JCGT 10(3). Radiance is in emissive, unpolarised
channels, `S0.<wavelength>nm`, reflectance in reflective ones, `T.<wavelength>nm`; with a decimal comma, since a dot
parts layers.

Notation: `H x W` pixels, `B` bands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32

from unmix_plugin.engine.runs.atomic_files import cannot_write, whole_file
from unmix_plugin.formats.files import numbered_apart
from unmix_plugin.spectral.bands import Bands


def write_exr(path: Path, channels: Mapping[str, np.ndarray], attributes: Mapping[str, str | float]) -> Path:
    """Write channels (H, W) of float32, float16 or uint32 as one scanline image, ZIP compressed.

    A dot in a channel's name parts layers. Readers get the channels in the order of their names.
    """
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **attributes}
    # The library reads memory row after row whatever an array's strides: other layouts would be written wrong.
    pixels = {name: np.ascontiguousarray(channel) for name, channel in channels.items()}
    with whole_file(path) as temporary:
        try:
            OpenEXR.File(header, pixels).write(str(temporary))
        except (OSError, RuntimeError) as error:
            # What the library says after the file's (temporary) name.
            reason = str(error).rpartition('". ')[2].strip().rstrip(".")
            raise cannot_write(path, reason) from error
    return path


def layer_names(layer: str, channels: Sequence[str]) -> list[str]:
    """Names of the channels of a layer, all different; dots in them become `_`, since a dot parts layers.

    >>> layer_names("abundances", ["v1.2", "v1_2"])
    ['abundances.v1_2', 'abundances.v1_2_1']
    """
    return [f"{layer}.{name}" for name in numbered_apart(one.replace(".", "_") for one in channels)]


def _channel_name(layer: str, wavelength_nm: float) -> str:
    """Channel of a band.

    >>> _channel_name("S0", 450.0)
    'S0.450,000000nm'
    """
    return f"{layer}.{wavelength_nm:.6f}nm".replace(".", ",").replace(",", ".", 1)


def write_spectral_exr(
    path: Path,
    spectra: Float32[np.ndarray, "H W B"],
    bands: Bands,
    rgb: Float32[np.ndarray, "H W 3"] | None,
    alpha: Float32[np.ndarray, "H W"] | None = None,
    comments: str = "",
    quantity: Literal["reflectance", "radiance"] = "radiance",
) -> Path:
    """Write spectra with their wavelengths, float32.

    Args:
        path: File; its folder is made.
        spectra, bands: On black, and their wavelengths.
        rgb: Preview for viewers that know no spectra, linear light in sRGB primaries.
        alpha: Opacity, [0, 1]; spectra and preview are multiplied by it already, as OpenEXR wants it.
        comments, quantity: What the numbers are, and what the spectra are, as `Materials.quantity` has it.
    Raises:
        ValueError: another number of wavelengths than of bands.
    """
    if spectra.shape[2] != len(bands):
        raise ValueError(f"{len(bands)} wavelengths for spectra of shape {spectra.shape}")
    layer = "T" if quantity == "reflectance" else "S0"
    channels = {_channel_name(layer, nm): spectra[..., i] for i, nm in enumerate(bands.centers_nm.tolist())}
    channels |= {} if rgb is None else {name: rgb[..., i] for i, name in enumerate("RGB")}
    channels |= {} if alpha is None else {"A": alpha}
    attributes = {"spectralLayoutVersion": "1.0"} | ({"comments": comments} if comments else {})
    if quantity == "radiance":  # the layout's unit; what 1 means depends on the sensor
        attributes["emissiveUnits"] = "W.m^-2.sr^-1"
    return write_exr(path, channels, attributes)
