"""Spectral sampling of a sensor.

Notation: `B` bands, index `i` rising with wavelength; wavelengths in nm. Each band stands for an interval of the
spectrum: its edges lie halfway between neighbouring centres, and the outermost bands are symmetric about their centres.
Where bands were left out there is a gap, into which those beside it reach no farther than half their spacing (a lone
one half of the largest step between the others): what lies in there was not measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from torch import Tensor

from unmix_plugin.errors import SpectrumError, counted, name_some

VISIBLE_RANGE_NM = (380.0, 780.0)
"""What a band must lie in to count as visible: the range in which colour matching functions are noticeably non-zero."""
_MEASURABLE_RANGE_NM = (20.0, 1e6)
"""Where optical sensors measure; numbers below are wavelengths in micrometres, numbers above are in no unit."""
_LEAST_NM = 100.0
"""Smaller numbers are wavelengths of no camera in nm: whole ones in a list of bands are numbers of bands."""
_LONE_BAND_WIDTH_NM = 10.0
"""Width given to a band that has no neighbour to tell its spacing."""
_LEAST_GAP = 2.5
"""A step so many times the spacing beside it is a gap. Two bands missing from an even sampling leave one; a single one,
or the uneven steps of a multispectral camera, do not."""
_NM_PER_UNIT = {
    **dict.fromkeys(("nm", "nanometer", "nanometers", "nanometre", "nanometres"), 1.0),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns"), 1e3),
    **dict.fromkeys(("micrometer", "micrometers", "micrometre", "micrometres"), 1e3),
    **dict.fromkeys(("nanomètre", "nanomètres", "nanometro", "nanometri", "nanometros", "nanómetros"), 1.0),
    **dict.fromkeys(("mikrometer", "mikron", "micromètre", "micromètres", "micrometri", "micrómetros"), 1e3),
    **dict.fromkeys(("a", "å", "angstrom", "angstroms"), 0.1),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1e9),
}


@dataclass(frozen=True, eq=False)
class Bands:
    """Spectral sampling of one sensor, validated where it is made; compares and hashes by value."""

    centers_nm: Float64[np.ndarray, " B"]
    """Band centres in nm: finite, positive, strictly increasing; stored as a read-only copy."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Full width at half maximum of the instrument in each band, nm; None where it is unknown. Not compared."""

    def __post_init__(self) -> None:
        centers = np.array(self.centers_nm, dtype=np.float64)
        _require_one_axis(centers)
        for rule, holds in (("be finite", np.isfinite(centers)), ("be positive", centers > 0)):
            if not holds.all():
                i = int(np.argmin(holds))
                raise SpectrumError(f"wavelengths must {rule}; found {centers[i]:g} nm at index {i}")
        for i in np.flatnonzero(np.diff(centers) <= 0).tolist():
            raise SpectrumError(
                f"wavelengths must strictly increase; found {centers[i]:g} nm at index {i} "
                f"then {centers[i + 1]:g} nm at index {i + 1}; sort the bands and drop repeated ones"
            )
        centers.setflags(write=False)
        object.__setattr__(self, "centers_nm", centers)

    @classmethod
    def of(cls, centers_nm: Sequence[object] | np.ndarray | Tensor) -> Bands:
        """Bands from a list, an array of any number type, or a tensor on any device.

        >>> Bands.of([450, 550, 650]).edges_nm
        array([400., 500., 600., 700.])
        """
        if isinstance(centers_nm, Tensor):
            centers_nm = centers_nm.detach().cpu().numpy()
        try:
            centers = np.asarray(centers_nm, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise SpectrumError(f"wavelengths must be a list of numbers in nm; {error}") from error
        _require_one_axis(centers)
        return cls(centers)

    def __len__(self) -> int:
        return len(self.centers_nm)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Bands) and np.array_equal(self.centers_nm, other.centers_nm)

    def __hash__(self) -> int:
        return hash(self.centers_nm.tobytes())

    def __str__(self) -> str:
        return f"{counted(len(self), 'band')}, {self.centers_nm[0]:g}-{self.centers_nm[-1]:g} nm"

    @property
    def edges_nm(self) -> Float64[np.ndarray, " edges"]:
        """B + 1 borders halfway between the bands in nm, increasing; they pass over gaps, so colours are made of them:
        a display has to show something for all of the eye's response."""
        centers = self.centers_nm
        if len(centers) == 1:
            return centers + _LONE_BAND_WIDTH_NM * np.array([-0.5, 0.5])
        inner = (centers[1:] + centers[:-1]) / 2
        return np.concatenate([[2 * centers[0] - inner[0]], inner, [2 * centers[-1] - inner[-1]]])

    @property
    def widths_nm(self) -> Float64[np.ndarray, " B"]:
        """Widths of the bands' intervals in nm: an estimate of the sensor's from its spacing."""
        return np.diff(self.intervals_nm)[:, 0]

    @property
    def intervals_nm(self) -> Float64[np.ndarray, "B 2"]:
        """From where to where each band stands for the spectrum, nm: up to its edges, but into a gap by half its
        spacing, or half its width at half maximum where that is known and larger."""
        centers, edges = self.centers_nm, self.edges_nm
        fwhm = 0.0 if self.fwhm_nm is None else self.fwhm_nm
        spacing = np.stack([_spacings_above(centers), _spacings_above(-centers[::-1])[::-1]], axis=1)
        to_edge = np.stack([centers - edges[:-1], edges[1:] - centers], axis=1)
        own = np.fmax(spacing, np.reshape(fwhm, (-1, 1))) / 2
        reach = np.where(2 * to_edge > _LEAST_GAP * spacing, np.minimum(to_edge, own), to_edge)
        for last, outwards in ((0, 0), (-1, 1)):  # the outermost are symmetric
            if reach[last, 1 - outwards] < to_edge[last, 1 - outwards]:
                reach[last, outwards] = reach[last, 1 - outwards]
        tiled = np.stack([edges[:-1], edges[1:]], axis=1)
        return np.where(reach < to_edge, centers[:, None] + reach * np.array([-1.0, 1.0]), tiled)

    @property
    def ranges_nm(self) -> Float64[np.ndarray, "R 2"]:
        """What the intervals cover without a gap, from where to where, nm: one range, and one more for each gap."""
        low, high = self.intervals_nm.T
        is_gap = low[1:] > high[:-1]
        return np.stack([low[np.append(True, is_gap)], high[np.append(is_gap, True)]], axis=1)

    @property
    def coverage(self) -> str:
        """The covered ranges in words, for a message.

        >>> Bands.of([450, 460, 470, 500, 510]).coverage
        '445-475, 495-515 nm'
        """
        return name_some([f"{low:g}-{high:g}" for low, high in self.ranges_nm], most=6) + " nm"

    @property
    def visible_mask(self) -> Bool[np.ndarray, " B"]:
        """Which bands have their centre inside `VISIBLE_RANGE_NM`, ends included."""
        return (self.centers_nm >= VISIBLE_RANGE_NM[0]) & (self.centers_nm <= VISIBLE_RANGE_NM[1])

    def contains(self, wavelength_nm: float | int, up_to_nm: float | int | None = None) -> bool:
        """Whether a wavelength lies in some band's interval; or all that lies from it to another."""
        low, high = self.ranges_nm.T
        last = wavelength_nm if up_to_nm is None else up_to_nm
        return bool(((low <= wavelength_nm) & (last <= high)).any())

    def nearest(self, wavelength_nm: float | int) -> int:
        """Index of the band whose centre is nearest to a wavelength in some band's interval; of two the shorter one.

        >>> Bands.of([450, 550, 650]).nearest(560)
        1
        """
        if not self.contains(wavelength_nm):
            raise SpectrumError(
                f"no band at {wavelength_nm:g} nm: {self} cover {self.coverage}; choose one in there"
            )
        return int(np.argmin(np.abs(self.centers_nm - wavelength_nm)))


