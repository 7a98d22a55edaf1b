"""What a camera writes beside its pixels: XMP and EXIF, the band that they describe, and how numbers become radiance.

Tags are called `prefix:Name` as in the file, such as `Camera:BandName` or `drone-dji:SensorGain`.

Notation: `H` rows, `W` columns, `p` stored number, `x` column, `y` row, both counted from 0. All makers' formulas are

    L(x, y) = (p(x, y) - black level) * factor(x, y)

with a factor for exposure, gain, vignetting and, where rows are read one after the other, the row.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal
from weakref import WeakKeyDictionary
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float, Float32, Float64, Int

from unmix_plugin.captures.cube import BandTable, CameraTags, Cube, XmpTags
from unmix_plugin.captures.wavelengths import PLUS_MINUS
from unmix_plugin.errors import CaptureError, counted
from unmix_plugin.limits import DEEPEST

_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_EXIF_CODE, _BLACK_LEVEL_CODE, _XMP_CODE = 34665, 50714, 700
_EXIF_OF_PAGE = ("Make", "Model", "Software", "Orientation", "BitsPerSample", "BlackLevel", "DateTime")
_EXPOSURE_OF_PAGE = ("ExposureTime", "FNumber", "ISOSpeedRatings")
_FOCAL_PLANE_OF_PAGE = tuple(f"FocalPlane{what}" for what in ("XResolution", "YResolution", "ResolutionUnit"))
"""Where a program moved them out of EXIF's own directory."""
_RATIONAL_TYPES = (5, 10)
"""Of TIFF, unsigned and signed."""
_SATURATED_12_BITS, _SATURATED_10_BITS_OF_16, _SATURATED_10_BITS = 65520.0, 65472.0, 1023.0
"""Sensors of 12 or 10 bits fill the upper ones of 16, or 10 bits alone."""
_FAULTY_EXPOSURE_S, _TRUE_EXPOSURE_S = 1.0 / 6329.0, 0.000274
"""What old firmware of the RedEdge wrote, and what it meant."""
_GREATEST_POWER = 20
_LARGEST_PACKET = 1 << 20
"""Characters of XMP; cameras write some thousand."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def parse_xmp(packet: bytes | str) -> dict[str, str | list[str]]:
    """Tags of an XMP packet, elements and attributes alike; empty if it is damaged, or declares entities."""
    text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else packet
    start, end = text.find("<rdf:RDF"), text.rfind("</rdf:RDF>")
    opening = text.find("<x:xmpmeta")
    start = opening if 0 <= opening < start else start
    declares = "<!DOCTYPE" in text[:end] or "<!ENTITY" in text[:end]
    if start < 0 or end < 0 or declares or end - start > _LARGEST_PACKET:
        return {}
    body = text[start:end] + "</rdf:RDF>" + ("</x:xmpmeta>" if start == opening else "")

    def name_of(tag: str) -> str:
        space, _, local = tag.removeprefix("{").rpartition("}")
        return f"{prefixes.get(space, '')}:{local}"

    prefixes: dict[str, str] = {}
    tags: dict[str, str | list[str]] = {}
    level = 0
    try:
        for event, item in ElementTree.iterparse(
            io.BytesIO(body.encode()), events=("start-ns", "start", "end")
        ):
            level += {"start": 1, "end": -1}.get(event, 0)
            if level > DEEPEST:
                return {}
            if event == "start-ns":
                prefixes[item[1]] = item[0]
            elif event == "end" and item.tag == f"{_RDF}Description":
                tags |= {name_of(key): value.strip() for key, value in item.attrib.items()}
                for child in item:
                    listed = [(one.text or "").strip() for one in child.iter(f"{_RDF}li")]
                    tags[name_of(child.tag)] = listed or (child.text or "").strip()
    except ElementTree.ParseError:
        return {}
    return tags


def camera_tags(page_tags: Any) -> CameraTags:
    """XMP and EXIF of a page, rationals as floats.

    Args:
        page_tags: `tifffile.TiffTags` of a page.
    """
    exif = {name: page_tags.valueof(name) for name in _EXIF_OF_PAGE}
    exif |= {name: _rational(page_tags.valueof(name)) for name in (*_EXPOSURE_OF_PAGE, *_FOCAL_PLANE_OF_PAGE)}
    exif |= {name: _rational(value) for name, value in (page_tags.valueof(_EXIF_CODE) or {}).items()}
    exif["BlackLevel"] = None
    if (tag := page_tags.get(_BLACK_LEVEL_CODE)) is not None:
        levels = np.atleast_1d(np.asarray(tag.value, dtype=np.float64)).tolist()
        if tag.dtype in _RATIONAL_TYPES:  # in one flat tuple of numerators and denominators
            levels = [above / below for above, below in zip(levels[::2], levels[1::2], strict=True) if below]
        exif["BlackLevel"] = levels
    known = {name: value for name, value in exif.items() if isinstance(value, (str, int, float, list))}
    plain = {name: int(value) if isinstance(value, int) else value for name, value in known.items()}
    return CameraTags(parse_xmp(page_tags.valueof(_XMP_CODE) or b""), plain)


def _rational(value: Any) -> Any:
    """A pair of integers is a rational in EXIF."""
    is_pair = isinstance(value, tuple) and len(value) == 2 and all(isinstance(part, int) for part in value)
    if not is_pair:
        return value
    return value[0] / value[1] if value[1] else None


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
        found = re.findall(_NUMBER, value if isinstance(value, str) else " ".join(value))
        if found:
            return [float(number) for number in found]
    return None


def tag_text(tags: XmpTags, *names: str) -> str | None:
    """Text of the first of some tags that is there and not empty; the items of a list with commas between."""
    values = (tag_value(tags, name) for name in names)
    return next((",".join(value) if isinstance(value, list) else value for value in values if value), None)


def band_of(tags: XmpTags) -> BandTable | None:
    """Centre and width of the bands of a multispectral camera's file; None where no tag tells them.

    DJI writes `560(+/-16)nm`: half a width, which is doubled here. Widths of 0 stand for unknown ones.
    """
    for name in ("Camera:CentralWavelength", "BandFreq"):
        value = tag_value(tags, name) or []
        items = [value] if isinstance(value, str) else value
        found = [re.search(_NUMBER, item) for item in items]
        centres = [float(number[0]) for number in found if number]
        if not found or len(centres) < len(found) or not all(100 < centre < 20_000 for centre in centres):
            continue
        halves = [re.search(rf"{PLUS_MINUS} ?({_NUMBER})", item) for item in items]
        widths = tag_numbers(tags, "Camera:WavelengthFWHM") or []
        if all(halves):
            widths = [2.0 * float(half[1]) for half in halves if half]
        fwhm_nm = np.array(widths) if len(widths) == len(centres) and min(widths) > 0 else None
        return BandTable(np.array(centres, dtype=np.float64), f"XMP tag {name}, nm", fwhm_nm)
    return None


def with_camera_tags(table: BandTable, tags: XmpTags, num_bands: int) -> BandTable:
    """The table with what a multispectral camera's XMP says of its bands, if nothing else says it."""
    names = tag_value(tags, "BandName")
    named = (names,) if isinstance(names, str) else tuple(names or ())
    if table.names is None and len(named) == num_bands:
        table = replace(table, names=named)
    found = band_of(tags) or BandTable()
    if table.wavelengths_nm is not None or found.wavelengths_nm is None:
        return table
    is_fitting = len(found.wavelengths_nm) == num_bands
    return replace(found, names=table.names, bad=table.bad) if is_fitting else table


