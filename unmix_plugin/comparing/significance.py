"""How sure a difference between two captures is, from how much the views of each differ among themselves.

At every place each view that sees it gives a value. The difference of the two captures' means is divided by its
standard error, whose variances lean on those of all places (moderated t), the more the more alike these are. What such
numbers are where nothing changed is seen in halves of one capture's own views, drawn at random: their differences are
noise alone. As halves have fewer views, their t are taken to what t of as many views as both captures have would be.
What halves of one capture can't show (a registration that is a little off, two trainings that err differently, cameras
that stood at the same places both times) is seen in the middle of what is found between the captures, most of which did
not change: two quantiles of it are laid on those of the halves, which gives width and heaviness of the tail.

Where a surface lies is no measurement of single views: all show the one field that a run has learnt, and agree in its
errors. So the error of distances is found from the differences themselves: how large they are at places like this one
(by how far views differ, how bent and rough the surface is, how many views see it), and the tail of a t distribution
that fits their middle.

Source: moderated variances and their prior degrees of freedom, Smyth 2004; an empirical null by the middle of what was
found, Efron 2004; false discoveries among many places, Benjamini and Hochberg 1995.

Notation: `V` views, `P` places, `Q` quantities, `F` features of places.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy import optimize, special, stats

_PRIOR_DEGREES = (0.1, 20.0)
"""Least and most degrees of freedom that the variance of all places counts for at each of them."""
_SPLITS = 8
"""Of each capture's views into halves."""
LEAST_SEEN = 4
"""Views of each capture that have to see a place, so that something can be said of it."""
_MIDDLE = (0.5, 0.8)
"""Quantiles at which the two distributions are laid on each other, the nearer to the tail the better they agree there;
a change of more places than are beyond makes everything less significant."""
_TAILS = (0.5, 2.0)
"""Least and greatest slope between the logarithms of both."""
_CONFIDENCE = 0.95
"""At which errors are widened, so that intervals hold as often as p says."""
_NO_VARIANCE, _NOTHING = 1e-14, 1e-9
"""Variances and squared ratios below which nothing is there, as of the abundance of a material that is elsewhere."""


@dataclass(frozen=True, eq=False)
class Moments:
    """What the views of one capture say of each place together."""

    mean: Float64[np.ndarray, "P Q"]
    variance: Float64[np.ndarray, "P Q"]
    """Between views."""
    count: Int[np.ndarray, " P"]
    prior_degrees: float
    """Degrees of freedom that the variance of all places counts for at each of them."""

    @classmethod
    def of(cls, values: Float[np.ndarray, "V P Q"], prior_degrees: float | None = None) -> Moments:
        """Of values that are NaN where a view does not see a place; without degrees, as the variances say."""
        seen = np.asarray(np.isfinite(values).all(axis=2))
        count = seen.sum(axis=0)
        known = np.where(seen[..., None], values, 0.0).astype(np.float64)
        divisor = count.clip(min=1)[:, None]
        mean = known.sum(axis=0) / divisor
        squares = (np.where(seen[..., None], known - mean, 0.0) ** 2).sum(axis=0)
        variance = squares / (count - 1).clip(min=1)[:, None]
        return cls(mean, variance, count, prior_degrees or _prior_degrees(variance, count))

    @property
    def error_squared(self) -> Float64[np.ndarray, "P Q"]:
        """Of the mean: the variance, drawn towards that of all places, over the number of views."""
        differing = np.where(
            (self.count >= 3)[:, None] & (self.variance > _NO_VARIANCE), self.variance, np.nan
        )
        several = np.isfinite(differing).any(axis=0)
        common = np.zeros(self.mean.shape[1])
        common[several] = np.nanmedian(differing[:, several], axis=0)
        degrees = (self.count - 1).clip(min=0)[:, None]
        variance = (self.prior_degrees * common + degrees * self.variance) / (self.prior_degrees + degrees)
        return variance.clip(min=1e-24) / self.count.clip(min=1)[:, None]


