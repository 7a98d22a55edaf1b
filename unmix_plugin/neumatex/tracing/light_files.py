"""Light from files: environment maps in colours (OpenEXR, Radiance RGBE) or of wavelengths, and a lamp's spectrum.

An environment in colours says how bright each direction is, not what its spectrum is. With a lamp, every direction has
the lamp's spectrum times the luminance of its colour: radiance of band b is `Y(direction) lamp_b`, where the lamp's
greatest band is 1. An environment whose channels are wavelengths needs no lamp; it is brought to the bands by linear
interpolation.

Notation: `H x W` pixels, `B` bands.

Source: Ward 1991, Real Pixels, Graphics Gems II; the run-length code of the Radiance file format's documentation.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from unmix_plugin.errors import CaptureError, SceneError, SpectrumError, counted
from unmix_plugin.formats.libraries import LIBRARY_SUFFIXES, read_library
from unmix_plugin.limits import MOST_TABLE_BYTES, allow_decoded, read_bounded
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, parse_light, power_in_bands
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.spectral.library.spectra_csv import resample_spectra

ENVIRONMENT_SUFFIXES = (".exr", ".hdr")
"""Formats that are read."""
_NEW_RUNS = (8, 0x7FFF)
"""Widths, in pixels, that may have the newer run-length code."""
_LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of the sRGB primaries."""


def read_environment(
    path: Path,
    rotation_deg: float = 0.0,
    exposure_stops: float = 0.0,
    bands: Bands | None = None,
    lamp: Float64[np.ndarray, " B"] | None = None,
) -> Environment:
    """The light of a latitude-longitude picture, in colours or in bands.

    Args:
        path: A .exr file with channels R, G, B (or Y), or a .hdr file; twice as wide as high. With bands, channels of
            a .exr file may be wavelengths.
        rotation_deg: Turns the light about +z, counter-clockwise seen from above.
        exposure_stops: Radiance is the picture's times 2 to this power.
        bands: Of the pictures that it lit; None for colours.
        lamp: Spectrum of light in colours, where there are bands.
    Raises:
        SceneError: the file is missing, damaged or of another kind, or has NaN, infinite or negative values, no light
            at all, or another aspect; wavelengths that do not reach all bands; colours without a lamp for bands.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such environment map")
    suffix = path.suffix.lower()
    if suffix not in ENVIRONMENT_SUFFIXES:
        raise SceneError(
            f"{path}: is not an environment map; convert it to one of {', '.join(ENVIRONMENT_SUFFIXES)}"
        )
    image, is_spectral = _light_of_exr(path, bands) if suffix == ".exr" else (_read_hdr(path), False)
    height, width = image.shape[:2]
    if width != 2 * height:
        raise SceneError(
            f"{path}: is {width} x {height} pixels; a latitude-longitude map is twice as wide as high, so crop or "
            "convert it"
        )
    require_light(path, image)
    if not (image > 0).any():
        raise SceneError(
            f"{path}: is black everywhere, so nothing would be lit; choose another environment map"
        )
    light = Environment(torch.from_numpy(np.ascontiguousarray(image)), rotation_deg, exposure_stops)
    if bands is None or is_spectral:
        return light
    if lamp is None:
        raise SceneError(
            f"{path}: is in colours, and the pictures have {len(bands)} bands, so the light's spectrum is not known; "
            "give the lamp's with 'illuminant_path' in transforms.json or --pipeline.datamanager.lamp (a .csv with "
            "wavelength,power, an ENVI spectral library, or a name such as D65), or an OpenEXR environment whose "
            "channels are wavelengths"
        )
    return of_lamp(light, torch.from_numpy(lamp))


def of_lamp(environment: Environment, lamp: Float[Tensor, "B"]) -> Environment:
    """An environment in three colours as one whose every direction has a lamp's spectrum, as bright as its colour."""
    luminance = environment.image @ environment.image.new_tensor(_LUMINANCE)
    return replace(environment, image=luminance[..., None] * lamp.to(luminance))


def read_exr(path: Path, channel: str | None = None) -> tuple[np.ndarray, list[str], np.ndarray | None]:
    """Numbers (H, W, C) of an OpenEXR picture, without alpha, or of one channel; names of the channels, and their
    wavelengths in nm if they are such. Raises CaptureError: the file is damaged, or of another kind."""
    from unmix_plugin.captures.cube import ReadOptions
    from unmix_plugin.captures.readers.exr import channel_names
    from unmix_plugin.captures.readers.opening import open_spectral_file

    channel_names(path)  # refuses other files
    file = open_spectral_file(path, ReadOptions(dataset=channel))
    return file.read(), list(file.bands.names or ()), file.bands.wavelengths_nm