@dataclass(frozen=True)
class _RadialVignetting:
    """1 + k0 r + k1 r^2 + ... at a distance of r pixels from a centre."""

    coefficients: tuple[float, ...]
    centre: tuple[float, float]
    """x and y."""

    def at(self, y: np.ndarray, x: np.ndarray) -> Float64[np.ndarray, "h W"]:
        """Its value at rows y and columns x."""
        radius = np.hypot(x - self.centre[0], y - self.centre[1])
        return np.polynomial.polynomial.polyval(radius, np.array([1.0, *self.coefficients]))


@dataclass(frozen=True)
class _PlaneVignetting:
    """A polynomial in x / W and y / H."""

    coefficients: Float64[np.ndarray, "n m"]
    """Of (x / W)^n (y / H)^m."""
    height: int
    width: int

    def at(self, y: np.ndarray, x: np.ndarray) -> Float64[np.ndarray, "h W"]:
        """Its value at rows y and columns x."""
        across = np.vander(x[0] / self.width, self.coefficients.shape[0], increasing=True)
        down = np.vander(y[:, 0] / self.height, self.coefficients.shape[1], increasing=True)
        return down @ self.coefficients.T @ across.T


@dataclass(frozen=True)
class _RowGain:
    """1 + a2 y / exposure - a3 y, of sensors that read one row after the other."""

    a2: float
    a3: float
    exposure_s: float

    def at(self, y: Int[np.ndarray, "h 1"]) -> Float64[np.ndarray, "h 1"]:
        """Its value at rows y."""
        return 1.0 + self.a2 * y / self.exposure_s - self.a3 * y


