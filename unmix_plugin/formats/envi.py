"""The text of an ENVI header as entries: `key = value` lines after the word ENVI.

Lists are in braces and may span lines; a line that begins with `;` is a comment.

How the numbers of an ENVI image lie on disk.

Notation: `H` lines, `W` samples, `B` bands.

The text beside an ENVI file: `key = value` lines after the word ENVI.

Lists are in braces, separated by commas, and neither can be escaped: names have them replaced.

ENVI images: NAME.hdr, a text, and NAME.img, the numbers, band-interleaved by pixel.

Notation: `H x W` pixels, `C` bands.

ENVI spectral libraries: NAME.hdr, a text, and NAME.sli, one spectrum after the other.

Notation: `K` spectra, `B` bands.

ENVI spectral libraries: a header `x.hdr` of `key = value` lines, and a file of numbers, one spectrum a line.

Of the header these keys count: `samples` (bands), `lines` (spectra), `data type`, `byte order`, `header offset`,
`wavelength` and `wavelength units`, `spectra names`, `reflectance scale factor` (values are divided by it) and
`data ignore value`. Spectra are stored one after the other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Float32, Float64

from unmix_plugin.engine.runs.atomic_files import write_errors_as, write_file
from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.files import RowSink, raw_rows
from unmix_plugin.spectral.bands import Bands, require_nanometres
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, read_spectra_csv

_KEY = re.compile(r"^[ \t]*([^=\n{}]*?)[ \t]*=(?:\s*(?=\{)|[ \t]*)", re.MULTILINE)
_BRACE = re.compile(r"[{}]")


def parse_envi_header(text: str) -> dict[str, str]:
    r"""Values by key; keys in lower case with single spaces, lists without their braces.

    Raises:
        ValueError: the text is no ENVI header, or a list in it is never closed.

    >>> parse_envi_header("ENVI\n; by hand\nBands = 2\nwavelength = {\n450,\n; half\n550}")
    {'bands': '2', 'wavelength': '450,\n550'}
    """
    lines = [line for line in text.lstrip("\ufeff").splitlines() if not line.lstrip().startswith(";")]
    if not lines or lines[0].strip() != "ENVI":
        raise ValueError("its first line is not 'ENVI'")
    body, position = "\n".join(lines[1:]), 0
    header: dict[str, str] = {}
    while match := _KEY.search(body, position):
        key, start = " ".join(match[1].lower().split()), match.end()
        if body[start : start + 1] == "{":
            position = _closing_brace(body, start, key) + 1
            header[key] = body[start + 1 : position - 1].strip()
        else:
            position = (body + "\n").index("\n", start)
            header[key] = body[start:position].strip()
    return header


def _closing_brace(body: str, start: int, key: str) -> int:
    """Where the list ends that the brace at `start` opens."""
    depth = 0
    for brace in _BRACE.finditer(body, start):
        depth += 1 if brace[0] == "{" else -1
        if depth == 0:
            return brace.start()
    first = body.find("}", start)
    if key == "description" and first >= 0:  # free text, in which a brace need have no partner
        return first
    raise ValueError(f"the list of '{key}' is never closed")


_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_COMPLEX_TYPES = (6, 9)
_AXES = {"bsq": "byx", "bil": "ybx", "bip": "yxb"}
_LARGEST = 2**40


@dataclass(frozen=True)
class EnviLayout:
    """Where each number lies."""

    shape: tuple[int, int, int]
    """H, W, B."""
    dtype: np.dtype
    interleave: str
    """bsq, bil or bip."""
    offset: int
    """Bytes before the first number."""
    notes: tuple[str, ...] = ()

    @property
    def num_bytes(self) -> int:
        """Least size of the file."""
        return self.offset + prod(self.shape) * self.dtype.itemsize

    @property
    def axes(self) -> str:
        """Order of the axes on disk, the slowest first."""
        return _AXES[self.interleave]


def read_layout(header: Mapping[str, str]) -> EnviLayout:
    """The layout that a header states.

    Raises:
        ValueError: an entry is missing or impossible.
    """
    _refuse_other_files(header)
    shape = (_count(header, "lines", 1), _count(header, "samples", 1), _count(header, "bands", 1))
    code, notes = _count(header, "data type", 0), []
    if code in _COMPLEX_TYPES:
        raise ValueError(f"'data type' is {code}, complex numbers; expected one of {_known_types()}")
    if code not in _TYPES:
        raise ValueError(f"'data type' is {code}; expected one of {_known_types()}")
    kind = np.dtype(_TYPES[code])
    if "byte order" not in header and kind.itemsize > 1:
        notes.append("the header has no byte order; taken as little-endian")
    order = _count(header, "byte order", 0, default=0)
    if order > 1:
        raise ValueError(f"'byte order' is {order}; expected 0 (little-endian) or 1 (big-endian)")
    offset = _count(header, "header offset", 0, default=0)
    return EnviLayout(
        shape, kind.newbyteorder(">" if order else "<"), _interleave(header), offset, tuple(notes)
    )


def _refuse_other_files(header: Mapping[str, str]) -> None:
    kind = header.get("file type", "").lower()
    if "library" in kind:
        raise ValueError("the file is a library of spectra; expected an image")
    if _count(header, "file compression", 0, default=0):
        raise ValueError("the file of numbers is compressed ('file compression'); write it uncompressed")
    for key in ("major frame offsets", "minor frame offsets"):
        if any(part.strip() not in ("", "0") for part in header.get(key, "").split(",")):
            raise ValueError(
                f"'{key}' is {header[key]}; expected 0: write the image without bytes between frames"
            )


def _interleave(header: Mapping[str, str]) -> str:
    stated = header.get("interleave")
    if stated is None and _count(header, "bands", 1) == 1:
        return "bsq"  # with one band all three are the same
    if (stated or "").lower() not in _AXES:
        found = "missing" if stated is None else f"'{stated}'"
        raise ValueError(f"'interleave' is {found}; expected bsq, bil or bip: correct the header")
    return str(stated).lower()


def _count(header: Mapping[str, str], key: str, least: int, default: int | None = None) -> int:
    """A whole number; a comment behind it is cut off."""
    text = header.get(key, "" if default is None else str(default)).partition(";")[0].strip()
    try:
        number = int(text) if len(text) < 20 else _LARGEST
    except ValueError:
        found = f"'{text}'" if text else "missing"
        raise ValueError(f"'{key}' is {found}; expected a whole number") from None
    if not least <= number < _LARGEST:
        raise ValueError(f"'{key}' is {text}; expected a whole number of at least {least}")
    return number


def _known_types() -> str:
    return ", ".join(f"{code} ({np.dtype(name).name})" for code, name in _TYPES.items())


HeaderValue: TypeAlias = str | int | Sequence[str] | Sequence[float] | np.ndarray

_FLOAT32 = 4
"""What the format calls this type."""


@contextmanager
def envi_rows(
    paths: Sequence[Path], shape: tuple[int, ...], entries: Mapping[str, HeaderValue]
) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of a file of float32.

    The header is written last, and an old one is removed before its numbers are replaced: whenever both files are
    there, they belong together.

    Args:
        paths: Header and numbers.
        shape: Of all rows.
        entries: Of the header.
    """
    header_path, data_path = paths
    with raw_rows(data_path, b"", shape, np.dtype("<f4")) as add:
        yield add
        with write_errors_as(header_path):
            header_path.unlink(missing_ok=True)
    write_file(header_path, header_bytes(entries))


