"""What contradicts itself in the values of a scene that is written, whatever went wrong before.

*Exposure.* Two views from near by show about the same things. If one is brighter than the other by the same factor in
all bands, from its dark to its bright pixels, this is no shading: their exposures differ.

*Dark level.* Light adds: shading scales the spectrum of a surface, so that spectra of a scene lie in a cone from the
origin, and the flat in which they vary contains the origin. If a level is added to them all, it does not.

*Bands.* A band that differs from its neighbours by the same factor in dark and bright pixels of all materials has a
gain of its own; what a material does to one band, it does to its own pixels only.

*Masks.* If what the masks call foreground is black and what they call background has light and texture, they are the
wrong way round. A mask that covers far more or less than those of near views is suspect.

Notation: `N` views, `P` pixels of one view, `B` bands; values in [0, 1] as they are written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.captures.writing.view_files import FULL_SCALE, ViewRecord
from unmix_plugin.engine.sampling import robust_deviation
from unmix_plugin.scenes.reading.cubes import map_array

_MOST_UNREAD, _HEADER_BYTES = 2.5, 20_000
"""Bytes of a file over those of the numbers taken from it, and beyond them, that leave nothing of weight unread."""
_CHOOSING_LAYOUTS = ("nespof", "nespof-real")
"""Layouts that take one channel of several on purpose."""
_WIDE_NM = 200.0
"""Of a band, full width at half maximum; panchromatic ones have 400 and more."""
_SIDE = 48
"""Of the grid of pixels that are looked at."""
_LEAST_PIXELS = 200
_PERCENTILES = (10, 25, 50, 75, 90)
_NEIGHBOURS = 4
_STEP, _UNLIKE = 0.1, 0.2
"""Logarithm of a ratio of brightness that counts, and how much it may vary over bands and percentiles, as a share of
itself. Views of rendered scenes from near by vary by 0.37 and more where they differ by so much."""
_BLACK = 1e-3
"""Median of a view's values below which it shows nothing."""
_LEAST_BANDS = 5
_MOST_WAYS, _UNEXPLAINED = 8, 0.02
"""In which spectra vary: dimensions of the flat, and the share of their variance that it may leave."""
_OFF_FLAT = 3.0
"""Distance of the origin from the flat, in standard deviations of a spectrum from it; right scenes have 1.8 at most."""
_LEAST_LEVEL = 0.002
"""The same, as a share of the mean spectrum."""
_BAND_GAIN, _BAND_DEVIATIONS, _PIXEL_DEVIATIONS = 0.15, 5.0, 2.5
"""Logarithm of a band over what its neighbours say, also in standard deviations over bands and over pixels."""
_GAP = 3.0
"""Step between bands, over the usual one, beyond which nothing follows from neighbours."""
_MOST_ODD = 5
"""Bands of which each may have a gain of its own."""
_BLACK_SHARE, _TEXTURE = 0.1, 0.3
"""Brightness of the foreground over that of the background, and spread of the background, from which masks are
inverted."""
_FILLED = 0.9
"""Share of the border that is foreground, and of the middle that is none, from which they may be."""
_OTHER_COVER = 0.3
"""Share of a view by which its mask may differ from those of near views."""


def check_files(views: Sequence[CaptureView], options: ProcessOptions) -> list[Remark]:
    """Files of which most was not read, and bands that are too wide for one wavelength."""
    unread: list[str] = []
    wide: dict[float, float] = {}
    for view in views:
        cube, bands = view.cube, view.cube.bands
        size = sum(path.stat().st_size for path in cube.files if path.is_file())
        if size > _MOST_UNREAD * np.prod(cube.shape) * cube.dtype.itemsize + _HEADER_BYTES:
            unread.append(f"{cube.path.name} ({cube.shape[2]} bands of {size / 1e6:.1f} MB)")
        if bands.wavelengths_nm is not None and bands.fwhm_nm is not None:
            pairs = zip(bands.wavelengths_nm, bands.fwhm_nm, strict=True)
            wide |= {nm: width for nm, width in pairs if width > _WIDE_NM}
    remarks = []
    if unread and options.dataset is None and options.layout not in _CHOOSING_LAYOUTS:
        remarks.append(Remark.of(Code.FILES_PARTLY_READ, files_read=len(unread), named=", ".join(unread[:3])))
    if wide:
        named = [f"{nm:g} nm ({width:.0f} nm wide)" for nm, width in wide.items()]
        remarks.append(Remark.of(Code.BANDS_WIDE, bands=len(wide), named=named))
    return remarks


