"""Light for pictures of many bands: a lamp's spectrum, and environments that have a spectrum in every direction.

An environment in colours says how bright each direction is, not what its spectrum is. With a lamp, every direction has
the lamp's spectrum times the luminance of its colour: radiance of band b is `Y(direction) lamp_b`, where the lamp's
greatest band is 1. An environment whose channels are wavelengths needs no lamp; it is brought to the bands by linear
interpolation.

Notation: `B` bands, `H x W` pixels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.errors import SceneError, SpectrumError
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.lighting.read_environment import check_environment, read_environment
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, parse_light
from unmix_plugin.spectral.library.material_library import read_library_table
from unmix_plugin.spectral.library.spectra_csv import resample_spectra

_LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of the sRGB primaries."""
_FILES = (".csv", ".hdr", ".sli")


def read_lamp(lamp: str, bands: Bands) -> Float64[np.ndarray, " B"]:
    """A lamp's relative power in each band, greatest 1.

    Args:
        lamp: Path of a table with one spectrum, a .csv (`wavelength,power`) or an ENVI spectral library; or the name
            of a known light (D65, A, FL2, ...).
        bands: Of the pictures.
    Raises:
        SpectrumError: the file is missing, malformed or holds several spectra; a light that is not known; one that is
            not known at all bands, or zero in one of them.
    """
    path = Path(lamp)
    if path.suffix.lower() not in _FILES:
        return _lit_everywhere(illuminant_power(parse_light(lamp), bands), lamp, bands)
    table = read_library_table(path)
    if len(table.names) != 1:
        raise SpectrumError(f"{path}: a lamp has one spectrum; found {len(table.names)}: {table.names}")
    try:
        power = resample_spectra(table.spectra[0], table.bands, bands)
    except SpectrumError as error:
        raise SpectrumError(f"{path}: {error}") from error
    return _lit_everywhere(power, lamp, bands)


def read_environment_of_bands(
    path: Path,
    bands: Bands,
    lamp: Float64[np.ndarray, " B"] | None,
    rotation_deg: float = 0.0,
    exposure_stops: float = 0.0,
) -> Environment:
    """The light of a latitude-longitude picture in colours or of wavelengths; see `read_environment`.

    Raises:
        SceneError: as `read_environment`; wavelengths that do not reach all bands; colours without a lamp.
    """
    spectral = _read_wavelengths(path, bands) if path.suffix.lower() == ".exr" and path.is_file() else None
    if spectral is not None:
        check_environment(path, spectral)
        return Environment(torch.from_numpy(spectral), rotation_deg, exposure_stops)
    colours = read_environment(path, rotation_deg, exposure_stops)
    if lamp is None:
        raise SceneError(
            f"{path}: is in colours, and the pictures have {len(bands)} bands, so the light's spectrum is not known; "
            "give the lamp's with 'illuminant_path' in transforms.json or --pipeline.datamanager.lamp (a .csv with "
            "wavelength,power, an ENVI spectral library, or a name such as D65), or an OpenEXR environment whose "
            "channels are wavelengths"
        )
    return of_lamp(colours, torch.from_numpy(lamp))


def of_lamp(environment: Environment, lamp: Float[Tensor, "B"]) -> Environment:
    """An environment in three colours as one whose every direction has a lamp's spectrum, as bright as its colour."""
    image = environment.image
    luminance = image @ image.new_tensor(_LUMINANCE)
    spectra = luminance[..., None] * lamp.to(image)
    return Environment(spectra, environment.rotation_deg, environment.exposure_stops)


def mean_spectrum(environment: Environment) -> Float[Tensor, "B"]:
    """Spectrum of all light of an environment together, greatest value 1."""
    height = environment.image.shape[0]
    rows = torch.arange(height, dtype=torch.float64) + 0.5
    weights = (torch.pi * rows / height).sin().to(environment.image)
    total = (environment.image * weights[:, None, None]).sum(dim=(0, 1))
    return total / total.amax()


def _lit_everywhere(power: Float64[np.ndarray, " B"], lamp: str, bands: Bands) -> Float64[np.ndarray, " B"]:
    if not (power > 0).all():
        dark = bands.centers_nm[int(np.argmin(power))]
        raise SpectrumError(
            f"lamp {lamp} has no power at {dark:g} nm, where nothing could be told of reflectance; leave such bands "
            "out of the pictures"
        )
    return power / power.max()


def _read_wavelengths(path: Path, bands: Bands) -> np.ndarray | None:
    """Channels that are wavelengths, at the bands; None where there are none."""
    from unmix_plugin.captures.readers.exr import open_exr
    from unmix_plugin.captures.readers.read_options import ReadOptions
    from unmix_plugin.errors import CaptureError

    try:
        file = open_exr(path, ReadOptions())
        if file.bands.wavelengths_nm is None:
            return None
        values = np.asarray(file.read_part(slice(None), slice(None)), dtype=np.float64)
    except CaptureError as error:
        raise SceneError(str(error)) from error
    order = np.argsort(file.bands.wavelengths_nm)
    try:
        found = resample_spectra(values[..., order], Bands(file.bands.wavelengths_nm[order]), bands)
    except SpectrumError as error:
        raise SceneError(
            f"{path}: its wavelengths and those of the pictures do not match: {error}"
        ) from error
    return np.ascontiguousarray(found, dtype=np.float32)