def header_bytes(values: Mapping[str, HeaderValue]) -> bytes:
    """The header with these entries, in their order; numbers with all their digits.

    >>> print(header_bytes({"lines": 2, "wavelength": [450.0, 550.5], "band names": ["a,b", "c"]}).decode())
    ENVI
    lines = 2
    wavelength = { 450.0, 550.5 }
    band names = { a-b, c }
    """
    lines = ["ENVI", *(f"{key} = {_text(key, value)}" for key, value in values.items()), ""]
    return "\n".join(lines).encode()


def layout_entries(samples: int, lines: int, bands: int, interleave: str) -> dict[str, HeaderValue]:
    """How the numbers lie on disk; float32, little-endian, nothing before them."""
    return {
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "header offset": 0,
        "data type": _FLOAT32,
        "interleave": interleave,
        "byte order": 0,
    }


def wavelength_entries(bands: Bands) -> dict[str, HeaderValue]:
    """Band centres and widths in nm; a width is that of the band's interval, an estimate from the spacing."""
    widths = bands.widths_nm.round(6)
    return {"wavelength units": "Nanometers", "wavelength": bands.centers_nm, "fwhm": widths}


def beside(path_without_suffix: Path, suffix: str) -> Path:
    """A file with this suffix; dots in the name before it stay."""
    return path_without_suffix.with_name(path_without_suffix.name + suffix)


def _text(key: str, value: HeaderValue) -> str:
    if isinstance(value, str):
        return "{ " + _plain(value) + " }" if key == "description" else _plain(value)
    if isinstance(value, int):
        return str(value)
    return "{ " + ", ".join(map(_element, value)) + " }"


def _element(value: str | float) -> str:
    return _plain(value).replace(",", "-") if isinstance(value, str) else repr(float(value))


def _plain(text: str) -> str:
    """One line without braces."""
    return re.sub(r"\s+", " ", text.replace("{", "(").replace("}", ")")).strip()


