"""One image alone: its endmembers, what each pixel is made of, and how certain that is.

Notation: `H x W` pixels, `N` of them in use, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Shaped
from torch import Tensor

from unmix_plugin.errors import SpectrumError, counted
from unmix_plugin.spectral.intervals import (
    COVERAGE,
    Interval,
    propagated_deviation,
    require_coverage,
    width_factor,
)
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.spectral.unmixing.abundances import nnls
from unmix_plugin.spectral.unmixing.endmembers import (
    as_lit_pixels,
    comparable_brightness,
    drop_uninformative_pixels,
    equal_peaks,
    usable_pixels,
)
from unmix_plugin.spectral.unmixing.num_materials import LEAST_BANDS, hysime, propose_num_materials
from unmix_plugin.spectral.unmixing.pooled_search import PooledEndmembers, pooled_search

_LIT = 0.9
"""Value that the 99.9th percentile of the pixels' peaks is scaled to, so that few count as saturated."""
_LIT_QUANTILE = 0.999
_PIXELS_TO_COUNT_BY = 20_000
_SHARED_MARGIN_ERROR = 0.6
"""Standard error of a margin where all sets agree: of what they get wrong alike. With it, of the pixels of artificial
landscapes about as many are right as the confidence says."""

_DIRECTIONS, _LEAST_SCALE = 4, 0.3
"""Of misfits that are followed through the unmixing, and the least misfit of a pixel in usual ones."""
_ALIKE, _ALIKE_IN_MIXTURES, _LEAST_ERROR = 0.1, 4.0, 0.01
"""What all sets get wrong alike, in the image's mean square of what they do not; times a (1 - a), what mixtures have
more of it; the least expected error. An image that is hard to unmix misleads all searches."""
_ENDMEMBER_ALIKE = 2.0
"""What all sets get wrong alike of an endmember, relative to it, in median angles between pixels and their mixtures: of
landscapes of even number, so that 0.8 to 1.0 of the values are in 90 % intervals, 0.92 in the median one."""
_WIDTH_FACTORS = (0.25, 0.45, 0.72, 1.1, 2.0, 3.2, 9.4)
"""Half widths of intervals in expected errors, for each of COVERAGES: of ten artificial landscapes of even number, so
many abundances had smaller errors."""

_ALONE = "of one material there is nothing to be mixed with, and whether another is missing is unknown"

Shares = Literal["auto", "area", "light"]
"""What abundances are shares of.

Area: endmembers are as bright as their well-lit pixels, so a dark material covers more than it shines. Light: all have
the same peak, as reference maps of images from the air count. Auto is area, but light where one material is less than
a quarter as bright as the brightest: haze, glint and noise would then become large areas of it.
"""


