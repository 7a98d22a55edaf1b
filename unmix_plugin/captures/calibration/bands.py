"""Which bands of one sensor become bands of the scene: those of which nothing says that they measure badly.

Notation: `N` sampled pixels, `B` bands of the file, `c` bands of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.calibration.references import Reference, SensorReferences
from unmix_plugin.captures.cube import MOST_WIDTH, Cube
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.readers.derived import said_of_mosaic
from unmix_plugin.captures.report import Code, Kind, Remark, sentences
from unmix_plugin.captures.wavelengths import in_ranges
from unmix_plugin.errors import CaptureError

_MOST_SATURATED = 0.2
"""Share of sampled values by which a band may be saturated more than bands usually are."""
_MOST_NOISY = 0.5
"""Share of bands that may be left out for their noise."""
_MOST_SATURATED_WHITE = 0.5
"""Share of a white reference's values at the detector's top at which it can't serve."""
_GAP, _LEFT_OUT = 3.0, 2.5
"""Between neighbouring bands, as a multiple of the steps beside it, above which bands are missing in the file itself,
and above which a range was left out: one band that is left out makes two steps of one, two make three."""
_LEAST_WHITE = 0.01
"""Signal of the white reference in a band, as a share of the greatest, below which the band is too dark."""


class BandFault(Enum):
    """Why a band is left out, with the sentence for people."""

    MARKED = "marked as bad in the file"
    BROAD = f"wider than {MOST_WIDTH:.0%} of its wavelength: too broad for one"
    REPEATED = "an earlier band has the same wavelength"
    NAMED = "named in --drop-bands"
    WHITE_SATURATED = "the white reference is saturated there"
    WHITE_MARKED = "marked as bad in the white reference"
    DARK_MARKED = "marked as bad in the dark frame"
    UNMEASURED = "a reference measured nothing there"
    WHITE_DARK = "the white reference has no light there"
    NOISY = "noise is {:.0%} of the signal"
    SATURATED = f"saturated in more than {_MOST_SATURATED:.0%} of sampled pixels"
    DEAD = "dead: the same value in every sampled pixel"
    BIN_INCOMPLETE = "too few up to a gap or the end for --bin-bands {}"


@dataclass(frozen=True)
class DroppedBand:
    """Why one band is left out."""

    fault: BandFault
    number: int | float | None = None
    """Noise over signal, or bands of a bin."""

    @property
    def reason(self) -> str:
        """For people."""
        return self.fault.value.format(self.number)


@dataclass(frozen=True)
class BandChoice:
    """The bands of one sensor: in order of wavelength, without bad ones."""

    wavelengths_nm: Float64[np.ndarray, " B"]
    """Of all bands of the file."""
    source: str = ""
    """Where the wavelengths are stated, for people."""
    dropped: dict[int, DroppedBand] = field(default_factory=dict)
    """Bands that are left out, by index."""

    @property
    def kept(self) -> np.ndarray:
        """Indices of the others, by rising wavelength."""
        order = np.argsort(self.wavelengths_nm, kind="stable")
        return order[[index not in self.dropped for index in order.tolist()]]

    def centers_nm(self, binning: int) -> Float64[np.ndarray, " c"]:
        """Wavelengths of the scene: means over binned bands."""
        return self.wavelengths_nm[self.kept].reshape(-1, binning).mean(axis=1)

    def without(
        self, marks: Bool[np.ndarray, " B"], fault: BandFault, number: int | None = None
    ) -> BandChoice:
        """The choice without some more bands; of several faults, the one that was found first counts."""
        added = {int(index): DroppedBand(fault, number) for index in np.flatnonzero(marks)}
        return BandChoice(self.wavelengths_nm, self.source, {**added, **self.dropped})

    def without_repeated(self) -> BandChoice:
        """The choice without bands whose wavelength an earlier one that is kept has."""
        rest = np.setdiff1d(np.arange(len(self.wavelengths_nm)), list(self.dropped))
        first = rest[np.unique(self.wavelengths_nm[rest], return_index=True)[1]]
        repeated = np.isin(np.arange(len(self.wavelengths_nm)), np.setdiff1d(rest, first))
        return self.without(repeated, BandFault.REPEATED)

    def without_incomplete_bins(self, binning: int) -> BandChoice:
        """The choice without bands that fill no bin up to the next gap: a bin across a gap would stand for light that
        was not measured, such as that of bands in which air absorbs. Single bad bands, or those of a second detector
        between those of the first, leave no gap."""
        kept = self.kept
        kept_nm, dropped_nm = self.wavelengths_nm[kept], self.wavelengths_nm[list(self.dropped)]
        steps_nm = np.diff(kept_nm)
        is_between = ((kept_nm[:-1, None] < dropped_nm) & (dropped_nm < kept_nm[1:, None])).any(axis=1)
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
        return self.without(marks, BandFault.BIN_INCOMPLETE, binning)

    def require(self, binning: int, where: str) -> None:
        """Refuse to go on with fewer bands than are averaged into one. Raises CaptureError: so few are left."""
        if len(self.kept) >= binning:
            return
        reasons = "; ".join(sorted({band.reason for band in self.dropped.values()}))
        advice = f"left out: {reasons}. Check dark and white, --drop-bands, --max-noise and --bin-bands"
        raise CaptureError(
            f"{where}: {len(self.kept)} of {len(self.wavelengths_nm)} bands are left, {binning} or more are needed; "
            + (advice if reasons else "lower --bin-bands")
        )


