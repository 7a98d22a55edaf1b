"""One image as values in all of its good bands, calibrated as the views of a capture are, for what needs no scene.

Notation: `H x W` pixels, `B` good bands.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from unmix_plugin.captures.calibration.bands import BandChoice, without_unlit, without_unmeasured
from unmix_plugin.captures.calibration.calibration import (
    Calibration,
    Raster,
    WhiteSample,
    bright_values,
    count_stored,
    find_unnamed_no_data,
)
from unmix_plugin.captures.calibration.references import (
    GivenReferences,
    SensorReferences,
    find_references,
    measured_bands,
)
from unmix_plugin.captures.cube import CaptureView, Cube, Meaning
from unmix_plugin.captures.decide import (
    ExposedFiles,
    compare_exposures,
    find_saturation,
    may_be_reflectance,
    saturated_bands,
)
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.report import Code, Kind, Remark, sentences
from unmix_plugin.captures.writing.view_files import read_view_masks
from unmix_plugin.errors import CaptureError, ConfigError, counted


@dataclass(frozen=True)
class CalibratedImage:
    """Values of an image, and what a user should know of them."""

    values: Float32[np.ndarray, "H W B"]
    """Reflectance where there is a white reference; 0 where nothing was measured."""
    mask: Bool[np.ndarray, "H W"]
    """Pixels that were measured in every band, were not saturated, and are not masked."""
    bands: Int[np.ndarray, " B"]
    """Indices in the file, by wavelength where that is known, each wavelength once."""
    wavelengths_nm: Float64[np.ndarray, " B"] | None
    is_calibrated: bool
    """Whether a white reference made reflectances of the numbers."""
    warnings: tuple[str, ...] = ()
    """What may make values wrong, one sentence each."""
    notes: tuple[str, ...] = ()
    """What was done."""


def calibrate_image(
    file: Cube, given: GivenReferences, white_reflectance: str = "1", mask: Path | None = None
) -> CalibratedImage:
    """Read one image.

    Args:
        given: Dark frame and white reference.
        white_reflectance: Of the white: a number, or a table.
        mask: A picture that is black where pixels are left out.
    Raises:
        CaptureError: a file can't be read, a reference does not fit, or no band or pixel is left.
        ConfigError: a reflectance without a white, or one that is none.
    """
    if white_reflectance != "1" and given.white is None:
        raise ConfigError("--white-reflectance needs a white reference: --white")
    view = CaptureView(file.path.stem, file, mask=mask)
    wavelengths, num_bands = file.bands.wavelengths_nm, file.shape[2]
    known = np.arange(1.0, num_bands + 1.0) if wavelengths is None else wavelengths
    if wavelengths is None and Path(white_reflectance).is_file():
        raise CaptureError(
            f"{file.path}: its wavelengths are not known; give --white-reflectance as a number"
        )
    options = ProcessOptions("cubes", file.path, Path(), white_reflectance=white_reflectance)
    references = find_references([view], known, options, given, [view])
    choice, remarks = without_unmeasured(BandChoice(known, file.bands.source), references)
    bands = _good_bands(file)
    saturation = find_saturation(count_stored([file], bands)) if references.whites else None
    for white in references.whites:
        stored = None if saturation is None else saturation.stored
        choice, found = without_unlit(choice, white, saturated_bands(WhiteSample.of(white), stored))
        remarks += found
    unlit = num_bands - len(choice.kept)
    bands = bands[np.isin(bands, choice.kept)]
    if len(bands) == 0:
        raise CaptureError(f"{file.path}: the white has no light in any of its good bands")
    exposed = ExposedFiles(
        [file],
        [white.file for white in references.whites],
        references.darks_beside([file]),
        file.is_srgb,
        may_be_reflectance(file, bright_values([file], bands)),
    )
    compared = compare_exposures(exposed)
    height, width, _ = file.shape
    raster = Raster(0, 0, height, width, 1)
    calibration = Calibration(
        raster,
        bands,
        1,
        references,
        saturation and saturation.stored,
        compared.common if references.whites else None,
    )
    rows = calibration.rows(file, 0, height)
    shown = read_view_masks(view, raster, use_opacity=False).valid
    saturated = rows.saturated.any(axis=-1)
    remarks += compared.remarks if references.whites else []
    if (number := find_unnamed_no_data([file], bands)) is not None:
        remarks.append(Remark.of(Code.NO_DATA_UNNAMED, number=f"{number:g}"))
    warnings = [*_doubts(file, bands, references), *sentences(remarks, Kind.WRONG)]
    used = next(iter(references.by_view.values()), references.common)
    named = (("dark frame", used.dark), ("white reference", used.white))
    notes = [f"{kind} {one.file.path.name}: {one.how}" for kind, one in named if one]
    notes += sentences(remarks, Kind.DONE)
    notes += (
        [
            f"{counted(unlit, 'band')} left out: no light on the white, saturated there, or a reference not measured"
        ]
        if unlit
        else []
    )
    if count := int((saturated & shown & ~rows.missing).sum()):
        notes.append(f"{counted(count, 'saturated pixel')} left out")
    if count := int((~shown).sum()):
        notes.append(f"{counted(count, 'pixel')} left out by {mask}")
    return CalibratedImage(
        rows.values,
        ~rows.missing & ~saturated & shown,
        bands,
        None if wavelengths is None else wavelengths[bands],
        bool(references.whites),
        tuple(warnings),
        tuple(notes),
    )


def _good_bands(file: Cube) -> np.ndarray:
    """Bands that the file does not mark as bad, that are measured somewhere, and of one wavelength the first."""
    table = file.bands
    if table.bad is not None and table.bad.all():
        raise CaptureError(f"{file.path}: the file marks all of its bands as bad")
    kept = measured_bands(file)  # EnMAP has no numbers where the air lets no light through.
    if table.wavelengths_nm is not None:
        _, first = np.unique(table.wavelengths_nm[kept], return_index=True)
        kept = kept[first]
    return kept


def _doubts(file: Cube, bands: np.ndarray, references: SensorReferences) -> list[str]:
    """That numbers are raw where they are, and references that are missing."""
    has_dark = any(used.dark is not None for used in (references.common, *references.by_view.values()))
    if references.whites and not has_dark and file.dtype.kind != "f":
        return [
            "there is a white reference and no dark frame (--dark): what is dark is taken as brighter than it is"
        ]
    if references.whites or file.is_srgb or file.meaning not in (Meaning.RAW, Meaning.FRACTION):
        return []
    if file.meaning is Meaning.FRACTION and may_be_reflectance(file, bright_values([file], bands)):
        return []
    return [
        "the numbers are raw counts: spectra have the colour of the lamp and the sensor"
        + ("" if has_dark else ", and the dark signal counts as a material of all pixels")
        + "; give --white and --dark to bring them to reflectance"
    ]
