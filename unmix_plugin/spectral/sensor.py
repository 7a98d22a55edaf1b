"""What a camera makes of spectra: a linear operator, of the scene's own cameras or of one simulated from its response.

A channel measures the mean of the radiance weighted with its response, so a flat spectrum 1 is 1 in every channel: one
matrix for each sampling of the spectrum.

Notation: `B` bands of the spectrum, `b` or `S` channels of the sensor, `N` wavelengths of its table. A response is
relative, piecewise linear between the wavelengths of its table, and 0 outside.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands, integrals_up_to
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, read_spectra

_MOST_UNSEEN = 0.01
"""Largest part of a channel's response that may lie where there are no bands."""
_CENTER_DECIMALS = 3
"""Digits of a centre in nm: more would be noise of the integration, and the names of files' channels have to differ."""


@dataclass(frozen=True)
class _SensorBands:
    """What a sensor makes of spectra on given bands."""

    sensor: str
    """Its name."""
    matrix: Float64[np.ndarray, "B S"]
    """`spectra @ matrix` are the channels' values; columns are not negative and sum to 1."""
    bands: Bands
    """Centres of the channels."""
    names: tuple[str, ...]
    """Of the channels, shortest wavelength first."""
    notes: tuple[str, ...]
    """A line for each channel that was left out, and why."""

    @property
    def description(self) -> str:
        """A line that says which wavelength is which channel's."""
        channels = zip(self.names, self.bands.centers_nm, strict=True)
        return f"seen through {self.sensor}: " + ", ".join(f"{name} {nm:g} nm" for name, nm in channels)


@dataclass(frozen=True, eq=False)
class SpectralResponses:
    """Relative spectral responses of the channels of a camera."""

    name: str
    responses: SpectraTable
    """A row for each channel; sorted by centre, in whatever order they were given."""
    column_names: tuple[str, ...] = ()
    """Of the channels as they were given."""

    def __post_init__(self) -> None:
        table = self.responses
        if len(table.bands) < 2:
            raise SpectrumError("a spectral response needs at least two wavelengths; found one")
        for name, response in zip(table.names, table.spectra, strict=True):
            if not response.max() > 0:
                raise SpectrumError(f"channel '{name}' is zero at all wavelengths; leave its column out")
        centers = self._mean_wavelengths(table)
        order = np.argsort(centers, kind="stable")
        for one, other in pairwise(order):
            if centers[one] == centers[other]:
                raise SpectrumError(
                    f"channels '{table.names[one]}' and '{table.names[other]}' have the same centre, "
                    f"{centers[one]:g} nm; bands are known by their wavelengths, so leave one of the columns out"
                )
        names = tuple(table.names[index] for index in order)
        object.__setattr__(self, "column_names", table.names)
        object.__setattr__(self, "responses", SpectraTable(table.bands, names, table.spectra[order]))

    @cached_property
    def bands(self) -> Bands:
        """Centres of the channels: mean wavelength, weighted with the response."""
        return Bands(self._mean_wavelengths(self.responses))

    def seen_by(self, bands: Bands) -> _SensorBands:
        """The channels as means over the bands of a spectrum.

        A band weighs as much as of the channel's response lies in its interval, so channels narrower than the bands
        count too; they get what the band has. A channel of which more than 1 % lies where there are no bands is left
        out; one has to be left.
        """
        integrals = self._responses_up_to(bands.intervals_nm.ravel())
        in_bands = np.diff(integrals.reshape(len(integrals), len(bands), 2))[..., 0]
        seen = in_bands.sum(axis=1)
        [total] = self._responses_up_to(self.responses.bands.centers_nm[-1:]).T
        is_covered = seen >= (1 - _MOST_UNSEEN) * total
        covered = f"the bands cover {bands.coverage}"
        names = self.responses.names
        left_out = [f"{names[s]} ({self._span(s)})" for s in np.flatnonzero(~is_covered).tolist()]
        if not is_covered.any():
            raise SpectrumError(f"the sensor '{self.name}' sees nothing: {covered}, {', '.join(left_out)}")
        return _SensorBands(
            self.name,
            (in_bands[is_covered] / seen[is_covered, None]).T,
            Bands(self.bands.centers_nm[is_covered]),
            tuple(name for name, covers in zip(names, is_covered, strict=True) if covers),
            tuple(f"left out {channel}: {covered}" for channel in left_out),
        )

    @staticmethod
    def _mean_wavelengths(table: SpectraTable) -> Float64[np.ndarray, " S"]:
        nm, values = table.bands.centers_nm, table.spectra
        low, high, steps = nm[:-1], nm[1:], np.diff(nm)
        first, second = values[:, :-1], values[:, 1:]
        # Exact: the integrand is quadratic in each piece.
        moments = (low * (2 * first + second) + high * (first + 2 * second)) @ steps / 6
        return np.round(moments / ((first + second) @ steps / 2), _CENTER_DECIMALS)

    def _responses_up_to(self, wavelengths_nm: Float64[np.ndarray, " M"]) -> Float64[np.ndarray, "S M"]:
        """Integral of each response up to each wavelength, exactly; outside the table nothing is added."""
        table = self.responses.bands.centers_nm
        return integrals_up_to(wavelengths_nm.clip(table[0], table[-1]), self.responses.spectra, table)

    def _span(self, channel: int) -> str:
        """From where to where a channel responds, up to 0.5 % of it at both ends, for a message."""
        table = self.responses.bands.centers_nm
        wavelengths = np.linspace(table[0], table[-1], 2001)
        integral = self._responses_up_to(wavelengths)[channel]
        low, high = np.interp(np.array([0.005, 0.995]) * integral[-1], integral, wavelengths)
        return f"{low:.0f}-{high:.0f} nm"


