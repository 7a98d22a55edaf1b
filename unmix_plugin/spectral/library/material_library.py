"""Libraries of known materials: a reflectance by its name, and which known materials a spectrum resembles.

Spectra are compared by their angle, which is blind to scale, over the bands that lie in the range of the material, as
reflectances: a spectrum that was lit by a known light is divided by it first.

Notation: `N` spectra, `B` bands. Each material keeps its own sampling; nothing is extrapolated unless asked for.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.difference import reflectance_to_lab
from unmix_plugin.spectral.features import continuum_removed
from unmix_plugin.spectral.library.spectra_csv import resample_spectra

_CRI_NAMES = (
    *("light greyish red", "dark greyish yellow", "strong yellow green", "moderate yellowish green"),
    *(
        "light bluish green",
        "light blue",
        "light violet",
        "light reddish purple",
        "strong red",
        "strong yellow",
    ),
    *("strong green", "strong blue", "light yellowish pink", "olive green leaf"),
)
"""Appearance under daylight of the test colour samples of CIE 13.3:1995, in their order."""

_LEFT_OUT = ("skin", "caucasian", "oriental", "south asian", "african", "pork", "smurf")
"""Of the built-in charts: skin, meat and figures of comics are no materials of scenes."""
_HUES = (
    *("red", "orange", "yellow", "yellow green", "green"),
    *("bluish green", "blue", "purplish blue", "purple", "magenta"),
)
_HUE_BOUNDS_DEG = (43.0, 76.0, 106.0, 140.0, 178.0, 215.0, 255.0, 295.0, 333.0, 368.0)
"""Where each hue ends in the plane of a* and b*, halfway between those of Munsell's at medium value and chroma."""


Comparison = Literal["scale", "continuum"]
"""What is taken out before angles are measured: the scale, or the convex hull above the spectrum as well, which leaves
the absorptions."""

_FEWEST_BANDS, _LEAST_OVERLAP = 3, 0.5
"""Bands that a comparison takes at least, since two positive numbers are always nearly parallel; and the part of a
spectrum's bands with light that a material must cover to be compared with it."""
_GREATEST_REFLECTANCE = 2.0
"""Values above it are not reflectances; glossy and fluorescent surfaces exceed 1."""
DARK_LIGHT = 1e-3
"""Light at a band, relative to its greatest, below which nothing is known of the reflectance there."""


@dataclass(frozen=True)
class LibraryMaterial:
    """One known material."""

    name: str
    bands: Bands
    """Where it was measured."""
    reflectance: Float64[np.ndarray, " B"]
    """Not negative; NaN where nothing was measured."""
    source: str
    """Where the measurement is from."""
    origin: tuple[Path, str] | None = None
    """The file, and the spectrum's name in it; None for what comes with the program."""


ALIKE_RAD = 0.1
"""Spectral angle up to which two materials are alike."""


@dataclass(frozen=True)
class LibraryMatch:
    """A known material that resembles a spectrum."""

    name: str
    angle_rad: float
    """0 for the same shape."""
    num_bands: int
    """Bands that were compared."""
    source: str

    @property
    def is_alike(self) -> bool:
        """Whether the spectrum may be of this material."""
        return self.angle_rad <= ALIKE_RAD


