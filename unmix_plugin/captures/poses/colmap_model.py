"""Cameras and images as COLMAP writes them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ColmapCamera:
    """A lens."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]
    """As the model orders them."""


@dataclass(frozen=True)
class ColmapImage:
    """A posed image."""

    name: str
    camera: int
    quaternion: tuple[float, ...]
    """w, x, y, z of the rotation from world to camera."""
    translation: tuple[float, ...]
    """From world to camera."""