def read_sensor(path: Path) -> SpectralResponses:
    """A sensor from a table of relative spectral responses, `wavelength,NAME,NAME,...`; its name is the file's. Where a
    channel alone was not measured, it responds to nothing."""
    table = read_spectra(path, outside=0.0)
    try:
        return SpectralResponses(path.stem, table)
    except SpectrumError as error:
        raise SpectrumError(f"{path}: {error}") from error


@dataclass(frozen=True, eq=False)
class SceneSensor:
    """A camera of a rig, or the only one; its frames have one size."""

    name: str
    """Unique in the scene."""
    matrix: Float64[np.ndarray, "b B"]
    """A channel's value is its row times the spectrum. Rows are not negative and sum to 1."""

    @cached_property
    def bands(self) -> tuple[int, ...] | None:
        """The band that each channel is; None where channels are means over several."""
        is_selection = ((self.matrix == 1).sum(axis=1) == 1) & ((self.matrix != 0).sum(axis=1) == 1)
        return tuple(self.matrix.argmax(axis=1).tolist()) if is_selection.all() else None

    @property
    def num_channels(self) -> int:
        """b."""
        return len(self.matrix)

    @property
    def sees_all_bands(self) -> bool:
        """Whether the channels are the scene's bands, in their order."""
        return self.bands == tuple(range(self.matrix.shape[1]))

    @property
    def seen_bands(self) -> Bool[np.ndarray, " B"]:
        """Bands that some channel responds to."""
        return np.any(self.matrix > 0, axis=0)

    @cached_property
    def false_colours(self) -> Float64[np.ndarray, "b 3"]:
        """From channels to red, green and blue, long waves red: each the mean of a third of the channels, or the
        nearest one."""
        centers = self.matrix @ np.arange(self.matrix.shape[1])
        order = np.argsort(np.argsort(centers, kind="stable"), kind="stable")
        middles = (np.array([2, 1, 0]) + 0.5) / 3 * len(centers) - 0.5
        distances = np.abs(order[:, None] - middles)
        near = distances <= np.maximum(distances.min(axis=0), len(centers) / 6)
        return near / near.sum(axis=0)

    def to_json(self) -> dict[str, Any]:
        """Name, and bands or responses; `from_json` restores the same bits."""
        if self.bands is not None:
            return {"name": self.name, "bands": list(self.bands)}
        return {"name": self.name, "responses": self.matrix.tolist()}

    @staticmethod
    def from_json(values: Mapping[str, Any], num_bands: int) -> SceneSensor:
        """The sensor that `to_json` wrote; a KeyError, IndexError, TypeError or ValueError where it is none."""
        if "bands" in values:
            return SceneSensor(str(values["name"]), np.eye(num_bands)[list(values["bands"])])
        matrix = np.array(values["responses"], dtype=np.float64)
        if matrix.ndim != 2 or matrix.shape[1] != num_bands or not matrix.min(initial=0.0) >= 0:
            raise ValueError(
                f"responses of shape {matrix.shape}; expected rows of {num_bands}, none negative"
            )
        return SceneSensor(str(values["name"]), matrix)
