"""Targets by name, `ace:paint.csv#gold>0.5`: how much each pixel looks like a given spectrum.

Notation: `B` bands, `N` pixels of the background, `*rays` any leading axes; spectra x and target t are reflectances.
The background has mean m and covariance S = C + d trace(C) / B, C the sample covariance, d `LOADING`. A score is NaN
where a pixel has a value that is not finite, is zero in all bands, or has no defined score.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.errors import ConfigError, SpectrumError, did_you_mean
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import LibraryMaterial, MaterialLibrary
from unmix_plugin.spectral.library.spectral_tables import TABLE_SUFFIXES
from unmix_plugin.spectral.metrics import spectral_angle

LOADING = 1e-3
"""Added to the covariance's diagonal, in mean variances of a band: a target may differ from how it is rendered by about
3% of the background's standard deviation in each band. Rendered spectra are mixtures of a few and vary in no other
direction, so that with much less, the smallest difference makes the target unlike everything in view; with much more,
similar materials can no longer be told apart. Chosen on rendered views against true reflectances of seven materials."""
_LEAST_DISTANCE = 1e-4
"""From the background's mean to a target, in standard deviations: the rounding of float32 reaches a tenth of it."""
_DetectionMethod = Literal["angle", "mf", "ace"]
"""Spectral angle, matched filter, adaptive coherence estimator."""
_GRAMMAR = re.compile(
    rf"((?P<method>{'|'.join(get_args(_DetectionMethod))}):)?"
    rf"(?P<file>.+?\.({'|'.join(TABLE_SUFFIXES)}|sli|hdr))(#(?P<name>.*?))?"
    r"(\s*(?P<side>[<>])\s*(?P<limit>[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?)\s*)?",
    re.IGNORECASE | re.DOTALL,
)
_EXAMPLES = "paint.csv, ace:paint.csv, mf:paint.csv#gold or 'paint.csv#gold<0.1'"
_SIDES: dict[_DetectionMethod, str] = {"angle": "<", "mf": ">", "ace": ">"}
"""On which side of a threshold a pixel is like the target."""
_POSSIBLE = {"angle": (0.0, math.pi), "mf": (-math.inf, math.inf), "ace": (0.0, 1.0)}
_USUAL = {"angle": (0.0, 0.5), "mf": (0.0, 1.0), "ace": None}
"""What pictures show; of `ace` the range that there is: a target that most resembles its background differs from it in
all pixels but has small scores."""
_LABELS: dict[_DetectionMethod, tuple[str, str]] = {
    "angle": ("spectral angle in radians to", "0 = the same but for brightness"),
    "mf": ("matched filter score of", "1 = like the target, 0 = like the background's mean"),
    "ace": ("adaptive coherence with", "1 = differs from the background as the target does, 0 = does not"),
}


@dataclass(frozen=True)
class Background:
    """Mean of what else there is, and the map after which it varies alike in all directions."""

    mean: Float[Tensor, "B"]
    whitening: Float[Tensor, "B B"]
    """W with W S W^T = 1: inverse of the lower Cholesky factor of S. Both float64."""

    @staticmethod
    def fit(spectra: Float[Tensor, "N B"]) -> Background:
        """Of a sample of pixels; those not finite or zero in all bands do not count, and two that differ are needed."""
        counted = spectra[_is_defined(spectra)].double()
        if len(counted) < 2:
            raise SpectrumError(
                f"the background has {len(counted)} pixels in which something is and its reflectance is known in all "
                "bands (2 or more needed); choose views that show more, or the spectral angle"
            )
        mean = counted.mean(dim=0)
        centred = counted - mean
        covariance = centred.T @ centred / (len(counted) - 1)
        variance = covariance.diagonal().mean()
        if not variance > 1e-12 * mean.square().mean():
            raise SpectrumError(
                f"all {len(counted)} pixels of the background are equal, so nothing stands out from it; choose views "
                "that show more, or the spectral angle"
            )
        identity = torch.eye(len(mean)).to(covariance)
        factor = torch.linalg.cholesky(covariance + LOADING * variance * identity)
        return Background(mean, torch.linalg.solve_triangular(factor, identity, upper=False))

    def _whiten(self, spectra: Float[Tensor, "*rays B"]) -> Float[Tensor, "*rays B"]:
        """W (x - m), float64: lengths and angles in these coordinates are those of S^-1."""
        return (spectra.double() - self.mean) @ self.whitening.T