@dataclass(frozen=True)
class RadiometricModel:
    """How the stored numbers of one file become radiance."""

    maker: str
    """`MicaSense`, `Parrot Sequoia`, `DJI`."""
    unit: Literal["W/m2/sr/nm", "relative"]
    """Relative radiance is comparable between the bands and exposures of one camera."""
    black_level: float
    """Stored number of no light."""
    saturated: float
    """Stored numbers from here on are saturated."""
    gain: float
    """For exposure and sensitivity."""
    vignetting: _RadialVignetting | _PlaneVignetting
    divides: bool
    """Whether the vignetting, and the row, divide; they multiply otherwise."""
    row: _RowGain | None = None
    irradiance: float | None = None
    """What the sunshine sensor measured, as the file gives it; not used."""

    def factor_of(self, y: Int[np.ndarray, "h 1"], x: Int[np.ndarray, "1 W"]) -> Float64[np.ndarray, "h W"]:
        """Factor at rows y and columns x."""
        vignetting = self.vignetting.at(y, x)
        if self.row is not None:
            vignetting = vignetting * self.row.at(y)
        return self.gain / vignetting if self.divides else self.gain * vignetting

    @property
    def description(self) -> str:
        """What was done, in one line, for the record."""
        unit = "relative radiance" if self.unit == "relative" else f"radiance in {self.unit}"
        return f"{unit} by {self.maker}'s calibration in the file, black level {self.black_level:g}"

    def apply(self, values: Float[np.ndarray, "h W b"], rows: slice) -> Float32[np.ndarray, "h W b"]:
        """Radiance of stored numbers of some rows; a little below 0 where noise goes below the black level."""
        y = (rows.start or 0) + np.arange(len(values))
        factor = self.factor_of(y[:, None], np.arange(values.shape[1])[None, :])
        return ((values - self.black_level) * factor[..., None]).astype(np.float32)


_MODELS: WeakKeyDictionary[Cube, RadiometricModel | None] = WeakKeyDictionary()
"""Of cubes that are open, as every strip of a cube is calibrated by its model."""


def radiometric_model(file: Cube) -> RadiometricModel | None:
    """The calibration that a file carries in its camera's tags, worked out once a cube; None where there is none.
    Raises CaptureError: the file has a calibration that lacks a number, or one that can't be."""
    if file not in _MODELS:
        _MODELS[file] = _read_model(file)
    return _MODELS[file]


def _read_model(file: Cube) -> RadiometricModel | None:
    tags, exif = file.camera.xmp, file.camera.exif
    read = next((read for mark, read in _MAKERS.items() if tag_numbers(tags, mark) is not None), None)
    if read is None:
        return None
    model = read(file, tags, exif)
    probe = model.factor_of(np.array([[0], [file.shape[0] - 1]]), np.arange(file.shape[1])[None, :])
    if not (np.isfinite(probe).all() and (probe > 0.0).all()):
        raise CaptureError(
            f"{file.path}: the calibration in its XMP gives factors from {probe.min():g} to {probe.max():g}; expected "
            "positive numbers: the tags of exposure, gain or vignetting are damaged"
        )
    return model


