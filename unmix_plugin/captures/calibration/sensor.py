"""All decisions on one sensor, taken before a view is written: bands, references, saturation, scale.

A cheap look at some rows of every view tells where the detector ends, which bands are bad, and how bright it is.

Notation: `N` sampled pixels, `B` bands of the file, `c` bands of the scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped

from unmix_plugin.captures.calibration.calibration import Calibration, Raster
from unmix_plugin.captures.calibration.exposures import ExposedFiles, compare_exposures
from unmix_plugin.captures.calibration.references import (
    Reference,
    References,
    find_missing,
    find_references,
    stated_reflectance,
    stated_values,
)
from unmix_plugin.captures.camera_tags import radiometric_model
from unmix_plugin.captures.cube import MOST_WIDTH, BandIndex, CaptureView, Cube
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.spoilt import ViewPixels, judge_values
from unmix_plugin.captures.wavelengths import in_ranges
from unmix_plugin.errors import CaptureError

_ROWS_A_VIEW = 12
_MOST_ALIKE = 4
"""Views that are looked at for bands with one value only."""
_MOST_PIXELS = 20000
"""Of all views together."""
_DETECTOR_BITS = (8, 10, 12, 14, 16)
_LEAST_AT_TOP = 10
"""Values that must equal the greatest one before it counts as the detector's end."""
_CROWDING = 20.0
"""Values at the greatest one, against the mean number at each value a little below it."""
_MOST_SATURATED = 0.2
"""Share of sampled values by which a band may be saturated more than bands usually are."""
_MOST_NOISY = 0.5
"""Share of bands that may be left out for their noise."""
_MOST_SATURATED_WHITE = 0.5
"""Share of a white reference's values at the detector's top at which it can't serve."""
_NEAR_TOP, _MOST_CLIPPED = 0.99, 0.05
"""Share of the detector's end that means of lines reach where some are above it; share of a white reference's values at
that end from which a band is left out."""
_GAP, _LEFT_OUT = 3.0, 2.5
"""Between neighbouring bands, as a multiple of the steps beside it, above which bands are missing in the file itself,
and above which a range was left out: one band that is left out makes two steps of one, two make three."""
_LEAST_WHITE = 0.01
"""Signal of the white reference in a band, as a share of the greatest, below which the band is too dark."""
BRIGHT_PERCENTILE, _FEW_PERCENTILE = 99.9, 5.0
_FAR_BRIGHTER, _LEAST_COMPARED, _MOST_USUAL = 1.5, 4, 0.75
"""Bright pixels of a view over those of most views, from which the scale does not follow it; views that it takes; and
the share of them that must not be so."""
_MOST_REFLECTANCE = 1.5
"""Of bright pixels with highlights."""