def _is_defined(spectra: Float[Tensor, "*rays B"]) -> Bool[Tensor, "*rays"]:
    """Which spectra are finite in all bands and not zero in all."""
    return spectra.isfinite().all(dim=-1) & (spectra != 0).any(dim=-1)


def matched_filter(
    spectra: Float[Tensor, "*rays B"], target: Float[Tensor, "B"], background: Background
) -> Float[Tensor, "*rays"]:
    """(x - m)^T S^-1 (t - m) / ((t - m)^T S^-1 (t - m)): 1 for the target t, 0 for the background's mean, float64.

    Source: Manolakis, Marden and Shaw 2003, Lincoln Laboratory Journal 14(1), as normalised by Eismann 2012.
    """
    wanted = background._whiten(target)
    return background._whiten(spectra) @ (wanted / wanted.square().sum())


def adaptive_coherence(
    spectra: Float[Tensor, "*rays B"], target: Float[Tensor, "B"], background: Background
) -> Float[Tensor, "*rays"]:
    """Squared cosine between x - m and t - m under S^-1, [0, 1], float64; NaN for the background's mean.

    0 where the cosine is negative: the square alone would find the opposite of the target too.

    Source:
        Scharf and McWhorter 1996, Adaptive matched subspace detectors and adaptive coherence estimators; Kraut, Scharf
        and Butler 2005, IEEE Trans. Signal Processing 53(2).
    """
    wanted, found = background._whiten(target), background._whiten(spectra)
    lengths = wanted.norm() * found.norm(dim=-1)
    return (found @ wanted / lengths).clamp(0, 1).square()


@dataclass(frozen=True)
class _Target:
    """A spectrum to look for, and how."""

    method: _DetectionMethod
    name: str
    file: str
    """Where the spectrum is from, for messages and legends."""
    reflectance: Float[Tensor, "B"]
    """Float64, at the bands of the run."""
    threshold: float | None = None
    """Scores below it (angle) or above it (mf, ace) become 1, others 0; None: the scores themselves."""

    @property
    def what(self) -> str:
        """One line: what the numbers are."""
        score, meaning = _LABELS[self.method]
        if self.threshold is None:
            return f"{score} '{self.name}' ({self.file}): {meaning}"
        side = "below" if self.method == "angle" else "above"
        return f"{score} '{self.name}' ({self.file}) {side} {self.threshold:g}: 1 = yes, 0 = no"

    @property
    def usual_range(self) -> tuple[float, float] | None:
        """What pictures show; None: whatever range there is."""
        return _USUAL[self.method] if self.threshold is None else (0.0, 1.0)

    def fit(
        self, background: Float[Tensor, "N B"]
    ) -> Callable[[Float[Tensor, "*rays B"]], Float[Tensor, "*rays"]]:
        """From reflectances to scores, or to 1 and 0 with a threshold: of the spectra's type and on their device.

        A sample of the scene's reflectances, which may not have the target as its mean, is the background to judge
        against; the angle ignores it.
        """
        if background.shape[1] != len(self.reflectance):
            raise SpectrumError(
                f"the target '{self.name}' has {len(self.reflectance)} bands, the background {background.shape[1]}"
            )
        around = None if self.method == "angle" else Background.fit(background)
        if around and not around._whiten(self.reflectance.to(around.mean)).norm() > _LEAST_DISTANCE:
            raise SpectrumError(
                f"the target '{self.name}' ({self.file}) is the mean of the background, so nothing tells them apart; "
                "choose views that show more than the target, or the spectral angle"
            )

        def score(reflectance: Float[Tensor, "*rays B"]) -> Float[Tensor, "*rays"]:
            spectra, target = reflectance.double(), self.reflectance.to(reflectance.device)
            if around is None:
                scores = spectral_angle(spectra, target)
            else:
                detect = matched_filter if self.method == "mf" else adaptive_coherence
                here = Background(around.mean.to(target), around.whitening.to(target))
                scores = detect(spectra, target, here)
            if self.threshold is not None:
                passes = scores < self.threshold if self.method == "angle" else scores > self.threshold
                scores = torch.where(scores.isnan(), scores, passes.double())
            return torch.where(_is_defined(reflectance), scores, torch.nan).to(reflectance.dtype)

        return score


