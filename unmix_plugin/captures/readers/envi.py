"""ENVI images: numbers as they lie in memory, which a text beside them describes."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from unmix_plugin.captures.band_entries import check_bands, state_bands
from unmix_plugin.captures.cube import Cube, Exposure, ReadOptions
from unmix_plugin.captures.fields import Format, listed, state_exposure, state_linear
from unmix_plugin.captures.numbers import Mapped, Numbers
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.errors import CaptureError
from unmix_plugin.formats.envi import (
    MAP_KEYS,
    data_beside,
    header_beside,
    image_size,
    is_envi_header,
    read_header,
    read_layout,
)

_SHOWN_LENGTH = 200
"""Longer entries of a header are lists, which are not kept for people."""
_FACTOR = "reflectance scale factor"
"""Says that values are reflectances, also where it is 1 and changes nothing."""
_DESCRIBED = (".tif", ".tiff", ".exr", ".npy", ".h5", ".hdf5", ".he5", ".nc", ".mat")
"""Images that a header may describe instead of plain numbers."""
_COMPRESSED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"PK\x03\x04": "zip", b"\xfd7zXZ": "xz"}


_DARK_START = "autodarkstartline"
"""Where cameras of Specim close the shutter at the end of a capture: the first dark line, from 0. Source: NEODAAS,
run_subtract_darkframes, and ARSF, apl."""

_LINE_RATES = ("fps", "framerate")
_OF_RESONON = {"shutter", "gain", "framerate"}
_OF_BANDS = ("wavelength", "wavelength units", "fwhm", "bbl", "band names")


def open_envi(path: Path, _: ReadOptions) -> Cube:
    """Open an image by its header, or by the file of numbers beside it."""
    is_header = path.suffix.lower() == ".hdr" or is_envi_header(path)
    header_path = path if is_header else header_beside(path)
    if header_path is None:
        raise CaptureError(f"{path}: no header beside this file; expected {path.stem}.hdr or {path.name}.hdr")
    try:
        header = read_header(header_path)
        layout = read_layout(header)
        data_path = path
        if path == header_path:
            data_path = data_beside(header_path, layout.num_bytes, f".{layout.interleave}")
    except ValueError as error:
        raise CaptureError(f"{header_path}: {error}") from error
    remarks = [Remark.of(Code.BYTE_ORDER_ASSUMED)] if layout.is_order_assumed else []
    found, needed = data_path.stat().st_size, layout.num_bytes
    if found > needed:
        remarks.append(Remark.of(Code.BYTES_LEFT, left=found - needed))
    elif found < needed:
        with data_path.open("rb") as file:
            begin = file.read(6)
        kind = next((kind for magic, kind in _COMPRESSED.items() if begin.startswith(magic)), None)
        if kind is not None:
            raise CaptureError(
                f"{data_path}: compressed with {kind}; unpack it, as numbers are read in place"
            )
        height, width, num_bands = layout.shape
        raise CaptureError(
            f"{data_path}: cut short: {found} bytes; {header_path.name} promises {needed} ({height} lines x {width} "
            f"samples x {num_bands} bands of {layout.dtype.name} after {layout.offset} bytes)"
        )
    lengths = dict(zip("yxb", layout.shape, strict=True))
    stored = tuple(lengths[axis] for axis in layout.axes)
    numbers = Mapped(data_path, layout.dtype, stored, layout.offset)
    plain = Cube(
        path=header_path,
        reader="envi",
        shape=layout.shape,
        dtype=layout.dtype,
        numbers=Numbers((numbers,), stored, layout.axes, layout.dtype),
        interleave=layout.interleave,
        remarks=tuple(remarks),
        sources=(data_path,),
    )
    return _described(plain, header_path, header)


def described_by_header(file: Cube) -> Cube:
    """An image of another format with what an ENVI header beside it says; unchanged where there is none.

    Programs write such headers beside TIFF files to keep wavelengths and gains, often with `file type = TIFF`. Raises
    CaptureError: it is a header of this image and is damaged.
    """
    header_path = header_beside(file.path)
    if header_path is None or described_image(header_path) != file.path:
        return file
    try:
        header = read_header(header_path)
        shape = image_size(header)
    except ValueError as error:
        raise CaptureError(f"{header_path}: {error}") from error
    if shape != file.shape:
        expected, found = (" x ".join(map(str, size)) for size in (file.shape, shape))
        named = {"header": header_path.name, "found": found, "size": expected}
        return file.remarking(Remark.of(Code.HEADER_OF_OTHER_SIZE, **named))
    described = _described(file, header_path, header)
    return replace(described, sources=(*file.sources, header_path))


def described_image(header_path: Path) -> Path | None:
    """The image of another format that a header describes, x.tif for x.hdr or x.tif.hdr; None for plain numbers."""
    named = [header_path.with_suffix(""), *(header_path.with_suffix(suffix) for suffix in _DESCRIBED)]
    named += [path.with_suffix(path.suffix.upper()) for path in named[1:]]
    others = [path for path in named if path.suffix.lower() in _DESCRIBED and path.is_file()]
    if not others or not is_envi_header(header_path):
        return None
    with suppress(ValueError, OSError):
        header = read_header(header_path)
        if "tif" not in header.get("file type", "").lower():
            needed_bytes = 0  # of a faulty header, whose reader says what is wrong
            with suppress(ValueError):
                needed_bytes = read_layout(header).num_bytes
            numbers = data_beside(header_path, needed_bytes)
            return None if numbers not in others else others[0]
    return others[0]


def _described(file: Cube, header_path: Path, header: dict[str, str]) -> Cube:
    """The file with bands, gains, exposure and other facts of a header; what the file says itself fills gaps."""
    num_bands, bands_of_file, remarks = file.shape[2], file.bands, list(file.remarks)
    if unread := header.pop("", "").splitlines():
        first = repr(unread[0][:80])
        remarks.append(Remark.of(Code.HEADER_LINES_UNREAD, lines=len(unread), first=first))
    stated = state_bands({key: header[key] for key in _OF_BANDS if key in header}, "header field")
    bands = check_bands(stated, num_bands, remarks)
    if bands.wavelengths_nm is None and bands_of_file.wavelengths_nm is not None:
        bands = replace(bands_of_file, bad=bands_of_file.bad if bands.bad is None else bands.bad)
    linear = state_linear(
        header_path, num_bands, header, where="header field", format_of=Format.ENVI, remarks=remarks
    )
    factors = [key for key in header if key.endswith("scale factor") and key != _FACTOR]
    factors = [key for key in factors if header[key].strip("{} ") not in ("1", "1.0")]
    remarks += [Remark.of(Code.FACTOR_NOT_APPLIED, entry=key, value=header[key]) for key in factors]
    # Of Resonon, which writes decibels without saying so. Source: massipipe, RadianceConverter.
    in_db = header.keys() >= _OF_RESONON and "gain unit" not in header
    exposure = state_exposure(header | ({"gain unit": "dB"} if in_db else {}), "header field", remarks)
    if in_db and exposure.gain is not None:
        source = f"{exposure.gain.source}, taken as decibels, as Resonon writes"
        exposure = replace(exposure, gain=replace(exposure.gain, source=source))
    start, lines = _numbers(header, _DARK_START, Code.DARK_LINES_NO_NUMBER, remarks), file.shape[0]
    dark_lines = lines - int(start[0]) if len(start) == 1 and 1 <= start[0] < lines else 0
    if len(start) > 1:
        remarks.append(Remark.of(Code.DARK_LINES_SEVERAL, entry=_DARK_START, count_stated=len(start)))
    no_data = _numbers(header, "data ignore value", Code.NO_DATA_NO_NUMBER, remarks)
    if dark_lines:
        remarks.append(Remark.of(Code.DARK_LINES_APART, entry=_DARK_START))
    # Source: headers of Specim's Lumo (fps) and of Resonon's Spectronon (framerate), both in Hz.
    rate = next((key for key in _LINE_RATES if key in header), "")
    rates = _numbers(header, rate, Code.LINE_RATE_NO_NUMBER, remarks)
    shown = {key: value for key, value in header.items() if len(value) < _SHOWN_LENGTH}
    on_map = {key: " ".join(header[key].split()) for key in MAP_KEYS if header.get(key)}
    return replace(
        file,
        shape=(lines - dark_lines, *file.shape[1:]),
        dark_lines=dark_lines,
        bands=bands if bands.names is not None else replace(bands, names=bands_of_file.names),
        linear=linear or file.linear,
        no_data=tuple(dict.fromkeys((*no_data, *file.no_data))),
        remarks=tuple(remarks),
        exposure=Exposure(
            exposure.time or file.exposure.time,
            exposure.gain or file.exposure.gain,
            exposure.f_number or file.exposure.f_number,
        ),
        reflectance_source="header field 'reflectance scale factor'" if _FACTOR in header else "",
        map_entries=on_map,
        others={**file.others, "header": shown},
        lines_per_second=rates[0] if len(rates) == 1 and 0 < rates[0] < float("inf") else None,
    )


def _numbers(header: dict[str, str], key: str, otherwise: Code, remarks: list[Remark]) -> list[float]:
    """Numbers of an entry, a comment behind them cut off; none with a remark where it is something else."""
    try:
        return [float(item) for item in listed(header.get(key, "").partition(";")[0])]
    except ValueError:
        remarks.append(Remark.of(otherwise, entry=key, value=header[key]))
        return []
