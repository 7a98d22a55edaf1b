"""Spectral indices and scores of targets for every point of a surface.

Notation: `P` points, `B` bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import NAMED_INDICES
from unmix_plugin.spectral.maps.reflectance_maps import (
    ReflectanceMap,
    is_reflectance_map,
    parse_reflectance_map,
    seen_reflectance,
)
from unmix_plugin.spectral.materials import Materials

_LONGEST_COMMENT = 300


@dataclass(frozen=True)
class PointScore:
    """A number to add to every point."""

    output: str
    """As asked for, such as `index:ndvi`."""
    property: str
    """What files call it, such as `index_ndvi`."""
    map: ReflectanceMap

    def values(
        self, diffuse: Float[Tensor, "P B"], light: Float[Tensor, "B"] | None
    ) -> Float32[np.ndarray, " P"]:
        """The numbers, relative to all the points given where a target needs a background; NaN where undefined.

        Args:
            diffuse: Spectra of points without the view-dependent part.
            light: Relative power of the light that they are seen in; None where it is unknown.
        Raises:
            SpectrumError: too few points to judge a target against, or all are alike.
        """
        opaque = torch.ones(len(diffuse), dtype=diffuse.dtype)
        reflectance = seen_reflectance(diffuse, opaque, light, 0.5)
        return self.map.fit(reflectance)(reflectance).numpy().astype(np.float32)

    def comment(self, materials: Materials) -> str:
        """What a file says of it."""
        caveat = "" if materials.light is not None else "; of radiance, since the scene's light is unknown"
        return f"{self.property}: {self.output}, {self.map.what}"[:_LONGEST_COMMENT] + caveat


def require_point_scores(outputs: Sequence[str], bands: Bands) -> list[PointScore]:
    """Numbers to add to points; an output asked for twice is given once.

    Args:
        outputs: Such as `index:ndvi`, `index:r800/r670`, `target:ace:paint.csv`.
        bands: The run's bands.
    Raises:
        ConfigError: another output, an unknown index, a formula that can't be read.
        SpectrumError: the bands do not cover what one needs, or a target that can't be read.
    """
    scores: list[PointScore] = []
    for output in dict.fromkeys(_plain(output) for output in outputs):
        if not is_reflectance_map(output) or not output.partition(":")[2]:
            raise ConfigError(
                f"--outputs {output}: points take spectral indices, index:NAME or index:FORMULA such as "
                "index:ndvi, and targets, target:FILE.csv or target:ace:FILE.csv; colour, material and abundances "
                "are in every cloud"
            )
        name = _property_name(output, [score.property for score in scores])
        scores.append(PointScore(output, name, parse_reflectance_map(output, bands)))
    return scores


def _plain(output: str) -> str:
    """Named indices in the one way that their table has them."""
    kind, colon, argument = output.partition(":")
    name = argument.strip().lower()
    return f"{kind}{colon}{name if kind == 'index' and name in NAMED_INDICES else argument}"


def _property_name(output: str, taken: Sequence[str]) -> str:
    """`index_ndvi` of a named index; otherwise the kind and the least number that is free: formats know few
    characters."""
    kind, _, argument = output.partition(":")
    if kind == "index" and argument in NAMED_INDICES:
        return f"index_{argument.replace('-', '_')}"
    number = next(count for count in range(1, len(taken) + 2) if f"{kind}_{count}" not in taken)
    return f"{kind}_{number}"
