"""Checks of a scene that unmix-process and unmix-train share: what is found is a code with values, and its sentence is
made where it is printed, as advice differs from command to command."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, unique

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.geometry.bounds import find_bounds
from unmix_plugin.scenes.geometry.carving import MOST_CONTRADICTED, Masks, share_contradicted


@unique
class Code(Enum):
    """All that may be found."""

    MASKS_CONTRADICT = (
        "the masks of the training views contradict each other: behind {share:.1%} of what they show, other views see "
        "only background (expected at most {most:.0%})"
    )
    """They do where poses are off by more than a few pixels, where masks err, and where a wall of a room that stands
    among the things is taken for what is behind them."""


@dataclass(frozen=True)
class Finding:
    """Something that looks wrong with a scene."""

    code: Code
    share: float
    most: float

    def sentence(self, advice: str) -> str:
        """What was found, and what to do."""
        return f"{self.code.value.format(share=self.share, most=self.most)}. {advice}"


def contradicted_share(cameras: Cameras, foreground: Masks) -> tuple[SceneBox | None, float]:
    """The box of what masks show, and the share of it that other masks contradict; 1 without a box where they have
    nothing in common.

    Args:
        cameras: In a space where coordinates are of order 1.
        foreground: For each view True on pixels that may show something.
    """
    try:
        box = find_bounds(cameras, foreground)
    except SceneError:
        return None, 1.0
    return box, share_contradicted(cameras, foreground, box)


def check_masks(share: float) -> Finding | None:
    """Judge a share that masks contradict."""
    return Finding(Code.MASKS_CONTRADICT, share, MOST_CONTRADICTED) if share > MOST_CONTRADICTED else None
