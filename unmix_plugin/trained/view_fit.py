"""Which training views do not fit what all of them together were trained to, and why: pose, exposure or blur.

A view with another view's pose, another exposure or a blur can't be explained by a scene that explains the others:
its error stands out. What is wrong with it is what makes the error smaller: one factor, an exposure; a shift of the
picture, a pose. Where fine structures are missing it is blurred; an error all over the view that nothing explains is a
pose, too.

Notation: `h x w` pixels of a view thinned out, `B` bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import Enum, unique
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.engine.runs.run_json import read_run_json, write_run_json
from unmix_plugin.trained.training_views import ThinnedView

FILE_NAME = "training_views.json"
"""In the folder of a run."""
_FEWEST_VIEWS, _FEWEST_PIXELS = 6, 50
_TIMES_USUAL, _LEAST_ERROR = 2.0, 0.05
"""Error of a view over the median of all from which it stands out, if it is so much of its brightness at all."""
_MOST = 0.25
"""Share of the views that may stand out; more are the capture as it is."""
_EXPLAINS = 0.7
"""Of the error, what is left where a cause explains it."""
_LEAST_FACTOR = float(np.log(1.15))
_FURTHEST_SHIFT = 4
"""Pixels of the thinned-out view."""
_BLURRED, _TIMES_USUAL_BLURRED = 0.6, 1.3
"""Fine contrast of a view over what is rendered of it, relative to the other views, and the error that stands out then:
a blur takes little of the brightness."""
_ALL_OVER = 0.4
"""Share of the pixels in which the error is above the usual one, of a pose that is wrong."""


@unique
class Misfit(Enum):
    """What is wrong with a view."""

    EXPOSURE = "exposure"
    POSE = "pose"
    BLUR = "blur"
    CONTENT = "it shows something that the others do not"


@dataclass(frozen=True)
class ViewFit:
    """A training view beside what is rendered of it."""

    name: str
    error: float
    """Root mean square over pixels and bands, as a share of what was measured."""
    factor: float
    """Measured over rendered, least squares."""
    error_of_factor: float
    """Error left with it."""
    error_of_shift: float
    """Error left with the best shift of the picture by whole pixels."""
    sharpness: float
    """Fine contrast measured over that rendered."""
    spread: float
    """Share of the pixels whose error is at least half of the root mean square."""


def fit_of_view(view: ThinnedView) -> ViewFit | None:
    """Compare a training view with what is rendered of it; None where it is dark or too few pixels count."""
    counts = view.counts
    if counts.sum() < _FEWEST_PIXELS:
        return None
    measured, rendered = view.measured[counts], view.rendered[counts]
    scale = float(np.sqrt(np.mean(measured**2)))
    if not scale > 0:
        return None
    factor = float((measured * rendered).sum() / max(float((rendered**2).sum()), 1e-12))
    away = np.sqrt(np.mean((measured - rendered) ** 2, axis=1)) / scale
    error = float(np.sqrt(np.mean(away**2)))
    grey, shown = view.measured.mean(axis=2), view.rendered.mean(axis=2)
    contrast = [_fine_contrast(picture, counts) for picture in (grey, shown)]
    return ViewFit(
        name=view.name,
        error=error,
        factor=factor,
        error_of_factor=float(np.sqrt(np.mean((measured - factor * rendered) ** 2))) / scale,
        error_of_shift=error * left_by_best_shift(grey, shown, counts),
        sharpness=contrast[0] / max(contrast[1], 1e-12),
        spread=float((away > 0.5 * error).mean()),
    )


def _fine_contrast(picture: Float64[np.ndarray, "h w"], counts: Bool[np.ndarray, "h w"]) -> float:
    """Root mean square of second differences along rows and columns; it is compared with that of the same pixels as
    rendered, so that unlike sharpness within a capture it needs no coarse contrast to be divided by."""
    squares = []
    for image, known in ((picture, counts), (picture.T, counts.T)):
        inside = known[:, :-2] & known[:, 1:-1] & known[:, 2:]
        squares.append(((image[:, :-2] - 2 * image[:, 1:-1] + image[:, 2:])[inside]) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if sum(map(len, squares)) else 0.0


def left_by_best_shift(
    measured: Float64[np.ndarray, "h w"],
    rendered: Float64[np.ndarray, "h w"],
    counts: Bool[np.ndarray, "h w"],
) -> float:
    """Share of the root mean square difference that is left by the best shift of what is rendered by whole pixels.

    Both are taken over the same pixels, those that no shift brings in from beyond the picture; 1 where none counts.
    """
    most = min(_FURTHEST_SHIFT, (min(measured.shape) - 1) // 4)
    inner = np.s_[most : measured.shape[0] - most, most : measured.shape[1] - most]
    kept = counts[inner]
    unmoved = float(np.mean((measured - rendered)[inner][kept] ** 2)) if kept.any() else 0.0
    if not unmoved > 0:
        return 1.0
    least = unmoved
    for down in range(-most, most + 1):
        for across in range(-most, most + 1):
            moved = np.roll(rendered, (down, across), axis=(0, 1))
            least = min(least, float(np.mean((measured - moved)[inner][kept] ** 2)))
    return float(np.sqrt(least / unmoved))


def misfits(fits: Sequence[ViewFit]) -> dict[str, Misfit]:
    """Views that do not fit the others, and why; none where many do not."""
    if len(fits) < _FEWEST_VIEWS:
        return {}
    usual = float(np.median([fit.error for fit in fits]))
    sharpness = float(np.median([fit.sharpness for fit in fits]))
    outlying = []
    for fit in fits:
        times = _TIMES_USUAL_BLURRED if fit.sharpness < _BLURRED * sharpness else _TIMES_USUAL
        if fit.error > max(times * usual, _LEAST_ERROR):
            outlying.append(fit)
    if len(outlying) > _MOST * len(fits):
        return {}

    reasons: dict[str, Misfit] = {}
    for fit in outlying:
        is_brighter = abs(np.log(max(fit.factor, 1e-6))) > _LEAST_FACTOR
        if is_brighter and fit.error_of_factor < _EXPLAINS * fit.error:
            reasons[fit.name] = Misfit.EXPOSURE
        elif fit.sharpness < _BLURRED * sharpness:
            reasons[fit.name] = Misfit.BLUR
        elif fit.error_of_shift < _EXPLAINS * fit.error or fit.spread > _ALL_OVER:
            reasons[fit.name] = Misfit.POSE
        else:
            reasons[fit.name] = Misfit.CONTENT
    return reasons


def describe_misfits(found: dict[str, Misfit]) -> list[str]:
    """A sentence per view."""
    mend = "leave it out with --leave-out of unmix-process, or mend it"
    look = "look at it: a fault if something stood in the way, none if it alone sees a place"
    return [
        f"{name} does not fit the other views: {reason.value}; {look if reason is Misfit.CONTENT else mend}"
        for name, reason in found.items()
    ]


def write_fits(run: Path, fits: Sequence[ViewFit]) -> dict[str, Misfit]:
    """Write how views fit into the folder of a run; gives those that do not."""
    found = misfits(fits)
    views = [{**asdict(fit), "misfit": found[fit.name].name if fit.name in found else None} for fit in fits]
    write_run_json(run / FILE_NAME, {"views": views})
    return found


def read_misfits(run: Path) -> dict[str, Misfit]:
    """The views of a run that do not fit, as they were written; empty where nothing was."""
    path = run / FILE_NAME
    if not path.is_file():
        return {}
    views = read_run_json(path)["views"]
    return {view["name"]: Misfit[view["misfit"]] for view in views if view["misfit"] is not None}
