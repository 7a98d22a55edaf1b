"""What GDAL says of bands, in a tag of TIFF files or in XML beside any file, and EnMAP's XML, which says the same."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.header_values import StatedBands
from unmix_plugin.captures.spectral_file import Linear, SpectralFile, linear_values
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import parse_xml, read_bounded

_CENTRES = ("wavelength", "wavelengths", "center_wavelength", "central_wavelength", "centre_wavelength")
_UNITS = ("wavelength_units", "wavelength_unit")
_GAIN_ITEMS = {
    "scale": ("scale", "scale_factor", "gain", "data_gain_values"),
    "offset": ("offset", "add_offset", "bias", "data_offset_values"),
}
"""Names of gains and offsets, by the role that GDAL itself marks them with."""
_ENMAP_IMAGE = "SPECTRAL_IMAGE"
_OF_BANDS = {
    "Scale": 1.0,
    "GainOfBand": 1.0,
    "Offset": 0.0,
    "OffsetOfBand": 0.0,
    **dict.fromkeys(("wavelengthCenterOfBand", "FWHMOfBand", "NoDataValue"), math.nan),
}
"""What XML beside a file says of a band, and what counts where it doesn't."""


@dataclass(frozen=True)
class GdalItem:
    """One entry of GDAL's metadata."""

    name: str
    """In lower case."""
    value: str
    sample: int | None
    """Band from 0; None for the whole file."""
    role: str | None


def gdal_items(text: str) -> list[GdalItem]:
    """Entries of a tag; none where it is damaged."""
    try:
        items = list(parse_xml(text).iter("Item"))
    except ValueError:
        return []
    samples = [item.get("sample", "") for item in items]
    bands = [int(text) if text.isdecimal() and len(text) < 9 else None for text in samples]
    return [
        GdalItem(item.get("name", "").lower(), (item.text or "").strip(), band, item.get("role"))
        for item, band in zip(items, bands, strict=True)
    ]


def linear_of_items(path: Path, items: Sequence[GdalItem], num_bands: int) -> Linear | None:
    """Gains and offsets: by their role, by names that ENVI and NetCDF give them, or one factor. A lone `gain` of the
    whole file is a camera's, and part of the exposure. Raises CaptureError: they are no numbers, or there are both."""
    columns, said = [], []
    for role, names in _GAIN_ITEMS.items():
        by_role = [item for item in items if item.role == role]
        by_name = [item for item in items if item.name.rpartition("#")[2].replace(" ", "_") in names]
        chosen = by_role or by_name
        own = {item.sample: item.value for item in chosen if item.sample is not None}
        whole = next((item.value for item in chosen if item.sample is None), None)
        texts = _words(whole or "")
        if own:
            usual = whole or ("1" if role == "scale" else "0")
            texts = [own.get(sample, usual) for sample in range(num_bands)]
        numbers = [number for text in texts if (number := gdal_number(text)) is not None]
        if len(numbers) < len(texts):
            found = next(text for text in texts if gdal_number(text) is None)
            raise CaptureError(f"{path}: GDAL's {role} is {found!r}; expected a number a band")
        columns.append(numbers)
        said.append({(item.name, item.sample, item.role) for item in chosen})
    if said == [{("gain", None, None)}, set()] and len(columns[0]) == 1:  # that of a camera
        columns[0] = []
    named = [gdal_number(item.value) for item in items if item.name == "reflectance_scale_factor"]
    factor = named[0] if named and named[0] else 1.0
    gains, offsets = columns
    linear = linear_values(path, num_bands, gains, offsets, "GDAL's scales and offsets")
    if factor != 1 and linear is not None:
        raise CaptureError(
            f"{path}: has reflectance_scale_factor {factor:g} and scales or offsets of bands; take one of them out, as "
            "it is unclear which the numbers need"
        )
    return linear or linear_values(path, num_bands, [1.0 / factor], [], "GDAL's reflectance_scale_factor")


