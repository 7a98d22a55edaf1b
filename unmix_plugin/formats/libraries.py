"""Files of known spectra, read in one way for every command that takes one: tables, ENVI libraries, text files.

| suffix | what |
|---|---|
| .csv | `wavelength,NAME,...`, one row a wavelength; `wavelength_um` if in micrometres, `NAME (%)` if in percent |
| .sli, .hdr | ENVI spectral library |
| .txt, .asc | one spectrum: of ECOSTRESS or ASTER, of USGS (splib06, splib07), or two columns of numbers alone |

Wavelengths may stand in any order. What a file marks as not measured, by NaN, -1.23e34 (USGS), -999 and the like, is
NaN.

Sources: Baldridge et al. 2009 and Meerdink et al. 2019 (ASTER, ECOSTRESS); Kokaly et al. 2017, USGS Data Series 1035.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from unmix_plugin.errors import SpectrumError, name_some
from unmix_plugin.formats.envi import data_beside, header_beside, header_items, read_header, read_layout
from unmix_plugin.limits import MOST_BANDS, allow_parts, read_bounded
from unmix_plugin.spectral.bands import Bands, are_band_numbers, nm_per_unit, require_nanometres
from unmix_plugin.spectral.library.material_library import (
    LibraryMaterial,
    MaterialLibrary,
    measured_library,
)
from unmix_plugin.spectral.library.spectra_csv import (
    PERCENT,
    is_number,
    read_number_table,
    without_percent,
)

BUILT_IN = "+builtin"
"""Stands among a user's files for the spectra that come with the program."""

LIBRARY_SUFFIXES = ("csv", "sli", "hdr", "txt", "asc")
_MARKERS, _HIGHEST_MARKER, _LEAST_REFLECTANCE = (-999.0, -9999.0), -99.0, -0.99
"""Stored numbers that stand for what was not measured: the first, and what is at most both of the others, as it is
stored and as a reflectance. Noise stored as ten-thousandths reaches one alone."""
_NOISE = 0.02
"""Part of its greatest value by which noise may take a spectrum below 0."""
_LARGEST_UM = 100.0
"""Greatest wavelength of a text file that doesn't say in which unit: up to here it is micrometres."""
_SMALLEST_SCALE = 1e-30


def library_of(
    paths: Iterable[Path], bands: Bands | None = None, light: Float[np.ndarray, " B"] | None = None
) -> MaterialLibrary:
    """The spectra of a user's files and folders alone, or the built-in ones where there are none or `+builtin` stands
    among them.

    Own spectra come first. One whose name another has is called `NAME (FILE)`. At `bands`, in `light` (relative power;
    None for flat light), they will be compared.

    Raises:
        SpectrumError: a file that can't be read; none of the user's spectra can be compared at the bands.
    """
    asked = list(dict.fromkeys(paths))
    named = [path for path in asked if str(path) != BUILT_IN]
    files = [file for path in named for file in (_libraries_in(path) if path.is_dir() else [path])]
    own = [one for file in files for one in read_library(file)]
    if bands is not None and own and not MaterialLibrary(tuple(_named(own))).comparable(bands, light).any():
        nm = np.concatenate([one.bands.centers_nm for one in own])
        raise SpectrumError(
            f"the library's spectra, from {nm.min():g} to {nm.max():g} nm, can't be compared: each covers less than "
            f"half of {bands}, or less than three, not counting those without light"
        )
    built_in = measured_library().materials if not own or Path(BUILT_IN) in asked else ()
    return MaterialLibrary(tuple(_named([*own, *built_in])))


def read_library(path: Path) -> list[LibraryMaterial]:
    """All spectra of a file; at least one.

    Raises:
        SpectrumError: another kind of file, or one that can't be read; negative values that are not noise.
    """
    readers = {"csv": _read_csv, "sli": _read_envi, "hdr": _read_envi, "txt": _read_text, "asc": _read_text}
    reader = readers.get(path.suffix.lower()[1:])
    if reader is None:
        raise SpectrumError(
            f"{path}: a library is a .csv, an ENVI spectral library (.hdr and .sli), or a text file (.txt, .asc) as "
            f"ECOSTRESS and USGS have them; {BUILT_IN} adds the built-in spectra"
        )
    try:
        names, wavelengths_nm, stored, scale = reader(path)
        spectra = stored / scale
        is_marker = (stored <= _HIGHEST_MARKER) & (spectra <= _LEAST_REFLECTANCE) | np.isin(stored, _MARKERS)
        return _materials(names, wavelengths_nm, np.where(is_marker, np.nan, spectra), path)
    except OSError as error:
        raise SpectrumError(f"{error.filename or path}: can't read: {error.strerror or error}") from error
    except (SpectrumError, ValueError) as error:
        raise SpectrumError(f"{path}: {error}") from error