@dataclass(frozen=True)
class UnmixedImage:
    """What an image is made of."""

    endmembers: Float32[np.ndarray, "K B"]
    """Spectra in the image's unit, as bright as the well-lit pixels that look like them, the most frequent first."""
    abundances: Float32[np.ndarray, "H W K"]
    """Shares of each pixel, at least 0 with sum 1; zeros for black pixels and those left out."""
    confidence: Float32[np.ndarray, "H W"]
    """Estimated probability that a pixel's largest abundance is its largest in truth, by its margin over the second and
    how far the best searches agree, 0.95 at most; 0 where there are no abundances."""
    deviation: Float32[np.ndarray, "H W K"]
    """Expected error of each abundance, by which intervals are made; 0 where there are no abundances."""
    endmember_deviation: Float32[np.ndarray, "K B"]
    """Expected error of each endmember in each band, by which its interval is made."""
    misfit: Float32[np.ndarray, "H W"]
    """Angle in radians between a pixel and its mixture; 0 where there are no abundances."""
    shares: Literal["area", "light"]
    """What abundances are shares of."""
    evidence: str
    """Why so many materials, in a few lines; empty where the number was given."""

    def endmember_interval(self, coverage: float = COVERAGE) -> Interval:
        """Where each endmember lies in each band, (K, B), as bright as it is: how far the best sets of endmembers
        differ, and more where mixtures do not fit the pixels. Errors are those of `interval`."""
        values = self.endmembers.astype(np.float64)
        if len(values) == 1:
            require_coverage(coverage)
            return Interval.unknown(values, coverage, _ALONE)
        return Interval.of_endmembers(values, self.endmember_deviation.astype(np.float64), coverage)

    def interval(self, coverage: float = COVERAGE) -> Interval:
        """Where each abundance lies, (H, W, K), with this probability; NaN where there are no abundances, and not
        determined of a single material. A ConfigError where intervals of that coverage can't be given."""
        half = width_factor(torch.tensor(_WIDTH_FACTORS), coverage) * self.deviation.astype(np.float64)
        values = self.abundances.astype(np.float64)
        if values.shape[2] == 1:
            return Interval.unknown(values, coverage, _ALONE)
        has_abundances = values.sum(axis=2, keepdims=True) > 0
        low, high = (
            np.where(has_abundances, end.clip(0, 1), np.nan) for end in (values - half, values + half)
        )
        return Interval(low, high, coverage)


def unmix_image(
    cube: Shaped[np.ndarray, "..."],
    endmembers: int | Literal["auto"] = "auto",
    *,
    mask: Bool[np.ndarray, "..."] | None = None,
    shares: Shares = "auto",
    seed: int = 0,
) -> UnmixedImage:
    """Find the spectra of an image's materials, and how much of each every pixel shows.

    Args:
        cube: (H, W, B), radiance or reflectance in any unit, in whole numbers too; negative values count as 0.
        endmembers: How many materials to find; auto proposes a number.
        mask: (H, W), pixels to use; None takes all. A pixel of which a NumPy masked array masks a band is left out.
        shares: What abundances are shares of.
        seed: Everything random follows from it.
    Raises:
        SpectrumError: no cube, an option that there is not, no light, NaN or infinite values in pixels to use, or more
            materials than bands, than distinct pixels or than the pixels hold above their noise.

    >>> materials = np.array([[0.1, 0.2, 0.6, 0.7], [0.6, 0.5, 0.2, 0.1]])
    >>> share = np.linspace(0, 1, 400)[:, None]
    >>> cube = (share * materials[0] + (1 - share) * materials[1]).reshape(20, 20, 4)
    >>> unmix_image(cube, 2).abundances.shape
    (20, 20, 2)
    """
    if not isinstance(cube, np.ndarray):
        raise SpectrumError(f"an image to unmix is a NumPy array; found {type(cube).__name__}")
    if not (isinstance(endmembers, int | np.integer) or endmembers == "auto"):
        raise SpectrumError(f"endmembers must be a whole number or 'auto'; found {endmembers!r}")
    if not (isinstance(seed, int | np.integer) and -(2**63) <= seed < 2**63):
        raise SpectrumError(f"seed must be a whole number of at most 63 bits; found {seed!r}")
    if shares not in get_args(Shares):
        raise SpectrumError(f"shares must be {', '.join(get_args(Shares))}; found {shares!r}")
    used = _used_pixels(cube, mask)
    cube = np.ma.getdata(cube, subok=False)  # SPy's images index pixels in a way of their own
    spectra = torch.from_numpy(np.ascontiguousarray(cube[used], dtype=np.float32)).clamp(min=0)
    peaks = spectra.amax(dim=1)
    usual = peaks.kthvalue(max(1, round(_LIT_QUANTILE * len(peaks)))).values
    brightest = float(usual) or float(peaks.max())
    if not brightest > 0:
        raise SpectrumError("the image is black: no pixel to use holds a value above 0")
    pixels = spectra * (_LIT / brightest)
    generator = torch.Generator().manual_seed(int(seed))
    count, evidence = _proposed(pixels, generator) if endmembers == "auto" else (endmembers, "")
    usable = usable_pixels(pixels, count, generator)
    _require_signal(usable, count)
    found = pooled_search(usable, count, generator)
    lit = as_lit_pixels(found.endmembers, usable)
    adjusted = {"auto": comparable_brightness, "light": equal_peaks}
    compared = adjusted[shares](lit) if shares in adjusted else lit
    amounts = nnls(pixels, compared)
    order = _shares(amounts).sum(dim=0).argsort(descending=True)
    own = _shares(amounts[:, order])
    of_margins, of_sets = _spread_over_sets(pixels, own, found, compared, order)
    certain = _confidence(own, of_margins)
    deviation = _deviation(pixels, own, compared[order], pixels - amounts @ compared, of_sets)
    others = found.others * lit.norm(dim=1, keepdim=True)
    is_lit = amounts.sum(dim=1) > 0
    misfit = torch.where(is_lit, spectral_angle(pixels, amounts @ compared), 0.0)
    shared = _ENDMEMBER_ALIKE * misfit[is_lit].median() * lit.square().mean(dim=1, keepdim=True).sqrt()
    of_endmembers = ((others - lit).square().mean(dim=0) + shared.square()).sqrt()
    return UnmixedImage(
        (lit[order] * (brightest / _LIT)).numpy(),
        _placed(own, used),
        _placed(torch.where(is_lit, certain, 0.0), used),
        _placed(torch.where(is_lit[:, None], deviation, 0.0), used),
        (of_endmembers[order] * (brightest / _LIT)).numpy(),
        _placed(misfit, used),
        "area" if torch.equal(compared, lit) else "light",
        evidence,
    )