def _micasense(file: Cube, tags: XmpTags, exif: Mapping[str, Any]) -> RadiometricModel:
    """MicaSense RedEdge and Altum: radiance in W/m2/sr/nm.

        L = 1 / V * a1 / (gain * exposure) * (p - pBL) / 2^bits / (1 + a2 y / exposure - a3 y)

    with gain = ISO speed / 100, pBL the mean black level, and V a polynomial of the distance to the vignetting centre,
    or, in a RedEdge-P or Altum-PT, a polynomial in x / W and y / H.
    Source: MicaSense, RedEdge camera radiometric calibration model; imageprocessing, metadata and image classes.
    """
    a1, a2, a3 = _xmp(file, tags, 3, "RadiometricCalibration")
    exposure = _exif(file, exif, "ExposureTime")
    if exif.get("Model") == "RedEdge" and abs(exposure - _FAULTY_EXPOSURE_S) < 1e-6:
        exposure = _TRUE_EXPOSURE_S
    iso = _exif(file, exif, "ISOSpeed", "ISOSpeedRatings", "PhotographicSensitivity")
    levels = exif.get("BlackLevel") or tag_numbers(tags, "DarkRowValue") or [0.0]
    gain = a1 / (0.01 * iso * exposure) / _stored_range(exif)
    has_centre = tag_numbers(tags, "VignettingCenter") is not None
    if not has_centre and tag_numbers(tags, "VignettingPolynomial2D") is not None:
        vignetting = _vignetting_2d(file, tags)
    else:
        centre = _xmp(file, tags, 2, "VignettingCenter")
        polynomial = _xmp(file, tags, 6, "VignettingPolynomial")
        vignetting = _RadialVignetting(tuple(polynomial), (centre[0], centre[1]))

    irradiance = tag_numbers(tags, "HorizontalIrradiance", "SpectralIrradiance")
    to_si = tag_numbers(tags, "IrradianceScaleToSIUnits")
    default = [0.01 if tag_numbers(tags, "HorizontalIrradiance") else 1.0]
    measured = None if irradiance is None else irradiance[0] * (to_si or default)[0]
    return RadiometricModel(
        maker="MicaSense",
        unit="W/m2/sr/nm",
        black_level=float(np.mean(levels)),
        saturated=_SATURATED_12_BITS,
        gain=gain,
        vignetting=vignetting,
        divides=True,
        row=_RowGain(a2, a3, exposure),
        irradiance=measured,
    )


def _sequoia(file: Cube, tags: XmpTags, exif: Mapping[str, Any]) -> RadiometricModel:
    """Parrot Sequoia: radiance in a unit of its own, the same for its four bands.

        I = f^2 (p - B) / (A * exposure * iso + C) / V(x / W, y / H)

    with the sensor model A, B, C and V a polynomial in two variables whose powers the file lists.
    Source: Parrot, SEQ-AN-01 (pixel value to irradiance) and SEQ-AN-02 (vignetting).
    """
    a, b, c = _xmp(file, tags, 3, "SensorModel")
    exposure, f_number = _exif(file, exif, "ExposureTime"), _exif(file, exif, "FNumber")
    iso = _exif(file, exif, "ISOSpeedRatings", "PhotographicSensitivity", "ISOSpeed")
    gain = f_number**2 / (a * exposure * iso + c)
    vignetting = _vignetting_2d(file, tags)
    saturated = _SATURATED_10_BITS if _stored_range(exif) == 2.0**10 else _SATURATED_10_BITS_OF_16
    # A black level that no number of 10 bits reaches is of the 16 bits that cameras fill otherwise.
    unit = 2.0**6 if saturated == _SATURATED_10_BITS < b else 1.0
    return RadiometricModel(
        maker="Parrot Sequoia",
        unit="relative",
        black_level=b / unit,
        saturated=saturated,
        gain=unit * gain,
        vignetting=vignetting,
        divides=True,
    )


