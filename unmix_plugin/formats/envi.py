"""ENVI files: images and libraries of spectra, each a text (NAME.hdr) beside a file of numbers.

The text has `key = value` lines after the word ENVI; a line that begins with `;` is a comment. Lists are in braces,
separated by commas, and may span lines. Neither can be escaped: names that are written have them replaced.

Notation: `H` lines, `W` samples and `C` bands of an image; `K` spectra of `B` bands of a library, which are stored as
`K` lines of `B` samples.
"""

from __future__ import annotations

import csv
import glob
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float, Float32

from unmix_plugin.engine.runs.atomic_files import write_errors_as, write_file
from unmix_plugin.engine.runs.replacing import refuse_foreign, remove
from unmix_plugin.engine.tables import decode_text
from unmix_plugin.formats.files import RowSink, raw_rows
from unmix_plugin.limits import MOST_BANDS, MOST_ITEMS, MOST_TEXT_BYTES, read_bounded
from unmix_plugin.spectral.bands import Bands

HeaderValue: TypeAlias = str | int | Sequence[str | int | float] | np.ndarray

_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_FLOAT32, UINT16 = 4, 12
_AXES: dict[str, Literal["byx", "ybx", "yxb"]] = {"bsq": "byx", "bil": "ybx", "bip": "yxb"}
_LARGEST = 2**40
_SAID_ONCE = re.compile(
    r"samples|lines|bands|header offset|data type|interleave|byte order|wavelength.*|fwhm|bbl|data .*|reflectance.*"
)
"""Keys by which numbers and bands are read."""
MAP_KEYS = ("map info", "projection info", "coordinate system string")
"""Where on the Earth an image lies."""
_OTHER_HEADERS = {
    "#?R": "a Radiance picture",
    "BYTEORDER": "an ESRI (ArcGIS) band file",
    "NROWS": "an ESRI (ArcGIS) band file",
    "NCOLS": "an ESRI (ArcGIS) band file",
}
"""What else ends in .hdr, by how it begins."""
_DATA_SUFFIXES = (
    *("", ".img", ".dat", ".raw", ".bil", ".bip", ".bsq"),
    *(".bin", ".cube", ".hyspex", ".sli", ".lib"),
)
_SHOWN_NM = (640.0, 550.0, 460.0)
"""Red, green and blue that a viewer shows first, as far as there are bands for them."""
_BRACE = re.compile(r"[{}]")


@dataclass(frozen=True)
class EnviLayout:
    """Where each number of an image lies on disk."""

    shape: tuple[int, int, int]
    """H, W, C."""
    dtype: np.dtype
    interleave: str
    """bsq, bil or bip."""
    offset: int
    """Bytes before the first number."""
    is_order_assumed: bool = False
    """Whether the header does not say the byte order, which is taken as little-endian."""

    @property
    def num_bytes(self) -> int:
        """Least size of the file."""
        return self.offset + math.prod(self.shape) * self.dtype.itemsize

    @property
    def axes(self) -> Literal["byx", "ybx", "yxb"]:
        """Order of the axes on disk, the slowest first: y lines, x samples, b bands."""
        return _AXES[self.interleave]


def read_header(path: Path) -> dict[str, str]:
    """Values by key; keys in lower case with single spaces, lists without their braces.

    Lines that are no `key = value` are the value of the key "".

    Raises:
        ValueError: it is no ENVI header, or a list in it is never closed.
        OSError: it can't be read.
    """
    if (size := path.stat().st_size) > MOST_TEXT_BYTES:
        raise ValueError(f"no ENVI header: {size} bytes; expected a text of a few kB")
    text = decode_text(read_bounded(path))
    try:
        return _parse_header(text)
    except ValueError as error:
        begin = text.lstrip().upper()
        if begin.startswith("ENVI"):
            raise
        other = next((kind for word, kind in _OTHER_HEADERS.items() if begin.startswith(word)), None)
        found = f"it is the header of {other}" if other else str(error)
        raise ValueError(
            f"no ENVI header: {found}; expected 'ENVI' and then 'key = value' lines. Convert the file to ENVI or "
            "write such a header for it"
        ) from error


