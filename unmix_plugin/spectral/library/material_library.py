"""Libraries of known materials: a reflectance by its name, and which known materials a spectrum resembles.

Spectra are compared by their angle, which is blind to scale, over the bands that lie in the range of the material, as
reflectances: a spectrum that was lit by a known light is divided by it first.

Notation: `N` spectra, `B` bands. Each material keeps its own sampling; nothing is extrapolated unless asked for.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, resample_spectra
from unmix_plugin.spectral.metrics import spectral_angle

_CRI_NAMES = (
    "light greyish red",
    "dark greyish yellow",
    "strong yellow green",
    "moderate yellowish green",
    "light bluish green",
    "light blue",
    "light violet",
    "light reddish purple",
    "strong red",
    "strong yellow",
    "strong green",
    "strong blue",
    "light yellowish pink",
    "moderate olive green leaf",
    "Asian skin",
)
"""Appearance under daylight of the test colour samples of CIE 13.3:1995 and the one added in 2024, in their order."""


Comparison = Literal["scale", "continuum"]
"""What is taken out before angles are measured: the scale, or the convex hull above the spectrum as well, which leaves
the absorptions."""

_FEWEST_BANDS = 3
"""Bands that a comparison takes at least: two positive numbers are always nearly parallel."""

_LEAST_OVERLAP = 0.5
"""Part of a spectrum's bands that a material must cover to be compared with it."""

DARK_LIGHT = 1e-3
"""Light at a band, relative to its greatest, below which nothing is known of the reflectance there."""


@dataclass(frozen=True)
class LibraryMaterial:
    """One known material."""

    name: str
    bands: Bands
    """Where it was measured."""
    reflectance: Float64[np.ndarray, " B"]
    """Finite, not negative."""
    source: str
    """Where the measurement is from."""


@dataclass(frozen=True)
class LibraryMatch:
    """A known material that resembles a spectrum."""

    name: str
    angle_rad: float
    """0 for the same shape."""
    num_bands: int
    """Bands that were compared."""
    source: str


