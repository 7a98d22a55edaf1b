"""The views of a capture, as a layout finds them: nothing is read, calibrated or posed yet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.spectral_file import SpectralFile


@dataclass(frozen=True)
class CaptureView:
    """One image from one place."""

    name: str
    """Unique in the capture, fit for file names; poses are found by it or by the stem of one of the files."""
    cube: SpectralFile
    """All bands that were taken from this place."""
    sensor: str = ""
    """Lens or camera of a rig that took it; views of one sensor share bands and size."""
    picture: Path | None = None
    """RGB or RGBA picture with the pixels of the cube."""
    mask: Path | None = None
    """Black where pixels are ignored."""
    labels: Path | None = None
    """True materials, if known."""
    alpha: SpectralFile | None = None
    """Opacity in [0, 1], (H, W, 1), where it is not a channel of the picture; the cube is multiplied by it."""
    lens: Lens | None = None
    """Intrinsics that the camera itself writes; poses may bring better ones."""
    release: str = ""
    """Name of the shutter release; views of one release were taken at one moment by the lenses of a rig."""
    split: Literal["train", "eval"] | None = None
    """What the layout says the view is for."""


@dataclass(frozen=True)
class Capture:
    """What a folder of an instrument holds."""

    layout: str
    root: Path
    views: tuple[CaptureView, ...]
    """In the order of their names."""
    poses: PoseSet | None = None
    """Where the layout has poses of its own."""
    notes: tuple[str, ...] = ()
    """What is odd about the folder, one sentence each."""