def is_envi_header(path: Path) -> bool:
    """Whether a file of any name begins as a header does."""
    with path.open("rb") as file:
        begin = file.read(32)
    return re.match(r"ENVI\s", decode_text(begin[: len(begin) // 2 * 2])) is not None


def _parse_header(text: str) -> dict[str, str]:
    r"""
    >>> _parse_header("ENVI\n; by hand\nBands = 2\nwavelength = {\n450,\n; half\n550}")
    {'bands': '2', 'wavelength': '450,\n550'}
    >>> _parse_header("ENVI\nwavelength_units = nm\nwavelength = [450\n550]")
    {'wavelength units': 'nm', 'wavelength': '450\n550'}
    """
    lines = [line for line in text.splitlines() if not line.lstrip().startswith(";")]
    if not lines or lines[0].strip() != "ENVI":
        raise ValueError("its first line is not 'ENVI'")
    body, position = "\n".join(lines[1:]) + "\n", 0
    header: dict[str, str] = {}
    unread: list[str] = []
    while position < len(body):
        end = body.index("\n", position)
        name, equals, value = body[position:end].partition("=")
        position = end + 1
        if not equals or _BRACE.search(name):
            if line := (name + equals + value).strip():
                unread.append(line)
            continue
        key = " ".join(name.lower().replace("_", " ").split())
        opening = re.compile(r"\s*([{[])").match(body, end - len(value))
        close = -1
        if opening is not None and opening[1] == "{":
            close = _closing_brace(body, opening.start(1), key, key in header)
        elif opening is not None:  # NumPy's way, which a value of one line may begin with too
            next_equals = body.find("=", opening.end())
            close = body.find("]", opening.end(), next_equals if next_equals >= 0 else len(body))
        if opening is not None and close >= 0:
            value, position = body[opening.end() : close], body.index("\n", close) + 1
        if _SAID_ONCE.fullmatch(key) and header.get(key, value.strip()) != value.strip():
            raise ValueError(f"'{key}' is there twice, with different values")
        if key != "description" and (items := max(map(value.count, ", \n"))) >= MOST_ITEMS:
            raise ValueError(f"the list of '{key}' has {items + 1:,} items; expected at most {MOST_ITEMS:,}")
        header[key] = value.strip()
    return header | ({"": "\n".join(unread)} if unread else {})


def _closing_brace(body: str, start: int, key: str, is_repeated: bool) -> int:
    """Where the list ends that the brace at `start` opens."""
    first, depth = body.find("}", start), 0
    # A description is free text, in which a brace need have no partner.
    is_free = key == "description" and first >= 0
    for brace in () if is_free and is_repeated else _BRACE.finditer(body, start):
        depth += 1 if brace[0] == "{" else -1
        if depth == 0:
            return brace.start()
    if is_free:
        return first
    raise ValueError(f"the list of '{key}' is never closed")


def header_items(header: Mapping[str, str], key: str, separator: str = r"[,\s]") -> list[str]:
    """Elements of a list; commas too many at its ends or in a row count as none."""
    text = header.get(key, "")
    if separator == "," and '"' in text:  # names with commas in them
        parts = next(csv.reader([" ".join(text.split())], skipinitialspace=True))
    else:
        parts = re.split(separator, text)
    items = [" ".join(item.split()) for item in parts]
    return [item for item in items if item]


def read_layout(header: Mapping[str, str]) -> EnviLayout:
    """The layout that the header of an image states.

    Raises:
        ValueError: an entry is missing or impossible, or it is no header of an image.
    """
    if "library" in header.get("file type", "").lower():
        raise ValueError("the file is a library of spectra; expected an image")
    if "classification" in header.get("file type", "").lower():
        raise ValueError("the file holds numbers of classes ('file type'), which are no light")
    if _count(header, "file compression", default="0"):
        raise ValueError("the file of numbers is compressed ('file compression'); write it uncompressed")
    for key in ("major frame offsets", "minor frame offsets"):
        if any(part.strip() not in ("", "0") for part in header.get(key, "").split(",")):
            raise ValueError(
                f"'{key}' is {header[key]}; expected 0: write the image without bytes between frames"
            )
    height, width, num_bands = image_size(header)
    code, is_assumed = _count(header, "data type"), False
    if code not in _TYPES:
        found = f"{code}, complex numbers" if code in (6, 9) else str(code)
        known = ", ".join(f"{code} ({np.dtype(name).name})" for code, name in _TYPES.items())
        raise ValueError(f"'data type' is {found}; expected one of {known}")
    kind = np.dtype(_TYPES[code])
    if "byte order" not in header and kind.itemsize > 1:
        is_assumed = True
    order = _count(header, "byte order", default="0")
    if order > 1:
        raise ValueError(f"'byte order' is {order}; expected 0 (little-endian) or 1 (big-endian)")
    # With one band all three are the same.
    interleave = header.get("interleave", "bsq" if num_bands == 1 else "missing")
    if interleave.lower() not in _AXES:
        found = interleave if "interleave" not in header else f"'{interleave}'"
        raise ValueError(f"'interleave' is {found}; expected bsq, bil or bip: correct the header")
    offset = _count(header, "header offset", default="0")
    dtype = kind.newbyteorder(">" if order else "<")
    return EnviLayout((height, width, num_bands), dtype, interleave.lower(), offset, is_assumed)


def image_size(header: Mapping[str, str]) -> tuple[int, int, int]:
    """Lines, samples and bands.

    Raises:
        ValueError: one is missing or no whole number above 0.
    """
    height, width, num_bands = (_count(header, key, least=1) for key in ("lines", "samples", "bands"))
    if num_bands > MOST_BANDS:
        raise ValueError(f"'bands' is {num_bands}; expected at most {MOST_BANDS}")
    return height, width, num_bands


def _count(header: Mapping[str, str], key: str, default: str = "", least: int = 0) -> int:
    """A whole number; a comment behind it is cut off."""
    text = header.get(key, default).partition(";")[0].strip()
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (least <= number < _LARGEST and number == int(number)):
        raise ValueError(f"'{key}' is {text or 'missing'}; expected a whole number of at least {least}")
    return int(number)


def header_beside(data_path: Path) -> Path | None:
    """The ENVI header of a file of numbers: x.hdr or x.raw.hdr for x.raw."""
    for candidate in (data_path.with_name(data_path.name + ".hdr"), data_path.with_suffix(".hdr")):
        for path in (candidate, candidate.with_suffix(".HDR")):
            if path.is_file() and path != data_path:
                return path
    return None


def data_beside(header_path: Path, needed_bytes: int, first: str = "") -> Path:
    """The file of numbers that a header describes; of several the one of that size, else the first that is larger.

    `first` is the suffix that is preferred: of several files of that size it tells which one is meant.

    Raises:
        ValueError: there is none, or several could be it.
    """
    base = header_path.with_suffix("")
    suffixes = [either for suffix in (first, *_DATA_SUFFIXES) for either in (suffix, suffix.upper())]
    candidates = dict.fromkeys(base.with_name(base.name + suffix) for suffix in suffixes)
    if base.suffix:  # x.raw.hdr beside x.RAW
        candidates |= {base.with_suffix(base.suffix.upper()): None}
    found: list[Path] = []
    for path in candidates:  # each once: disks that ignore case have one file under `x.img` and `x.IMG`
        if path != header_path and path.is_file() and not any(path.samefile(other) for other in found):
            found.append(path)
    if not found and needed_bytes:  # any other file of this name will do if it has just the size
        others = sorted(header_path.parent.glob(f"{glob.escape(base.name)}.*"))
        found = [path for path in others if path.is_file() and path.stat().st_size == needed_bytes]
    if not found:
        usual = f"{base.name}{first}" if first == ".sli" else f"{base.name} or {base.name}.img"
        raise ValueError(
            f"no file of numbers beside this header; expected {usual} (.dat, .raw, .bil, .bip, .bsq, ...)"
        )
    alike = [path for path in found if path.stat().st_size == needed_bytes > 0]
    large = [path for path in found if path.stat().st_size >= needed_bytes]
    chosen = [*alike, *large, *found][0]
    if len(alike) > 1 and chosen.suffix.lower() != first:
        names = " and ".join(path.name for path in alike)
        raise ValueError(f"{names} could each be what it describes; name one, or move the others away")
    return chosen


def envi_cube_paths(path_without_suffix: Path) -> list[Path]:
    """Files that `write_envi_cube` makes."""
    return [beside(path_without_suffix, ".hdr"), beside(path_without_suffix, ".img")]


def write_envi_cube(
    path_without_suffix: Path,
    cube: Float32[np.ndarray, "H W C"],
    wavelengths: Bands | None,
    names: Sequence[str] | None,
    description: str,
    more: Mapping[str, HeaderValue] | None = None,
) -> list[Path]:
    """Write a cube as NAME.hdr and NAME.img, float32, band-interleaved by pixel.

    Args:
        path_without_suffix: Folder, which is made, and NAME.
        cube: Any numbers.
        wavelengths, names: Of the bands; commas in names become `-`, as the format has no other way.
        description: What the numbers are, with their unit.
        more: Further entries of the header.
    Raises:
        ValueError: another number of wavelengths or names than of bands.
    """
    with envi_cube_rows(path_without_suffix, cube.shape, wavelengths, names, description, more) as add:
        add(cube)
    return envi_cube_paths(path_without_suffix)


@contextmanager
def envi_cube_rows(
    path_without_suffix: Path,
    shape: tuple[int, int, int],
    wavelengths: Bands | None,
    names: Sequence[str] | None,
    description: str,
    more: Mapping[str, HeaderValue] | None = None,
) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of a cube of `shape` (H, W, C); `more` are further entries of its header,
    the rest is as in `write_envi_cube`."""
    for what, given in (("wavelengths", wavelengths), ("names", names)):
        if given is not None and len(given) != shape[2]:
            raise ValueError(f"{len(given)} {what} for {shape[2]} bands")
    height, width, num_bands = shape
    entries = cube_entries("ENVI Standard", description, width, height, num_bands, "bip")
    if names is not None:
        entries["band names"] = list(names)
    if wavelengths is not None:
        entries |= wavelength_entries(wavelengths)
        if all(map(wavelengths.contains, _SHOWN_NM)):
            entries["default bands"] = [str(wavelengths.nearest(nm) + 1) for nm in _SHOWN_NM]
    with _rows(envi_cube_paths(path_without_suffix), shape, {**entries, **(more or {})}) as add:
        yield add


def envi_library_paths(path_without_suffix: Path) -> list[Path]:
    """Files that `write_envi_library` makes."""
    return [beside(path_without_suffix, ".hdr"), beside(path_without_suffix, ".sli")]


def write_envi_library(
    path_without_suffix: Path,
    spectra: Float[np.ndarray, "K B"],
    bands: Bands,
    names: Sequence[str],
    description: str = "spectra",
) -> list[Path]:
    """Write spectra as NAME.hdr and NAME.sli, float32, as `write_envi_cube` writes a cube.

    Raises:
        ValueError: another number of names than of spectra, or of wavelengths than of bands.
    """
    if spectra.shape != (len(names), len(bands)):
        raise ValueError(f"{len(names)} names and {len(bands)} wavelengths for spectra of {spectra.shape}")
    entries = cube_entries("ENVI Spectral Library", description, len(bands), len(names), 1, "bsq")
    entries |= wavelength_entries(bands) | {"spectra names": list(names)}
    paths = envi_library_paths(path_without_suffix)
    with _rows(paths, spectra.shape, entries) as add:
        add(spectra)
    return paths


@contextmanager
def _rows(
    paths: Sequence[Path], shape: tuple[int, ...], entries: Mapping[str, HeaderValue]
) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of a file of float32.

    The header is written last, and an old one is removed before its numbers are replaced: whenever both files are
    there, they belong together.
    """
    header_path, data_path = paths
    with raw_rows(data_path, b"", shape, np.dtype("<f4")) as add:
        yield add
        with write_errors_as(header_path):
            refuse_foreign([data_path, header_path])
            remove(header_path)
    write_file(header_path, header_bytes(entries))


def cube_entries(
    kind: str,
    description: str,
    samples: int,
    lines: int,
    bands: int,
    interleave: str,
    data_type: int = _FLOAT32,
) -> dict[str, HeaderValue]:
    """What the file is and how its numbers lie: little-endian, nothing before them."""
    return {
        "description": description,
        "file type": kind,
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "header offset": 0,
        "data type": data_type,
        "interleave": interleave,
        "byte order": 0,
    }


def wavelength_entries(bands: Bands) -> dict[str, HeaderValue]:
    """Band centres and widths in nm; where the instrument's are unknown those of the bands' intervals."""
    widths = (bands.widths_nm if bands.fwhm_nm is None else bands.fwhm_nm).round(6)
    return {"wavelength units": "Nanometers", "wavelength": bands.centers_nm, "fwhm": widths}


def beside(path_without_suffix: Path, suffix: str) -> Path:
    """A file with this suffix; dots in the name before it stay."""
    return path_without_suffix.with_name(path_without_suffix.name + suffix)


def header_bytes(values: Mapping[str, HeaderValue]) -> bytes:
    """The header with these entries, in their order; numbers with all their digits.

    >>> print(header_bytes({"lines": 2, "wavelength": [450.0, 550.5], "band names": ["a,b", "c"]}).decode())
    ENVI
    lines = 2
    wavelength = { 450.0, 550.5 }
    band names = { a-b, c }
    """

    def plain(text: str) -> str:
        return re.sub(r"\s+", " ", text.replace("{", "(").replace("}", ")")).strip()

    def element(value: str | int | float) -> str:
        if isinstance(value, str):
            return plain(value).replace(",", "-")
        return str(value) if isinstance(value, int) else repr(float(value))  # a zone is a whole number

    lines = ["ENVI"]
    for key, value in values.items():
        if isinstance(value, str):
            text = f"{{ {plain(value)} }}" if key in ("description", *MAP_KEYS) else plain(value)
        else:
            text = str(value) if isinstance(value, int) else f"{{ {', '.join(map(element, value))} }}"
        lines.append(f"{key} = {text}")
    return "\n".join([*lines, ""]).encode()