def stated_bands(files: Sequence[Cube], options: ProcessOptions) -> BandChoice:
    """Bands that no file marks as bad, by the wavelengths of the first. Raises CaptureError: these are unknown. Raises
    ConfigError: bands that the user drops are no ranges."""
    table, num_bands = files[0].bands, files[0].shape[2]
    if table.wavelengths_nm is None:
        notes = "".join(f". {note}" for note in sentences(files[0].remarks, Kind.WRONG))
        raise CaptureError(
            f"{files[0].path}: the wavelengths of its {num_bands} bands are unknown ({table.source}); give them with "
            f"--wavelengths{said_of_mosaic(files[0])}{notes}"
        )
    choice = BandChoice(table.wavelengths_nm, table.source)
    for file in files:
        if file.bands.bad is not None:
            choice = choice.without(file.bands.bad, BandFault.MARKED)
    choice = choice.without(table.is_broad, BandFault.BROAD).without_repeated()
    if options.drop_bands is not None:
        choice = choice.without(in_ranges(options.drop_bands, table.wavelengths_nm), BandFault.NAMED)
    return choice


def without_unmeasured(choice: BandChoice, references: SensorReferences) -> tuple[BandChoice, list[Remark]]:
    """The choice without bands that a reference marks as bad or measured nothing in, and remarks on the latter."""
    whites, remarks = {white.file.path for white in references.whites}, dict[str, Remark]()
    for reference in references.all:
        file, bands = reference.file, np.arange(len(choice.wavelengths_nm))
        if file.bands.bad is not None:
            fault = BandFault.WHITE_MARKED if file.path in whites else BandFault.DARK_MARKED
            choice = choice.without(file.bands.bad, fault)
        lacking = ~np.isin(bands, [*reference.measured, *choice.dropped])
        if lacking.any():
            listed = [f"{nm:g} nm" for nm in choice.wavelengths_nm[lacking]]
            remarks[file.path.name] = Remark.of(Code.REFERENCE_UNMEASURED, file=file.path.name, bands=listed)
            choice = choice.without(lacking, BandFault.UNMEASURED)
    return choice, [*remarks.values()]


def without_unlit(
    choice: BandChoice, white: Reference, saturated: Bool[np.ndarray, " B"]
) -> tuple[BandChoice, list[Remark]]:
    """The choice without bands in which a white reference is saturated or has no light, and a remark on saturated ones.
    Raises CaptureError: most of the white is saturated."""
    path = white.file.path
    if saturated.mean() > _MOST_SATURATED_WHITE:
        raise CaptureError(
            f"{path}: {saturated.mean():.0%} of the white reference is saturated; take it again with a shorter exposure"
        )
    listed = [f"{nm:g} nm" for nm in choice.wavelengths_nm[saturated]]
    remarks = [Remark.of(Code.WHITE_SATURATED, file=path.name, bands=listed)] if listed else []
    choice = choice.without(saturated, BandFault.WHITE_SATURATED)
    is_dark = white.signal < _LEAST_WHITE * white.signal.max()
    return choice.without(is_dark, BandFault.WHITE_DARK), remarks


def without_bad(
    choice: BandChoice,
    values: Float32[np.ndarray, "N c"],
    saturated: Bool[np.ndarray, "N c"],
    max_noise: float,
) -> tuple[BandChoice, list[Remark]]:
    """The choice without bands that are dead, saturated or noisy, and a remark where too many are noisy to be left out.

    Args:
        values, saturated: Calibrated pixels of all bands that the choice keeps.
        max_noise: Noise over signal that is bearable.
    """
    kept = choice.kept
    shares = saturated.mean(axis=0)
    is_saturated = shares > _MOST_SATURATED + np.median(shares)
    is_dead = np.ptp(values, axis=0) == 0
    noise = np.zeros(len(kept))
    usable = ~saturated[:, ~is_dead].any(axis=1)
    noise[~is_dead] = noise_shares(values[usable][:, ~is_dead])
    is_noisy = noise > max_noise  # false for NaN
    remarks = []
    if is_noisy.mean() > _MOST_NOISY:  # bands have little in common then, or the whole capture is noisy
        facts = {"noisy": int(is_noisy.sum()), "bands": len(kept), "limit": f"{max_noise:.0%}"}
        remarks.append(Remark.of(Code.NOISY_BANDS_KEPT, **facts))
        is_noisy[:] = False
    found = {int(kept[i]): DroppedBand(BandFault.NOISY, float(noise[i])) for i in np.flatnonzero(is_noisy)}
    found |= dict.fromkeys(kept[is_saturated].tolist(), DroppedBand(BandFault.SATURATED))
    found |= dict.fromkeys(kept[is_dead].tolist(), DroppedBand(BandFault.DEAD))
    return BandChoice(choice.wavelengths_nm, choice.source, found | choice.dropped), remarks


def noise_shares(values: Float32[np.ndarray, "N B"]) -> Float64[np.ndarray, " B"]:
    """Noise of each band over its signal, its root mean square, from what the other bands can't explain; NaN with too
    few pixels."""
    import torch

    from unmix_plugin.spectral.subspace import estimate_noise

    count, bands = values.shape
    if count < 4 * bands or bands < 8:
        return np.full(bands, np.nan)
    pixels = values.astype(np.float64)
    size = np.sqrt((pixels**2).mean(axis=0))
    size[size == 0] = 1.0
    noise = estimate_noise(torch.from_numpy(pixels / size)).numpy()
    return np.sqrt((noise**2).mean(axis=0))
