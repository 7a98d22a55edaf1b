"""What a camera writes beside its pixels: XMP and EXIF of a TIFF, and the band that they describe.

Tags are called `prefix:Name` as in the file, such as `Camera:BandName` or `drone-dji:SensorGain`.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping
from typing import Any, TypeAlias
from xml.etree import ElementTree

import numpy as np

from unmix_plugin.captures.spectral_file import BandTable

XmpTags: TypeAlias = dict[str, str | list[str]]
"""Text of each tag, or the texts of a list."""
RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
EXIF_CODE, BLACK_LEVEL_CODE, XMP_CODE = 34665, 50714, 700
EXIF_OF_PAGE = ("Make", "Model", "Software", "Orientation", "BitsPerSample", "BlackLevel", "DateTime")
EXPOSURE_OF_PAGE = ("ExposureTime", "FNumber", "ISOSpeedRatings")
FOCAL_PLANE_OF_PAGE = tuple(f"FocalPlane{what}" for what in ("XResolution", "YResolution", "ResolutionUnit"))
"""Where a program moved them out of EXIF's own directory."""
RATIONAL_TYPES = (5, 10)
"""Of TIFF, unsigned and signed."""
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def parse_xmp(packet: bytes | str) -> XmpTags:
    """Tags of an XMP packet, elements and attributes alike; empty if it is damaged.

    A packet that declares entities is taken as damaged: no camera writes one.
    """
    text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else packet
    start, end = text.find("<rdf:RDF"), text.rfind("</rdf:RDF>")
    opening = text.find("<x:xmpmeta")
    start = opening if 0 <= opening < start else start
    if start < 0 or end < 0 or "<!DOCTYPE" in text[:end] or "<!ENTITY" in text[:end]:
        return {}
    body = text[start:end] + "</rdf:RDF>" + ("</x:xmpmeta>" if start == opening else "")
    prefixes: dict[str, str] = {}
    tags: XmpTags = {}
    try:
        for event, item in ElementTree.iterparse(io.BytesIO(body.encode()), events=("start-ns", "end")):
            if event == "start-ns":
                prefixes[item[1]] = item[0]
            elif item.tag == f"{RDF}Description":
                tags.update(_tags_of(item, prefixes))
    except ElementTree.ParseError:
        return {}
    return tags


def _tags_of(description: ElementTree.Element, prefixes: dict[str, str]) -> XmpTags:
    def name_of(tag: str) -> str:
        space, _, local = tag.removeprefix("{").rpartition("}")
        return f"{prefixes.get(space, '')}:{local}"

    tags: XmpTags = {name_of(key): value.strip() for key, value in description.attrib.items()}
    for child in description:
        items = [(item.text or "").strip() for item in child.iter(f"{RDF}li")]
        tags[name_of(child.tag)] = items if items else (child.text or "").strip()
    return tags


def camera_tags(page_tags: Any) -> dict[str, Any]:
    """XMP and EXIF of a page, as JSON-able values.

    Args:
        page_tags: `tifffile.TiffTags` of a page.
    Returns:
        `xmp`, see `parse_xmp`, and `exif`: tags by tifffile's names, rationals as floats.
    """
    exif = {name: page_tags.valueof(name) for name in EXIF_OF_PAGE}
    exif |= {name: _rational(page_tags.valueof(name)) for name in (*EXPOSURE_OF_PAGE, *FOCAL_PLANE_OF_PAGE)}
    exif |= {name: _rational(value) for name, value in (page_tags.valueof(EXIF_CODE) or {}).items()}
    exif["BlackLevel"] = _black_levels(page_tags.get(BLACK_LEVEL_CODE))
    known = {name: value for name, value in exif.items() if isinstance(value, (str, int, float, list))}
    plain = {name: int(value) if isinstance(value, int) else value for name, value in known.items()}
    return {"xmp": parse_xmp(page_tags.valueof(XMP_CODE) or b""), "exif": plain}


def _rational(value: Any) -> Any:
    """A pair of integers is a rational in EXIF."""
    is_pair = isinstance(value, tuple) and len(value) == 2 and all(isinstance(part, int) for part in value)
    if not is_pair:
        return value
    return value[0] / value[1] if value[1] else None


def _black_levels(tag: Any) -> list[float] | None:
    """Stored as integers, or as rationals in one flat tuple of numerators and denominators."""
    if tag is None:
        return None
    numbers = [float(part) for part in np.atleast_1d(np.asarray(tag.value, dtype=np.float64))]
    if tag.dtype not in RATIONAL_TYPES:
        return numbers
    return [above / below for above, below in zip(numbers[::2], numbers[1::2], strict=True) if below]


def exif_number(exif: Mapping[str, Any], *names: str) -> float | None:
    """The first of some tags that is a finite number."""
    values = [exif.get(name) for name in names]
    numbers = [float(value) for value in values if isinstance(value, (int, float))]
    return next((number for number in numbers if math.isfinite(number)), None)


def tag_value(tags: XmpTags, name: str) -> str | list[str] | None:
    """A tag by its full name, or by its name without prefix under whichever prefix it is."""
    if ":" in name:
        return tags.get(name)
    return next((value for key, value in tags.items() if key.rpartition(":")[2] == name), None)


def tag_numbers(tags: XmpTags, *names: str) -> list[float] | None:
    """Numbers of the first of some tags that has any: one, a list, or many separated by commas."""
    for name in names:
        value = tag_value(tags, name) or ""
        found = re.findall(NUMBER, value if isinstance(value, str) else " ".join(value))
        if found:
            return [float(number) for number in found]
    return None


def tag_text(tags: XmpTags, *names: str) -> str | None:
    """Text of the first of some tags that is there and not empty; the items of a list with commas between."""
    for name in names:
        value = tag_value(tags, name)
        text = ",".join(value) if isinstance(value, list) else value
        if text:
            return text
    return None


def band_of(tags: XmpTags) -> BandTable | None:
    """Centre and width of the bands of a multispectral camera's file; None where no tag tells them.

    DJI writes `560(+/-16)nm`: half a width, which is doubled here.
    """
    for name in ("Camera:CentralWavelength", "BandFreq"):
        value = tag_value(tags, name) or []
        items = [value] if isinstance(value, str) else value
        centres = [number_in(item) for item in items]
        if not centres or any(centre is None or not 100.0 < centre < 20_000.0 for centre in centres):
            continue
        halves = [re.search(rf"\+\s*/?\s*-\s*({NUMBER})", item) for item in items]
        widths = tag_numbers(tags, "Camera:WavelengthFWHM") or []
        if all(halves):
            widths = [2.0 * float(half[1]) for half in halves if half]
        fwhm_nm = np.array(widths) if len(widths) == len(centres) else None
        return BandTable(np.array(centres, dtype=np.float64), f"XMP tag {name}, nm", fwhm_nm)
    return None


def number_in(text: str) -> float | None:
    """The first number of a text."""
    found = re.search(NUMBER, text)
    return float(found[0]) if found else None
