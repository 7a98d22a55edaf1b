"""Line cameras, registered to the scene that they see: lost rows are found again, then all rows are fitted.

The scene is held meanwhile. Gradients alone move poses and scene together, along a valley so flat that neither arrives.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from unmix_plugin.poses.line_registration.fit_rows import Fit, fit_rows
from unmix_plugin.poses.line_registration.lost_rows import num_lost, recover
from unmix_plugin.poses.line_registration.swept_view import SweptView

_MOST_SOUGHT = 0.25
"""Share of the views in which lost rows are looked for, those with most of them. Where more are lost, the scene is not
ready; and each view takes as long as all that are only fitted."""


def register(
    views: Sequence[SweptView], steps: Sequence[Float64[Tensor, "n 6"]]
) -> list[Float64[Tensor, "n 6"]]:
    """Steps under which the scene looks most like what the views measured.

    Args:
        views: Of line cameras, at least one.
        steps: Of each, where to start.
    """
    errors = [view.row_errors(own) for view, own in zip(views, steps, strict=True)]
    known = torch.cat(errors)
    if not bool((known > 0).any()):
        return list(steps)
    usual, found = float(known[known > 0].median()), list(steps)
    for number in _most_lost([num_lost(own, usual) for own in errors]):
        found[number] = recover(views[number], steps[number], usual).steps
    return [fit_rows(view, own, Fit()) for view, own in zip(views, found, strict=True)]


def _most_lost(counts: Sequence[int]) -> list[int]:
    """Views in which most rows are lost, of their counts."""
    order = sorted(range(len(counts)), key=lambda view: -counts[view])
    return order[: max(1, round(_MOST_SOUGHT * len(counts)))]
