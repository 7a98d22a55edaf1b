"""Intervals of what is estimated: how wide they have to be by errors that were seen, and how errors of spectra become
errors of what is made of them.

An interval of coverage 0.9 is meant to hold what is true in nine of ten cases. Errors have heavy tails, so that no
normal distribution tells how wide it has to be: the error that nine of ten stayed below does, in multiples of the
deviation that was expected of each.

Notation: `B` bands, `L` coverages, `D` directions of errors, `N` errors, `*any` any axes.

Source: split conformal prediction with normalised errors (J. Lei, M. G'Sell, A. Rinaldo, R. J. Tibshirani and L.
Wasserman, JASA 113(523), 2018, section 5); of deviations, unscented propagation (S. J. Julier and J. K. Uhlmann, Proc.
IEEE 92(3), 2004).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from unmix_plugin.errors import ConfigError

COVERAGE = 0.9
"""Of intervals where nothing else is asked for."""
COVERAGES = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
"""For which errors are counted; between them widths are interpolated."""
_MOST_ERROR = 0.3
"""Expected error of an endmember in lengths of it: beyond that, the sets of endmembers that explain the pixels alike
have another material in its place."""
UNDETERMINED = "other sets of endmembers that explain the pixels as well have none like it"
_MOST_ERRORS = 1_000_000
"""That quantiles are taken of."""


@dataclass(frozen=True)
class Interval:
    """Where values lie, with a given probability each."""

    low: Float64[np.ndarray, "*values"]
    """NaN where it is not determined."""
    high: Float64[np.ndarray, "*values"]
    coverage: float
    """Probability that it is meant to hold what is true."""
    not_determined: str = ""
    """Why there is no interval, or none of some of the values, for people; empty where all have one."""

    @property
    def is_known(self) -> bool:
        """Whether any of the values has an interval."""
        return bool(np.isfinite(self.low).any())

    @property
    def width(self) -> Float64[np.ndarray, "*values"]:
        """From low to high."""
        return np.asarray(self.high - self.low)

    def in_words(self, number: str) -> list[str]:
        """From low to high of each value, by a format of numbers."""
        return [
            f"{number.format(low)} to {number.format(high)}" if np.isfinite(low) else "not determined"
            for low, high in zip(self.low.ravel(), self.high.ravel(), strict=True)
        ]

    @staticmethod
    def unknown(values: Float64[np.ndarray, "*values"], coverage: float, reason: str) -> Interval:
        """Of values about which nothing can be said."""
        nothing = np.full(values.shape, np.nan)
        return Interval(nothing, nothing, coverage, reason)

    @staticmethod
    def of_endmembers(
        spectra: Float64[np.ndarray, "K B"], deviations: Float64[np.ndarray, "K B"], coverage: float
    ) -> Interval:
        """Of endmembers by their expected errors, as if these were normally distributed: no view that is left out tells
        more. Not determined where an endmember's error is large beside it."""
        require_coverage(coverage)
        half = NormalDist().inv_cdf((1 + coverage) / 2) * deviations
        is_known = is_determined(spectra, deviations)
        low, high = (
            np.where(is_known[:, None], end, np.nan) for end in ((spectra - half).clip(min=0), spectra + half)
        )
        return Interval(low, high, coverage, "" if is_known.all() else UNDETERMINED)


def is_determined(
    spectra: Float64[np.ndarray, "K B"], deviations: Float64[np.ndarray, "K B"]
) -> Bool[np.ndarray, " K"]:
    """Whether the expected error of each endmember is small beside it."""
    return np.linalg.norm(deviations, axis=1) <= _MOST_ERROR * np.linalg.norm(spectra, axis=1)


def require_coverage(coverage: float) -> None:
    """A ConfigError where no interval of that coverage can be given."""
    if not COVERAGES[0] <= coverage <= COVERAGES[-1]:
        raise ConfigError(
            f"the coverage of an interval is {coverage:g}; expected {COVERAGES[0]:g} to {COVERAGES[-1]:g}"
        )


def width_factors(ratios: Float[Tensor, "N"], generator: torch.Generator) -> Float[Tensor, "L"]:
    """For each of `COVERAGES` the multiple of its expected deviation that so many errors stayed below; the `ratios` are
    errors over that deviation, at least 0, and one or more."""
    chosen = torch.randperm(len(ratios), generator=generator)[:_MOST_ERRORS].to(ratios.device)
    return torch.quantile(ratios[chosen].double(), ratios.new_tensor(COVERAGES, dtype=torch.float64)).to(
        ratios
    )


def width_factor(factors: Float[Tensor, "L"], coverage: float) -> float:
    """Half a width in multiples of the expected deviation; a ConfigError as of `require_coverage`."""
    require_coverage(coverage)
    return float(np.interp(coverage, COVERAGES, factors.double().cpu().numpy()))


def propagated_deviation(
    function: Callable[[Float[Tensor, "*any B"]], Tensor],
    spectra: Float[Tensor, "*any B"],
    directions: Float[Tensor, "D B"],
    scales: Float[Tensor, "*any"],
) -> Tensor:
    """Standard deviation of a function of spectra whose errors have the covariance directions^T directions times the
    square of a scale: the root of the sum of squares of half its differences along each direction.

    Exact of linear functions; of others it follows them as far as errors go, so that what can't be negative is not
    taken to go there. NaN where the function is undefined in reach.
    """
    squares = []
    for direction in directions:
        step = scales[..., None] * direction.to(spectra)
        squares.append(((function(spectra + step) - function(spectra - step)) / 2).square())
    return torch.stack(squares).sum(dim=0).sqrt()
