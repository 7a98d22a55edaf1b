"""From linear light to what a display shows: exposure, view transform, gamma.

Notation: `light` is linear RGB in sRGB primaries, 0 and up, 1 = the sensor's full scale before exposure; `display` is
encoded for an sRGB display, [0, 1].
"""

from __future__ import annotations

import math
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from unmix_plugin.spectral.colour.conversion import agx, linear_to_srgb

ViewTransform = Literal["srgb", "agx"]
VIEW_TRANSFORMS: dict[ViewTransform, str] = {
    "srgb": "sRGB (exact up to white)",
    "agx": "AgX (keeps highlights)",
}
"""Names and what users read."""


def to_display(
    light: Float[Tensor, "*pixels 3"], exposure_ev: float, gamma: float, transform: ViewTransform
) -> Float[Tensor, "*pixels 3"]:
    """Light as a display shows it.

    Args:
        light: Linear RGB.
        exposure_ev: Stops: each doubles the light.
        gamma: Applied last; above 1 lifts what is dark.
        transform: `srgb` clips at white; `agx` compresses 16.5 stops, as film does.
    """
    exposed = light * 2.0**exposure_ev
    shown = agx(exposed) if transform == "agx" else linear_to_srgb(exposed.clamp(0, 1))
    shown = shown.clamp(0, 1)
    return shown if math.isclose(gamma, 1.0) else shown.pow(1 / gamma)