def _libraries_in(folder: Path) -> list[Path]:
    """Files of spectra in a folder, without what ECOSTRESS and USGS put beside them."""
    kinds = [f".{suffix}" for suffix in LIBRARY_SUFFIXES if suffix != "hdr"]  # each .sli has its own
    there = sorted(folder.iterdir())
    found = [path for path in there if path.suffix.lower() in kinds and not _BESIDE_SPECTRA.search(path.name)]
    with_numbers = {header_beside(path) for path in found if path.suffix.lower() == ".sli"}
    headers = [path for path in there if path.suffix.lower() == ".hdr" and path not in with_numbers]
    found += filter(_is_library, headers)
    if not found:
        raise SpectrumError(f"{folder}: no library in this folder ({', '.join(kinds)})")
    return found


def _is_library(header_path: Path) -> bool:
    """Whether the numbers beside a header, whatever their suffix, are spectra."""
    try:
        return "library" in read_header(header_path).get("file type", "").lower()
    except ValueError:
        return False
    except OSError:  # which is said where it is read
        return True


_BESIDE_SPECTRA = re.compile(r"ancillary|wavelengths|bandpass|readme", re.IGNORECASE)


def _named(materials: Sequence[LibraryMaterial]) -> list[LibraryMaterial]:
    """With names that differ."""
    taken: dict[str, LibraryMaterial] = {}
    for one in materials:
        name, number = one.name, 1
        while name in taken:
            number += 1
            name = f"{one.name} ({one.source}{'' if number == 2 else f' {number - 1}'})"
        taken[name] = LibraryMaterial(name, one.bands, one.reflectance, one.source, one.origin)
    return list(taken.values())


_Table = tuple[
    Sequence[str], Float64[np.ndarray, " B"], Float64[np.ndarray, "K B"], float | Float64[np.ndarray, "K 1"]
]
"""Names, wavelengths in nm in any order, spectra as they are stored, and what they are to be divided by."""


def _materials(
    names: Sequence[str], wavelengths_nm: np.ndarray, spectra: np.ndarray, path: Path
) -> list[LibraryMaterial]:
    """In order of wavelength, with NaN for what was not measured, also in the middle of a gap where rows were left out;
    of values at one wavelength the mean."""
    require_nanometres(wavelengths_nm)
    given = Bands(np.unique(wavelengths_nm))
    middles, (low, high) = given.edges_nm[1:-1], given.intervals_nm.T
    gaps = middles[(high[:-1] < middles) & (low[1:] > middles)]
    wavelengths_nm = np.append(wavelengths_nm, gaps)
    spectra = np.pad(spectra, ((0, 0), (0, len(gaps))), constant_values=np.nan)
    centers, places = np.unique(wavelengths_nm, return_inverse=True)
    bands, found = Bands(centers), []
    for name, row in zip(names, spectra, strict=True):
        measured = np.isfinite(row)
        counts = np.bincount(places[measured], minlength=len(centers))
        if not counts.any():
            raise SpectrumError(f"'{name}' has no value that was measured")
        sums = np.bincount(places[measured], row[measured], len(centers))
        values = np.divide(sums, counts, out=np.full(len(centers), np.nan), where=counts > 0)
        least = np.nanmin(values)
        if least < -_NOISE * np.nanmax(values):
            found_at = f"'{name}' at {centers[np.nanargmin(values)]:g} nm"
            raise SpectrumError(f"spectra must not be negative; found {least:g} in {found_at}")
        inside = slice(*(np.flatnonzero(counts)[[0, -1]] + (0, 1)))
        own = bands if counts.all() else Bands(centers[inside])
        found.append(LibraryMaterial(name, own, np.maximum(values[inside], 0), path.name, (path, name)))
    return found


_CSV_HEAD = re.compile(
    r"(?:wave ?length|wl|lambda)s?[\s_]*[\[(]?\s*(?:in )?([^\])]*?)\s*[\])]?", re.IGNORECASE
)


def _read_csv(path: Path) -> _Table:
    header, values = read_number_table(path)
    head = _CSV_HEAD.fullmatch(header[0])
    factor = None if head is None else nm_per_unit(head[1] or "nm")
    if factor is None:
        raise SpectrumError(
            f"the first column must be headed 'wavelength' (in nm) or 'wavelength_um'; found '{header[0]}'"
        )
    if len(header) == 1:
        raise SpectrumError("no spectra: there is no column beside the wavelengths")
    names, scales = without_percent(header[1:])
    if not all(names) or len(set(names)) < len(names):
        raise SpectrumError(f"each spectrum needs a name of its own; found {name_some(names, 8)}")
    return names, values[:, 0] * factor, values[:, 1:].T, scales


