"""Poses of an evaluation view's rows, fitted to its picture with the field as it is, where training corrected poses.

A line camera's rows wobble, so no single turn and shift aligns such a view. Once these are found (pose_alignment.py),
its rows are fitted to averages over squares of pixels, of ever smaller edges: rows that are off by ten pixels look
alike there. Where rows are lost then, they are looked for all around (sought_rows.py). At last, those that fit best
tell where their neighbours are.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.poses.line_cameras import keep, shower, swept_view
from unmix_plugin.poses.line_registration.fit_rows import Fit, fit_ever_sharper, fit_rows
from unmix_plugin.poses.line_registration.lost_rows import FEWEST_LOST, LOST, num_lost, track
from unmix_plugin.poses.line_registration.sought_rows import sought
from unmix_plugin.poses.line_registration.swept_view import SweptView, columns_compared
from unmix_plugin.trained.pose_alignment import align_pose

if TYPE_CHECKING:
    from unmix_plugin.trained.evaluation import ViewTruth
    from unmix_plugin.trained.trained_scene import TrainedScene

_MOST_PIXELS = 20_000
_BLURS = (17, 9, 5, 3)
"""Edges of the squares over which pictures are averaged at first, pixels."""
_HOW = Fit(iterations=6, reach=30.0)
_ROUNDS = 4
_RIGHT = 0.25
"""Part of the rows that is right at least, once pictures that were averaged are alike."""
_RUN = 12
"""Rows in a row from which others are looked for."""
_CLEARLY_BETTER = 0.98
"""Part of the former error below which what was found is taken."""


@torch.no_grad()
def align_rows(scene: TrainedScene, camera: Cameras, truth: ViewTruth) -> Cameras:
    """A line camera, its rows moved to where the scene looks most like what was measured."""
    columns = columns_compared(*camera.size(0), _MOST_PIXELS)
    alpha = None if truth.alpha is None else truth.alpha[:, columns]
    kept = keep(camera, columns, truth.spectra[:, columns], truth.valid[:, columns], alpha)
    matrix = kept.axes
    if truth.sensor is not None:
        matrix = torch.from_numpy(truth.sensor.matrix).to(matrix).T @ matrix
    composite = partial(scene.renderer.composite, scene.field)
    show = shower(composite, scene.materials, matrix, has_opacity=kept.has_opacity)
    turned = align_pose(scene, camera, truth)
    found: list[tuple[float, SweptView, Float64[Tensor, "n 6"], Cameras]] = []
    for start, find in ((turned, _fitted), (turned, sought), (camera, sought)):
        view = swept_view(kept, start.to(scene.device), scene.scene_box, show)
        steps = find(view, torch.zeros(view.num_knots, 6, dtype=torch.float64))
        errors = view.row_errors(steps)
        found.append((float(errors.sqrt().mean()), view, steps, start))
        if num_lost(errors, _usual(errors)) < FEWEST_LOST:
            break
    _, view, steps, start = min(found, key=lambda candidate: candidate[0])
    return view.moved(start, _tracked(view, steps))


def _fitted(view: SweptView, steps: Float64[Tensor, "n 6"]) -> Float64[Tensor, "n 6"]:
    """Steps from others on, by ever sharper pictures."""
    return fit_rows(view, fit_ever_sharper(view, steps, _HOW, _BLURS), Fit())


def _usual(errors: Float[Tensor, " H"]) -> float:
    """Error of a row that fits well; 0 where no row shows anything."""
    shown = errors[errors > 0]
    return float(shown.quantile(_RIGHT)) if len(shown) else 0.0


def _tracked(view: SweptView, steps: Float64[Tensor, "n 6"]) -> Float64[Tensor, "n 6"]:
    """Steps after the rows were looked for from those outwards that fit best, until that makes nothing better."""
    errors, tried = view.row_errors(steps), set[int]()
    for _ in range(_ROUNDS):
        usual = _usual(errors)
        row = _best_run(errors, view.shows_matter, tried)
        if row is None or float(errors.max()) <= LOST * usual:
            return steps
        tried.add(row)
        found = fit_rows(view, track(view, steps, slice(row, row + _RUN), usual), Fit())
        seen = view.row_errors(found)
        if float(seen.sqrt().mean()) < _CLEARLY_BETTER * float(errors.sqrt().mean()):
            steps, errors = found, seen
    return steps


def _best_run(errors: Float[Tensor, " H"], shown: slice, tried: set[int]) -> int | None:
    """First of the rows in a row that fit best, away from those that were tried; None where there are no more."""
    if shown.stop - shown.start < _RUN:
        return None
    means = errors[shown].unfold(0, _RUN, 1).mean(dim=1)
    for row in means.argsort().tolist():
        if all(abs(row + shown.start - other) >= _RUN for other in tried):
            return int(row + shown.start)
    return None
