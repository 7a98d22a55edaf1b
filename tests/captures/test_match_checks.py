"""Pictures against their poses and lens, by matched points: a textured floor seen from around."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from tests.factories.scenes import look_at
from unmix_plugin.captures.match_checks import MatchedScene, MatchedView, check_matches, views_of_other_poses
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera

SIZE, FOCAL, VIEWS = 200, 100.0, 6
LENS = Lens(SIZE, SIZE, (FOCAL, FOCAL), (SIZE / 2, SIZE / 2))


@pytest.fixture(scope="module")
def pinhole_views(tmp_path_factory) -> list[MatchedView]:
    return make_views(tmp_path_factory.mktemp("pinhole"), lambda bent: bent, bumps())


def bumps() -> np.ndarray:
    """A floor with bumps of colour that are all unlike each other."""
    generator = np.random.default_rng(0)
    waves = [ndimage.gaussian_filter(generator.random((600, 600)), width) * width for width in (2, 4, 9)]
    texture = np.sum(waves, axis=0)
    return (texture - texture.min()) / np.ptp(texture)


ROWS, COLUMNS = np.mgrid[:600, :600]
REPEATED = {
    "gingham": 0.2 + 0.3 * (COLUMNS // 20 % 2) + 0.3 * (ROWS // 20 % 2),
    "stripes across": 0.2 + 0.3 * (COLUMNS // 20 % 2) + 0.3 * ((COLUMNS + ROWS) // 28 % 2),
    "checks around a print": np.where(
        np.hypot(COLUMNS - 300, ROWS - 300) < 90, bumps(), 0.3 + 0.4 * ((COLUMNS // 22 + ROWS // 22) % 2)
    ),
}


def make_views(folder: Path, straighten, texture: np.ndarray) -> list[MatchedView]:
    """Views of a floor, through a lens that is told how to undo its bending."""
    generator = np.random.default_rng(1)
    columns, rows = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    ideal = straighten((np.column_stack([columns.ravel(), rows.ravel()]) - SIZE / 2) / FOCAL)
    views = []
    for index, azimuth in enumerate(np.radians(10.0 * np.arange(VIEWS))):
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


def checked(views: list[MatchedView]) -> tuple[str, list[str]]:
    """What is said, and what is found wrong."""
    found: list[str] = []
    return check_matches(matched(views), found), found


def matched(views: list[MatchedView]) -> MatchedScene:
    return MatchedScene.of([f"v{index}" for index in range(len(views))], views)


@pytest.mark.slow
def test_poses_of_other_pictures_do_not_fit_and_true_ones_give_no_finding(pinhole_views):
    said, found = checked(pinhole_views)
    assert "points matched in" in said
    assert found == []
    mixed = [(pinhole_views[(3 * i + 1) % VIEWS][0], path) for i, (_, path) in enumerate(pinhole_views)]
    assert "do not fit their poses" in checked(mixed)[1][0]


@pytest.mark.slow
def test_a_fisheye_read_as_a_pinhole_does_not_fit_its_lens(tmp_path):
    def straighten(bent):
        angle = np.linalg.norm(bent, axis=1, keepdims=True)
        return bent * np.tan(angle) / angle

    assert "do not fit their lens" in checked(make_views(tmp_path, straighten, bumps()))[1][0]


@pytest.mark.parametrize(
    "name", [name if "print" in name else pytest.param(name, marks=pytest.mark.slow) for name in REPEATED]
)
def test_patterns_that_repeat_speak_against_no_poses(tmp_path, name):
    """Squares and stripes match each other at one period's distance in all views alike."""
    texture = ndimage.gaussian_filter(REPEATED[name], 1.0)
    assert checked(make_views(tmp_path, lambda bent: bent, texture))[1] == []


@pytest.mark.parametrize("size", [(SIZE, SIZE), (7, 5)])
def test_views_without_features_are_not_judged(tmp_path, size):
    Image.new("L", size, 128).save(tmp_path / "grey.png")
    plain = [(PosedCamera(np.eye(4)[:3], LENS), tmp_path / "grey.png")] * VIEWS
    said, found = checked(plain)
    assert "too few views share features" in said
    assert found == []


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", [0, 2, 5])
def test_a_view_with_the_pose_of_another_one_is_named_and_no_other(pinhole_views, spoilt):
    assert views_of_other_poses(matched(pinhole_views)) == {}
    views = list(pinhole_views)
    views[spoilt] = views[(spoilt + 3) % VIEWS][0], views[spoilt][1]
    scene = matched(views)
    found = views_of_other_poses(scene)
    assert list(found) == [f"v{spoilt}"]
    wrong: list[str] = []
    check_matches(scene.without(found), wrong)
    assert wrong == []


@pytest.mark.slow
@pytest.mark.parametrize(("share", "is_wrong"), [(0.5, False), (0.95, True)])
def test_false_matches_beside_true_ones_do_not_call_poses_wrong(pinhole_views, share, is_wrong):
    """As of checks and stripes; false poses leave hardly any point that fits."""
    generator = np.random.default_rng(0)

    def disturbed(ideal: np.ndarray) -> np.ndarray:
        false = generator.random(len(ideal)) < share
        moved = generator.uniform(-0.3, 0.3, ideal.shape)
        return np.where(false[:, None, None], ideal + moved, ideal)

    scene = matched(pinhole_views)
    stars = tuple(replace(star, ideal=disturbed(star.ideal)) for star in scene.stars)
    found: list[str] = []
    check_matches(replace(scene, stars=stars), found)
    assert any("do not fit their poses" in text for text in found) == is_wrong