_PERCENT_UNIT = re.compile(r"percent|per cent|%", re.IGNORECASE)
_KEYS = ("reflectance scale", "data ignore", "data gain", "data offset", "bbl", "wavelength", "spectra names")
"""Of a header of spectra, beside those of its layout."""


def _header_of_spectra(path: Path) -> dict[str, str]:
    header = read_header(path)
    for line in header.get("", "").splitlines():
        if line.lower().replace("_", " ").startswith(_KEYS):
            raise ValueError(f"the line {line[:80]!r} has no '='")
    return header


def _read_envi(path: Path) -> _Table:
    """Of the header these keys count beside those of the layout: `wavelength` and `wavelength units`, `spectra names`,
    `reflectance scale factor` (values are divided by it), `data ignore value`, and `bbl`, whose bad bands are gaps.
    Percent in `y units` or `z plot titles` is divided by 100, where no factor says otherwise."""
    header_path = path if path.suffix.lower() == ".hdr" else header_beside(path)
    if header_path is None:
        raise ValueError(f"no header beside it; expected {path.stem}.hdr or {path.name}.hdr")
    header = _header_of_spectra(header_path)
    layout = read_layout({**header, "file type": "", "bands": "1", "interleave": "bsq"})
    num_spectra, num_bands, _ = layout.shape
    allow_parts(header_path, num_bands, "bands", SpectrumError, MOST_BANDS)
    data_path = data_beside(header_path, layout.num_bytes, ".sli")
    found = data_path.stat().st_size
    if found != layout.num_bytes:  # more is a header that is wrong, too
        raise ValueError(
            f"{data_path.name} has {found} bytes; {num_spectra} spectra of {num_bands} values need {layout.num_bytes}"
        )
    stored = np.fromfile(data_path, layout.dtype, num_spectra * num_bands, offset=layout.offset)
    with np.errstate(all="ignore"):  # signalling NaN, and an ignored value that the type can't hold
        values = stored.reshape(num_spectra, num_bands).astype(np.float64)
        if "data ignore value" in header:
            ignored = np.array(_number(header, "data ignore value")).astype(layout.dtype)
            values[stored.reshape(values.shape) == ignored] = np.nan
    for key, usual in (("gain", 1.0), ("offset", 0.0)):
        if any(float(number) != usual for number in header_items(header, f"data {key} values")):
            raise ValueError(f"'data {key} values' can't be applied to spectra; write it with its values")
    good = [float(number) for number in header_items(header, "bbl")] or [1.0] * num_bands
    if len(good) != num_bands:
        raise ValueError(f"'bbl' has {len(good)} marks for {num_bands} bands")
    values[:, np.array(good) == 0] = np.nan
    unit = header.get("wavelength units", "").strip()
    factor = nm_per_unit("nm" if unit.lower() in ("", "unknown") else unit)
    if factor is None:
        raise ValueError(f"'wavelength units' is {unit!r}; expected Nanometers or Micrometers")
    names = header_items(header, "spectra names", ",") or [f"spectrum {i}" for i in range(num_spectra)]
    if len(names) != num_spectra:
        raise ValueError(
            f"{len(names)} 'spectra names' for {num_spectra} spectra; names with commas need quotes: \"grass, dry\""
        )
    is_percent = any(_PERCENT_UNIT.search(header.get(key, "")) for key in ("y units", "z plot titles"))
    scale = _number(header, "reflectance scale factor", "100" if is_percent else "1")
    if not _SMALLEST_SCALE <= scale <= 1.0 / _SMALLEST_SCALE:
        raise ValueError(f"'reflectance scale factor' is {scale:g}; expected a number above 0, such as 10000")
    return names, _wavelengths(header, num_bands) * factor, values, scale


def _wavelengths(header: Mapping[str, str], num_bands: int) -> np.ndarray:
    try:
        values = np.array([float(number) for number in header_items(header, "wavelength")])
    except ValueError:
        values = np.zeros(0)
    if not len(values):
        raise ValueError("'wavelength' is missing or no list of numbers")
    if len(values) != num_bands:
        raise ValueError(f"'wavelength' has {len(values)} values for {num_bands} bands")
    return values


def _number(header: Mapping[str, str], key: str, default: str = "") -> float:
    try:
        return float(header.get(key, default))
    except ValueError:
        raise ValueError(f"'{key}' is {header.get(key)}; expected a number") from None


