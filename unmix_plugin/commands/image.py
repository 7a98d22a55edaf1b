"""`unmix-image FILE`: the materials of one image, without a scene: spectra, and maps of how much each pixel shows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from unmix_plugin.commands.process_inspect import ReadingOptions
from unmix_plugin.engine.configs import short_flag
from unmix_plugin.engine.printing import tell
from unmix_plugin.errors import CaptureError, ConfigError, counted

if TYPE_CHECKING:
    import numpy as np

    from unmix_plugin.captures.calibration.one_image import CalibratedImage
    from unmix_plugin.captures.calibration.references import GivenReferences
    from unmix_plugin.captures.cube import Cube
    from unmix_plugin.spectral.features import NoiseFractions
    from unmix_plugin.spectral.library.material_library import MaterialLibrary
    from unmix_plugin.spectral.unmixing.image import UnmixedImage

_CONFIDENT = 0.9


@dataclass(frozen=True, kw_only=True)
class _ImageOptions(ReadingOptions):
    """Find the materials of one spectral image: spectra, abundances and how far to trust them, as files and figures."""

    file: Annotated[Path, tyro.conf.Positional]
    """An image of any format that unmix-process reads, or a folder with one picture a band."""
    white: Path | None = None
    """White reference: an image of a white panel; the image becomes reflectance."""
    dark: Path | None = None
    """Dark frame: an image taken with the shutter closed."""
    white_reflectance: str = "1"
    """Reflectance of the white panel: a number, or a table (wavelength,reflectance)."""
    mask: Path | None = None
    """Picture of the image's size that is black where pixels are left out."""
    endmembers: int | Literal["auto"] = "auto"
    """How many materials to find; auto proposes a number and prints why."""
    shares: Literal["auto", "area", "light"] = "auto"
    """What abundances are shares of: the area that a pixel shows, or the light between spectra of one peak, as
    reference maps of images from the air count. Auto is area, but light where a material is less than a quarter as
    bright as the brightest."""
    library: tuple[Path, ...] = ()
    """Known spectra, to which the angles of the materials are written: .csv files, ENVI spectral libraries, texts of
    ECOSTRESS or USGS, or folders of them; +builtin for the built-in ones."""
    mnf: int = 0
    """How many minimum noise fractions of the image to write: components in order of their noise."""
    output_dir: Annotated[Path, short_flag("output")] = Path("unmixed")
    """Results go to a folder in it, named like the file."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace earlier results."""
    seed: int = 0
    """Everything random follows from it."""


def image(argv: list[str]) -> None:
    """Parse the arguments, unmix, write, and say what was found."""
    options = tyro.cli(_ImageOptions, prog="unmix-image", args=argv)

    from unmix_plugin.captures.calibration.one_image import calibrate_image
    from unmix_plugin.captures.readers.opening import open_spectral_file
    from unmix_plugin.engine.runs.replacing import remove
    from unmix_plugin.formats.files import NOT_PORTABLE, refuse_to_overwrite, safe_name
    from unmix_plugin.products.unmixed_image import unmixed_image_paths, write_unmixed_image
    from unmix_plugin.spectral.unmixing.image import unmix_image

    folder = options.output_dir / safe_name(options.file.resolve().stem, NOT_PORTABLE, "image")
    paths = unmixed_image_paths(folder, bool(options.library), options.mnf > 0)
    all_paths = unmixed_image_paths(folder, True, True)
    refuse_to_overwrite(all_paths, options.overwrite)
    opened = open_spectral_file(options.file, options.for_readers())
    given = _references(options)
    calibrated = calibrate_image(opened, given, options.white_reflectance, options.mask)
    cube, mask = calibrated.values, calibrated.mask
    if not mask.any():
        raise CaptureError(f"{options.file}: no pixel holds a measurement in all bands")
    library = _library(options, calibrated.wavelengths_nm)
    _say_what_was_read(opened, calibrated, library is not None)
    fractions = _fractions(cube, mask, options.mnf)
    found = unmix_image(cube, options.endmembers, mask=mask, shares=options.shares, seed=options.seed)
    place = dict(opened.map_entries) or None
    remove(*({*all_paths} - {*paths}))  # they would tell of other materials
    names = write_unmixed_image(
        folder, found, calibrated.wavelengths_nm, calibrated.bands + 1, place, library, fractions
    )
    _say(found, mask, names)
    for path in paths:
        tell(f"  {path}")


