"""Files of known spectra, read in one way for every command that takes one: ENVI libraries (.sli, .hdr) and texts.

What texts there are, and what marks a value that was not measured, is in `spectral.library.spectral_tables`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unmix_plugin.errors import SpectrumError, name_some
from unmix_plugin.formats.envi import data_beside, header_beside, header_items, read_header, read_layout
from unmix_plugin.limits import MOST_BANDS, allow_parts
from unmix_plugin.spectral.bands import Bands, nm_per_unit
from unmix_plugin.spectral.library.material_library import (
    LibraryMaterial,
    MaterialLibrary,
    measured_library,
)
from unmix_plugin.spectral.library.spectral_tables import (
    TABLE_SUFFIXES,
    MeasuredSpectra,
    read_spectral_text,
    require_wavelengths,
    without_markers,
)

BUILT_IN = "+builtin"
"""Stands among a user's files for the spectra that come with the program."""

LIBRARY_SUFFIXES = (*TABLE_SUFFIXES, "sli", "hdr")
_NOISE = 0.02
"""Part of its greatest value by which noise may take a spectrum below 0."""
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
    suffix = path.suffix.lower()[1:]
    if suffix not in LIBRARY_SUFFIXES:
        binary = (
            "; ASD's own files are binary: export them as text with ViewSpec Pro" if suffix == "asd" else ""
        )
        raise SpectrumError(
            f"{path}: a library is a .csv, an ENVI spectral library (.hdr and .sli), or a text file (.txt, .asc) as "
            f"ECOSTRESS, USGS and field spectrometers (.sig, .sed) have them; {BUILT_IN} adds the built-in "
            f"spectra{binary}"
        )
    try:
        return _materials((_read_envi if suffix in ("sli", "hdr") else read_spectral_text)(path), path)
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
    except OSError:  # which is reported where it is read
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


def _materials(given_spectra: MeasuredSpectra, path: Path) -> list[LibraryMaterial]:
    """In order of wavelength, with NaN for what was not measured, also in the middle of a gap where rows were left out;
    of values at one wavelength the mean."""
    names, wavelengths_nm, spectra = given_spectra.names, given_spectra.wavelengths_nm, given_spectra.values
    if not all(names) or len(set(names)) < len(names):
        raise SpectrumError(f"each spectrum needs a name of its own; found {name_some(names, 8)}")
    require_wavelengths(wavelengths_nm)
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


_PERCENT_UNIT = re.compile(r"percent|per cent|%", re.IGNORECASE)
_KEYS = ("reflectance scale", "data ignore", "data gain", "data offset", "bbl", "wavelength", "spectra names")
"""Of a header of spectra, beside those of its layout."""


def _header_of_spectra(path: Path) -> dict[str, str]:
    header = read_header(path)
    for line in header.get("", "").splitlines():
        if line.lower().replace("_", " ").startswith(_KEYS):
            raise ValueError(f"the line {line[:80]!r} has no '='")
    return header


def _read_envi(path: Path) -> MeasuredSpectra:
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
    nm = _wavelengths(header, num_bands) * factor
    return MeasuredSpectra(tuple(names), nm, without_markers(values, scale))


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
