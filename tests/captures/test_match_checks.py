"""Pictures against their poses and lens, by matched points: a textured floor seen from around."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from unmix_plugin.captures.match_checks import MatchedView, check_matches
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera

SIZE, FOCAL, VIEWS = 200, 100.0, 6
LENS = Lens(SIZE, SIZE, (FOCAL, FOCAL), (SIZE / 2, SIZE / 2))
ANGLES = 10.0 * np.abs(np.subtract.outer(np.arange(VIEWS), np.arange(VIEWS)))


@pytest.fixture(scope="module")
def pinhole_views(tmp_path_factory) -> list[MatchedView]:
    return make_views(tmp_path_factory.mktemp("pinhole"), lambda bent: bent)


def make_views(folder: Path, straighten) -> list[MatchedView]:
    """Views of a floor with bumps of colour, through a lens that is told how to undo its bending."""
    generator = np.random.default_rng(0)
    waves = [ndimage.gaussian_filter(generator.random((600, 600)), width) * width for width in (2, 4, 9)]
    texture = np.sum(waves, axis=0)
    texture = (texture - texture.min()) / np.ptp(texture)
    views = []
    for index in range(VIEWS):
        azimuth = np.radians(10.0 * index)
        position = np.array([2.2 * np.cos(azimuth), 2.2 * np.sin(azimuth), 2.0 + 0.2 * (index % 2)])
        back = position / np.linalg.norm(position)
        right = np.cross([0.0, 0.0, 1.0], back) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], back))
        pose = np.column_stack([right, np.cross(back, right), back, position])
        columns, rows = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
        ideal = straighten((np.column_stack([columns.ravel(), rows.ravel()]) - SIZE / 2) / FOCAL)
        rays = np.column_stack([ideal[:, 0], -ideal[:, 1], -np.ones(len(ideal))]) @ pose[:, :3].T
        depth = -position[2] / rays[:, 2]
        x, y, _ = (position + depth[:, None] * rays).T
        shown = ndimage.map_coordinates(texture, [300 + 90 * y, 300 + 90 * x], order=1, mode="mirror")
        shown = shown.reshape(SIZE, SIZE)
        path = folder / f"{index}.png"
        Image.fromarray((255 * shown).astype(np.uint8)).save(path)
        views.append((PosedCamera(pose, LENS), path))
    return views


@pytest.mark.slow
def test_views_that_fit_give_no_finding(pinhole_views):
    found: list[str] = []
    assert "points matched in" in check_matches(pinhole_views, ANGLES, found)
    assert found == []


@pytest.mark.slow
def test_a_fisheye_read_as_a_pinhole_does_not_fit_its_lens(tmp_path):
    def straighten(bent):
        angle = np.linalg.norm(bent, axis=1, keepdims=True)
        return bent * np.tan(angle) / angle

    found: list[str] = []
    check_matches(make_views(tmp_path, straighten), ANGLES, found)
    assert "do not fit their lens" in found[0]


@pytest.mark.slow
def test_poses_of_other_pictures_do_not_fit(pinhole_views):
    mixed = [(pinhole_views[(3 * i + 1) % VIEWS][0], path) for i, (_, path) in enumerate(pinhole_views)]
    found: list[str] = []
    check_matches(mixed, ANGLES, found)
    assert "do not fit their poses" in found[0]


@pytest.mark.parametrize("size", [(SIZE, SIZE), (7, 5)])
def test_views_without_features_are_not_judged(tmp_path, pinhole_views, size):
    Image.new("L", size, 128).save(tmp_path / "grey.png")
    plain = [(camera, tmp_path / "grey.png") for camera, _ in pinhole_views]
    found: list[str] = []
    assert "too few views share features" in check_matches(plain, ANGLES, found)
    assert found == []