def _vignetting_2d(file: Cube, tags: XmpTags) -> _PlaneVignetting:
    """A polynomial in x / W and y / H, whose powers the file lists; 1 where there is none."""
    height, width = file.shape[:2]
    powers = [int(power) for power in tag_numbers(tags, "VignettingPolynomial2DName") or ()]
    lacks_powers = not powers and tag_numbers(tags, "VignettingPolynomial2D") is not None
    if lacks_powers or len(powers) % 2 or not all(0 <= power <= _GREATEST_POWER for power in powers):
        raise CaptureError(
            f"{file.path}: the tag XMP VignettingPolynomial2DName holds {powers}; expected pairs of powers from 0 to "
            f"{_GREATEST_POWER}"
        )
    coefficients = np.ones((1, 1))  # of x^n y^m
    if powers:
        coefficients = np.zeros((max(powers[::2]) + 1, max(powers[1::2]) + 1))
        numbers = _xmp(file, tags, len(powers) // 2, "VignettingPolynomial2D")
        np.add.at(coefficients, (powers[::2], powers[1::2]), numbers)

    return _PlaneVignetting(coefficients, height, width)


def _dji(file: Cube, tags: XmpTags, exif: Mapping[str, Any]) -> RadiometricModel:
    """DJI P4 Multispectral and Mavic 3 Multispectral: radiance in a unit of its own, the same for all bands.

        L = V(r) * (p - black level) / 2^bits / (gain * exposure) * gain adjustment

    with V a polynomial of the distance to the calibrated optical centre, which multiplies here; exposure in seconds.
    Source: DJI, P4 Multispectral and Mavic 3M image processing guides.
    """
    (gain,) = _xmp(file, tags, 1, "drone-dji:SensorGain", positive=True)
    (microseconds,) = _xmp(file, tags, 1, "drone-dji:ExposureTime", positive=True)
    adjustment = tag_numbers(tags, "drone-dji:SensorGainAdjustment") or [1.0]
    names = ("drone-dji:BlackLevel", "BlackLevel", "BlackCurrent")
    levels = exif.get("BlackLevel") or _xmp(file, tags, 1, *names)
    polynomial = tag_numbers(tags, "VignettingData", "VignettingPolynomial") or []
    centre = [0.0, 0.0]
    if polynomial:
        x, y = (tag_numbers(tags, f"drone-dji:CalibratedOpticalCenter{axis}") or [] for axis in "XY")
        middle = tag_numbers(tags, "VignettingCenter") or [*x, *y]
        centre = _required(file, "XMP drone-dji:CalibratedOpticalCenterX, Y", middle or None, 2)
    scale = adjustment[0] / (gain * 1e-6 * microseconds) / _stored_range(exif)

    irradiance = tag_numbers(tags, "drone-dji:Irradiance")
    return RadiometricModel(
        maker="DJI",
        unit="relative",
        black_level=float(np.mean(levels)),
        saturated=_SATURATED_12_BITS,
        gain=scale,
        vignetting=_RadialVignetting(tuple(polynomial), (centre[0], centre[1])),
        divides=False,
        irradiance=irradiance[0] if irradiance else None,
    )


_MAKERS = {"RadiometricCalibration": _micasense, "SensorModel": _sequoia, "drone-dji:SensorGain": _dji}
"""How a calibration is read, by the XMP tag that it is known by."""


def _required(
    file: Cube, name: str, numbers: list[float] | None, count: int, positive: bool = False
) -> list[float]:
    if numbers is None or len(numbers) != count or (positive and min(numbers) <= 0.0):
        kind = "positive number" if positive else "number"
        found = "it is absent" if numbers is None else f"found {numbers}"
        raise CaptureError(
            f"{file.path}: the tag {name} should hold {counted(count, kind)}; {found}. Without it the stored numbers "
            "can't become radiance: export the image with its metadata"
        )
    return numbers


def _xmp(file: Cube, tags: XmpTags, count: int, *names: str, positive: bool = False) -> list[float]:
    """The numbers of the first of some XMP tags that is there."""
    return _required(file, f"XMP {names[0]}", tag_numbers(tags, *names), count, positive)


def _exif(file: Cube, exif: Mapping[str, Any], *names: str) -> float:
    """The first of some EXIF tags, a number above 0."""
    number = exif_number(exif, *names)
    return _required(file, f"EXIF {names[0]}", None if number is None else [number], 1, positive=True)[0]


def _stored_range(exif: Mapping[str, Any]) -> float:
    """Stored numbers go up to this, less one."""
    return 2.0 ** min(32.0, exif_number(exif, "BitsPerSample") or 16.0)