def bands_of_items(items: Sequence[GdalItem]) -> StatedBands | None:
    """What entries say of bands; None where they say neither wavelengths nor names."""

    def of_samples(*names: str, role: str | None = None) -> list[str]:
        """Values of one entry for each band in the order of bands, or the list in one for the whole file."""
        chosen = [item for item in items if item.name in names or (role and item.role == role)]
        found = {item.sample: item.value for item in chosen if item.sample is not None}
        if found:
            return [found[sample] for sample in sorted(found)]
        whole = [item.value for item in items if item.sample is None and item.name in names]
        return _words(whole[0]) if whole else []

    names = of_samples(role="description") or of_samples("band_name", "bandname")
    numbered = {int(item.name[5:]): item.value for item in items if re.fullmatch(r"band_\d{1,6}", item.name)}
    if not names and sorted(numbered) == [*range(1, len(numbered) + 1)]:  # files list Band_10 before Band_2
        names = [numbered[number] for number in sorted(numbered)]
    units = [item.value for item in items if item.name in _UNITS]
    centres, fwhm = of_samples(*_CENTRES), of_samples("fwhm")
    if not centres:
        centres, fwhm = of_samples("central_wavelength_um"), of_samples("fwhm_um")
        units = ["Micrometers"] if centres else units
    if not centres and not names:
        return None
    good, unit = of_samples("bbl") or None, units[0] if units else None
    return StatedBands("GDAL metadata", centres or None, unit, fwhm or None, good, names or None)


def gdal_number(text: str) -> float | None:
    """A number, which may be NaN but not infinite; None for other text."""
    try:
        number = float(text.strip("\0 "))
    except ValueError:
        return None
    return number if not math.isinf(number) else None


def _words(text: str) -> list[str]:
    return re.findall(r"[^\s,{}]+", text)


def with_xml_beside(file: SpectralFile) -> SpectralFile:
    """The file with what an XML beside it says of its bands, where it says nothing itself.

    GDAL keeps gains, offsets and the no-data value in NAME.aux.xml; EnMAP's NAME-SPECTRAL_IMAGE.TIF has wavelengths,
    widths, gains and offsets in NAME-METADATA.XML. Raises CaptureError: gains are impossible.
    """
    beside = [path.with_name(f"{path.name}.aux.xml") for path in file.files]
    beside += [
        path.with_name(path.stem.removesuffix(_ENMAP_IMAGE) + ending)
        for path in file.files
        if path.stem.endswith(_ENMAP_IMAGE)
        for ending in ("METADATA.XML", "METADATA.xml")
    ]
    for path in filter(Path.is_file, beside):
        file = _with_xml(file, path)
    return file


def _with_xml(file: SpectralFile, found: Path) -> SpectralFile:
    try:
        root = parse_xml(read_bounded(found))
    except ValueError:
        return replace(file, warnings=(*file.warnings, f"{found.name} is damaged: what it says is not used"))
    columns = {name: np.full(file.shape[2], usual) for name, usual in _OF_BANDS.items()}
    for element in [*root.iter("PAMRasterBand"), *root.iterfind(".//bandCharacterisation/bandID")]:
        index = int(element.get("band") or element.get("number") or 0) - 1
        for name, column in columns.items():
            text = element.findtext(name)
            if text and 0 <= index < len(column):
                column[index] = float(text)
    gains, offsets = columns["Scale"] * columns["GainOfBand"], columns["Offset"] + columns["OffsetOfBand"]
    bands, centres, widths = file.bands, columns["wavelengthCenterOfBand"], columns["FWHMOfBand"]
    if bands.wavelengths_nm is None and np.isfinite(centres).all():
        known = ((widths > 0) & (widths < np.inf)).all()
        bands = replace(bands, wavelengths_nm=centres, evidence=f"{found.name}, nm")
        bands = replace(bands, fwhm_nm=widths) if known else bands
    stated = (gains.tolist(), offsets.tolist(), found.name)
    linear = file.linear or linear_values(file.path, file.shape[2], *stated)
    beside = columns["NoDataValue"]
    no_data = tuple(dict.fromkeys((*file.no_data, *beside[~np.isnan(beside)].tolist())))
    more = (*file.sources, found)
    return replace(file, bands=bands, linear=linear, no_data=no_data, sources=more)
