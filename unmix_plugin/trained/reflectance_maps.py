"""Outputs made of the reflectance of what is seen, one number a pixel: spectral indices, scores of a target, nearest
spectra of a library, absorptions.

Reflectance is radiance over the light that the scene was recorded in; where that is unknown, radiance stands for it,
and the description of the output says so. A pixel in which hardly anything is, or whose number is undefined, is NaN.

Notation: `B` bands, `N` pixels, `*rays` any leading axes.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.outputs import OutputKind, with_remarks
from unmix_plugin.errors import ConfigError, SpectrumError, counted
from unmix_plugin.figures.plotting import distinct_colours, own_colours
from unmix_plugin.formats.libraries import library_of, read_library
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.features import AbsorptionMeasure, absorption
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.spectral.maps.indices import parse_index
from unmix_plugin.spectral.maps.targets import parse_target
from unmix_plugin.spectral.segmentation import NOTHING_ID

Score: TypeAlias = Callable[[Float[Tensor, "*rays B"]], Tensor]
"""From reflectances to (*rays) numbers; uint8 ids for labels."""


@dataclass(frozen=True)
class ReflectanceMap:
    """An index, a target, an absorption or what is nearest in a library, for given bands."""

    label: str
    """What its numbers are."""
    usual_range: tuple[float, float] | None
    """What pictures show; None: whatever range there is."""
    fit: Callable[[Float[Tensor, "N B"]], Score]
    """From the reflectances of what else there is in the views to the numbers, which may be judged against them."""
    kind: OutputKind = "map"
    classes: tuple[tuple[str, tuple[float, ...]], ...] = ()
    """Names of ids and their sRGB colours, where the numbers are ids."""
    remarks: tuple[str, ...] = ()
    """What else is to be known of them, for people."""

    is_local: bool = True
    """Whether a pixel's number follows from its own spectrum alone, whatever it might be judged against."""

    @property
    def what(self) -> str:
        """What its numbers are, in one line for people."""
        return with_remarks(self.label, self.remarks)


def is_reflectance_map(name: str) -> bool:
    """Whether an output is one of these.

    >>> is_reflectance_map("index:ndvi"), is_reflectance_map("band:650nm")
    (True, False)
    """
    return name.partition(":")[0] in _PARSERS


def parse_reflectance_map(name: str, bands: Bands, lit: Bool[Tensor, "B"] | None = None) -> ReflectanceMap:
    """What an output such as `index:ndvi`, `target:ace:paint.csv>0.5`, `library:mine.csv<0.1` or
    `absorption:centre:650-700` is.

    Targets, libraries and absorptions are made of the bands with light alone (`lit`; None: all), and say so.

    Raises:
        ConfigError: an unknown index, or a formula, a threshold or wavelengths that can't be read.
        SpectrumError: the bands, or those with light, do not cover what it needs, or a file that can't be read.
    """
    kind, _, argument = name.partition(":")
    is_lit = np.ones(len(bands), dtype=np.bool_) if lit is None else lit.cpu().numpy()
    if kind != "index" and not is_lit.any():
        raise SpectrumError(f"{name}: the light has no power in any of the {bands}")
    return _PARSERS[kind](argument, bands, is_lit)


def _left_out(lit: Bool[np.ndarray, " some"]) -> tuple[str, ...]:
    """What is to be said of bands that are left out for lack of light."""
    dark = len(lit) - int(lit.sum())
    return (f"{dark} of {counted(len(lit), 'band')} left out: no light",) if dark else ()


def _index(argument: str, bands: Bands, _: Bool[np.ndarray, " B"]) -> ReflectanceMap:
    index = parse_index(argument, bands)
    return ReflectanceMap(index.title, index.usual_range, lambda _: index, remarks=index.remarks)


def _target(argument: str, bands: Bands, lit: Bool[np.ndarray, " B"]) -> ReflectanceMap:
    """`[METHOD:]FILE[#NAME][<VALUE or >VALUE]`."""
    chosen = np.flatnonzero(lit)
    target = parse_target(argument, Bands(bands.centers_nm[chosen]), read_library)

    def fit(background: Float[Tensor, "N B"]) -> Score:
        score = target.fit(background[:, chosen])
        return lambda spectra: score(spectra[..., chosen])

    return ReflectanceMap(target.what, target.usual_range, fit, remarks=_left_out(lit), is_local=False)


_LIBRARY = re.compile(r"(?P<angle>angle:)?(?P<file>.+?)\s*(<\s*(?P<limit>\d+\.?\d*|\.\d+)\s*)?", re.DOTALL)
_LARGEST_ANGLE_RAD = 0.1
"""Beyond it nothing counts as alike if no other threshold is asked for; the usual one of spectral angle mappers."""


