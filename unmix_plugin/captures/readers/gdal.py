"""What GDAL says of bands, in a tag of TIFF files or in XML beside any file, and the XML of EnMAP and DESIS, which says
the same."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree.ElementTree import Element

from unmix_plugin.captures.band_entries import check_bands, state_bands
from unmix_plugin.captures.cube import Cube, Linear, Meaning
from unmix_plugin.captures.fields import Format, plain_names, state_linear
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.limits import parse_xml, read_bounded

GdalItems: TypeAlias = Mapping[str, Mapping[int | None, str]]
"""Texts by name in lower case, and by band from 0; None for the whole file."""
_NAMES_BY_ROLE = {"scale": "scale", "offset": "offset", "description": "band_name"}
"""What entries are that GDAL itself marks with a role."""
_IMAGE_NAME = re.compile(r"SPECTRAL_IMAGE(_VNIR|_SWIR)?$")
"""End of the name of an image of EnMAP or DESIS; those of EnMAP's level L1B have the bands of one detector."""
_MEANINGS = {"L1B": Meaning.RADIANCE, "L1C": Meaning.RADIANCE, "L2A": Meaning.REFLECTANCE}
_LEVEL = re.compile(rf"(?<![A-Z])({'|'.join(_MEANINGS)})(?![A-Z0-9])")
"""Of EnMAP and DESIS, as their XML or their names say it: ENMAP01-____L2A-..., DESIS-HSI-L2A-..."""
_OF_BANDS = {
    "scale": ("Scale", "GainOfBand", "gainOfBand"),
    "offset": ("Offset", "OffsetOfBand", "offsetOfBand"),
    "wavelength": ("wavelengthCenterOfBand",),
    "fwhm": ("FWHMOfBand", "wavelengthWidthOfBand"),
    "no_data": ("NoDataValue",),
    "band_name": ("Description",),
}
"""What XML beside a file says of a band, by names in GDAL's, EnMAP's and DESIS's."""


def gdal_items(text: str, remarks: list[Remark]) -> GdalItems:
    """Entries of a tag; none, and a remark, where it is damaged."""
    try:
        items = list(parse_xml(text).iter("Item")) if text else []
    except ValueError:
        remarks.append(Remark.of(Code.GDAL_DAMAGED))
        return {}
    found: dict[str, dict[int | None, str]] = defaultdict(dict)
    for item in items:
        sample, name = item.get("sample", ""), item.get("name", "").lower()
        band = int(sample) if sample.isdecimal() and len(sample) < 9 else None
        found[_NAMES_BY_ROLE.get(item.get("role", ""), name)].setdefault(band, (item.text or "").strip())
    return found


def gdal_entries(items: GdalItems) -> dict[str, Any]:
    """Entries as `state_bands` takes them: one text a band in the order of bands, or that of the whole file."""
    entries: dict[str, Any] = {}
    for name, texts in items.items():
        bands = sorted(band for band in texts if band is not None)
        entries[name] = [texts[band] for band in bands] if bands else texts[None]
    numbered = {int(name[5:]): entries[name] for name in items if re.fullmatch(r"band_\d{1,6}", name)}
    if sorted(numbered) == [*range(1, len(numbered) + 1)]:  # files list Band_10 before Band_2
        entries.setdefault("band_names", [numbered[number] for number in sorted(numbered)])
    return entries


def gdal_linear(
    path: Path, items: GdalItems, num_bands: int, *, where: str, remarks: list[Remark]
) -> Linear | None:
    """Gains and offsets, where bands may lack their own. Raises CaptureError: they are no numbers, or impossible."""
    entries = gdal_entries(items)
    for name, key in plain_names(items).items():
        if name in (*Format.GDAL.gains, *Format.GDAL.offsets) and set(items[key]) != {None}:
            usual = items[key].get(None, "1" if name in Format.GDAL.gains else "0")
            lacking = num_bands - len(items[key].keys() - {None})
            if lacking > 0 and None not in items[key]:
                facts = {"stated": num_bands - lacking, "bands": num_bands, "usual": usual}
                entry = f"{where} '{key}'"
                remarks.append(Remark(Code.GAINS_OF_SOME_BANDS, {"entry": entry, **facts}))
            entries[key] = [items[key].get(band, usual) for band in range(num_bands)]
    return state_linear(path, num_bands, entries, where=where, format_of=Format.GDAL, remarks=remarks)


