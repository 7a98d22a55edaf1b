"""What is concluded from samples of the views: where the detector ends, what exposures are brought to, what values are,
what is written as 1, and what is background. Nothing is read here. Which bands are kept, `calibration/bands.py` says.

Notation: `N` and `M` sampled pixels, `B` bands of the file, `c` bands of the scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.calibration.calibration import BRIGHT_PERCENTILE, StoredCounts, WhiteSample
from unmix_plugin.captures.calibration.references import finished_by, stated_reflectance
from unmix_plugin.captures.camera_tags import radiometric_model
from unmix_plugin.captures.cube import Cube
from unmix_plugin.captures.options import MaskKind
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.spoilt import ViewPixels
from unmix_plugin.captures.writing.view_files import BackgroundRule
from unmix_plugin.engine.sampling import robust_deviation
from unmix_plugin.errors import CaptureError, ConfigError

_DETECTOR_ENDS = {2**bits - 1 for bits in (8, 10, 12, 14, 16)}
_LEAST_AT_TOP = 10
"""Values that must equal the greatest one before it counts as the detector's end."""
_CROWDING = 20.0
"""Values at the greatest one, against the mean number at each value a little below it."""
_NEAR_TOP, _MOST_CLIPPED = 0.99, 0.05
"""Share of the detector's end that means of lines reach where some are above it; share of a white reference's values at
that end from which a band is left out."""
_FAR_BRIGHTER, _LEAST_COMPARED, _MOST_USUAL = 1.5, 4, 0.75
"""Bright pixels of a view over those of most views, from which the scale does not follow it; views that it takes; and
the share of them that must not be so."""
_MOST_REFLECTANCE = 1.5
"""Of bright pixels with highlights."""
MOST_ABOVE_ONE = 0.01
"""Share of reflectances above 1 that is still taken for highlights."""
_MOST_BEYOND, _HEADROOM = 1.25, 1.02
"""The brightest sampled value over the bright percentile up to which there are no glints; and what is left above the
brightest, as not all pixels are sampled."""
LEAST_BRIGHT = 0.05
"""Bright values below this would lose digits if they were kept."""
_MOST_BELOW, _LEAST_LEVEL, _PILED_UP = 0.02, 0.005, 0.84
"""Share of a band's values below 0, and their mean over what is bright and over their root mean square, above which a
level was taken off: of noise around black the last is 0.8, of a level 1."""
_DEVIATIONS = 6.0
"""Standard deviations of the background's noise between its level and the threshold."""
_LEAST_DISTANCE = 0.02
"""Between level and threshold, as a share of the brightest pixels; JPEG and shading vary a background by about this."""
_LEAST_WHITE, _MOST_BLACK = 0.5, 0.2
"""Level of a white or black background, as a share of the brightest pixels."""
_BRIGHTEST_PERCENTILE = 99.0


@dataclass(frozen=True)
class Saturation:
    """Stored number from which a pixel is saturated; None where none is known."""

    stored: float | None
    reason: str
    """For people."""


