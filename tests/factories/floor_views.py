"""A textured floor seen from around, as pictures with poses."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from tests.factories.scenes import look_at
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera

SIZE, FOCAL, VIEWS = 200, 100.0, 6
LENS = Lens(SIZE, SIZE, (FOCAL, FOCAL), (SIZE / 2, SIZE / 2))


def bumps() -> np.ndarray:
    """A floor with bumps of colour that are all unlike each other."""
    generator = np.random.default_rng(0)
    waves = [ndimage.gaussian_filter(generator.random((600, 600)), width) * width for width in (2, 4, 9)]
    texture = np.sum(waves, axis=0)
    return (texture - texture.min()) / np.ptp(texture)


def make_views(
    folder: Path, straighten, texture: np.ndarray, count: int = VIEWS
) -> list[tuple[PosedCamera, Path]]:
    """Views of a floor, through a lens that is told how to undo its bending."""
    generator = np.random.default_rng(1)
    columns, rows = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    ideal = straighten((np.column_stack([columns.ravel(), rows.ravel()]) - SIZE / 2) / FOCAL)
    views = []
    for index, azimuth in enumerate(np.radians(10.0 * np.arange(count))):
        position = np.array([2.2 * np.cos(azimuth), 2.2 * np.sin(azimuth), 2.0 + 0.2 * (index % 2)])
        pose = look_at(position, np.zeros(3))[:3]
        rays = np.column_stack([ideal[:, 0], -ideal[:, 1], -np.ones(len(ideal))]) @ pose[:, :3].T
        x, y, _ = (position - position[2] / rays[:, 2:] * rays).T
        shown = ndimage.map_coordinates(texture, [300 + 90 * y, 300 + 90 * x], order=1, mode="mirror")
        noisy = shown.reshape(SIZE, SIZE) + 0.01 * generator.standard_normal((SIZE, SIZE))
        path = folder / f"{index}.png"
        Image.fromarray((255 * noisy.clip(0, 1)).astype(np.uint8)).save(path)
        views.append((PosedCamera(pose, LENS), path))
    return views
