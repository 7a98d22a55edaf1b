"""Whether pictures are about as bright as the environment can make an object.

Pictures and environment must have one unit. A white surface sends back at most four times the mean radiance around it,
which a single lamp straight before it does; dark ones in the shade send some thousandths.
"""

from __future__ import annotations

import math

import numpy as np

from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.scene.posed_pictures import PosedPictures, opacity

BOUNDS = (0.002, 4.0)
"""Of the object's pixels over the environment's mean radiance: 95 of 100 pixels darker than the one, or half of them
brighter than the other, are no surface's under this light."""
_USUAL = 0.3
_MOST_VIEWS = 24
_OPAQUE = 0.99


def light_doubt(pictures: PosedPictures, environment: Environment) -> str | None:
    """What to say of pictures that are much too bright or too dark for their light; None if they are right.

    Only pictures of linear light with alpha are compared: others say nothing of a unit, or of what is background.
    """
    if pictures.tone != "linear":
        return None
    step = max(1, -(-len(pictures) // _MOST_VIEWS))
    read = [pictures.read(view) for view in range(0, len(pictures), step)]
    shown = [picture.numbers[opacity(picture) >= _OPAQUE] for picture in read if picture.alpha is not None]
    found = np.concatenate(shown).mean(axis=1) if shown else np.zeros(0)
    mean = float(environment.mean_radiance().mean())
    if not (found.size and mean > 0):
        return None
    middle, bright = (float(np.quantile(found, share)) / mean for share in (0.5, 0.95))
    if middle > BOUNDS[1]:
        ratio, what, bound = (
            middle,
            "half of the object's pixels are more than",
            f"at most {BOUNDS[1]:g} times",
        )
    elif 0 < bright < BOUNDS[0]:
        ratio, what, bound = (
            bright,
            "95 % of the object's pixels are less than",
            f"at least {BOUNDS[0]:g} times",
        )
    else:
        return None
    return (
        f"{what} {ratio:.2g} times as bright as the mean of the environment map; {bound} is usual. Pictures and map "
        "seem to have different units, and materials come out wrong then. Scale one of them: an "
        f"'environment_exposure_stops' {math.log2(ratio / _USUAL):.0f} higher would be about right"
    )