def require_nanometres(centers_nm: Float64[np.ndarray, " B"]) -> None:
    """Refuse wavelengths that count bands, look like micrometres, or lie where no optical sensor measures."""
    low, high = _MEASURABLE_RANGE_NM
    first, last = float(centers_nm.min()), float(centers_nm.max())
    if are_band_numbers(centers_nm):
        raise SpectrumError(
            f"wavelengths of {first:g} to {last:g} count the bands; expected those of the bands in nm"
        )
    if last < low:
        raise SpectrumError(
            f"wavelengths of {first:g} to {last:g} look like micrometres; expected nm: multiply them by 1000"
        )
    if first < low or last > high:
        raise SpectrumError(f"wavelengths of {first:g} to {last:g} nm; expected {low:g} to {high:g} nm")


def nm_per_unit(unit: str) -> float | None:
    """How many nm one of the unit is; None for what is not a unit of length that files use.

    >>> nm_per_unit("Micrometers")
    1000.0
    """
    return _NM_PER_UNIT.get(unit.strip().lower())


def are_band_numbers(values: np.ndarray, may_have_gaps: bool = False) -> bool:
    """Whether numbers without a unit, one a band, count bands instead of measuring: whole ones, one apart from 0 or 1;
    or, with gaps, any whole ones too small for nm, as in a list called `bands`.

    >>> are_band_numbers(np.array([1, 2, 3])), are_band_numbers(np.array([8, 9, 10]))
    (True, False)
    """
    if may_have_gaps:
        return bool((values == np.round(values)).all() and values.min() < _LEAST_NM)
    return float(values[0]) in (0.0, 1.0) and np.array_equal(values, values[0] + np.arange(len(values)))


def _spacings_above(centers: Float64[np.ndarray, " B"]) -> Float64[np.ndarray, " B"]:
    """Mean of the next two steps above each centre, so that near duplicates don't count alone. Where only one is left
    the median of all steps counts if it is larger; where none is, the largest of the steps but that below, or infinity
    where these are fewer than two: nothing is known of it.
    """
    if len(centers) == 1:
        return np.array([np.inf])
    steps = np.diff(centers)
    outermost = steps[:-1].max() if len(steps) > 2 else np.inf
    return np.concatenate([(steps[1:] + steps[:-1]) / 2, [max(steps[-1], np.median(steps)), outermost]])


def _require_one_axis(centers: np.ndarray) -> None:
    if centers.ndim != 1 or centers.size == 0:
        raise SpectrumError(
            f"wavelengths must be a list of at least one number in nm; found an array of shape {centers.shape}"
        )


def integrals_up_to(
    wavelengths_nm: Float64[np.ndarray, " M"],
    spectra: Float64[np.ndarray, "S N"],
    samples_nm: Float64[np.ndarray, " N"],
) -> Float64[np.ndarray, "S M"]:
    """Integral of each spectrum, known at `samples_nm`, from one common start to each wavelength, both increasing.

    Only differences between integrals mean anything. Beyond the samples the outermost values are held.
    """
    nodes = np.union1d(samples_nm, wavelengths_nm)
    values = np.stack([np.interp(nodes, samples_nm, spectrum) for spectrum in spectra])
    areas = np.diff(nodes) * (values[:, 1:] + values[:, :-1]) / 2
    integrals = np.concatenate([np.zeros((len(areas), 1)), np.cumsum(areas, axis=1)], axis=1)
    return integrals[:, np.searchsorted(nodes, wavelengths_nm)]