@dataclass(frozen=True)
class _BandChoice:
    """The bands of one sensor: in order of wavelength, without bad ones."""

    wavelengths_nm: Float64[np.ndarray, " B"]
    """Of all bands of the file."""
    dropped: dict[int, str]
    """Why bands are left out, by index."""

    @property
    def kept(self) -> np.ndarray:
        """Indices of the others, by rising wavelength."""
        order = np.argsort(self.wavelengths_nm, kind="stable")
        return order[[index not in self.dropped for index in order.tolist()]]

    def centers_nm(self, binning: int) -> Float64[np.ndarray, " c"]:
        """Wavelengths of the scene: means over binned bands."""
        return self.wavelengths_nm[self.kept].reshape(-1, binning).mean(axis=1)

    def without(self, marks: Bool[np.ndarray, " B"], reason: str) -> _BandChoice:
        """The choice without some more bands."""
        added = {int(index): reason for index in np.flatnonzero(marks)}
        return _BandChoice(self.wavelengths_nm, {**added, **self.dropped})

    def without_repeated(self) -> _BandChoice:
        """The choice without bands whose wavelength an earlier one that is kept has."""
        left = np.setdiff1d(np.arange(len(self.wavelengths_nm)), list(self.dropped))
        first = left[np.unique(self.wavelengths_nm[left], return_index=True)[1]]
        repeated = np.isin(np.arange(len(self.wavelengths_nm)), np.setdiff1d(left, first))
        return self.without(repeated, "an earlier band has the same wavelength")

    def without_incomplete_bins(self, binning: int) -> _BandChoice:
        """The choice without bands that fill no bin up to the next gap: a bin across a gap would stand for light that
        was not measured, such as that of bands in which air absorbs. Single bad bands, or those of a second detector
        between those of the first, leave no gap."""
        kept = self.kept
        own, others = self.wavelengths_nm[kept], self.wavelengths_nm[list(self.dropped)]
        steps_nm = np.diff(own)
        is_between = ((own[:-1, None] < others) & (others < own[1:, None])).any(axis=1)
        around = np.pad(steps_nm, 1, constant_values=np.nan)
        # Several ranges may be left out with few bands between them.
        widest_nm = np.where(
            is_between,
            _LEFT_OUT * np.fmin(around[:-2], around[2:]),
            _GAP * np.fmax(around[:-2], around[2:]),
        )
        marks = np.zeros(len(self.wavelengths_nm), bool)
        for run in np.split(kept, np.flatnonzero(steps_nm > widest_nm) + 1):
            marks[run[len(run) // binning * binning :]] = True
        return self.without(marks, f"too few up to a gap or the end for --bin-bands {binning}")

    def require(self, binning: int, where: str) -> None:
        """Refuse to go on with fewer bands than are averaged into one. Raises CaptureError: so few are left."""
        if len(self.kept) >= binning:
            return
        reasons = "; ".join(sorted(set(self.dropped.values())))
        advice = f"left out: {reasons}. Check dark and white, --drop-bands, --max-noise and --bin-bands"
        raise CaptureError(
            f"{where}: {len(self.kept)} of {len(self.wavelengths_nm)} bands are left, {binning} or more are needed; "
            + (advice if reasons else "lower --bin-bands")
        )


@dataclass(frozen=True)
class Sensor:
    """How all views of one lens or camera are calibrated, and why."""

    calibration: Calibration
    bands: _BandChoice
    unit: str
    """What values are: reflectance, relative radiance, ..."""
    is_absolute: bool
    """Whether 1 means something: full reflectance, or what the files themselves take for 1."""
    sample: Float32[np.ndarray, "N c"]
    """Calibrated pixels of all views, on the bands of the scene."""
    evidence: dict[str, Any]
    """What was decided and from what, for the record."""
    lamp: Float64[np.ndarray, " c"] | None = None
    """Light on the white panel as the detector sees it, greatest value 1."""
    remarks: tuple[Remark, ...] = ()
    left_out: Mapping[str, Remark] = field(default_factory=dict)
    """Views that nothing was decided from, as they are spoilt, and why."""
    is_usual: Bool[np.ndarray, " N"] | None = None
    """Sampled pixels of views that are not far brighter than most; None if all are."""
    is_stated: bool = False
    """Whether a white reference or the files say what 1 is, which dividing values loses."""
    is_reflectance: bool = False
    """Whether values are reflectances, of which 1 is a white: by a white reference, or as the files say."""
    saturated_from: float = np.inf
    """Calibrated value of nearly the darkest of sampled numbers that are saturated."""

    @property
    def usual_sample(self) -> Float32[np.ndarray, "M c"]:
        """The sample without views that are far brighter than most."""
        return self.sample if self.is_usual is None else self.sample[self.is_usual]

    @property
    def centers_nm(self) -> Float64[np.ndarray, " c"]:
        """Bands of the scene."""
        return self.bands.centers_nm(self.calibration.bin_bands)


def prepare_sensor(
    views: Sequence[CaptureView],
    options: ProcessOptions,
    references: tuple[Cube | None, Cube | None],
    all_views: Sequence[CaptureView],
    cameras: Mapping[str, PosedCamera] | None = None,
) -> Sensor:
    """Look at some rows of every view and decide how they are calibrated.

    Args:
        views: At least one; all have the same bands and size.
        references: Dark frame and white reference that the user names.
        all_views: With those that have no pose: one may show a panel.
        cameras: By view, if they are known.
    Raises:
        CaptureError: references don't fit, wavelengths are unknown, no band is left, or a file can't be read.
        ConfigError: an option does not fit the files.
    """
    files = [view.cube for view in views]
    first, binning = files[0], options.bin_bands
    model = radiometric_model(first)
    choice = _stated_bands(files, options)
    remarks: list[Remark] = []
    (dark, white), own = find_references(views, choice.wavelengths_nm, options, references, all_views)
    pairs = list(own.values()) or [(dark, white)]
    whites = [one for _, one in pairs if one is not None]
    if options.saturation is not None:
        saturation, how = options.saturation, "given with --saturation"
    elif model is not None:
        saturation, how = model.saturated, f"known of {model.maker}"
    else:
        saturation, how = _find_saturation(files, choice.kept)
    lamp = None
    for used in whites:
        lamp = used.signal / used.reflectance if lamp is None else lamp
        choice = _lit_bands(choice, used, saturation, remarks)
    choice.require(binning, str(first.path))
    exposure = None
    if model is None:  # a maker's calibration accounts for exposures already
        darks: list[tuple[Cube, Cube]] = []
        for file in files:
            its_dark, used = own.get(file.path, (dark, white))
            darks += [(its_dark.file, file)] if its_dark else []
            darks += [(used.dark.file, used.file)] if used and used.dark else []
        of_whites = [one.file for one in whites]
        exposed = ExposedFiles(files, of_whites, darks, first.is_srgb, may_be_reflectance(files))
        compared = compare_exposures(exposed)
        exposure = compared.common
        remarks += compared.remarks
    raster = Raster.of(first.shape[0], first.shape[1], options.crop, options.bin_pixels)
    calibration = Calibration(raster, choice.kept, 1, dark, white, saturation, exposure, own)
    drawn = _draw_sample(views, calibration)
    spoilt = judge_values(drawn, cameras)
    left_out = {name: remark for name, remark in spoilt.items() if name not in options.keep_view}
    drawn = [view for view in drawn if view.name not in left_out]
    sample = _pooled(drawn, first)
    choice = _drop_found(choice, sample, options.max_noise, remarks)
    choice = choice.without_incomplete_bins(binning)
    choice.require(binning, str(first.path))
    still_kept = np.isin(calibration.bands, choice.kept)
    at_end = sample[0][:, still_kept][sample[1][:, still_kept]]
    if lamp is not None:
        lamp = lamp[choice.kept].astype(np.float32).reshape(-1, binning).mean(axis=1).astype(np.float64)
        lamp = np.clip(lamp, 0.0, None) / lamp.max()
    # Floating-point numbers may have been brought to what stands for 1 already.
    has_one = first.is_srgb or first.linear is not None or (first.dtype.kind == "f" and model is None)
    linear = None if model is not None else first.linear
    states_one = linear is not None and linear.scale is not None
    states_one |= has_one and stated_reflectance(first, by_name=False) is not None
    said = [stated_reflectance(file) for file in files]
    finished = said[0] if None not in said else None
    evidence = {"saturation": {"stored": saturation, "evidence": how}}
    return Sensor(
        replace(calibration, bands=choice.kept, bin_bands=binning),
        choice,
        "reflectance" if whites else _unit(first, finished, has_one),
        bool(whites) or has_one,
        sample[0][:, still_kept].reshape(len(sample[0]), -1, binning).mean(axis=2),
        evidence | _evidence(views, choice, (dark, white), own),
        lamp,
        tuple(remarks),
        left_out,
        _of_usual_views(drawn, still_kept),
        bool(whites) or states_one,
        bool(whites) or (has_one and finished is not None),
        float(np.percentile(at_end, _FEW_PERCENTILE)) if len(at_end) else np.inf,
    )


def may_be_reflectance(files: Sequence[Cube]) -> bool:
    """Whether the values of sampled rows of most of some files were brought to what stands for 1, perhaps."""
    if files[0].dtype.kind != "f" and files[0].linear is None:
        return False
    bright = []
    for index in np.unique(np.linspace(0, len(files) - 1, min(len(files), _MOST_ALIKE + 1)).astype(int)):
        file = files[index]
        parts = [
            (_stored_pixels(file, row)[None], slice(row, row + 1)) for row in sampled_rows(file.shape[0])
        ]
        values = np.concatenate([stated_values(file, *part).ravel() for part in parts])
        bright += [float(np.percentile(values, BRIGHT_PERCENTILE))] if len(values) else []
    return len(bright) > 0 and 0.0 < float(np.median(bright)) <= _MOST_REFLECTANCE


def _stated_bands(files: Sequence[Cube], options: ProcessOptions) -> _BandChoice:
    """Bands that no file marks as bad, by the wavelengths of the first."""
    file = files[0]
    wavelengths = file.bands.wavelengths_nm
    if wavelengths is None:
        raise CaptureError(
            f"{file.path}: the wavelengths of its {file.shape[2]} bands are unknown ({file.bands.evidence}); give them "
            "with --wavelengths"
        )
    marks = [one.bands.bad for one in files if one.bands.bad is not None] or [
        np.zeros(len(wavelengths), bool)
    ]
    choice = _BandChoice(wavelengths, {}).without(np.any(marks, axis=0), "marked as bad in the file")
    broad = f"wider than {MOST_WIDTH:.0%} of its wavelength: too broad for one"
    choice = choice.without(file.bands.is_broad, broad).without_repeated()
    if options.drop_bands is not None:
        choice = choice.without(in_ranges(options.drop_bands, wavelengths), "named in --drop-bands")
    return choice


def _unit(file: Cube, finished: str | None, has_one: bool) -> str:
    """What values are without a white reference; `finished` is where all files say that they are reflectances."""
    if file.is_srgb:
        return "linear light of pictures in sRGB"
    if finished is not None:
        return f"{'' if has_one else 'relative '}reflectance, as {finished} says"
    model = radiometric_model(file)
    if model is not None:
        return model.description
    if file.linear is None:
        return "relative radiance"
    if file.linear.scale is not None:
        return "stored numbers divided by the scale factor of the files"
    return f"stored numbers times a gain plus an offset ({file.linear.source})"


def _evidence(
    views: Sequence[CaptureView], choice: _BandChoice, common: References, own: dict[Path, References]
) -> dict[str, Any]:
    """References, bands, and what sunshine sensors measured, by view."""
    found: dict[str, Any] = {}
    for what, of_all, of_view in zip(
        ("dark", "white"), common, next(iter(own.values()), common), strict=True
    ):
        if own and of_view is not None:
            found[what] = {"file": "each view's own", "use": f"each view's own; {of_view.how}"}
        elif of_all is not None:
            found[what] = {"file": str(of_all.file.path), "use": of_all.how}
    found["wavelengths"] = views[0].cube.bands.evidence
    found["dropped_bands"] = [
        {"band": band, "wavelength_nm": float(choice.wavelengths_nm[band]), "reason": reason}
        for band, reason in sorted(choice.dropped.items())
    ]
    models = {view.name: radiometric_model(view.cube) for view in views}
    light = {
        name: model.irradiance for name, model in models.items() if model and model.irradiance is not None
    }
    return found | ({"irradiance": light} if light else {})


def sampled_rows(height: int) -> list[int]:
    """Rows spread evenly over an image."""
    count = min(height, _ROWS_A_VIEW)
    return [int((index + 0.5) * height / count) for index in range(count)]


def _find_saturation(files: Sequence[Cube], bands: np.ndarray) -> tuple[float | None, str]:
    """The stored number at which a detector ends, from a plateau at the greatest one, and the evidence."""
    dtype = files[0].dtype
    is_wide = dtype.kind not in "iu" or dtype.itemsize > 2  # a detector's, or processed
    limits = np.iinfo(np.uint16 if is_wide else dtype)
    low, high = int(limits.min), int(limits.max)
    counts = np.zeros(high - low + 1, dtype=np.int64)
    rows = sampled_rows(files[0].shape[0])
    parts = [_stored_pixels(file, row, bands) for file, row in product(files[:_MOST_ALIKE], rows)]
    known = np.concatenate(parts)
    if not len(known):
        return None, "none: no sampled pixel has a measurement"
    bands = bands[np.ptp(known, axis=0) > 0]
    if not len(bands):
        return None, "none: every band has one value only"
    for file, row in product(files, rows):
        stored = _stored_pixels(file, row, bands).ravel()
        if is_wide and not ((stored >= 0) & (stored <= high) & (stored % 1 == 0)).all():
            return None, f"none: not all numbers ({dtype.name}) are whole ones from 0 to {high}"
        counts += np.bincount(stored.astype(np.int64) - low, minlength=len(counts))
    top = int(np.flatnonzero(counts)[-1]) if counts.any() else 0
    below = counts[max(0, top - max(1, (top + low) // 50)) : top]
    at_top, usual = int(counts[top]), float(below.mean()) if len(below) else 0.0
    number, is_end = top + low, top + low in {2**bits - 1 for bits in _DETECTOR_BITS}
    if at_top >= _LEAST_AT_TOP and (at_top > _CROWDING * usual or is_end):
        return float(number), f"{at_top} sampled values are {number}, none is greater"
    said = f"the greatest sampled value is {number}"
    if is_wide:
        return None, f"none: no plateau in {dtype.name}; {said}"
    return float(high), f"no plateau below the end of {dtype.name}; {said}"


def _stored_pixels(file: Cube, row: int, bands: BandIndex = slice(None)) -> Shaped[np.ndarray, "N b"]:
    """Stored numbers of the pixels of a row that have a measurement."""
    stored = file.read(slice(row, row + 1), bands)
    return stored[~find_missing(stored, file, slice(row, row + 1), bands)]


def _lit_bands(
    choice: _BandChoice, white: Reference, saturation: float | None, remarks: list[Remark]
) -> _BandChoice:
    """The choice without bands in which a white reference is saturated, marked as bad, or has no light."""
    clipped, path = _clipped_bands(white, saturation), white.file.path
    if clipped.mean() > _MOST_SATURATED_WHITE:
        raise CaptureError(
            f"{path}: {clipped.mean():.0%} of the white reference is saturated; take it again with a shorter exposure"
        )
    if clipped.any():
        listed = [f"{nm:g} nm" for nm in choice.wavelengths_nm[clipped]]
        remarks.append(Remark.of(Code.WHITE_SATURATED, file=path.name, bands=listed))
    choice = choice.without(clipped, "the white reference is saturated there")
    if white.file.bands.bad is not None:
        choice = choice.without(white.file.bands.bad, "marked as bad in the white reference")
    is_dark = white.signal < _LEAST_WHITE * white.signal.max()
    return choice.without(is_dark, "the white reference has no light there")


def _clipped_bands(white: Reference, saturation: float | None) -> Bool[np.ndarray, " B"]:
    """Bands in which a white reference is at the end of the detector, where reflectances would come out too high.

    It may reach that end where no posed view does, and then shows it by many numbers that are exactly there. Columns
    count by their means, too: software that averages lines leaves none exactly there.
    """
    file, nowhere = white.file, np.zeros(white.file.shape[2], bool)
    if saturation is None:
        return nowhere
    top, left, height, width = white.rectangle or (0, 0, *file.shape[:2])
    columns, read, measured = slice(left, left + width), [], []
    for row in sampled_rows(height):
        line = slice(top + row, top + row + 1)
        numbers = file.read(line)
        read.append(numbers[:, columns])
        measured.append(~find_missing(numbers, file, line)[:, columns])
    known = np.concatenate(measured)
    if not known.any():
        return nowhere
    lines = np.where(known[..., None], np.concatenate(read), 0)
    stored, end = lines[known], saturation
    if file.dtype.kind in "iu" and stored.max() in {2**bits - 1 for bits in _DETECTOR_BITS}:
        end = min(end, float(stored.max()))
    means = lines.sum(axis=0, dtype=np.float64) / np.maximum(known.sum(axis=0), 1)[:, None]
    is_near = (means >= _NEAR_TOP * saturation).mean(axis=0) > _MOST_CLIPPED
    return is_near | ((stored >= end).mean(axis=0) > _MOST_CLIPPED)


_Sample: TypeAlias = tuple[Float32[np.ndarray, "N B"], Bool[np.ndarray, "N B"]]
"""Calibrated pixels of all views of a sensor, and which numbers are saturated."""


def _draw_sample(views: Sequence[CaptureView], calibration: Calibration) -> list[ViewPixels]:
    """Pixels on the sampled rows of each view, evenly spaced along them, at all bands that the calibration keeps."""
    raster = calibration.raster
    rows = sampled_rows(raster.height)
    step = max(1, len(views) * len(rows) * raster.width // _MOST_PIXELS)
    drawn = []
    for view in views:
        parts = [calibration.rows(view.cube, row, row + 1) for row in rows]
        kept = np.zeros((len(rows), raster.width), bool)
        for index, row in enumerate(rows):
            kept[index, row % step :: step] = True
        kept &= ~np.concatenate([part.missing for part in parts])
        values, saturated = (
            np.concatenate([getattr(part, name) for part in parts])[kept] for name in ("values", "saturated")
        )
        drawn.append(ViewPixels(view.name, values, saturated))
    return drawn


def _pooled(drawn: Sequence[ViewPixels], first: Cube) -> _Sample:
    """The pixels of all views. Raises CaptureError: there are none."""
    sample = np.concatenate([one.values for one in drawn]), np.concatenate([one.saturated for one in drawn])
    if not len(sample[0]):
        raise CaptureError(
            f"{first.path}: no sampled pixel of it and of the other views has a measurement in all bands (NaN, "
            "no-data, or no light on the white panel); check these, or leave bands out with --drop-bands"
        )
    return sample


def _of_usual_views(
    drawn: Sequence[ViewPixels], bands: Bool[np.ndarray, " B"]
) -> Bool[np.ndarray, " N"] | None:
    """Which pixels are of views whose bright pixels are not far brighter than those of most."""
    values = [one.values[:, bands] for one in drawn]
    bright = [np.percentile(one, BRIGHT_PERCENTILE) if one.size else np.nan for one in values]
    is_usual = ~(np.array(bright) > _FAR_BRIGHTER * np.nanmedian(bright))
    if is_usual.all() or len(drawn) < _LEAST_COMPARED or is_usual.mean() < _MOST_USUAL:
        return None
    return np.repeat(is_usual, [len(one) for one in values])


def _drop_found(choice: _BandChoice, sample: _Sample, max_noise: float, remarks: list[Remark]) -> _BandChoice:
    """Leave out bands that are dead, saturated or noisy in the sample, which has all that were kept."""
    kept, (values, saturated) = choice.kept, sample
    shares = saturated.mean(axis=0)
    is_saturated = shares > _MOST_SATURATED + np.median(shares)
    is_dead = np.ptp(values, axis=0) == 0
    noise = np.zeros(len(kept))
    usable = ~saturated[:, ~is_dead].any(axis=1)
    noise[~is_dead] = _noise_shares(values[usable][:, ~is_dead])
    is_noisy = noise > max_noise  # false for NaN
    if is_noisy.mean() > _MOST_NOISY:  # bands have little in common then, or the whole capture is noisy
        values = {"noisy": int(is_noisy.sum()), "bands": len(kept), "limit": f"{max_noise:.0%}"}
        remarks.append(Remark.of(Code.NOISY_BANDS_KEPT, **values))
        is_noisy[:] = False
    # The first reason that is found counts.
    reasons = {int(kept[i]): f"noise is {noise[i]:.0%} of the signal" for i in np.flatnonzero(is_noisy)}
    often = f"saturated in more than {_MOST_SATURATED:.0%} of sampled pixels"
    reasons |= dict.fromkeys(kept[is_saturated].tolist(), often)
    reasons |= dict.fromkeys(kept[is_dead].tolist(), "dead: the same value in every sampled pixel")
    return _BandChoice(choice.wavelengths_nm, reasons | choice.dropped)


def _noise_shares(values: Float32[np.ndarray, "N B"]) -> Float64[np.ndarray, " B"]:
    """Noise of each band over its signal, its root mean square, from what the other bands can't explain; NaN with too
    few pixels."""
    import torch

    from unmix_plugin.spectral.noise import estimate_noise

    count, bands = values.shape
    if count < 4 * bands or bands < 8:
        return np.full(bands, np.nan)
    pixels = values.astype(np.float64)
    size = np.sqrt((pixels**2).mean(axis=0))
    size[size == 0] = 1.0
    noise = estimate_noise(torch.from_numpy(pixels / size)).numpy()
    return np.sqrt((noise**2).mean(axis=0))
