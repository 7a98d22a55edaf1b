"""How a user has chosen to see pictures: tones of light, colours of values, what lies behind.

Imports no torch, so that help of commands stays fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Highlights = Literal["cut", "kept"]
Background = Literal["grey", "white", "black"]
ColourMap = Literal["viridis", "magma", "inferno", "cividis", "turbo", "coolwarm", "gray"]
"""As matplotlib names them."""

NEUTRAL = 0.92
"""sRGB grey of what shows nothing."""

BACKGROUNDS: dict[Background, float] = {"grey": NEUTRAL, "white": 1.0, "black": 0.0}
"""sRGB value of what shows nothing."""


@dataclass(frozen=True)
class Look:
    """How pictures and videos show what is in them; numbers stay as they are."""

    exposure: float = 0.0
    """Stops by which light is brighter in pictures."""
    gamma: float = 1.0
    """Lifts the dark parts of light in pictures where it is above 1."""
    highlights: Highlights = "cut"
    """Light brighter than a display can show: cut at white (sRGB, exact), or kept (AgX, as film does)."""
    background: Background | None = None
    """Where nothing is seen; None: PNG is transparent there, and videos are light grey."""
    colour_map: ColourMap | None = None
    """Of values, and then of single bands too; None: each output's own."""
    value_range: tuple[float, float] | None = None
    """Values at the ends of the colour map; None: each output's own."""
    mixed: bool = False
    """Paint abundances as one picture, each material in its colour, in place of a picture of each."""
