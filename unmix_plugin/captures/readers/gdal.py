"""What GDAL says of bands, in a tag of TIFF files or in XML beside any file, and the XML of EnMAP and DESIS, which says
the same."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.header_values import StatedBands
from unmix_plugin.captures.spectral_file import Linear, SpectralFile, linear_values
from unmix_plugin.errors import CaptureError, counted
from unmix_plugin.limits import parse_xml, read_bounded

_CENTRES = ("wavelength", "wavelengths", "center_wavelength", "central_wavelength", "centre_wavelength")
_UNITS = ("wavelength_units", "wavelength_unit")
_GAIN_ITEMS = {
    "scale": ("scale", "scale_factor", "gain", "data_gain_values"),
    "offset": ("offset", "add_offset", "bias", "data_offset_values"),
}
"""Names of gains and offsets, by the role that GDAL itself marks them with."""
_IMAGE_NAME = re.compile(r"SPECTRAL_IMAGE(_VNIR|_SWIR)?$")
"""End of the name of an image of EnMAP or DESIS; those of EnMAP's level L1B have the bands of one detector."""
_OF_BANDS = {
    "gain": (1.0, ("Scale", "GainOfBand", "gainOfBand")),
    "offset": (0.0, ("Offset", "OffsetOfBand", "offsetOfBand")),
    "centre": (math.nan, ("wavelengthCenterOfBand",)),
    "width": (math.nan, ("FWHMOfBand", "wavelengthWidthOfBand")),
    "no data": (math.nan, ("NoDataValue",)),
}
"""What XML beside a file says of a band: what counts where it doesn't, and names in GDAL's, EnMAP's and DESIS's."""


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
    names = " and ".join(f"'{name}'" for name in sorted({name for chosen in said for name, *_ in chosen}))
    linear = linear_values(path, num_bands, gains, offsets, f"GDAL's {names}")
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

    GDAL keeps gains, offsets and the no-data value in NAME.aux.xml; NAME-SPECTRAL_IMAGE.TIF of EnMAP and DESIS has
    wavelengths, widths, gains and offsets in NAME-METADATA.XML. Raises CaptureError: gains are impossible.
    """
    beside = [path.with_name(f"{path.name}.aux.xml") for path in file.files]
    beside += [
        path.with_name(_IMAGE_NAME.sub("", path.stem) + ending)
        for path in file.files
        if _IMAGE_NAME.search(path.stem)
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
    num_bands, first = file.shape[2], 1
    elements = list(root.iter("PAMRasterBand"))
    if not found.name.endswith(".aux.xml"):
        elements = [
            *root.iterfind(".//bandCharacterisation/bandID"),
            *root.iterfind(".//bandCharacterisation/band"),
        ]
        detector = next((end[1] for path in file.files if (end := _IMAGE_NAME.search(path.stem))), None)
        if len(elements) < num_bands or (len(elements) > num_bands and detector is None):
            listed = f"{found.name} describes {counted(len(elements), 'band')}, the image has {num_bands}"
            return replace(
                file, warnings=(*file.warnings, f"{listed}: wavelengths and gains in it are not used")
            )
        first = 1 + len(elements) - num_bands if detector == "_SWIR" else 1
    columns = {what: np.full(num_bands, usual) for what, (usual, _) in _OF_BANDS.items()}
    for element in elements:
        number = element.get("band") or element.get("number") or element.findtext("bandNumber") or 0
        index = int(number) - first
        for what, (_, names) in _OF_BANDS.items():
            text = next(filter(None, map(element.findtext, names)), None)
            if text and 0 <= index < num_bands:
                columns[what][index] = float(text)
    gains, offsets = columns["gain"], columns["offset"]
    bands, centres, widths = file.bands, columns["centre"], columns["width"]
    if bands.wavelengths_nm is None and np.isfinite(centres).all():
        known = ((widths > 0) & (widths < np.inf)).all()
        bands = replace(bands, wavelengths_nm=centres, evidence=f"{found.name}, nm")
        bands = replace(bands, fwhm_nm=widths) if known else bands
    stated = (gains.tolist(), offsets.tolist(), found.name)
    linear = file.linear or linear_values(file.path, file.shape[2], *stated)
    beside = columns["no data"]
    no_data = tuple(dict.fromkeys((*file.no_data, *beside[~np.isnan(beside)].tolist())))
    more = (*file.sources, found)
    return replace(file, bands=bands, linear=linear, no_data=no_data, sources=more)