_SHOWN_NM = (640.0, 550.0, 460.0)
"""Red, green and blue that a viewer shows first, as far as there are bands for them."""


def envi_cube_paths(path_without_suffix: Path) -> list[Path]:
    """Files that `write_envi_cube` makes."""
    return [beside(path_without_suffix, ".hdr"), beside(path_without_suffix, ".img")]


def write_envi_cube(
    path_without_suffix: Path,
    cube: Float32[np.ndarray, "H W C"],
    wavelengths: Bands | None,
    names: Sequence[str] | None,
    description: str,
) -> list[Path]:
    """Write a cube as NAME.hdr and NAME.img, float32.

    Args:
        path_without_suffix: Folder, which is made, and NAME.
        cube: Any numbers.
        wavelengths: Centres of the bands, if they are bands of a spectrum.
        names: Of the bands; commas in them become `-`, as the format has no other way.
        description: What the numbers are, with their unit.
    Raises:
        ValueError: another number of wavelengths or names than of bands.
    """
    with envi_cube_rows(path_without_suffix, cube.shape, wavelengths, names, description) as add:
        add(cube)
    return envi_cube_paths(path_without_suffix)


@contextmanager
def envi_cube_rows(
    path_without_suffix: Path,
    shape: tuple[int, int, int],
    wavelengths: Bands | None,
    names: Sequence[str] | None,
    description: str,
) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of a cube of `shape` (H, W, C); the rest is as in `write_envi_cube`."""
    for what, given in (("wavelengths", wavelengths), ("names", names)):
        if given is not None and len(given) != shape[2]:
            raise ValueError(f"{len(given)} {what} for {shape[2]} bands")
    height, width, num_bands = shape
    entries: dict[str, HeaderValue] = {
        "description": description,
        "file type": "ENVI Standard",
        **layout_entries(width, height, num_bands, "bip"),
    }
    if wavelengths is not None:
        entries |= wavelength_entries(wavelengths)
    if names is not None:
        entries["band names"] = list(names)
    if wavelengths is not None and all(map(wavelengths.contains, _SHOWN_NM)):
        entries["default bands"] = [str(wavelengths.nearest(wavelength) + 1) for wavelength in _SHOWN_NM]
    with envi_rows(envi_cube_paths(path_without_suffix), shape, entries) as add:
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
    """Write spectra as NAME.hdr and NAME.sli, float32; commas in names become `-`, as the format has no other way.

    Args:
        path_without_suffix: Folder, which is made, and NAME.
        spectra, bands, names: Any numbers, their wavelengths, and what each spectrum is called.
        description: What the numbers are, with their unit.
    Raises:
        ValueError: another number of names than of spectra, or of wavelengths than of bands.
    """
    if spectra.shape != (len(names), len(bands)):
        raise ValueError(f"{len(names)} names and {len(bands)} wavelengths for spectra of {spectra.shape}")
    entries = {
        "description": description,
        "file type": "ENVI Spectral Library",
        **layout_entries(len(bands), len(names), 1, "bsq"),
        **wavelength_entries(bands),
        "spectra names": list(names),
    }
    paths = envi_library_paths(path_without_suffix)
    with envi_rows(paths, spectra.shape, entries) as add:
        add(spectra)
    return paths


_TYPES_SPECTRA_ENVI = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_NM_PER_UNIT = {
    **dict.fromkeys(("", "nm", "nanometers", "nanometer"), 1.0),
    **dict.fromkeys(("um", "micrometers", "micrometer", "microns"), 1e3),
}
_GREATEST_COUNT = 2**53
_SMALLEST_SCALE = 1e-30
_DATA_SUFFIXES = (".sli", ".SLI", "", ".dat", ".img", ".lib", ".raw")


def read_spectra_envi(path: Path) -> SpectraTable:
    """Read and validate an ENVI spectral library.

    Args:
        path: Its header, or the file of numbers beside which the header lies.
    Raises:
        SpectrumError: a part is missing, is not such a library, has a unit of wavelength that is not known, or holds
            values that are ignored, not finite or negative.
    """
    header_path = path if path.suffix.lower() == ".hdr" else path.with_suffix(".hdr")
    try:
        header = _read_header(header_path)
        values = _read_values(header, header_path)
        centers = _numbers(header, "wavelength", values.shape[1]) * _nm_per_unit(header)
        names = _names(header, len(values))
        bands, scale = Bands(centers), _number(header, "reflectance scale factor", 1.0)
        require_nanometres(bands.centers_nm)
        if not _SMALLEST_SCALE <= scale <= 1.0 / _SMALLEST_SCALE:
            raise SpectrumError(
                f"'reflectance scale factor' is {scale:g}; expected a number above 0, such as 10000"
            )
        return SpectraTable(bands, names, values / scale)
    except SpectrumError as error:
        raise SpectrumError(f"{header_path}: {error}") from error
    except OSError as error:
        raise SpectrumError(f"{header_path}: can't read: {error.strerror or error}") from error


def _read_header(path: Path) -> dict[str, str]:
    """Keys in lower case, and their values; lists with their braces cut off."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SpectrumError(f"no ENVI header: not text in UTF-8 ({error.reason})") from error
    try:
        return parse_envi_header(text)
    except ValueError as error:
        raise SpectrumError(f"no ENVI header: {error}") from error