@dataclass(frozen=True)
class ViewSample:
    """Some pixels of a view that show foreground and are measured."""

    record: ViewRecord
    spectra: Float32[np.ndarray, "P B"]
    is_hollow: bool = False
    """Whether the foreground fills the border of the picture and leaves out its middle."""

    @staticmethod
    def of(record: ViewRecord, scene: Path) -> ViewSample:
        """Pixels on a grid; saturated ones are left out."""
        cube = map_array(scene / record.paths["hyperspectral_file_path"])
        rows, columns = (np.unique(np.linspace(0, side - 1, _SIDE).astype(int)) for side in cube.shape[:2])
        grid = np.ix_(rows, columns)
        stored = np.stack([cube[row][columns] for row in rows])
        foreground, measured = (mask[grid] for mask in record.read_masks(scene))
        border = np.concatenate([foreground[0], foreground[-1], foreground[:, 0], foreground[:, -1]])
        third = [slice(side // 3, side - side // 3) for side in foreground.shape]
        is_hollow = bool(border.mean() > _FILLED and foreground[third[0], third[1]].mean() < 1.0 - _FILLED)
        kept = foreground & measured & np.all(stored < FULL_SCALE, axis=-1)
        return ViewSample(record, stored[kept].astype(np.float32) / FULL_SCALE, is_hollow)


def check_values(
    samples: Sequence[ViewSample],
    angles_deg: Float64[np.ndarray, "N N"],
    wavelengths_nm: Float64[np.ndarray, " B"],
) -> list[Remark]:
    """What contradicts itself in the views of one sensor.

    Args:
        angles_deg: Between their axes.
    """
    spectra = np.concatenate([sample.spectra for sample in samples]).astype(np.float64)
    remarks = _exposure_steps(samples, angles_deg)
    if spectra.shape[1] >= _LEAST_BANDS and len(spectra) >= _LEAST_PIXELS:
        remarks += [*_dark_level(spectra), *_odd_bands(spectra, wavelengths_nm)]
    return [*remarks, *_masks(samples, angles_deg)]


def _exposure_steps(samples: Sequence[ViewSample], angles_deg: Float64[np.ndarray, "N N"]) -> list[Remark]:
    """Pairs of near views of which one is brighter by the same factor everywhere."""
    usable = [
        index
        for index, sample in enumerate(samples)
        if len(sample.spectra) >= _LEAST_PIXELS and np.median(sample.spectra) > _BLACK
    ]
    if len(usable) < 2 or samples[usable[0]].spectra.shape[1] < 3:
        return []
    percentiles = {index: np.percentile(samples[index].spectra, _PERCENTILES, axis=0) for index in usable}
    levels = {index: np.log(np.maximum(numbers, 1e-5)) for index, numbers in percentiles.items()}
    steps: dict[tuple[int, int], float] = {}
    for view in usable:
        others = sorted((other for other in usable if other != view), key=lambda at: angles_deg[view, at])
        for other in others[:_NEIGHBOURS]:
            ratios = levels[other] - levels[view]
            step = float(np.median(ratios))
            spread = float(robust_deviation(ratios))
            if step > _STEP and spread < _UNLIKE * step:
                steps[view, other] = step
    if not steps:
        return []
    names = [
        f"{samples[second].record.name} is {np.exp(step):.2f} times as bright as {samples[first].record.name}"
        for (first, second), step in sorted(steps.items(), key=lambda item: -item[1])
    ]
    concerned = {view for pair in steps for view in pair}
    return [Remark.of(Code.EXPOSURE_STEPS, views=len(concerned), pairs="; ".join(names[:3]))]


def _dark_level(spectra: Float64[np.ndarray, "P B"]) -> list[Remark]:
    """Whether a level is added to all spectra."""
    mean = spectra.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov(spectra.T))
    variances, axes = np.clip(variances[::-1], 0.0, None), axes[:, ::-1]
    size = float(np.linalg.norm(mean))
    worst, off, rank = 0.0, 0.0, 0
    # How many ways the spectra vary in is not known: a level is outside of all flats that explain nearly everything.
    for count in range(1, min(_MOST_WAYS, len(mean) - 3) + 1):
        flat, rest = axes[:, :count], float(variances[count:].sum())
        if rest > _UNEXPLAINED * variances.sum() or rest <= 0 or size <= 0:
            continue
        away = float(np.linalg.norm(mean - flat @ (flat.T @ mean)))
        usual = float(np.sqrt(len(mean) * rest / (len(mean) - count)))
        if away / usual > worst:
            worst, off, rank = away / usual, away / size, count
    if worst < _OFF_FLAT or off < _LEAST_LEVEL:
        return []
    return [Remark.of(Code.LEVEL_ADDED, rank=rank, share=f"{off:.1%}", times=f"{worst:.0f}")]


def _odd_bands(
    spectra: Float64[np.ndarray, "P B"], wavelengths_nm: Float64[np.ndarray, " B"]
) -> list[Remark]:
    """Bands with a gain of their own."""
    logs = np.log(np.maximum(spectra[spectra.mean(axis=1) > np.median(spectra.mean(axis=1))], 1e-5))
    found: dict[int, float] = {}
    for _ in range(_MOST_ODD):
        excess = _excess(logs, wavelengths_nm)
        gains = np.median(excess, axis=0)
        spreads = robust_deviation(excess, axis=0)
        usual = float(robust_deviation(gains))
        band = int(np.argmax(np.abs(gains)))
        limit = max(_BAND_GAIN, _BAND_DEVIATIONS * usual, _PIXEL_DEVIATIONS * float(spreads[band]))
        if band in found or abs(gains[band]) < limit:
            break
        found[band] = float(gains[band])
        logs[:, band] -= gains[band]  # it disturbs what its neighbours are compared with
    if not found:
        return []
    named = [f"{wavelengths_nm[band]:g} nm ({np.exp(gain):.2f} times)" for band, gain in found.items()]
    return [Remark.of(Code.BANDS_ODD, bands=len(found), named=", ".join(named))]


def _excess(
    logs: Float64[np.ndarray, "P B"], wavelengths_nm: Float64[np.ndarray, " B"]
) -> Float64[np.ndarray, "P B"]:
    """Logarithm of the gain by which each band stands out from a smooth course through those around it.

    A gain of one band shows as +1 there and as -1/2 at both neighbours. 0 at the two bands of either end and beside a
    gap, of which not all neighbours are known.
    """
    low, middle, high = wavelengths_nm[:-2], wavelengths_nm[1:-1], wavelengths_nm[2:]
    part = (middle - low) / (high - low)
    curvatures = np.zeros_like(logs)
    curvatures[:, 1:-1] = logs[:, 1:-1] - logs[:, :-2] * (1 - part) - logs[:, 2:] * part
    excess = np.zeros_like(logs)
    excess[:, 2:-2] = (curvatures[:, 2:-2] - 0.5 * (curvatures[:, 1:-3] + curvatures[:, 3:-1])) / 1.5
    steps = np.diff(wavelengths_nm)
    for step in np.flatnonzero(steps > _GAP * np.median(steps)):
        excess[:, max(0, step - 1) : step + 3] = 0.0
    return excess


def _masks(samples: Sequence[ViewSample], angles_deg: Float64[np.ndarray, "N N"]) -> list[Remark]:
    """Masks that are the wrong way round, or unlike those of near views."""
    records = [sample.record for sample in samples]
    inverted = [
        record.name
        for record in records
        if record.matter_share > 0
        and record.background_brightness > 0
        and record.brightness < _BLACK_SHARE * record.background_brightness
        and record.background_spread > _TEXTURE
    ]
    hollow = [sample.record.name for sample in samples if sample.is_hollow]
    remarks = []
    if inverted:
        remarks.append(Remark.of(Code.MASKS_INVERTED, views=len(inverted), named=inverted))
    elif 2 * len(hollow) > len(samples):
        remarks.append(Remark.of(Code.MASKS_HOLLOW, views=len(hollow), named=hollow))
    shares = np.array([record.matter_share for record in records])
    if len(shares) <= _NEIGHBOURS or np.ptp(shares) == 0:
        return remarks
    off = []
    for view, share in enumerate(shares):
        near = [other for other in np.argsort(angles_deg[view]) if other != view][:_NEIGHBOURS]
        if abs(share - np.median(shares[near])) > max(_OTHER_COVER, 2 * float(np.ptp(shares[near]))):
            off.append(f"{records[view].name} ({share:.0%}, near ones {np.median(shares[near]):.0%})")
    if off:
        remarks.append(Remark.of(Code.MASKS_UNLIKE, views=len(off), named=off))
    return remarks