@dataclass(frozen=True)
class MaterialLibrary:
    """Known materials; their names differ."""

    materials: tuple[LibraryMaterial, ...]

    def __post_init__(self) -> None:
        repeated = [name for name, count in Counter(self.names).items() if count > 1]
        if repeated:
            raise SpectrumError(
                f"materials of a library must have different names; found {repeated[0]!r} twice"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Full names, in order."""
        return tuple(material.name for material in self.materials)

    def extended(self, table: SpectraTable, source: str) -> MaterialLibrary:
        """This library with the reflectances of a table before its own; those of the same name are hidden."""
        rows = zip(table.names, table.spectra, strict=True)
        own = tuple(LibraryMaterial(name, table.bands, row, source) for name, row in rows)
        others = tuple(material for material in self.materials if material.name not in table.names)
        return MaterialLibrary(own + others)

    def find(self, name: str) -> LibraryMaterial:
        """The material of a name: in full (`pmc/Carrot`), or its last part where only one has it; in any case.

        Raises:
            SpectrumError: no material or several of that name; the message has the nearest names.
        """
        wanted = name.strip().casefold()
        for key in (str.casefold, _last_part):
            found = [material for material in self.materials if key(material.name) == wanted]
            if len(found) == 1:
                return found[0]
            if found:
                several = ", ".join(material.name for material in found)
                raise SpectrumError(f"{name!r} may be any of {several}; give the full name")
        raise SpectrumError(f"the library has no {name!r}; {self._suggest(wanted)}")

    def reflectance(
        self, name: str, bands: Bands, beyond: Literal["refuse", "hold"] = "refuse"
    ) -> Float64[np.ndarray, " B"]:
        """Reflectance of a material at other wavelengths, by linear interpolation.

        Outside the measured range (`beyond`) it is refused, or the outermost value is held.

        Raises:
            SpectrumError: as `find`; or bands outside the measured range that are not to be held.
        """
        material = self.find(name)
        if beyond == "hold":
            return np.interp(bands.centers_nm, material.bands.centers_nm, material.reflectance)
        try:
            return resample_spectra(material.reflectance, material.bands, bands)
        except SpectrumError as error:
            raise SpectrumError(f"{material.name}: {error}") from error

    def nearest(
        self,
        spectra: Float[np.ndarray, "N B"],
        bands: Bands,
        light: Float[np.ndarray, " B"] | None = None,
        count: int = 3,
        comparison: Comparison = "scale",
    ) -> list[list[LibraryMatch]]:
        """The materials that resemble each spectrum most, nearest first.

        Materials that cover less than half of the bands, or less than three, are passed over; so are bands in which
        there is no light. Fewer than `count` come back if the library holds no more.

        Args:
            spectra: Radiance under `light`, or reflectance; finite.
            bands: Of the spectra.
            light: Relative power of the light at the bands; None for flat light.
            count: How many materials.
            comparison: What is taken out before angles are measured.
        """
        lit = np.ones(len(bands), bool) if light is None else light > DARK_LIGHT * np.max(light)
        reflectance = spectra if light is None else spectra / np.where(lit, light, 1.0)
        found: list[list[LibraryMatch]] = [[] for _ in spectra]
        for material in self.materials:
            low, high = material.bands.centers_nm[[0, -1]]
            shared = lit & (bands.centers_nm >= low) & (bands.centers_nm <= high)
            if shared.sum() < max(_FEWEST_BANDS, _LEAST_OVERLAP * len(bands)):
                continue
            centers = bands.centers_nm[shared]
            known = np.interp(centers, material.bands.centers_nm, material.reflectance)
            compared = reflectance[:, shared].astype(np.float64)
            if comparison == "continuum":
                compared = _continuum_removed(compared, centers)
                known = _continuum_removed(known[None], centers)[0]
            angles = spectral_angle(torch.from_numpy(compared), torch.from_numpy(known)).numpy()
            for matches, angle in zip(found, angles, strict=True):
                matches.append(LibraryMatch(material.name, float(angle), len(centers), material.source))
        return [sorted(matches, key=lambda match: match.angle_rad)[:count] for matches in found]

    def _suggest(self, wanted: str) -> str:
        if not self.materials:
            return "it is empty"
        spelled = {key(name): name for key in (str.casefold, _last_part) for name in self.names}
        near = difflib.get_close_matches(wanted, spelled, n=3, cutoff=0.5)
        near = near or [key for key in spelled if wanted and wanted in key][:3]
        if near:
            return f"nearest: {', '.join(dict.fromkeys(spelled[key] for key in near))}"
        return f"it has {len(self.names)} materials, among them {', '.join(self.names[:5])}"


@lru_cache(maxsize=1)
def measured_library() -> MaterialLibrary:
    """The measured reflectances that colour-science carries, 183 of them; named `set/sample`.

    Sets: `pmc`, skin, fruit, vegetables, leaves and paints; `checker`, the ColorChecker; `cri`, test colour samples of
    CIE 13.3; `cqs`, saturated ones of NIST's colour quality scale; `cie2017`, the 99 samples of CIE 224:2017. The
    tables of `cqs` and `cie2017` go on beyond what was measured by repeating the outermost value; these flat ends are
    cut off, so that they are not taken for data.
    """
    # Guarded because importing colour-science changes how NumPy prints.
    with np.printoptions():
        from colour import SpectralShape
        from colour.characterisation import SDS_COLOURCHECKERS
        from colour.quality.cfi2017 import load_TCS_CIE2017
        from colour.quality.datasets import SDS_TCS, SDS_VS

    known = SDS_TCS.get("CIE 2024", SDS_TCS)  # colour-science below 0.4.7 has the fourteen of 1995 alone
    samples: dict[str, Any] = dict(zip(_CRI_NAMES, known.values(), strict=False))
    table = load_TCS_CIE2017(SpectralShape(380, 780, 5))
    bands = Bands.of(np.asarray(table.wavelengths))
    cie2017 = [
        LibraryMaterial(f"cie2017/{index:02d}", bands, values, "test colour samples, CIE 224:2017")
        for index, values in enumerate(np.asarray(table.values, dtype=np.float64).T, 1)
    ]
    cqs = _materials("cqs", SDS_VS["NIST CQS 9.0"], "colour quality scale 9.0, NIST")
    return MaterialLibrary(
        (
            *_materials("pmc", SDS_COLOURCHECKERS["PMC"], "Preferred Memory Color chart"),
            *_materials("checker", SDS_COLOURCHECKERS["ColorChecker N Ohta"], "ColorChecker, Ohta 1997"),
            *_materials("cri", samples, "test colour samples, CIE 13.3:1995 and CIE 2024"),
            *map(_without_flat_ends, (*cqs, *cie2017)),
        )
    )


def _materials(group: str, distributions: Mapping[str, Any], source: str) -> list[LibraryMaterial]:
    return [
        LibraryMaterial(
            f"{group}/{sample}",
            Bands.of(np.asarray(found.wavelengths)),
            np.asarray(found.values, dtype=np.float64),
            source,
        )
        for sample, found in distributions.items()
    ]


def _without_flat_ends(material: LibraryMaterial) -> LibraryMaterial:
    changes = np.flatnonzero(np.diff(material.reflectance))
    inside = slice(changes[0], changes[-1] + 2)
    bands = Bands.of(material.bands.centers_nm[inside])
    return replace(material, bands=bands, reflectance=material.reflectance[inside])


def _continuum_removed(
    spectra: Float64[np.ndarray, "N B"], wavelengths_nm: Float64[np.ndarray, " B"]
) -> Float64[np.ndarray, "N B"]:
    """Spectra over their continuum, the upper convex hull (Clark and Roush 1984): below 1 where something absorbs.

    >>> _continuum_removed(np.array([[0.2, 0.2, 0.4]]), np.array([400.0, 500.0, 600.0])).round(3)
    array([[1.   , 0.667, 1.   ]])
    """
    hulls = np.stack([_upper_hull(row, wavelengths_nm) for row in spectra])
    return np.divide(spectra, hulls, out=np.ones_like(spectra), where=hulls > 0)


def _upper_hull(
    spectrum: Float64[np.ndarray, " B"], wavelengths_nm: Float64[np.ndarray, " B"]
) -> Float64[np.ndarray, " B"]:
    """Monotone chain: corners that lie below the line between their neighbours are dropped."""
    corners: list[int] = []
    for index in range(len(spectrum)):
        while len(corners) >= 2:
            first, second = corners[-2:]
            run, whole = (wavelengths_nm[[second, index]] - wavelengths_nm[first]).tolist()
            rise, whole_rise = (spectrum[[second, index]] - spectrum[first]).tolist()
            if rise * whole > whole_rise * run:
                break
            corners.pop()
        corners.append(index)
    return np.interp(wavelengths_nm, wavelengths_nm[corners], spectrum[corners])


def _last_part(name: str) -> str:
    return name.casefold().rpartition("/")[2]