@dataclass(frozen=True)
class MaterialLibrary:
    """Known materials; their names differ."""

    materials: tuple[LibraryMaterial, ...]

    def __post_init__(self) -> None:
        for name, count in Counter(self.names).items():
            if count > 1:
                raise SpectrumError(f"materials of a library must have different names; found {name!r} twice")

    @property
    def names(self) -> tuple[str, ...]:
        """Full names, in order."""
        return tuple(material.name for material in self.materials)

    def find(self, name: str) -> LibraryMaterial:
        """The material of exactly this name; or else in any case, in full (`ColorChecker/blue`), or its last part
        where only one has it. Errors have the nearest names.
        """
        if name in self.names:
            return self.materials[self.names.index(name)]
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

        Where it was not measured (`beyond`) it is refused; or the outermost value is held, and gaps are bridged.
        """
        material = self.find(name)
        if beyond == "hold":
            known = np.isfinite(material.reflectance)
            return np.interp(bands.centers_nm, material.bands.centers_nm[known], material.reflectance[known])
        try:
            found = resample_spectra(material.reflectance, material.bands, bands)
        except SpectrumError as error:
            raise SpectrumError(f"{material.name}: {error}") from error
        if not np.isfinite(found).all():
            gap = bands.centers_nm[np.argmin(np.isfinite(found))]
            raise SpectrumError(f"{material.name} was not measured at {gap:g} nm; leave that band out")
        return found

    def require_reflectance(self, name: str, values: Float[np.ndarray, " B"], what: str) -> None:
        """Refuse percent and the like where the unit counts: by a material's values that are used, and of a dark one
        by the median of any spectrum of its file."""
        file = self.find(name).origin
        beside = self._greatest_medians[file[0]] if file else 0.0
        own = float(values.max())
        greatest, where = (own, "") if own > _GREATEST_REFLECTANCE else (beside, " in its file")
        if greatest > _GREATEST_REFLECTANCE:
            raise SpectrumError(
                f"{what} must be in reflectances, 1 for white; found {greatest:g}{where}. If these are percent, say so "
                "('NAME (%)' in the head of a table, 'y units = Percent' in an ENVI header) or divide percent by 100; "
                "if they are another quantity, give reflectances"
            )

    @cached_property
    def _greatest_medians(self) -> dict[Path, float]:
        medians: dict[Path, float] = {}
        for one in self.materials:
            if one.origin:
                median = float(np.nanmedian(one.reflectance))
                medians[one.origin[0]] = max(median, medians.get(one.origin[0], 0.0))
        return medians

    def resampled(self, bands: Bands) -> Float64[np.ndarray, "M B"]:
        """Reflectance of every material at other wavelengths; NaN where it was not measured."""
        rows = [
            np.interp(bands.centers_nm, one.bands.centers_nm, one.reflectance, left=np.nan, right=np.nan)
            for one in self.materials
        ]
        return np.array(rows).reshape(len(rows), len(bands))

    def comparable(
        self, bands: Bands, light: Float[np.ndarray, " B"] | None = None
    ) -> Bool[np.ndarray, " M"]:
        """Which materials cover half of the bands with light or more, and three at least."""
        return np.asarray(self._compared_bands(bands, light).any(axis=1))

    def _compared_bands(self, bands: Bands, light: Float[np.ndarray, " B"] | None) -> Bool[np.ndarray, "M B"]:
        """Bands that each material is compared over; none of those that are passed over."""
        lit = np.ones(len(bands), bool) if light is None else light > DARK_LIGHT * np.max(light)
        shared = np.isfinite(self.resampled(bands)) & lit
        enough = shared.sum(axis=1) >= max(_FEWEST_BANDS, _LEAST_OVERLAP * lit.sum())
        return shared & enough[:, None]

    def angles(
        self,
        spectra: Float[np.ndarray, "N B"],
        bands: Bands,
        light: Float[np.ndarray, " B"] | None = None,
        comparison: Comparison = "scale",
    ) -> tuple[Float64[np.ndarray, "N M"], Int64[np.ndarray, " M"]]:
        """Angle in radians between each spectrum and each material, and over how many bands a material is compared.

        Spectra are radiance under a light of this relative power, or reflectance where it is None. Bands in which there
        is no light are passed over. So are materials that cover less than half of the others, or less than three: NaN
        and 0. Spectra that are not finite, or black, have no angles, NaN.
        """
        shared, known = self._compared_bands(bands, light), self.resampled(bands)
        power = np.ones(len(bands)) if light is None else np.where(light > 0, light, 1.0)
        reflectance = spectra.astype(np.float64) / power
        angles = np.full((len(spectra), len(known)), np.nan)
        for used in np.unique(shared[shared.any(axis=1)], axis=0):
            rows = (shared == used).all(axis=1)
            pair = [torch.from_numpy(one[:, used]) for one in (reflectance, known[rows])]
            if comparison == "continuum":
                pair = [continuum_removed(one, bands.centers_nm[used]) for one in pair]
            x, y = (one / one.norm(dim=1, keepdim=True) for one in pair)
            angles[:, rows] = (x @ y.T).clamp(-1, 1).arccos().numpy()
        return angles, shared.sum(axis=1)

    def nearest(
        self,
        spectra: Float[np.ndarray, "N B"],
        bands: Bands,
        light: Float[np.ndarray, " B"] | None = None,
        count: int = 3,
        comparison: Comparison = "scale",
    ) -> list[list[LibraryMatch]]:
        """The materials that resemble each spectrum most by their `angles`, nearest first, at most `count`."""
        angles, counts = self.angles(spectra, bands, light, comparison)
        return [
            [
                LibraryMatch(
                    self.names[index], float(row[index]), int(counts[index]), self.materials[index].source
                )
                for index in np.argsort(row, kind="stable")[:count]
                if np.isfinite(row[index])
            ]
            for row in angles
        ]

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
    """The measured reflectances that colour-science carries, named `set/sample`, without skin and figures of comics.

    Sets: `ColorChecker`, its paints; `memory colours`, a chart of the colours of fruit, vegetables, leaves and sky;
    `CIE 13.3`, test colour samples; `CQS`, saturated ones of NIST's colour quality scale; `CIE 224`, the 99 samples of
    CIE 224:2017. Samples of the last two have numbers alone and are called by their colour too. Their tables go on
    beyond what was measured by repeating the outermost value; these flat ends are cut off, so that they are not taken
    for data.
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
    numbered = _numbered("CIE 224", table.to_sds(), "test colour samples, CIE 224:2017")
    saturated = _numbered("CQS", SDS_VS["NIST CQS 9.0"].values(), "colour quality scale 9.0, NIST")
    return MaterialLibrary(
        (
            *_materials("ColorChecker", SDS_COLOURCHECKERS["ColorChecker N Ohta"], "ColorChecker, Ohta 1997"),
            *_materials("memory colours", SDS_COLOURCHECKERS["PMC"], "Preferred Memory Color chart"),
            *_materials("CIE 13.3", samples, "test colour samples, CIE 13.3:1995"),
            *map(_without_flat_ends, (*saturated, *numbered)),
        )
    )