def _light_of_exr(path: Path, bands: Bands | None) -> tuple[np.ndarray, bool]:
    """Colours, or where bands are wanted and there are channels of wavelengths, spectra at them; and whether they are
    spectra."""
    from unmix_plugin.captures.readers.exr import channel_names

    try:
        names = channel_names(path)
        if bands is not None:
            values, _, nm = read_exr(path)
            if nm is not None:
                order = np.argsort(nm)
                spectra = resample_spectra(values[..., order].astype(np.float64), Bands(nm[order]), bands)
                return spectra.astype(np.float32), True
        colours = next((colours for colours in ("RGB", "Y") if set(colours) <= set(names)), None)
        if colours is None:
            raise SceneError(f"{path}: has channels {', '.join(names)}; an environment map needs R, G and B")
        planes = [read_exr(path, colour)[0][..., 0] for colour in colours]
    except CaptureError as error:
        raise SceneError(str(error)) from error
    except SpectrumError as error:
        raise SceneError(
            f"{path}: its wavelengths and those of the pictures do not match: {error}"
        ) from error
    return np.stack(3 // len(planes) * planes, axis=-1).astype(np.float32), False


def require_light(path: Path, numbers: Float32[np.ndarray, "*pixels C"]) -> None:
    """Refuse what is no light."""
    bad = ~(np.isfinite(numbers) & (numbers >= 0)).all(axis=-1)
    if bad.any():
        raise SceneError(
            f"{path}: negative values, NaN or infinity in {counted(int(bad.sum()), 'pixel')}, such as "
            f"{numbers[bad][0].tolist()}; expected light, 0 and up: repair the picture"
        )


def _read_hdr(path: Path) -> Float32[np.ndarray, "H W 3"]:
    """Linear radiance of a picture whose rows run from the top, each from the left."""
    try:
        data = read_bounded(path, MOST_TABLE_BYTES)
    except OSError as error:
        raise SceneError(f"{path}: can't be read ({error.strerror})") from error
    match = re.search(rb"\r?\n\r?\n(\S+) (\d+) (\S+) (\d+)\r?\n", data[:65536])
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")) or match is None:
        raise SceneError(f"{path}: is no Radiance picture (its header is missing); convert it to .exr")
    if b"FORMAT=32-bit_rle_xyze" in data[: match.start()]:
        raise SceneError(f"{path}: holds XYZ colours; convert it to RGB")
    if (match[1], match[3]) != (b"-Y", b"+X"):
        raise SceneError(
            f"{path}: has its rows in the order {match[0].strip()[:80]!r}, not -Y +X; convert it"
        )
    height, width, start = int(match[2]), int(match[4]), match.end()
    allow_decoded(path, height * width * 4, SceneError)
    rgbe = np.empty((height, width, 4), dtype=np.uint8)
    row = 0
    try:
        for row in range(height):
            start = _read_row(data, start, rgbe[row])
    except (IndexError, ValueError) as error:
        raise SceneError(
            f"{path}: ends or breaks in row {row} of {height} ({error}); copy the file again, or convert it to .exr"
        ) from error
    exponents = rgbe[..., 3:].astype(np.int32)
    scale = np.where(exponents > 0, np.ldexp(np.float32(1.0), exponents - 136), np.float32(0.0))
    return (rgbe[..., :3] * scale).astype(np.float32)


def _read_row(data: bytes, start: int, row: np.ndarray) -> int:
    """Fill a row's (W, 4) bytes; where the next row starts."""
    width = len(row)
    coded = _NEW_RUNS[0] <= width <= _NEW_RUNS[1] and data[start : start + 2] == b"\x02\x02"
    if not coded or data[start + 2] > 127:  # a pixel whose blue is brightest, since no row is that wide
        return _read_old_row(data, start, row)
    if data[start + 2] << 8 | data[start + 3] != width:
        raise ValueError("length of the row")
    start += 4
    for channel in range(4):
        column = 0
        while column < width:
            count = data[start]
            if count > 128:
                count -= 128
                values, used = data[start + 1], 2
            else:
                values, used = np.frombuffer(data, np.uint8, count, start + 1), count + 1
            if count == 0 or column + count > width:
                raise ValueError("run")
            row[column : column + count, channel] = values
            column, start = column + count, start + used
    return start


def _read_old_row(data: bytes, start: int, row: np.ndarray) -> int:
    """A row of plain pixels, in which (1, 1, 1, n) repeats the pixel before it."""
    column, shift = 0, 0
    while column < len(row):
        pixel, count, start = np.frombuffer(data, np.uint8, 4, start), 1, start + 4
        is_run = tuple(pixel[:3]) == (1, 1, 1)
        if is_run:
            pixel, count = row[column - 1], int(pixel[3]) << shift
            if column == 0 or column + count > len(row):
                raise ValueError("run")
        row[column : column + count] = pixel
        column, shift = column + count, shift + 8 if is_run else 0
    return start


def read_lamp(lamp: str, bands: Bands) -> Float64[np.ndarray, " B"]:
    """A lamp's relative power in each band, greatest 1; of tables as of names it is the mean over the band's interval.

    Args:
        lamp: Path of a table with one spectrum, a .csv (`wavelength,power`) or an ENVI spectral library; or the name
            of a known light (D65, A, FL2, ...).
        bands: Of the pictures.
    Raises:
        SpectrumError: the file is missing, malformed or holds several spectra; a light that is not known; one that is
            not known at all bands, or zero in one of them.
    """
    is_file = Path(lamp).suffix.lower()[1:] in LIBRARY_SUFFIXES
    power = _power_of_table(Path(lamp), bands) if is_file else illuminant_power(parse_light(lamp), bands)
    if not (power > 0).all():
        dark = bands.centers_nm[int(np.argmin(power))]
        raise SpectrumError(
            f"lamp {lamp} has no power at {dark:g} nm, where nothing could be told of reflectance; leave such bands "
            "out of the pictures"
        )
    return power / power.max()


def _power_of_table(path: Path, bands: Bands) -> Float64[np.ndarray, " B"]:
    library = MaterialLibrary(tuple(read_library(path)))
    if len(library.names) != 1:
        raise SpectrumError(f"{path}: a lamp has one spectrum; found {len(library.names)}: {library.names}")
    [table] = library.materials
    try:
        library.reflectance(table.name, bands)  # refuses bands in which the lamp was not measured
    except SpectrumError as error:
        raise SpectrumError(f"{path}: {error}") from error
    known = np.isfinite(table.reflectance)
    return power_in_bands(table.reflectance[known], Bands(table.bands.centers_nm[known]), bands)