def _references(options: _ImageOptions) -> GivenReferences:
    from unmix_plugin.captures.calibration.references import GivenReferences
    from unmix_plugin.captures.readers.opening import open_spectral_file

    opened: dict[str, Cube] = {}
    for path, kind in ((options.dark, "dark"), (options.white, "white")):
        if path is not None:
            if not path.exists():
                raise CaptureError(f"--{kind} {path}: no such file; give the image of the reference")
            opened[kind] = open_spectral_file(path, options.for_readers())
    return GivenReferences(**opened)


def _say_what_was_read(opened: Cube, calibrated: CalibratedImage, is_compared: bool) -> None:
    """Size, doubts and notes of a file, and what of it is left out."""
    from unmix_plugin.captures.calibration.references import stated_reflectance
    from unmix_plugin.captures.report import Kind, sentences
    from unmix_plugin.trained.run_materials import LIGHT_UNKNOWN

    mask, num_bands = calibrated.mask, len(calibrated.bands)
    size = f"{mask.shape[0]} x {mask.shape[1]} pixels, {counted(num_bands, 'band')}"
    tell(f"{opened.path}: {size}")
    for warning in (*sentences(opened.remarks, Kind.WRONG), *calibrated.warnings):
        tell(f"looks wrong: {warning}")
    if opened.is_geotiff:
        tell("note: the maps do not keep the geo-reference of a TIFF; their pixels are those of the file")
    for note in (*sentences(opened.remarks, Kind.DONE), *calibrated.notes):
        tell(f"note: {note}")
    if opened.is_srgb:
        tell("the picture is taken as sRGB and brought to linear light")
    if is_compared and not calibrated.is_calibrated and stated_reflectance(opened) is None:
        tell(f"note: the file does not say that it holds reflectance. If it does not, {LIGHT_UNKNOWN}")
    if left_out := opened.shape[2] - num_bands:
        why = "marked as bad in the file, of a wavelength that is there twice, without light, or measured nowhere"
        tell(f"{counted(left_out, 'band')} left out: {why}")
    if not mask.all():
        tell(f"{counted(int((~mask).sum()), 'pixel')} without a measurement in every band left out")


def _say(found: UnmixedImage, mask: np.ndarray, names: list[str]) -> None:
    """What was found, in a few lines."""
    if found.evidence:
        tell(found.evidence)
    counts = found.abundances[mask].mean(axis=0)
    for name, share in zip(names, counts, strict=True):
        tell(f"  {name:12s} {share:6.1%} of the {found.shares}")
    sure = float((found.confidence[mask] > _CONFIDENT).mean())
    misfit = float(found.misfit[mask].mean())
    tell(f"{sure:.0%} of the pixels are at least {_CONFIDENT:.0%} sure of their main material")
    tell(f"mean angle between a pixel and its mixture: {misfit:.4f} rad")


def _fractions(cube: np.ndarray, mask: np.ndarray, count: int) -> NoiseFractions | None:
    import numpy as np
    import torch

    from unmix_plugin.spectral.features import minimum_noise_fractions

    num_bands = cube.shape[2]
    if not 0 <= count <= num_bands:
        raise ConfigError(f"--mnf is {count}; expected 1 to {num_bands}, one a band at most, or 0 for none")
    numbers = torch.from_numpy(np.where(mask[..., None], cube, 0).astype(np.float64))
    return minimum_noise_fractions(numbers, torch.from_numpy(mask), count) if count else None


def _library(options: _ImageOptions, wavelengths: np.ndarray | None) -> MaterialLibrary | None:
    from unmix_plugin.formats.libraries import library_of
    from unmix_plugin.spectral.bands import Bands

    if not options.library:
        return None
    if wavelengths is None:
        unknown = "its wavelengths are not known, so no spectrum of a library can be compared"
        raise CaptureError(f"{options.file}: {unknown}")
    return library_of(options.library, Bands.of(wavelengths))