def _material(name: str, sample: Any, source: str) -> LibraryMaterial:
    """A spectrum of colour-science."""
    values = np.asarray(sample.values, dtype=np.float64)
    return LibraryMaterial(name, Bands.of(np.asarray(sample.wavelengths)), values, source)


def _materials(group: str, samples: Mapping[str, Any], source: str) -> list[LibraryMaterial]:
    """A set of samples by their names."""
    named = ((given.partition(" (")[0].lower(), sample) for given, sample in samples.items())
    return [
        _material(f"{group}/{name}", sample, source)
        for name, sample in named
        if not any(word in name for word in _LEFT_OUT)
    ]


def _numbered(group: str, samples: Iterable[Any], source: str) -> Iterator[LibraryMaterial]:
    """A set of samples by their colours and numbers."""
    for number, sample in enumerate(samples, 1):
        found = _material("", sample, source)
        yield replace(found, name=f"{group}/{_colour_in_words(found.reflectance, found.bands)} {number}")


def _colour_in_words(reflectance: Float64[np.ndarray, " B"], bands: Bands) -> str:
    """What a surface looks like in even light, as in `dark greyish blue`."""
    lightness, a, b = reflectance_to_lab(reflectance, np.ones(len(bands)), bands)
    chroma = np.hypot(a, b)
    tone = "dark " if lightness < 40 else "light " if lightness > 70 else "strong " if chroma > 55 else ""
    if chroma < 7:
        return f"{tone}grey"
    hue = (np.degrees(np.arctan2(b, a)) - 8.0) % 360.0 + 8.0
    word = _HUES[int(np.searchsorted(_HUE_BOUNDS_DEG, hue))]
    if word == "orange" and lightness < 60 and chroma < 55:
        word = "brown"
    return f"{tone}{'greyish ' if chroma < 20 else ''}{word}"


def _without_flat_ends(material: LibraryMaterial) -> LibraryMaterial:
    changes = np.flatnonzero(np.diff(material.reflectance))
    inside = slice(changes[0], changes[-1] + 2)
    bands = Bands.of(material.bands.centers_nm[inside])
    return replace(material, bands=bands, reflectance=material.reflectance[inside])


def _last_part(name: str) -> str:
    return name.casefold().rpartition("/")[2]
