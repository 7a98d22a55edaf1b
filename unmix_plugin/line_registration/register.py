"""Line cameras, registered to the scene that they see: lost rows are found again, then all rows are fitted.

The scene is held meanwhile. Gradients alone move poses and scene together, along a valley so flat that neither arrives.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from unmix_plugin.line_registration.fit_rows import Fit, fit_rows
from unmix_plugin.line_registration.lost_rows import recover
from unmix_plugin.line_registration.swept_view import SweptView


def register(
    views: Sequence[SweptView], steps: Sequence[Float64[Tensor, "n 6"]]
) -> list[Float64[Tensor, "n 6"]]:
    """Steps under which the scene looks most like what the views measured.

    Args:
        views: Of line cameras, at least one.
        steps: Of each, where to start.
    """
    errors = torch.cat([view.row_errors(own) for view, own in zip(views, steps, strict=True)])
    if not bool((errors > 0).any()):
        return list(steps)
    usual = float(errors[errors > 0].median())
    found = [recover(view, own, usual).steps for view, own in zip(views, steps, strict=True)]
    return [fit_rows(view, own, Fit()) for view, own in zip(views, found, strict=True)]
