"""Every figure of merit, defined once.

Notation: images are (H, W, B), values in [0, 1], bands last; `pred_*` against `target_*`. Figures are Python floats,
computed in float64 with the prediction clamped to [0, 1]; the mean over views is the caller's. Angles are in radians.
A spectrum of zero length has no direction: its angle to anything is pi/2. Images are converted to float64 a few rows at
a time, so that scoring a cube takes little more memory than the cube.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.evidence import DARK_RMS, over_background

SSIM_WINDOW_PX = 7
_VALUES_AT_ONCE = 1 << 20


def psnr(
    pred_image: Float[Tensor, "H W B"],
    target_image: Float[Tensor, "H W B"],
    valid_mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Peak signal to noise ratio in dB over all pixels and bands that count, peak 1; infinite for equal images.

    >>> psnr(torch.full((2, 2, 3), 0.6, dtype=torch.float64), torch.full((2, 2, 3), 0.5, dtype=torch.float64))
    20.0...
    """
    return _decibels(rmse(pred_image, target_image, valid_mask))


def psnr_over_white(
    pred_image: Float[Tensor, "H W B"],
    pred_opacity: Float[Tensor, "H W"],
    target_image: Float[Tensor, "H W B"],
    target_opacity: Float[Tensor, "H W"],
    valid_mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """The same of two images on black, premultiplied by their opacities, laid over white."""
    opacities = (pred_opacity, target_opacity)
    return _decibels(_root_mean_square(_rows(pred_image, target_image, valid_mask, opacities)))


def rmse(
    pred_image: Float[Tensor, "H W B"],
    target_image: Float[Tensor, "H W B"],
    valid_mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Root of the mean squared error over all pixels and bands; NaN if no pixel counts."""
    return _root_mean_square(_rows(pred_image, target_image, valid_mask))


def ssim(
    pred_image: Float[Tensor, "H W B"],
    target_image: Float[Tensor, "H W B"],
    valid_mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Structural similarity in [-1, 1], mean over bands: 7 x 7 uniform window, data range 1, sample covariance, windows
    that reach beyond the image left out. Pixels whose windows do not count are made equal in both images first.

    Source: Wang et al., IEEE TIP 13(4), 2004, as computed by scikit-image.
    """
    from skimage.metrics import structural_similarity

    height, width, _ = pred_image.shape
    if min(height, width) < SSIM_WINDOW_PX:
        raise SpectrumError(
            f"SSIM needs images of at least {SSIM_WINDOW_PX} x {SSIM_WINDOW_PX} pixels; found {height} x {width}"
        )
    valid = torch.ones(height, width, dtype=torch.bool) if valid_mask is None else valid_mask.cpu()
    inner = slice(SSIM_WINDOW_PX // 2, -(SSIM_WINDOW_PX // 2))
    if not bool(valid[inner, inner].any()):
        return math.nan
    means = []
    for pred_band, target_band in zip(pred_image.unbind(-1), target_image.unbind(-1), strict=True):
        pred, target = (
            torch.where(valid, band.detach().cpu().double(), 0.0).numpy()
            for band in (pred_band.clamp(0, 1), target_band)
        )
        result: Any = structural_similarity(target, pred, win_size=SSIM_WINDOW_PX, data_range=1.0, full=True)
        similarity = result[1]  # [0] is the mean over all pixels
        means.append(float(similarity[inner, inner][valid[inner, inner].numpy()].mean()))
    return math.fsum(means) / len(means)


def sam(
    pred_image: Float[Tensor, "H W B"],
    target_image: Float[Tensor, "H W B"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Spectral angle mapper: mean angle in radians over the pixels that count; NaN if none does, or of a single band.

    Pixels whose true spectrum is dark (root mean square over bands at most 0.005) never count.
    """
    total, count = 0.0, 0
    if target_image.shape[-1] < 2:  # numbers have no angle between them
        return math.nan
    for pred, target, counts in _rows(pred_image, target_image, mask):
        counts = counts & (target.norm(dim=-1) > DARK_RMS * math.sqrt(target.shape[-1]))
        total += float(spectral_angle(pred[counts], target[counts]).sum())
        count += int(counts.sum())
    return total / count if count else math.nan


def spectral_angle(a: Float[Tensor, "*#rays B"], b: Float[Tensor, "*#rays B"]) -> Float[Tensor, "*#rays"]:
    """Angle between spectra, blind to brightness.

    Radians in [0, pi], precise for small angles too; gradients stay finite at parallel and at zero spectra.

    Source:
        Kruse et al. 1993, spectral angle mapper; in Kahan's form, 2 atan2(|u - v|, |u + v|) of the unit spectra, as
        arccos loses half the digits at 0 and has an infinite slope there.

    >>> spectral_angle(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 2.0]))
    tensor(1.5708)
    """
    u, v = _unit(a), _unit(b)
    return 2 * torch.atan2((u - v).norm(dim=-1), (u + v).norm(dim=-1))


@dataclass(frozen=True)
class _EndmemberMatching:
    """Which predicted endmember stands for which true one."""

    pred_ids: tuple[int, ...]
    true_ids: tuple[int, ...]
    """Pairs in step with `pred_ids`, increasing; as many as the smaller set has."""
    angles: tuple[float, ...]
    """Angle of each pair in radians."""


def match_endmembers(
    pred_endmembers: Float[Tensor, "P B"], true_endmembers: Float[Tensor, "K B"]
) -> _EndmemberMatching:
    """Pair predicted with true endmembers one to one so that the sum of spectral angles is least (Hungarian method)."""
    from scipy.optimize import linear_sum_assignment

    angles = spectral_angle(true_endmembers.double()[:, None], pred_endmembers.double()[None])
    true_ids, pred_ids = linear_sum_assignment(angles.cpu().numpy())
    return _EndmemberMatching(
        pred_ids=tuple(int(i) for i in pred_ids),
        true_ids=tuple(int(i) for i in true_ids),
        angles=tuple(float(angles[t, p]) for t, p in zip(true_ids, pred_ids, strict=True)),
    )


def endmember_angle(pred_endmembers: Float[Tensor, "P B"], true_endmembers: Float[Tensor, "K B"]) -> float:
    """Mean angle in radians between true endmembers, in the light that the predicted ones are in, and their matches.

    The mean is over true materials: one without a match counts pi/2, surplus predicted endmembers do not count.
    """
    matching = match_endmembers(pred_endmembers, true_endmembers)
    num_unmatched = len(true_endmembers) - len(matching.true_ids)
    return (sum(matching.angles) + num_unmatched * math.pi / 2) / len(true_endmembers)


def abundance_rmse(
    pred_abundances: Float[Tensor, "H W P"],
    true_abundances: Float[Tensor, "H W K"],
    matching: _EndmemberMatching,
    mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Root mean squared error of abundances over pixels and true materials; NaN where no pixel counts.

    A true material without a match is predicted as 0; what a surplus predicted endmember takes is missing from the
    others. Without a mask, pixels count whose true abundances are not all zero.
    """
    if mask is None:
        mask = true_abundances.sum(dim=-1) > 0
    matched = torch.zeros_like(true_abundances)
    matched[..., list(matching.true_ids)] = pred_abundances.to(matched)[..., list(matching.pred_ids)]
    return _root_mean_square(_rows(matched, true_abundances, mask))


def _rows(
    pred_image: Float[Tensor, "H W C"],
    target_image: Float[Tensor, "H W C"],
    mask: Bool[Tensor, "H W"] | None,
    opacities: tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]] | None = None,
) -> Iterator[tuple[Float[Tensor, "h W C"], Float[Tensor, "h W C"], Bool[Tensor, "h W"]]]:
    """A few rows at a time: prediction clamped and truth, both in float64, over white where `opacities` are given; and
    the pixels that count."""
    height, width, channels = pred_image.shape
    if mask is None:
        mask = torch.ones(height, width, dtype=torch.bool, device=target_image.device)
    step = max(1, _VALUES_AT_ONCE // max(1, width * channels))
    for start in range(0, height, step):
        pred, target, counts = (image[start : start + step] for image in (pred_image, target_image, mask))
        if opacities is not None:
            white = torch.ones_like(target[..., :1])
            pred, target = (
                over_background(image, opacity[start : start + step], white)
                for image, opacity in zip((pred, target), opacities, strict=True)
            )
        yield pred.detach().double().clamp(0, 1), target.double(), counts


def _decibels(error: float) -> float:
    return math.inf if error == 0 else -20 * math.log10(error)


def _root_mean_square(
    rows: Iterator[tuple[Float[Tensor, "h W C"], Float[Tensor, "h W C"], Bool[Tensor, "h W"]]],
) -> float:
    """Of the differences over all rows; NaN where nothing counts."""
    total, count = 0.0, 0
    for pred, target, counts in rows:
        difference = (pred - target)[counts]
        total += float(difference.square().sum())
        count += difference.numel()
    return math.sqrt(total / count) if count else math.nan


def _unit(spectra: Tensor) -> Tensor:
    # Zero spectra stay zero: dividing by 1, not by a tiny number, keeps their gradient finite.
    lengths = spectra.norm(dim=-1, keepdim=True)
    return spectra / torch.where(lengths > 0, lengths, 1.0)
