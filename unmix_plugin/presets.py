"""All that depends on whether alpha tells objects from background, decided in one place.

With alpha, space outside the objects' visual hull is carved away before training, and a transparent pixel is known to
be empty. Without it, as in a closed room, a black pixel may show a black thing or nothing at all, and free space is
only cleared by training, from what rays meet. In an unbounded world every ray ends on something, if
only the sky; where pictures without alpha share a plain backdrop, the hull of what is before it is carved as with
alpha, and the backdrop is learnt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

Auto = Literal["auto"]
ConfigT = TypeVar("ConfigT")


@dataclass(frozen=True)
class AlphaPreset:
    """Values of the settings that are left at `auto`, by their names; by default those of scenes with alpha."""

    single_ray_until: float = 0.4
    initial_opacity: float = 0.05
    """Empty space between cameras and walls must start almost clear."""
    smallest_weight: float = 4e-3
    """Lighter samples have no gradient, so that haze which they are made of fades."""
    first_smallest_weight: float = 4e-3
    """The same at the start: surfaces far behind semi-transparent density must be able to grow."""
    visible_weight: float = 0.05
    """1: nothing is left out. In rooms, walls must be found behind semi-transparent density."""
    background: Literal["random", "black"] = "random"
    """Random greys would reward floaters before the cameras where alpha is unknown."""
    rgb_loss_weight: float = 0.2
    opacity_loss_weight: float = 0.0
    sparsity_loss_weight: float = 0.0
    surface_loss_weight: float = 0.0
    near_loss_weight: float = 0.0
    coarse_samples: int = 256
    is_carved: bool = True
    """Whether pictures tell where nothing is."""
    specular_endmembers: bool = False
    """Whether the specular dictionary has the endmembers' spectra too: in rooms, walls colour the light."""


WITH_ALPHA = AlphaPreset()
WITHOUT_ALPHA = AlphaPreset(
    single_ray_until=0.8,
    initial_opacity=0.01,
    first_smallest_weight=1e-3,
    visible_weight=1.0,
    background="black",
    rgb_loss_weight=0.0,
    opacity_loss_weight=0.01,
    sparsity_loss_weight=1e-3,
    is_carved=False,
    specular_endmembers=True,
)
UNBOUNDED = replace(
    WITHOUT_ALPHA,
    initial_opacity=0.005,
    opacity_loss_weight=0.002,  # what is bright may be the sky, which floaters would hide
    surface_loss_weight=0.3,
    near_loss_weight=0.005,
    coarse_samples=64,
)
BEFORE_BACKDROP = replace(WITH_ALPHA, background="black")


def preset_for(has_alpha: bool, is_unbounded: bool = False, has_backdrop: bool = False) -> AlphaPreset:
    """The preset of a scene with or without alpha, in a box, before a backdrop or in an unbounded world."""
    if has_backdrop:
        return BEFORE_BACKDROP
    return UNBOUNDED if is_unbounded else WITH_ALPHA if has_alpha else WITHOUT_ALPHA


def fill_auto(config: ConfigT, **values: Any) -> ConfigT:
    """The settings with these values where they are `auto`."""
    filled = {name: value for name, value in values.items() if getattr(config, name) == "auto"}
    return replace(config, **filled)  # type: ignore[type-var]