def find_saturation(found: StoredCounts) -> Saturation:
    """Where a detector ends, from a plateau at the greatest number."""
    if not found.num_pixels:
        return Saturation(None, "none: no sampled pixel has a measurement")
    if not found.num_bands:
        return Saturation(None, "none: every band has one value only")
    if not found.are_whole:
        numbers = f"not all numbers ({found.dtype.name}) are whole ones from 0 to {found.highest}"
        return Saturation(None, f"none: {numbers}")
    counts = found.counts
    top = int(np.flatnonzero(counts)[-1]) if counts.any() else 0
    number = top + found.lowest
    below = counts[max(0, top - max(1, number // 50)) : top]
    at_top, usual = int(counts[top]), float(below.mean()) if len(below) else 0.0
    if at_top >= _LEAST_AT_TOP and (at_top > _CROWDING * usual or number in _DETECTOR_ENDS):
        return Saturation(float(number), f"{at_top} sampled values are {number}, none is greater")
    greatest = f"the greatest sampled value is {number}"
    if found.is_wide:
        return Saturation(None, f"none: no plateau in {found.dtype.name}; {greatest}")
    return Saturation(float(found.highest), f"no plateau below the end of {found.dtype.name}; {greatest}")


def saturated_bands(white: WhiteSample, saturation: float | None) -> Bool[np.ndarray, " B"]:
    """Bands in which a white reference is at the end of the detector, where reflectances would come out too high.

    It may reach that end where no posed view does, and then shows it by many numbers that are exactly there. Columns
    count by their means, too: software that averages lines leaves none exactly there.
    """
    known = white.is_measured
    if saturation is None or not known.any():
        return np.zeros(white.stored.shape[2], bool)
    lines = np.where(known[..., None], white.stored, 0)
    stored, end = lines[known], saturation
    if white.stored.dtype.kind in "iu" and int(stored.max()) in _DETECTOR_ENDS:
        end = min(end, float(stored.max()))
    means = lines.sum(axis=0, dtype=np.float64) / np.maximum(known.sum(axis=0), 1)[:, None]
    is_near = (means >= _NEAR_TOP * saturation).mean(axis=0) > _MOST_CLIPPED
    return is_near | ((stored >= end).mean(axis=0) > _MOST_CLIPPED)


# What exposures are brought to: where one file states a factor that another lacks, it is taken for 1 nowhere without a
# warning. `b` is 1, or the bands of a file.


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
        return [exposure for file in self.views if (exposure := file.total_exposure()) is not None]

    @cached_property
    def of_whites(self) -> list[Float64[np.ndarray, " b"]]:
        """Exposures of the white references that state one."""
        return [exposure for file in self.whites if (exposure := file.total_exposure()) is not None]

    @property
    def stating(self) -> list[Cube]:
        """Views and whites that state an exposure."""
        return [file for file in (*self.views, *self.whites) if file.total_exposure() is not None]

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
    pairs = [
        (dark.total_exposure(to_light=False), other.total_exposure(to_light=False))
        for dark, other in files.darks
    ]
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


# What values are, and what is written as 1.


@dataclass(frozen=True)
class ValueMeaning:
    """What the calibrated values of a sensor are."""

    description: str
    """For people: reflectance, relative radiance, ..."""
    has_one: bool
    """Whether 1 means something: full reflectance, or what the files themselves take for 1."""
    states_one: bool
    """Whether a white reference or the files say what 1 is, which dividing values loses."""
    is_reflectance: bool
    """Whether values are reflectances, of which 1 is a white: by a white reference, or as the files say."""


def find_meaning(files: Sequence[Cube], has_white: bool) -> ValueMeaning:
    """What the values of a sensor's files are, perhaps divided by a white reference."""
    first, model = files[0], radiometric_model(files[0])
    # Floating-point numbers may have been brought to what stands for 1 already.
    has_one = first.is_srgb or first.linear is not None or (first.dtype.kind == "f" and model is None)
    sources = [stated_reflectance(file) for file in files]
    source = None if None in sources else sources[0]
    if has_white:
        return ValueMeaning("reflectance", has_one=True, states_one=True, is_reflectance=True)
    states_one = model is None and first.linear is not None and first.linear.scale is not None
    states_one |= has_one and stated_reflectance(first, by_name=False) is not None
    is_reflectance = has_one and source is not None
    if first.is_srgb:
        description = "linear light of pictures in sRGB"
    elif source is not None:
        description = f"{'' if has_one else 'relative '}reflectance, as {source} says"
    elif model is not None:
        description = model.description
    elif first.linear is None:
        description = "relative radiance"
    elif first.linear.scale is not None:
        description = "stored numbers divided by the scale factor of the files"
    else:
        description = f"stored numbers times a gain plus an offset ({first.linear.source})"
    return ValueMeaning(description, has_one, states_one, is_reflectance)


def may_be_reflectance(file: Cube, bright: Sequence[float]) -> bool:
    """Whether the values of files like this one were brought to what stands for 1, perhaps.

    Args:
        bright: Values of bright pixels of some files.
    """
    can_be = file.dtype.kind == "f" or file.linear is not None
    return can_be and len(bright) > 0 and 0.0 < float(np.median(bright)) <= _MOST_REFLECTANCE


def usual_pixels(views: Sequence[ViewPixels], bands: Bool[np.ndarray, " B"]) -> Bool[np.ndarray, " N"] | None:
    """Which pixels are of views whose bright pixels are not far brighter than those of most; None if all are."""
    values = [view.values[:, bands] for view in views]
    bright = [np.percentile(one, BRIGHT_PERCENTILE) if one.size else np.nan for one in values]
    is_usual = ~(np.array(bright) > _FAR_BRIGHTER * np.nanmedian(bright))
    if is_usual.all() or len(views) < _LEAST_COMPARED or is_usual.mean() < _MOST_USUAL:
        return None
    return np.repeat(is_usual, [len(one) for one in values])


@dataclass(frozen=True)
class Scale:
    """Calibrated value that is written as 1."""

    value: float
    reason: str
    """For people."""
    is_given: bool = False
    """Whether the user names it."""


def choose_scale(
    meanings: Sequence[ValueMeaning], values: Float32[np.ndarray, " N"], given: float | None
) -> Scale:
    """The scale of all views.

    Reflectances, and values of files that say what stands for 1, are kept unless many are above 1 or all are small;
    others are divided by a high percentile.

    Args:
        meanings: Of each sensor.
        values: Sampled values of all sensors, of views that are not far brighter than most.
        given: What the user names.
    Raises:
        CaptureError: nothing in the sampled pixels is above 0.
        ConfigError: the given scale is not above 0.
    """
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise ConfigError(f"--scale {given:g}: expected a number above 0, what is written as 1")
        return Scale(given, "given with --scale", is_given=True)
    bright = float(np.percentile(values, BRIGHT_PERCENTILE)) if len(values) else 0.0
    if not bright > 0:
        raise CaptureError(
            f"{BRIGHT_PERCENTILE:g} % of the calibrated values are not above 0 (up to {values.max(initial=0):g}); "
            "check the dark frame: is it as bright as the views?"
        )
    above = float((values > 1.0).mean())
    if all(one.has_one for one in meanings) and above <= MOST_ABOVE_ONE and bright >= LEAST_BRIGHT:
        kept = f"values are kept ({meanings[0].description}); {above:.2%} of the sampled ones are above 1"
        return Scale(1.0, kept)
    if (brightest := float(values.max())) <= _MOST_BEYOND * bright:  # no glints, which would darken the rest
        return Scale(float(f"{_HEADROOM * brightest:.4g}"), "a little more than the brightest sampled value")
    return Scale(float(f"{bright:.4g}"), f"the {BRIGHT_PERCENTILE:g}th percentile of the sampled values")


def is_below_black(sample: Float32[np.ndarray, "N c"]) -> bool:
    """Whether values pile up below 0 in half of the bands that have many there."""
    below = np.clip(-sample.astype(np.float64), 0.0, None)
    count, total = (below > 0).sum(axis=0), below.sum(axis=0)
    judged = count > max(100, _MOST_BELOW * len(sample))
    bright = np.percentile(sample, BRIGHT_PERCENTILE, axis=0)[judged]
    count, total, below = count[judged], total[judged], below[:, judged]
    piled = total > _PILED_UP * np.sqrt(count * (below**2).sum(axis=0))
    return bool(judged.any()) and bool(np.mean(piled & (total > _LEAST_LEVEL * bright * count)) >= 0.5)


# What is background: files of the capture say it, or it is white or black, or a backdrop that nobody has named.


def choose_mask(
    asked: MaskKind, views: Sequence[str], without: Sequence[str], is_rig: bool
) -> tuple[MaskKind, list[Remark]]:
    """What tells foreground from background, `auto` where files don't, and what a user should know of it.

    Args:
        views: Names of all views.
        without: Of those without an alpha channel or, where it is asked for, a mask.
        is_rig: Whether lenses of a rig took them. What these see from above is ground: a field or water is as plain as
            a backdrop and is the scene, so that their views are left whole.
    Raises:
        CaptureError: opacity is asked of files that some views don't have.
    """
    if asked not in ("auto", "files"):
        return asked, []
    if not without:
        return "files", []
    if asked == "files":
        raise CaptureError(
            f"--mask files: view {without[0]} has no mask; expected an alpha channel, or a mask that is white where "
            "the foreground is, for every view"
        )
    otherwise: MaskKind = "none" if is_rig else "auto"
    if len(without) == len(views):
        return otherwise, []
    has = "has" if len(without) == 1 else "have"
    return otherwise, [Remark.of(Code.OPACITY_OF_SOME, without, views=len(views), has=has)]


def background_rule(
    kind: Literal["white", "black"], border: Float32[np.ndarray, "M c"], sample: Float32[np.ndarray, "N c"]
) -> BackgroundRule:
    """The rule that fits the border of the views, beside a sample of all their pixels: the border tells how bright a
    background is and how much it varies, and a threshold between it and the rest follows. Raises CaptureError: most of
    the border is not of this kind."""
    brightness = BackgroundRule.brightness(kind, border)
    everywhere = np.concatenate([BackgroundRule.brightness(kind, sample), brightness])
    brightest = float(np.percentile(np.clip(everywhere, 0.0, 1.0), _BRIGHTEST_PERCENTILE))
    level = float(np.median(brightness))
    deviation = float(robust_deviation(brightness))
    distance = max(_DEVIATIONS * deviation, _LEAST_DISTANCE * brightest)
    share = level / brightest if brightest > 0 else 0.0
    if (kind == "white" and share < _LEAST_WHITE) or (kind == "black" and share > _MOST_BLACK):
        expected = f"more than {_LEAST_WHITE:.0%}" if kind == "white" else f"less than {_MOST_BLACK:.0%}"
        raise CaptureError(
            f"--mask {kind}: the border of the views is at {share:.0%} of the brightest pixels; expected {expected}, "
            "as the background should reach to the border: choose another --mask"
        )
    threshold = level - distance if kind == "white" else level + distance
    return BackgroundRule(kind, threshold, level, deviation)
