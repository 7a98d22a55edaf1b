"""Whether pictures are about as bright as the environment can make an object.

Pictures and environment must have one unit. A white surface sends back at most four times the mean radiance around it,
which a single lamp straight before it does; dark ones in the shade send some thousandths.
"""

from __future__ import annotations

import math

import numpy as np

from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.scene.posed_pictures import PosedPictures

BOUNDS = (0.002, 4.0)
"""Of the median pixel of the object, over the environment's mean radiance."""
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
    shown = [picture.numbers[picture.alpha >= _OPAQUE] for picture in read if picture.alpha is not None]
    found = np.concatenate(shown).mean(axis=1) if shown else np.zeros(0)
    ratio = float(np.median(found)) / float(environment.mean_radiance().mean()) if found.size else 1.0
    if BOUNDS[0] <= ratio <= BOUNDS[1] or not ratio > 0:
        return None
    stops = math.log2(ratio / _USUAL)
    return (
        f"the object's median pixel is {ratio:.2g} times as bright as the mean of the environment map, and {BOUNDS[0]:g} "
        f"to {BOUNDS[1]:g} times is what surfaces send back: pictures and map have different units, so that materials "
        f"come out wrong. Scale one of them; an 'environment_exposure_stops' {stops:.0f} higher would be about right"
    )