def _prior_degrees(variance: Float64[np.ndarray, "P Q"], count: Int[np.ndarray, " P"]) -> float:
    """By how much more the logarithms of variances differ than those of so many views would by chance."""
    excess = []
    for one in variance.T:
        usable = (count >= 3) & (one > _NO_VARIANCE)
        if usable.sum() > 1:
            low, high = np.quantile(np.log(one[usable]), stats.norm.cdf((-1, 1)))  # rid of outliers
            chance = special.polygamma(1, (count[usable] - 1) / 2).mean()
            excess.append(float(((high - low) / 2) ** 2 - chance))
    least, most = _PRIOR_DEGREES
    wanted = np.clip(np.mean(excess or [0.0]), *special.polygamma(1, [most / 2, least / 2]))
    return (
        2
        * optimize.root_scalar(
            lambda half: special.polygamma(1, half) - wanted, bracket=(0.4 * least, most)
        ).root
    )


def _ratios(first: Moments, second: Moments, least: int) -> Float64[np.ndarray, "P Q"]:
    """Differences over their standard errors; NaN where one of the two is seen by too few views."""
    both = (first.count >= least) & (second.count >= least)
    found = (second.mean - first.mean) / np.sqrt(first.error_squared + second.error_squared)
    return np.where(both[:, None], found, np.nan)