def _used_pixels(cube: np.ndarray, mask: np.ndarray | None) -> Bool[np.ndarray, "H W"]:
    if cube.ndim != 3 or cube.dtype.kind not in "iuf" or 0 in cube.shape:
        raise SpectrumError(
            f"an image to unmix is an array of rows, columns and bands of real numbers; found {cube.dtype} of shape "
            f"{cube.shape}"
        )
    used = np.ones(cube.shape[:2], bool) if mask is None else np.asarray(mask)
    if used.shape != cube.shape[:2] or used.dtype != bool:
        raise SpectrumError(
            f"the mask must be {cube.shape[0]} x {cube.shape[1]} of True and False; found {used.dtype} of shape "
            f"{used.shape}"
        )
    if isinstance(cube, np.ma.MaskedArray):
        used = used & ~np.ma.getmaskarray(cube).any(axis=-1)
    if not used.any():
        raise SpectrumError("the mask leaves no pixel to unmix")
    broken = used & ~np.isfinite(np.ma.getdata(cube, subok=False)).all(axis=-1)
    if broken.any():
        raise SpectrumError(
            f"{int(broken.sum())} of {int(used.sum())} pixels hold NaN or infinite values; leave them out with a mask"
        )
    return used


def _proposed(pixels: Float[Tensor, "N B"], generator: torch.Generator) -> tuple[int, str]:
    """A number of materials, and why."""
    informative = drop_uninformative_pixels(pixels)
    if len(informative) == 0:
        raise SpectrumError("no pixel is neither dark nor saturated: there is nothing to count materials by")
    some = informative[torch.randperm(len(informative), generator=generator)[:_PIXELS_TO_COUNT_BY]]
    proposed = propose_num_materials(some, generator)
    dimensions = proposed.signal_dimensions
    if dimensions is None or proposed.number <= max(1, dimensions):
        return proposed.number, proposed.evidence()
    # Where most pixels mix more than two materials, pairs need more of them than there are.
    return max(1, dimensions), f"{proposed.evidence()}\nso {dimensions} are taken: mixtures of two need more"


