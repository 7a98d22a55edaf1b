"""What a TIFF says of its bands: GDAL's metadata, the description of the image, and names of pages."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from unmix_plugin.captures.readers.stated_bands import StatedBands
from unmix_plugin.captures.readers.wavelength_text import nm_per_unit

if TYPE_CHECKING:
    from tifffile import TiffPage

_GDAL_METADATA, _GDAL_NODATA, _DESCRIPTION, _PAGE_NAME = 42112, 42113, 270, 285
_CENTRES = ("wavelength", "wavelengths", "center_wavelength", "central_wavelength", "centre_wavelength")
_LIST = re.compile(
    r"""["']?wavelengths?(?: ?\(?(?P<unit>[a-zµμ]+)\)?)?["']?\s*[=:]\s*[\[{(]?(?P<list>[\d.,;\s]+)""", re.I
)


@dataclass(frozen=True)
class GdalItem:
    """One entry of GDAL's metadata."""

    name: str
    """In lower case."""
    value: str
    sample: int | None
    """Band from 0; None for the whole file."""
    role: str | None


def gdal_items(page: TiffPage) -> list[GdalItem]:
    """Entries of GDAL's metadata; none if there is no such tag or it is damaged."""
    text = str(page.tags.valueof(_GDAL_METADATA) or "").strip("\0 \n")
    if not text or "<!" in text:  # entities can grow without bound, and GDAL writes none
        return []
    try:
        items = list(ElementTree.fromstring(text).iter("Item"))
    except ElementTree.ParseError:
        return []
    return [
        GdalItem(
            item.get("name", "").lower(),
            (item.text or "").strip(),
            int(sample) if (sample := item.get("sample", "")).isdecimal() and len(sample) < 9 else None,
            item.get("role"),
        )
        for item in items
    ]


def state_bands(pages: list[TiffPage], items: list[GdalItem]) -> StatedBands:
    """Wavelengths by the first of the places where they can be, and names."""
    return _from_gdal(items) or _from_description(pages[0]) or _from_pages(pages)


def scale_and_no_data(
    page: TiffPage, items: list[GdalItem]
) -> tuple[float | None, float | None, tuple[str, ...]]:
    """Stored number that stands for 1, stored number of no measurement, and notes."""
    no_data = _number(str(page.tags.valueof(_GDAL_NODATA) or ""))
    named = [_number(item.value) for item in items if item.name in ("reflectance_scale_factor",)]
    if named and named[0]:
        return named[0], no_data, ()
    factors = {_number(item.value) for item in items if item.role == "scale"} - {None}
    offsets = {_number(item.value) for item in items if item.role == "offset"} - {None, 0.0}
    if len(factors) == 1 and not offsets and (factor := factors.pop()) and factor > 0:
        return (1 / factor if factor != 1 else None), no_data, ()
    note = ("scales and offsets of GDAL differ between bands and are left out",) if factors or offsets else ()
    return None, no_data, note


def _from_gdal(items: list[GdalItem]) -> StatedBands | None:
    centres = _of_samples(items, _CENTRES)
    names = _of_roles(items, "description") or _of_samples(items, ("band_name", "bandname"))
    names = names or [item.value for item in items if re.fullmatch(r"band_\d+", item.name)]
    where, fwhm = "GDAL metadata", _of_samples(items, ("fwhm",))
    units = [item.value for item in items if item.name in ("wavelength_units", "wavelength_unit")]
    if not centres:
        centres, fwhm = _of_samples(items, ("central_wavelength_um",)), _of_samples(items, ("fwhm_um",))
        units = ["Micrometers"]
    if not centres:
        whole = [item.value for item in items if item.sample is None and item.name in _CENTRES]
        centres = re.findall(r"[^\s,{}]+", whole[0]) if whole else None
        units = [item.value for item in items if item.name in ("wavelength_units", "wavelength_unit")]
    if not centres and not names:
        return None
    return StatedBands(
        where,
        centres or None,
        units[0] if units else None,
        fwhm or None,
        _of_samples(items, ("bbl",)) or None,
        names or None,
    )


def _of_samples(items: list[GdalItem], names: tuple[str, ...]) -> list[str]:
    """Values of one entry for each band, in the order of bands."""
    found = {item.sample: item.value for item in items if item.name in names and item.sample is not None}
    return [found[sample] for sample in sorted(found)]


def _of_roles(items: list[GdalItem], role: str) -> list[str]:
    found = {item.sample: item.value for item in items if item.role == role and item.sample is not None}
    return [found[sample] for sample in sorted(found)]


def _from_description(page: TiffPage) -> StatedBands | None:
    """Wavelengths in JSON, or in text as `wavelengths = 450, 460`."""
    text = str(page.tags.valueof(_DESCRIPTION) or "")[: 2**20]
    if "wavelength" not in text.lower():
        return None
    if listed := re.findall(r'<Channel\b[^>]*?\bEmissionWavelength="([^"]+)"', text):
        unit = re.search(r'EmissionWavelengthUnit="([^"]+)"', text)
        return StatedBands("OME-XML, EmissionWavelength", listed, unit[1] if unit else "nm")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        content = None
    if isinstance(content, dict):
        entries: dict[str, Any] = {str(key).lower().rstrip("s"): value for key, value in content.items()}
        centres = entries.get("wavelength", entries.get("wavelengths_nm", entries.get("wavelength_nm")))
        unit = entries.get("wavelength_unit", "nm" if "wavelengths_nm" in map(str.lower, content) else None)
        if isinstance(centres, list):
            fwhm = entries.get("fwhm")
            return StatedBands(
                "image description",
                centres,
                unit if isinstance(unit, str) else None,
                fwhm if isinstance(fwhm, list) else None,
            )
    match = _LIST.search(text)
    centres = re.findall(r"\d+(?:\.\d+)?", match["list"]) if match else []
    if match is None or not centres:
        return None
    return StatedBands(
        "image description", centres, match["unit"] if nm_per_unit(match["unit"] or "") else None
    )


def _from_pages(pages: list[TiffPage]) -> StatedBands:
    """Names of pages, where each has its own."""
    for tag, what in ((_PAGE_NAME, "names of pages"), (_DESCRIPTION, "descriptions of pages")):
        names = [" ".join(str(page.tags.valueof(tag) or "").split()) for page in pages]
        if all(names) and all(len(name) < 200 for name in names) and (len(set(names)) == len(names)):
            return StatedBands(what, names=names)
    return StatedBands("the file")


def _number(text: str) -> float | None:
    """A number, not a NaN where none is allowed; None for other text."""
    try:
        number = float(text.strip("\0 "))
    except ValueError:
        return None
    return number if not math.isinf(number) else None