def parse_target(text: str, bands: Bands, read: Callable[[Path], Sequence[LibraryMaterial]]) -> _Target:
    """The text after `target:` in the name of an output, `[METHOD:]FILE[#NAME][<VALUE | >VALUE]`, for reflectances of
    these bands; `read` reads the file's spectra.

    Raises:
        ConfigError: text of another form, no such file, no or several spectra that could be meant, a threshold on the
            wrong side or one that says the same of every pixel.
        SpectrumError: the file is not a library of spectra, does not cover the bands, is not in reflectances (the angle
            takes any unit), or has no angle to anything.
    """
    match = _GRAMMAR.fullmatch(text)
    if match is None:
        raise ConfigError(f"target:{text} must be target:[METHOD:]FILE[#NAME][<VALUE], as in {_EXAMPLES}")
    prefix = match["method"] or ""
    named: _DetectionMethod | None = next((known for known in _SIDES if known == prefix), None)
    file = match["file"] if named or not prefix else f"{prefix}:{match['file']}"
    method: _DetectionMethod = "angle" if named is None else named
    threshold = None if match["limit"] is None else _threshold(method, match["side"], float(match["limit"]))
    library = _library(file, read)
    name = _chosen(match["name"], library.names, file)
    try:
        reflectance = library.reflectance(name, bands)
    except SpectrumError as error:
        raise SpectrumError(f"{file}: {error}") from error
    what = f"the target '{name}' ({file})"
    if method == "angle" and not reflectance.any():
        raise SpectrumError(f"{what} is zero in all bands: no angle to it is defined; choose mf or ace")
    if method != "angle":
        library.require_reflectance(name, reflectance, what)
    if method != "mf" and len(reflectance) < 2:
        raise SpectrumError(f"{method} compares spectra of two bands or more; found 1 band")
    return _Target(method, name, Path(file).name, torch.from_numpy(reflectance.copy()), threshold)


def _threshold(method: _DetectionMethod, side: str, limit: float) -> float:
    if side != _SIDES[method]:
        alike = "small" if method == "angle" else "large"
        raise ConfigError(
            f"{alike} scores of {method} are alike, so its threshold is {_SIDES[method]}{limit:g}; "
            f"found {side}{limit:g}"
        )
    low, high = _POSSIBLE[method]
    if not (low < limit <= high if method == "angle" else low <= limit < high):
        raise ConfigError(
            f"scores of {method} lie between {low:g} and {high:.4g}, so {side}{limit:g} says the same of every pixel"
        )
    return limit


def _library(file: str, read: Callable[[Path], Sequence[LibraryMaterial]]) -> MaterialLibrary:
    if not Path(file).exists():
        prefix, colon, _ = file.partition(":")
        near = difflib.get_close_matches(prefix.lower(), _SIDES, n=1, cutoff=0.6) if colon else []
        hint = f"; did you mean the method {near[0]}: (they are {', '.join(_SIDES)})?" if near else ""
        raise ConfigError(f"there is no file {file} with the spectrum of a target{hint}")
    return MaterialLibrary(tuple(read(Path(file))))


def _chosen(name: str | None, names: Sequence[str], file: str) -> str:
    listed = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    if name is None:
        if len(names) == 1:
            return names[0]
        raise ConfigError(f"{file} has {len(names)} spectra; say which, as in {file}#NAME: {listed}")
    if name in names:
        return name
    hint = did_you_mean(name, names, form="{} ")
    raise ConfigError(f"{file} has no spectrum {name!r}; {hint}it has {listed}")