def gdal_number(text: str) -> float | None:
    """A number, which may be NaN but not infinite; None for other text."""
    try:
        number = float(text.strip("\0 "))
    except ValueError:
        return None
    return number if not math.isinf(number) else None


def with_xml_beside(file: Cube) -> Cube:
    """The file with what an XML beside it says of its bands, where it says nothing itself.

    GDAL keeps gains, offsets and the no-data value in NAME.aux.xml; NAME-SPECTRAL_IMAGE.TIF of EnMAP and DESIS has
    wavelengths, widths, gains and offsets in NAME-METADATA.XML, and the level, which says what gains make of numbers.
    Raises CaptureError: gains are impossible.

    Source: SNAP's reader of EnMAP, for `base/level`; EnMAP-Box's readers, for names.
    """
    beside = [path.with_name(f"{path.name}.aux.xml") for path in file.files]
    beside += [
        path.with_name(_IMAGE_NAME.sub("", path.stem) + ending)
        for path in file.files
        if _IMAGE_NAME.search(path.stem)
        for ending in ("METADATA.XML", "METADATA.xml")
    ]
    for path in filter(Path.is_file, beside):
        remarks: list[Remark] = []
        file = _with_xml(file, path, remarks).remarking(*remarks)
    return file


def _with_xml(file: Cube, found: Path, remarks: list[Remark]) -> Cube:
    try:
        root = parse_xml(read_bounded(found))
    except ValueError:
        remarks.append(Remark.of(Code.XML_DAMAGED, xml=found.name))
        return file
    num_bands, first, meaning = file.shape[2], 1, None
    elements = list(root.iter("PAMRasterBand"))
    if not found.name.endswith(".aux.xml"):
        places = (".//bandCharacterisation/bandID", ".//bandCharacterisation/band")
        elements = [element for place in places for element in root.iterfind(place)]
        detector = next((end[1] for path in file.files if (end := _IMAGE_NAME.search(path.stem))), None)
        if len(elements) < num_bands or (len(elements) > num_bands and detector is None):
            facts = {"described": len(elements), "bands": num_bands}
            remarks.append(Remark(Code.XML_OF_OTHER_BANDS, {"xml": found.name, **facts}))
            return file
        first = 1 + len(elements) - num_bands if detector == "_SWIR" else 1
        level = _LEVEL.search(root.findtext("base/level") or found.stem)
        meaning = level and _MEANINGS[level[1]]
    items = _items_of_bands(elements, first, num_bands)
    bands, of_all = file.bands, {name: texts for name, texts in items.items() if len(texts) == num_bands}
    unit = {} if found.name.endswith(".aux.xml") else {"wavelength_units": "nm"}
    stated = state_bands(gdal_entries(of_all) | unit, found.name)
    if bands.wavelengths_nm is None and (stated.centres or stated.names):
        table = check_bands(stated, num_bands, remarks).marking(bands.bad)
        bands = replace(table, names=table.names if bands.names is None else bands.names)
    linear = file.linear or gdal_linear(file.path, items, num_bands, where=found.name, remarks=remarks)
    if linear is not None and meaning:
        linear = replace(linear, source=f"{linear.source} of {meaning.value}", meaning=meaning)
    texts = items.get("no_data", {}).values()
    no_data = [number for number in map(gdal_number, texts) if number is not None and not math.isnan(number)]
    return replace(
        file,
        bands=bands,
        linear=linear,
        no_data=tuple(dict.fromkeys((*file.no_data, *no_data))),
        sources=(*file.sources, found),
    )


def _items_of_bands(elements: Iterable[Element], first: int, num_bands: int) -> GdalItems:
    """What elements say of the bands of the image, the first of which has the number `first`."""
    found: dict[str, dict[int | None, str]] = defaultdict(dict)
    for element in elements:
        number = element.get("band") or element.get("number") or element.findtext("bandNumber") or 0
        band = int(number) - first
        texts = {str(item.get("key")).lower(): item.text for item in element.iterfind("Metadata/MDI")}
        for name, tags in _OF_BANDS.items():
            texts[name] = next(filter(None, map(element.findtext, tags)), texts.get(name))
        for name, text in texts.items():
            if text and 0 <= band < num_bands:
                found[name][band] = text.strip()
    return found
