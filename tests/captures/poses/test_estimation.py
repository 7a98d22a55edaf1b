from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from tests.factories.files import present
from tests.factories.poses import align_poses, elsewhere, ring_set
from tests.factories.scenes import look_at
from unmix_plugin.captures.poses import estimation
from unmix_plugin.captures.poses.estimation import contrast_picture, estimate_poses
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.errors import CaptureError

pytest.importorskip("pycolmap")
LENS = Lens(256, 192, (300.0, 300.0), (128.0, 96.0))
TEXTURE = 400


def test_an_error_of_one_camera_is_told_in_its_pixels_and_degrees():
    truth = ring_set(20)
    name = "images/view_3.png"
    pose = truth.cameras[name].camera_to_world
    turned = pose[:, :3] @ Rotation.from_euler("y", 0.2, degrees=True).as_matrix()
    wrong = replace(truth.cameras[name], camera_to_world=np.column_stack([turned, pose[:, 3]]))
    estimated = elsewhere(replace(truth, cameras={**truth.cameras, name: wrong}))
    alignment = align_poses(estimated, truth)
    worst = int(np.argmax(alignment.errors_px))
    assert alignment.names[worst] == name
    shift = 500 * np.tan(np.radians(0.2))
    np.testing.assert_allclose(alignment.errors_px[worst], shift, rtol=0.1)
    np.testing.assert_allclose(alignment.rotation_errors_deg[worst], 0.2, rtol=0.1)


def corner_of_a_room(pose: np.ndarray, textures: np.ndarray) -> np.ndarray:
    """What a camera sees of three walls, x = 0, y = 0 and z = 0, with a texture each."""
    x, y = np.meshgrid(np.arange(LENS.width) + 0.5, np.arange(LENS.height) + 0.5)
    local = np.stack([(x - 128) / 300, -(y - 96) / 300, -np.ones_like(x)], -1)
    directions = local @ pose[:3, :3].T
    distances = np.where(directions < 0, -pose[:3, 3] / np.minimum(directions, -1e-9), np.inf)
    wall = distances.argmin(-1)
    points = pose[:3, 3] + distances.min(-1)[..., None] * directions
    seen = np.zeros(wall.shape)
    for axis in range(3):
        along = [index for index in range(3) if index != axis]
        place = np.moveaxis(points[..., along], -1, 0) * TEXTURE / 4
        seen[wall == axis] = map_coordinates(textures[axis], place, order=1, mode="wrap")[wall == axis]
    return seen


@pytest.fixture(scope="module")
def room():
    """Pictures of the corner, and where they were taken from."""
    generator = np.random.default_rng(0)
    noise = generator.normal(size=(3, TEXTURE, TEXTURE))
    textures = np.stack([gaussian_filter(part, 1.5) + 2 * gaussian_filter(part, 4) for part in noise])
    cameras, pictures = {}, {}
    for index, angle in enumerate(np.radians(np.linspace(15, 75, 8))):
        height = 1.6 + 0.4 * (index % 2)
        pose = look_at(np.array([3 * np.cos(angle), 3 * np.sin(angle), height]), np.array([0.4, 0.4, 0.4]))
        cameras[f"view {index}"] = PosedCamera(pose[:3], LENS)
        seen = corner_of_a_room(pose, textures)
        pictures[f"view {index}"] = np.clip(128 + 60 * seen / seen.std(), 0, 255).astype(np.uint8)
    return pictures, PoseSet(cameras, "the truth")


def test_poses_of_a_textured_scene_are_found_to_a_part_of_a_pixel(room, tmp_path):
    pictures, truth = room
    found = estimate_poses(pictures, tmp_path, threads=1)
    assert list(found.cameras) == sorted(pictures)
    assert len(present(found.points)) > 100
    assert any("registered 8 of 8 views with a mean reprojection error of 0." in note for note in found.notes)
    assert align_poses(replace(found, points=None), truth).rms_px < 0.5
    assert (tmp_path / "colmap.log").stat().st_size > 0
    lens = present(found.cameras["view 0"].lens)
    np.testing.assert_allclose(lens.focal_px, LENS.focal_px, rtol=0.05)


def test_pictures_without_texture_are_refused_with_what_to_do(room, tmp_path):
    blank = {name: np.full_like(picture, 128) for name, picture in room[0].items()}
    with pytest.raises(CaptureError, match=r"only 0 of 8 views could be estimated.*more views"):
        estimate_poses(blank, tmp_path, threads=1)


def test_views_that_match_little_are_shown_and_the_next_try_takes_what_was_found(room, tmp_path, monkeypatch):
    generator = np.random.default_rng(0)
    noise = {name: generator.integers(0, 255, (90, 120), np.uint8) for name in list(room[0])[:4]}
    with pytest.raises(CaptureError, match=r"share \d+ with the view nearest.* the fewest: view "):
        estimate_poses(noise, tmp_path, threads=1)
    report = (tmp_path / "report.txt").read_text()
    assert report.count("\n- ") == 4
    assert all(f"{name}: " in report for name in noise)
    with Image.open(tmp_path / "worst-matches.png") as drawn:
        assert drawn.width == 2 * next(iter(noise.values())).shape[1]
    monkeypatch.setattr(estimation.subprocess, "run", pytest.fail)
    with pytest.raises(CaptureError, match="the fewest: view "):
        estimate_poses(noise, tmp_path, threads=1)


def test_two_views_are_too_few_and_a_crash_of_colmap_is_told_with_its_log(room, tmp_path, monkeypatch):
    with pytest.raises(CaptureError, match="2 views; at least 3 are needed"):
        estimate_poses(dict(list(room[0].items())[:2]), tmp_path)
    monkeypatch.setattr(estimation.sys, "executable", "/bin/false")
    with pytest.raises(CaptureError, match=r"COLMAP stopped with status 1 .*colmap\.log"):
        estimate_poses(room[0], tmp_path)


def test_dark_texture_uses_the_whole_range_and_what_does_not_count_is_black():
    cube = np.random.default_rng(0).uniform(100, 200, (150, 80, 3))
    valid = np.ones((150, 80), bool)
    valid[:, :20] = False
    cube[:, :20], cube[5, 50, 1] = 9e4, np.nan
    picture = contrast_picture(cube, 65535.0, valid)
    assert not picture[:, :20].any()
    assert picture[5, 50] == 0
    assert picture[:, 20:].max() - np.percentile(picture[:, 20:], 5) > 150
    everywhere = np.ones((8, 8), bool)  # a flat or empty picture is no noise
    assert np.unique(contrast_picture(np.full((8, 8, 2), 0.3), 1.0, everywhere)).tolist() == [128]
    assert not contrast_picture(np.full((8, 8, 2), np.nan), 1.0, everywhere).any()
