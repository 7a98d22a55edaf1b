"""How long views and their references were exposed, and what values are brought to.

The exposure of a file is its time times the gain, over the square of the f-number: what the numbers of one scene grow
with. A factor that one file states and another lacks is taken for 1 nowhere without a warning.

Notation: `b` is 1, or the bands of a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.calibration.references import finished_by
from unmix_plugin.captures.cube import Cube
from unmix_plugin.captures.report import Code, Remark


def exposure_of(file: Cube, to_light: bool = True) -> Float64[np.ndarray, " b"] | None:
    """Exposure time times gain, and over the square of the f-number if that is known, one number or one a band; None
    where the file does not say the time.

    Args:
        to_light: Whether the aperture counts, which lets in light but no dark current.
    """
    time, gain, f_number = file.exposure.time, file.exposure.gain, file.exposure.f_number
    factors = [np.array(factor.numbers) for factor in (time, gain) if factor is not None]
    if time is None or any(len(factor) not in (1, file.shape[2]) for factor in factors):
        return None
    exposure = np.multiply.reduce(np.broadcast_arrays(*factors))
    exposure = exposure if f_number is None or not to_light else exposure / f_number**2
    return exposure if np.isfinite(exposure).all() and (exposure > 0).all() else None


@dataclass(frozen=True)
class ExposedFiles:
    """Files whose exposures are compared: of one sensor, or one file of each of several."""

    views: Sequence[Cube]
    """At least one."""
    whites: Sequence[Cube] = ()
    """References of all views, or one a view."""
    darks: Sequence[tuple[Cube, Cube]] = ()
    """Each dark frame with a view or a white that it is subtracted from."""
    is_srgb: bool = False
    """Whether the files are pictures for people, in which twice the exposure is not twice the number."""
    may_be_reflectance: bool = False
    """Whether values look like reflectances, which nothing is divided by but a reference."""

    @cached_property
    def known(self) -> list[Float64[np.ndarray, " b"]]:
        """Exposures of the views that state one."""
        return [exposure for file in self.views if (exposure := exposure_of(file)) is not None]

    @cached_property
    def of_whites(self) -> list[Float64[np.ndarray, " b"]]:
        """Exposures of the white references that state one."""
        return [exposure for file in self.whites if (exposure := exposure_of(file)) is not None]

    @property
    def stating(self) -> list[Cube]:
        """Views and whites that state an exposure."""
        return [file for file in (*self.views, *self.whites) if exposure_of(file) is not None]

    @property
    def differ(self) -> bool:
        """Whether the views were exposed differently, or their bands."""
        return len({tuple(one) for one in self.known}) > 1 or any(len(one) > 1 for one in self.known)

    @property
    def range_and_unit(self) -> dict[str, str]:
        """The exposures of the views, for sentences."""
        return {"exposed": _range(self.known), "unit": _unit(self.stating)}

    def lacking(self, factor: Literal["gain", "f_number"]) -> list[Cube]:
        """Files without a factor of the exposure that others of those with a time state."""
        without = [file for file in self.stating if getattr(file.exposure, factor) is None]
        return without if len(without) < len(self.stating) else []


@dataclass(frozen=True)
class ComparedExposures:
    """What exposures were found, and what follows."""

    common: Float64[np.ndarray, " b"] | None = None
    """What all views are brought to: the exposure of the white reference, otherwise of the first view; None where
    exposures are not compared."""
    remarks: tuple[Remark, ...] = ()


def compare_exposures(files: ExposedFiles) -> ComparedExposures:
    """What the views are brought to, and what may be wrong with that."""
    finished = [finished_by(file, by_name=not files.whites) for file in files.views]
    if None not in finished and not files.is_srgb:
        kept = Remark.of(Code.EXPOSURE_COUNTED_BEFORE, **files.range_and_unit, source=finished[0])
        return ComparedExposures(None, (kept,) if files.differ else ())
    misfits = _misfits(files)
    doubts = _missing_units((*files.views, *files.whites)) + misfits
    why = _why_not(files, bool(misfits))
    if why is not None:
        return ComparedExposures(None, (*doubts, *why))
    if files.known and len(files.of_whites) < len(files.whites) and not misfits:
        doubts.append(Remark.of(Code.WHITE_EXPOSURE_UNKNOWN, **files.range_and_unit))
    if lacking := files.lacking("gain"):
        doubts.append(Remark.of(Code.GAIN_TAKEN_AS_ONE, lacking=[file.path.name for file in lacking]))

    # A dark frame should be exposed as what it is subtracted from.
    pairs = [(exposure_of(dark, False), exposure_of(other, False)) for dark, other in files.darks]
    unlike = [(a, b) for a, b in pairs if a is not None and b is not None and not np.array_equal(a, b)]
    if unlike:
        of_darks, of_others = (_range(exposures) for exposures in zip(*unlike, strict=True))
        unit = _unit([file for pair in files.darks for file in pair], to_light=False)
        facts = {"of_dark": of_darks, "of_others": of_others, "unit": unit}
        doubts.append(Remark.of(Code.DARK_EXPOSED_OTHERWISE, **facts))

    common, of_whom = np.median(files.known[0], keepdims=True), "the first view"
    if files.of_whites:
        common, of_whom = files.of_whites[0], f"{'the' if len(files.whites) == 1 else 'its'} white reference"
    if len({tuple(exposure) for exposure in [*files.known, *files.of_whites, common]}) > 1:
        to = _range(files.of_whites or [common])
        doubts.append(Remark.of(Code.EXPOSURES_EVENED, **files.range_and_unit, whose=of_whom, common=to))
    return ComparedExposures(common, tuple(doubts))


def _why_not(files: ExposedFiles, has_misfits: bool) -> list[Remark] | None:
    """Why exposures are not compared, or nothing where that does no harm; None where they are."""
    missing = len(files.views) - len(files.known)
    if missing:
        is_partial = bool(files.known or files.of_whites) and not has_misfits
        return [Remark.of(Code.EXPOSURE_UNKNOWN, missing=missing)] if is_partial else []
    gains = {file.exposure.gain.numbers for file in files.stating if file.exposure.gain is not None}
    unknown = {"f-number of the lens": files.lacking("f_number")}
    unknown |= {"gain": files.lacking("gain")} if gains != {(1.0,)} else {}
    for name, lacking in unknown.items():
        if lacking:
            names = [file.path.name for file in lacking]
            return [Remark.of(Code.EXPOSURE_FACTOR_UNKNOWN, factor=name, lacking=names)]
    if files.is_srgb:
        return [Remark.of(Code.EXPOSURES_OF_PICTURES, **files.range_and_unit)] if files.differ else []
    if files.may_be_reflectance and files.differ and not (files.whites or files.darks):
        return [Remark.of(Code.EXPOSURES_OF_REFLECTANCES, **files.range_and_unit)]
    return None


def _unit(files: Sequence[Cube], to_light: bool = True) -> str:
    """What is counted: only that which some file states."""
    gain = any(file.exposure.gain is not None for file in files)
    aperture = any(file.exposure.f_number is not None for file in files)
    return f"s{' times gain' * gain}{' over the square of the f-number' * (aperture and to_light)}"


def _range(exposures: Iterable[Float64[np.ndarray, " _"]]) -> str:
    """The range of exposures in words; empty where there are none.

    >>> _range([np.array([0.01]), np.array([0.02])])
    '0.01 to 0.02'
    """
    every = [*exposures]
    if not every:
        return ""
    low, high = np.concatenate(every).min(), np.concatenate(every).max()
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _misfits(files: ExposedFiles) -> list[Remark]:
    """A warning where exposures are neither one number nor one a band, unless a white has the same ones."""
    every = (*files.views, *files.whites)
    stated = {
        tuple(factor and factor.numbers for factor in (file.exposure.time, file.exposure.gain))
        for file in every
    }
    if files.whites and len(stated) == 1:
        return []
    found: dict[str, tuple[int, int]] = {}
    for file in every:
        time, gain = file.exposure.time, file.exposure.gain
        sizes = {len(factor.numbers) for factor in (time, gain) if factor is not None}
        if (odd := sizes - {1, file.shape[2]}) and time is not None:
            found[file.path.name] = max(odd), file.shape[2]
    if not found:
        return []
    numbers = " or ".join(str(size) for size in sorted({size for size, _ in found.values()}))
    bands = next(iter(found.values()))[1]
    return [Remark.of(Code.EXPOSURES_MISFIT, [*found], numbers=numbers, bands=bands)]


def _missing_units(files: Iterable[Cube]) -> list[Remark]:
    """Warnings where units are missing and matter."""
    exposures = [file.exposure for file in files if file.exposure.time is not None]
    times = {one.time for one in exposures if one.time is not None and one.time.source}
    gains = {one.gain for one in exposures if one.gain is not None and one.gain.source}
    has_some_units = any(time.assumed for time in times) and not all(time.assumed for time in times)
    gains_differ = len({(1.0,) if one.gain is None else one.gain.numbers for one in exposures}) > 1
    remarks = []
    for name, factors, matters in (
        ("exposure times", times, has_some_units),
        ("gains", gains, gains_differ and any(gain.assumed for gain in gains)),
    ):
        if matters:
            sources = "; ".join(sorted({factor.description for factor in factors}))
            remarks.append(Remark.of(Code.EXPOSURE_UNITS_MISSING, factor=name, sources=sources))
    return remarks
