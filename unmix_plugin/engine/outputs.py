"""What a trained model can show: outputs by name, each of a kind that says how to write and draw it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

OutputKind = Literal["channels", "shares", "srgb", "linear", "picture", "grey", "map", "labels", "vectors"]
"""What an output's numbers are, (height, width, ...): any channels, on black; a share or score of each class; sRGB on
black (3); linear light on black (3); a picture not multiplied by opacity (3); one channel of light on black; any other
number a pixel; uint8 ids, 255 where nothing is; unit vectors (3)."""


@dataclass(frozen=True)
class Output:
    """One thing that can be shown of a trained scene."""

    name: str
    """In commands, files and the viewer."""
    kind: OutputKind
    title: str
    """What a menu says."""
    what: str
    """What its numbers are, with their unit."""
    value_range: tuple[float, float] | None = None
    """Values at the ends of a colour map; None where only the views tell."""
    colour_map: str = "viridis"
    """As matplotlib names it."""