def _null(
    values: Float[np.ndarray, "V P Q"], prior_degrees: float, generator: np.random.Generator
) -> Float64[np.ndarray, "n Q"]:
    """The same of halves of one capture's views."""
    found = []
    for _ in range(_SPLITS):
        order = generator.permutation(len(values))
        halves = [Moments.of(values[half], prior_degrees) for half in np.array_split(order, 2)]
        ratios = _ratios(halves[0], halves[1], LEAST_SEEN // 2)
        known = np.isfinite(ratios).all(axis=1)
        count = (halves[0].count + halves[1].count)[known, None]
        # t of these degrees of freedom as t of twice as many views have it, at the same probability.
        tail = stats.t.sf(np.abs(ratios[known]), prior_degrees + (count - 2).clip(min=1))
        found.append(stats.t.isf(tail.clip(min=1e-300), prior_degrees + (2 * count - 2).clip(min=1)))
    return np.concatenate(found)


@dataclass(frozen=True, eq=False)
class Difference:
    """How one quantity, of one number or several, differs between the captures at each place."""

    mean: Float64[np.ndarray, "P Q"]
    """Second less first."""
    error: Float64[np.ndarray, "P Q"]
    """Standard error of that, widened as the calibration says."""
    p: Float64[np.ndarray, " P"]
    """Probability of so large a difference where nothing changed; NaN where too few views see the place."""
    widening: float
    """How much wider differences between the captures are than halves of one would let expect."""

    @property
    def q(self) -> Float64[np.ndarray, " P"]:
        """`p` after correction for all places."""
        return adjusted(self.p)


def difference(
    before: Float[np.ndarray, "V P Q"], after: Float[np.ndarray, "W P Q"], seed: int = 0
) -> Difference:
    """Compare what two captures' views say of the same places; several numbers are tested together."""
    first, second = Moments.of(before), Moments.of(after)
    ratios = _ratios(first, second, LEAST_SEEN)
    generator = np.random.default_rng(seed)
    both = ((before, first.prior_degrees), (after, second.prior_degrees))
    null = np.concatenate([_null(values, degrees, generator) for values, degrees in both])
    found, expected = (ratios**2).sum(axis=1), np.sort((null**2).sum(axis=1))
    known = np.isfinite(found)
    if not known.any() or len(expected) == 0:
        nothing = np.full_like(ratios, np.nan)
        return Difference(nothing, nothing, np.full(len(ratios), np.nan), 1.0)
    here, there = found[known & (found > _NOTHING)], expected[expected > _NOTHING]
    slope, high, expected_high = 1.0, 1.0, 1.0
    if len(here) and len(there):
        (low, high), (expected_low, expected_high) = (np.quantile(sizes, _MIDDLE) for sizes in (here, there))
        slope = float(np.clip(np.log(high / low) / max(np.log(expected_high / expected_low), 1e-9), *_TAILS))
    # As large as this they would be among halves: the straight line through both quantiles, of logarithms.
    larger = len(expected) - np.searchsorted(expected, expected_high * (found / high) ** (1 / slope))
    edge = max(float(np.quantile(expected, _CONFIDENCE)), _NOTHING)
    widening = float(np.sqrt(high * (edge / expected_high) ** slope / edge))
    mean, error = second.mean - first.mean, widening * np.sqrt(first.error_squared + second.error_squared)
    return Difference(
        np.where(known[:, None], mean, np.nan),
        np.where(known[:, None], error, np.nan),
        np.where(known, (1 + larger) / (1 + len(expected)), np.nan),
        widening,
    )


_DEGREES = (2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 30.0, 100.0)
"""Of freedom that are tried."""
_INNER, _OUTER = 0.5, 0.95
"""Quantiles of sizes that t is fitted to; what changed is expected beyond."""
_USUAL_FEATURES = (0.03, 0.97)
"""Quantiles of each feature of places that are told apart."""
_LEAST_DISTANCE = 0.005
"""Pixels below which a distance is as good as none."""


def difference_of_heights(
    change: Float64[np.ndarray, " P"], features: Float64[np.ndarray, "P F"]
) -> Difference:
    """What of differences of heights (pixels, NaN where unknown) is significant, where nothing but they and features of
    the places tell how uncertain they are."""
    known = np.isfinite(change) & np.isfinite(features).all(axis=1)
    p, error = np.full(len(change), np.nan), np.full(len(change), np.nan)
    if known.sum() < 20 * (1 + features.shape[1]):
        return Difference(np.where(known, change, np.nan)[:, None], error[:, None], p, 1.0)
    given = features[known]
    # What is rare among the places is not extrapolated to: a deep dent is not to explain its own size.
    given = given.clip(*np.quantile(given, _USUAL_FEATURES, axis=0))
    columns = np.concatenate([np.ones((len(given), 1)), given, given**2], axis=1)
    sizes = np.log(np.abs(change[known]) + _LEAST_DISTANCE)
    solution, *_ = np.linalg.lstsq(columns, sizes, rcond=None)
    usual = np.exp(columns @ solution)
    ratios = np.abs(change[known]) / usual
    inner, outer = np.quantile(ratios, _INNER), np.quantile(ratios, _OUTER)
    spreads = [stats.t.ppf((1 + _OUTER) / 2, n) / stats.t.ppf((1 + _INNER) / 2, n) for n in _DEGREES]
    degrees = _DEGREES[int(np.argmin(np.abs(np.array(spreads) - outer / max(inner, 1e-12))))]
    # Of a run beside itself, nearly all distances are 0 and what rounding leaves would stand out.
    error[known] = (usual * inner / stats.t.ppf((1 + _INNER) / 2, degrees)).clip(min=_LEAST_DISTANCE)
    p[known] = 2 * stats.t.sf(np.abs(change[known]) / error[known], degrees)
    return Difference(np.where(known, change, np.nan)[:, None], error[:, None], p, 1.0)


def adjusted(p: Float[np.ndarray, " P"]) -> Float64[np.ndarray, " P"]:
    """p after Benjamini and Hochberg: among places below a limit, at most that part is false; NaN stays.

    >>> adjusted(np.array([0.01, 0.02, 0.9, np.nan])).round(2)
    array([0.03, 0.03, 0.9 ,  nan])
    """
    known = np.isfinite(p)
    values = p[known]
    order = np.argsort(values)
    ranked = values[order] * len(values) / np.arange(1, len(values) + 1)
    found = np.empty_like(values, dtype=np.float64)
    found[order] = np.minimum.accumulate(ranked[::-1])[::-1].clip(max=1.0)
    result = np.full(len(p), np.nan)
    result[known] = found
    return result


def is_significant(q: Float[np.ndarray, " P"], level: float) -> Bool[np.ndarray, " P"]:
    """Where a corrected p is known and small."""
    return np.isfinite(q) & (np.where(np.isfinite(q), q, 1.0) <= level)
