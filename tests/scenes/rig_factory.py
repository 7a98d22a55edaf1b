"""Tiny rigs for tests: the ball of `scene_factory`, seen by a spectral camera and by others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from tests.scenes.scene_factory import WAVELENGTHS, SceneFolder, make_scene, set_frame
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.sensor import read_sensor

RESPONSES = "wavelength,red,blue\n480,0,1\n560,0.5,1\n640,1,0\n"
"""Of a camera with two channels, the longer waves first."""


def make_rig(root: Path) -> SceneFolder:
    """Frames 0 to 2 have all four bands, 3 and 4 two bands at half the size, 5 the channels of `RESPONSES`."""
    folder = make_scene(root)
    for index in (3, 4):
        halve(folder, index)
        folder.edit_cube(index, lambda cube: cube[..., [2, 0]])
        folder.edit(set_frame(index, bands=[2, 0], sensor="small"))
    (root / "colours.csv").write_text(RESPONSES, encoding="utf-8")
    channels = read_sensor(root / "colours.csv").seen_by(Bands.of(WAVELENGTHS)).matrix[:, ::-1]
    folder.edit_cube(5, lambda cube: cube.astype(np.float32) @ channels.astype(np.float32))
    return folder.edit(set_frame(5, responses_path="colours.csv"))


def halve(folder: SceneFolder, index: int) -> None:
    """Bring a frame's files and lens to half the size."""
    folder.edit_cube(index, lambda cube: cube.astype(np.float32).reshape(8, 2, 10, 2, -1).mean(axis=(1, 3)))
    for kind in ("images", "labels"):
        path = folder.root / f"{kind}/view_{index}.png"
        Image.fromarray(np.asarray(Image.open(path))[::2, ::2]).save(path)
    path = folder.root / f"abundances/view_{index}.npy"
    np.save(path, np.load(path)[::2, ::2])
    folder.edit(set_frame(index, w=10, h=8, fl_x=14.0, fl_y=14.0, cx=5.0, cy=4.0))