def _library(argument: str, bands: Bands, lit: Bool[np.ndarray, " B"]) -> ReflectanceMap:
    """`[angle:]FILE[<LIMIT]`: which spectrum of a library is nearest, or the angle to it."""
    match = _LIBRARY.fullmatch(argument)
    if match is None:
        raise ConfigError(
            f"library:{argument} must be library:[angle:]FILE[<RADIANS], as in library:mine.csv<0.1"
        )
    file, limit = match["file"], float(match["limit"] or _LARGEST_ANGLE_RAD)
    if not Path(file).exists() and not file.startswith("+"):
        raise ConfigError(f"there is no file or folder {file} with a library")
    library, name = library_of([Path(file)], bands, lit.astype(np.float64)), Path(file).name
    if match["angle"]:
        if match["limit"]:
            raise ConfigError(
                f"library:{argument}: the angle itself takes no threshold; leave out <{match['limit']}"
            )
        what = f"spectral angle in radians to the nearest spectrum of {name}: 0 = the same but for brightness"
        return ReflectanceMap(
            what,
            (0.0, 0.5),
            lambda _: lambda spectra: _nearest(library, bands, lit, spectra)[0],
            remarks=_left_out(lit),
        )
    if not 0 < limit <= np.pi:
        raise ConfigError(f"library:{argument}: the largest angle must lie between 0 and {np.pi:.4g} rad")
    if len(library.names) > NOTHING_ID:
        raise ConfigError(
            f"library:{file} has {len(library.names)} spectra; a map has room for {NOTHING_ID}: choose fewer"
        )

    def ids(spectra: Float[Tensor, "*rays B"]) -> Tensor:
        angles, nearest = _nearest(library, bands, lit, spectra)
        return torch.where(angles <= limit, nearest, NOTHING_ID).to(torch.uint8)

    looks = torch.from_numpy(np.nan_to_num(library.resampled(bands)))
    colours = distinct_colours(own_colours(looks, bands))
    classes = tuple(
        (name, tuple(colour)) for name, colour in zip(library.names, colours.tolist(), strict=True)
    )
    what = f"nearest spectrum of {name} by its number"
    remarks = (f"{NOTHING_ID} where none is within {limit:g} rad", *_left_out(lit))
    return ReflectanceMap(what, None, lambda _: ids, "labels", classes, remarks)


def _nearest(
    library: MaterialLibrary, bands: Bands, lit: Bool[np.ndarray, " B"], spectra: Float[Tensor, "*rays B"]
) -> tuple[Float[Tensor, "*rays"], Tensor]:
    """Angle to the nearest spectrum of a library, NaN where there is none, and its number."""
    rows = spectra.reshape(-1, len(bands)).double().cpu().numpy()
    lit = lit & np.isfinite(rows).any(axis=0)
    angles, _ = library.angles(np.where(lit, rows, 0.0), bands, lit.astype(np.float64))
    least = torch.from_numpy(np.nan_to_num(angles, nan=np.inf)).min(dim=1)
    values = torch.where(least.values.isfinite(), least.values, torch.nan)
    shape = spectra.shape[:-1]
    return values.to(spectra).reshape(shape), least.indices.to(spectra.device).reshape(shape)


_ABSORPTION = re.compile(
    r"((?P<measure>depth|centre|center|area):)?\s*(?P<low>\d+(\.\d+)?)\s*-\s*(?P<high>\d+(\.\d+)?)\s*(nm)?"
)
_MEASURES: dict[str, tuple[AbsorptionMeasure, str]] = {
    "depth": ("depth", "depth of the deepest absorption below the continuum"),
    "centre": ("centre", "wavelength in nm at which the deepest absorption is deepest"),
    "center": ("centre", "wavelength in nm at which the deepest absorption is deepest"),
    "area": ("area", "area in nm between the continuum and the spectrum divided by it"),
}


def _absorption(argument: str, bands: Bands, lit: Bool[np.ndarray, " B"]) -> ReflectanceMap:
    """`[depth|centre|area:]LOW-HIGH`, wavelengths in nm."""
    match = _ABSORPTION.fullmatch(argument.strip())
    if match is None:
        raise ConfigError(
            f"absorption:{argument} must be absorption:[depth|centre|area:]LOW-HIGH in nm, as in "
            "absorption:centre:2150-2250"
        )
    low, high = float(match["low"]), float(match["high"])
    within = (bands.centers_nm >= low) & (bands.centers_nm <= high)
    chosen = np.flatnonzero(within & lit)
    seen = Bands(bands.centers_nm[lit], None if bands.fwhm_nm is None else bands.fwhm_nm[lit])
    if low >= high or not seen.contains(low, up_to_nm=high) or len(chosen) < 3:
        with_light = "" if lit.all() else " with light"
        raise SpectrumError(
            f"absorption:{argument} needs three bands or more{with_light} from {low:g} to {high:g} nm, all of it "
            f"covered; found {len(chosen)} of {bands}, which cover {seen.coverage}"
        )
    measure, what = _MEASURES[match["measure"] or "depth"]
    window = bands.centers_nm[chosen]
    usual = (low, high) if measure == "centre" else None

    def score(spectra: Float[Tensor, "*rays B"]) -> Tensor:
        return absorption(spectra[..., chosen], window, measure).to(spectra.dtype)

    remarks = (f"{low:g} to {high:g} nm", *_left_out(lit[within]))
    return ReflectanceMap(what, usual, lambda _: score, remarks=remarks)


_PARSERS: dict[str, Callable[[str, Bands, Bool[np.ndarray, " B"]], ReflectanceMap]] = {
    "index": _index,
    "target": _target,
    "library": _library,
    "absorption": _absorption,
}
"""By the part of the name before the colon."""
