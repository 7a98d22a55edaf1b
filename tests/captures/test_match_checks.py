"""Pictures against their poses and lens, by matched points: a textured floor seen from around."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from tests.factories.floor_views import LENS, SIZE, VIEWS, bumps, make_views
from unmix_plugin.captures.match_checks import MatchedScene, MatchedView, check_matches
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.report import Code


@pytest.fixture(scope="module")
def pinhole_views(tmp_path_factory) -> list[MatchedView]:
    return make_views(tmp_path_factory.mktemp("pinhole"), lambda bent: bent, bumps())


ROWS, COLUMNS = np.mgrid[:600, :600]
REPEATED = {
    "gingham": 0.2 + 0.3 * (COLUMNS // 20 % 2) + 0.3 * (ROWS // 20 % 2),
    "stripes across": 0.2 + 0.3 * (COLUMNS // 20 % 2) + 0.3 * ((COLUMNS + ROWS) // 28 % 2),
    "checks around a print": np.where(
        np.hypot(COLUMNS - 300, ROWS - 300) < 90, bumps(), 0.3 + 0.4 * ((COLUMNS // 22 + ROWS // 22) % 2)
    ),
}


def checked(views: list[MatchedView]) -> list[Code]:
    return [remark.code for remark in check_matches(MatchedScene.of(views))]


@pytest.mark.slow
def test_poses_of_other_pictures_do_not_fit_and_true_ones_give_no_finding(pinhole_views):
    assert checked(pinhole_views) == [Code.POINTS_MATCHED]
    mixed = [(pinhole_views[(3 * i + 1) % VIEWS][0], path) for i, (_, path) in enumerate(pinhole_views)]
    assert checked(mixed) == [Code.POINTS_MATCHED, Code.POSES_MISFIT]


@pytest.mark.slow
def test_a_fisheye_read_as_a_pinhole_does_not_fit_its_lens(tmp_path):
    def straighten(bent):
        angle = np.linalg.norm(bent, axis=1, keepdims=True)
        return bent * np.tan(angle) / angle

    views = make_views(tmp_path, straighten, bumps())
    assert checked(views) == [Code.POINTS_MATCHED, Code.LENS_MISFITS]


@pytest.mark.parametrize(
    "name", [name if "print" in name else pytest.param(name, marks=pytest.mark.slow) for name in REPEATED]
)
def test_patterns_that_repeat_speak_against_no_poses(tmp_path, name):
    """Squares and stripes match each other at one period's distance in all views alike."""
    texture = ndimage.gaussian_filter(REPEATED[name], 1.0)
    looks_wrong = [
        code for code in checked(make_views(tmp_path, lambda bent: bent, texture)) if code.looks_wrong
    ]
    assert looks_wrong == []


@pytest.mark.parametrize("size", [(SIZE, SIZE), (7, 5)])
def test_views_without_features_are_not_judged(tmp_path, size):
    Image.new("L", size, 128).save(tmp_path / "grey.png")
    plain = [(PosedCamera(np.eye(4)[:3], LENS), tmp_path / "grey.png")] * VIEWS
    assert checked(plain) == [Code.TOO_FEW_MATCHED]


@pytest.mark.slow
@pytest.mark.parametrize(("share", "is_wrong"), [(0.5, False), (0.95, True)])
def test_false_matches_beside_true_ones_do_not_call_poses_wrong(pinhole_views, share, is_wrong):
    """As of checks and stripes; false poses leave hardly any point that fits."""
    generator = np.random.default_rng(0)

    def disturbed(ideal: np.ndarray) -> np.ndarray:
        false = generator.random(len(ideal)) < share
        moved = generator.uniform(-0.3, 0.3, ideal.shape)
        return np.where(false[:, None, None], ideal + moved, ideal)

    scene = MatchedScene.of(pinhole_views)
    stars = tuple(replace(star, ideal=disturbed(star.ideal)) for star in scene.stars)
    codes = [remark.code for remark in check_matches(replace(scene, stars=stars))]
    assert (Code.POSES_MISFIT in codes) == is_wrong