_DEVIATION = re.compile(r"std|stdev|deviation|error|uncertainty|sigma", re.IGNORECASE)
_UNITS_OF_X = {"micromet": 1000.0, "micron": 1000.0, "nanomet": 1.0}


def _read_text(path: Path) -> _Table:
    """A spectrum with lines of text before its numbers: one a line (splib07), or a wavelength and a value."""
    words, numbers = _words_and_numbers(path)
    said = {key.strip().lower(): value.strip() for key, _, value in (line.partition(":") for line in words)}
    record = re.match(r"\s*(\S+) Record=\d+:\s*(.*\S)", words[0]) if words else None
    is_usgs = record is not None or any("USGS" in line for line in words[:3])
    if record is not None and all(len(row) == 1 for row in numbers):
        values = np.array([row[0] for row in numbers])
        return [" ".join(record[2].split())], _usgs_wavelengths(path, len(values)), values[None], 1.0
    rows = np.array([row[:2] for row in numbers if len(row) >= 2])
    if not len(rows):
        raise SpectrumError("no lines with a wavelength and a value")
    head = words[-1] if words else ""
    count = max(map(len, numbers))
    if count > 2 + is_usgs:  # those of USGS have deviations in the third column
        heads = next((x for x in (re.split(r"[\t;,]", head.strip()), head.split()) if len(x) == count), None)
        third = "column 3" if heads is None else f"column 3, '{heads[2].strip()}',"
        if count > 3 or heads is None or not _DEVIATION.search(heads[2]):
            raise SpectrumError(
                f"a line has {count} numbers, and what {third} means is unknown; leave a wavelength and a value, or "
                "write several spectra as a .csv headed 'wavelength,NAME,...'"
            )
    kept = rows[:, 0] > 0
    wavelengths, values = rows[kept].T
    unit = said.get("x units", "").lower()
    factor = next((factor for word, factor in _UNITS_OF_X.items() if word in unit), None)
    if factor is None:
        if unit:
            raise SpectrumError(f"'X Units' is {said['x units']!r}; expected micrometers or nanometers")
        is_um = wavelengths.max(initial=0) < _LARGEST_UM and not are_band_numbers(rows[:, 0])
        factor = 1000.0 if is_um else 1.0
    quantity = said.get("y units", "reflectance").lower()
    if "reflectance" not in quantity:
        raise SpectrumError(f"'Y Units' is {said['y units']!r}; expected reflectance")
    # The second line from the last before the numbers of splib06 is the title.
    title = said.get("name") or (words[-2] if is_usgs and len(words) > 1 else path.stem)
    scale = 100.0 if "percent" in quantity or PERCENT.search(head) else 1.0
    return [" ".join(title.split())], wavelengths * factor, values[None], scale


def _words_and_numbers(path: Path) -> tuple[list[str], list[list[float]]]:
    """Lines of text before the numbers, and the numbers of each line after; empty lines left out.

    A comma is the decimal mark between digits of a line whose numbers something else parts: `400<tab>0,25`.
    """
    text = read_bounded(path).decode("utf-8-sig", "replace")
    allow_parts(path, text.count("\n"), "lines", SpectrumError, MOST_BANDS)
    words: list[str] = []
    numbers: list[list[float]] = []
    for line in filter(str.strip, text.splitlines()):
        line = line.strip()
        if "." not in line and re.search(r"[\s;]", line) and not re.search(r"\D,|,\D", line):
            line = line.replace(",", ".")
        parts = re.split(r"[\s,;]+", line.strip(",; \t"))
        if parts and all(map(is_number, parts)):
            numbers.append([float(part) for part in parts])
        elif numbers:
            raise SpectrumError(f"{line[:40]!r} stands among the numbers")
        else:
            words.append(line)
    if not numbers:
        raise SpectrumError("there are no numbers in it")
    return words, numbers


def _usgs_wavelengths(path: Path, count: int) -> Float64[np.ndarray, " B"]:
    """Of splib07, whose spectra are lists of values alone: the one list of wavelengths of that length nearby."""
    folders = (path.parent, path.resolve().parent.parent)
    near = [one for folder in folders for one in sorted(folder.glob("*[Ww]avelengths*.txt"))]
    columns = ([row[0] for row in _words_and_numbers(one)[1] if len(row) == 1] for one in near)
    lists = {tuple(column) for column in columns if len(column) == count}
    if len(lists) != 1:
        raise SpectrumError(
            f"it has {count} values without wavelengths, and {len(lists)} lists of {count} wavelengths lie beside it "
            "or above; put the *Wavelengths*.txt of its spectrometer there"
        )
    return np.array(lists.pop()) * 1000.0