def _require_signal(usable: Float[Tensor, "N B"], count: int) -> None:
    """Refuse more materials than the pixels can tell apart: K of them, one among the others, span K - 1 dimensions."""
    num_pixels, num_bands = usable.shape
    if num_bands < LEAST_BANDS or num_pixels <= num_bands:
        return
    dimensions = hysime(usable)
    if count > dimensions + 1:
        raise SpectrumError(
            f"the pixels hold {counted(dimensions, 'dimension')} above their noise, by which at most {dimensions + 1} "
            f"materials can be told apart; {count} were asked for; ask for at most {dimensions + 1}"
        )


def _shares(amounts: Float[Tensor, "N K"]) -> Float[Tensor, "N K"]:
    return amounts / amounts.sum(dim=1, keepdim=True).clamp(min=1e-12)


def _spread_over_sets(
    pixels: Float[Tensor, "N B"],
    own: Float[Tensor, "N K"],
    found: PooledEndmembers,
    compared: Float[Tensor, "K B"],
    order: Tensor,
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N K"]]:
    """Mean squares by which the margin of the largest share, and all shares, differ with the other best sets of
    endmembers; 0 of a single material."""
    of_margins, of_sets = torch.zeros(len(own)), torch.zeros_like(own)
    if own.shape[1] == 1:
        return of_margins, of_sets
    largest = own.topk(2, dim=1)
    margins = largest.values[:, 0] - largest.values[:, 1]
    for other in found.others:
        shares = _shares(nnls(pixels, other * compared.norm(dim=1, keepdim=True)))[:, order]
        first, second = shares.gather(1, largest.indices).unbind(1)
        of_margins += (margins - first + second).square() / len(found.others)
        of_sets += (shares - own).square() / len(found.others)
    return of_margins, of_sets


def _confidence(own: Float[Tensor, "N K"], of_margins: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Probability that the largest share is the largest in truth: of its margin, if the spread of the margin over the
    best sets of endmembers is the margin's error."""
    if own.shape[1] == 1:  # nothing is second, and no search can tell whether a material is missing
        return torch.special.ndtr(torch.ones(len(own)) / _SHARED_MARGIN_ERROR)
    largest = own.topk(2, dim=1).values
    error = (of_margins + _SHARED_MARGIN_ERROR**2).sqrt()
    return torch.special.ndtr((largest[:, 0] - largest[:, 1]) / error)


def _deviation(
    pixels: Float[Tensor, "N B"],
    own: Float[Tensor, "N K"],
    ordered: Float[Tensor, "K B"],
    misfits: Float[Tensor, "N B"],
    of_sets: Float[Tensor, "N K"],
) -> Float[Tensor, "N K"]:
    """Expected errors of shares: what the misfits of pixels become through the unmixing, how far the best sets of
    endmembers differ, and what all sets get wrong alike."""
    if own.shape[1] == 1:
        return torch.zeros_like(own)
    eigen = torch.linalg.eigh((misfits.T @ misfits).double() / len(misfits))
    kept = slice(-min(_DIRECTIONS, misfits.shape[1]), None)
    directions = (eigen.eigenvectors[:, kept] * eigen.eigenvalues[kept].clamp(min=0).sqrt()).T.to(pixels)
    sizes = misfits.square().mean(dim=1).sqrt()
    scales = (sizes / sizes.square().mean().sqrt().clamp(min=1e-12)).clamp(min=_LEAST_SCALE)
    own_errors = propagated_deviation(lambda one: _shares(nnls(one, ordered)), pixels, directions, scales)
    known = own_errors.square() + of_sets
    alike = known.mean() * (_ALIKE + _ALIKE_IN_MIXTURES * own * (1 - own))
    return (known + alike + _LEAST_ERROR**2).sqrt()


def _placed(values: Tensor, used: Bool[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W *rest"]:
    """Values of the pixels in use in the image, 0 elsewhere."""
    placed = np.zeros((*used.shape, *values.shape[1:]), np.float32)
    placed[used] = values.numpy()
    return placed
