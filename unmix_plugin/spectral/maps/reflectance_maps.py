"""Outputs made of the reflectance of what is seen, one number a pixel: spectral indices and scores of a target.

Reflectance is radiance over the light that the scene was recorded in; where that is unknown, radiance stands for it,
and the description of the output says so. A pixel in which hardly anything is, or whose number is undefined, is NaN.

Notation: `B` bands, `N` pixels, `*rays` any leading axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import parse_index
from unmix_plugin.spectral.maps.targets import parse_target

Score: TypeAlias = Callable[[Float[Tensor, "*rays B"]], Float[Tensor, "*rays"]]
"""From reflectances to numbers."""


@dataclass(frozen=True)
class ReflectanceMap:
    """An index or a target, for given bands."""

    what: str
    """One line: what its numbers are."""
    usual_range: tuple[float, float] | None
    """What pictures show; None: whatever range there is."""
    fit: Callable[[Float[Tensor, "N B"]], Score]
    """From the reflectances of what else there is in the views to the numbers, which may be judged against them."""


def is_reflectance_map(name: str) -> bool:
    """Whether an output is one of these.

    >>> is_reflectance_map("index:ndvi"), is_reflectance_map("band:650nm")
    (True, False)
    """
    return name.partition(":")[0] in ("index", "target")


def parse_reflectance_map(name: str, bands: Bands) -> ReflectanceMap:
    """What an output such as `index:ndvi`, `index:(r800-r670)/(r800+r670)` or `target:ace:paint.csv>0.5` is.

    Raises:
        ConfigError: an unknown index, or a formula or threshold that can't be read.
        SpectrumError: the bands do not cover what it needs, or a target that can't be read.
    """
    kind, _, argument = name.partition(":")
    if kind == "index":
        index = parse_index(argument, bands)
        return ReflectanceMap(index.what, index.usual_range, lambda _: index)
    target = parse_target(argument, bands)
    return ReflectanceMap(target.what, target.usual_range, target.fit)


def seen_reflectance(
    spectra: Float[Tensor, "*rays B"],
    opacity: Float[Tensor, "*rays"],
    light: Float[Tensor, "B"] | None,
    smallest_opacity: float,
) -> Float[Tensor, "*rays B"]:
    """Reflectance of what is seen.

    Args:
        spectra, opacity: Radiance on black, and the opacity in [0, 1] by which it is multiplied.
        light: Relative power of the scene's light; None: unknown, so that radiance is returned. NaN in bands that it
            leaves dark.
        smallest_opacity: NaN where there is less.
    """
    is_seen = (opacity >= smallest_opacity)[..., None]
    radiance = torch.where(is_seen, spectra / opacity.clamp(min=1e-6)[..., None], torch.nan)
    if light is None:
        return radiance
    power = light.to(radiance)
    return radiance / torch.where(power > 0, power, torch.nan)