def _read_values(header: dict[str, str], header_path: Path) -> Float64[np.ndarray, "K B"]:
    code = _count_spectra_envi(header, "data type")
    if code not in _TYPES_SPECTRA_ENVI:
        raise SpectrumError(f"'data type' is {code}; known: {', '.join(map(str, _TYPES_SPECTRA_ENVI))}")
    shape = _count_spectra_envi(header, "lines", least=1), _count_spectra_envi(header, "samples", least=1)
    kind = np.dtype(
        (">" if _count_spectra_envi(header, "byte order", 0) else "<") + _TYPES_SPECTRA_ENVI[code]
    )
    offset, data_path = _count_spectra_envi(header, "header offset", 0), _data_path(header_path)
    found = max(0, data_path.stat().st_size - offset)
    needed = shape[0] * shape[1] * kind.itemsize
    if found < needed:
        raise SpectrumError(
            f"{data_path.name} has {found} bytes; {shape[0]} spectra of {shape[1]} values need {needed}"
        )
    with data_path.open("rb") as file:
        file.seek(offset)
        stored = np.frombuffer(file.read(needed), kind).reshape(shape)
    with np.errstate(all="ignore"):  # signalling NaN, and an ignored value that the type can't hold
        values = stored.astype(np.float64)
        if "data ignore value" in header:
            values[values == np.array(_any_number(header, "data ignore value")).astype(kind)] = np.nan
    return values


def _data_path(header_path: Path) -> Path:
    for suffix in _DATA_SUFFIXES:
        found = header_path.with_suffix(suffix)
        if found.is_file():
            return found
    raise SpectrumError(f"no file of numbers beside it; expected {header_path.with_suffix('.sli').name}")


def _nm_per_unit(header: dict[str, str]) -> float:
    unit = header.get("wavelength units", "").strip().lower()
    if unit not in _NM_PER_UNIT:
        raise SpectrumError(f"'wavelength units' is {unit!r}; expected Nanometers or Micrometers")
    return _NM_PER_UNIT[unit]


def _names(header: dict[str, str], count: int) -> tuple[str, ...]:
    names = tuple(" ".join(name.split()) for name in header.get("spectra names", "").split(","))
    if names == ("",):
        return tuple(f"spectrum {index}" for index in range(count))
    if len(names) != count:
        raise SpectrumError(f"{len(names)} 'spectra names' for {count} spectra")
    return names


def _numbers(header: dict[str, str], key: str, count: int) -> Float64[np.ndarray, " B"]:
    try:
        values = np.array([float(number) for number in header.get(key, "").split(",")])
    except ValueError:
        raise SpectrumError(f"'{key}' is missing or no list of numbers") from None
    if len(values) != count:
        raise SpectrumError(f"'{key}' has {len(values)} values for {count} bands")
    return values


def _number(header: dict[str, str], key: str, default: float | int | None = None) -> float:
    """A finite number."""
    if key not in header and default is not None:
        return float(default)
    number = _any_number(header, key)
    if not math.isfinite(number):
        raise SpectrumError(f"'{key}' is {header[key]}; expected a finite number")
    return number


def _any_number(header: dict[str, str], key: str) -> float:
    try:
        return float(header[key])
    except (KeyError, ValueError):
        raise SpectrumError(f"'{key}' is {header.get(key, 'missing')}; expected a number") from None


def _count_spectra_envi(header: dict[str, str], key: str, default: int | None = None, least: int = 0) -> int:
    """A whole number from `least` up."""
    number = _number(header, key, default)
    if number != int(number) or not least <= number <= _GREATEST_COUNT:
        raise SpectrumError(f"'{key}' is {header[key]}; expected a whole number of at least {least}")
    return int(number)


def read_library_table(path: Path) -> SpectraTable:
    """Reflectances from a CSV file or an ENVI spectral library (.hdr or .sli), told by the file's suffix.

    Raises:
        SpectrumError: another kind of file, or one that can't be read.
    """
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return read_spectra_csv(path)
    if suffix in (".hdr", ".sli"):
        return read_spectra_envi(path)
    raise SpectrumError(f"{path}: a library is a .csv, or an ENVI spectral library (.hdr and .sli)")
