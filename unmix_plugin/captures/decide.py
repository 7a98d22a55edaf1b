"""What is concluded from samples of the views: where the detector ends, what values are, what is written as 1, and what
is background. Nothing is read here. Which bands are kept, `calibration/bands.py` says; what exposures are brought to,
`calibration/exposures.py`.

Notation: `N` and `M` sampled pixels, `B` bands of the file, `c` bands of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.captures.calibration.calibration import BRIGHT_PERCENTILE, StoredCounts, WhiteSample
from unmix_plugin.captures.calibration.references import stated_reflectance
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
