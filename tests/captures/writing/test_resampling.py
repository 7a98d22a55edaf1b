"""Pictures brought from a file's lens into the scene's: where things are seen, and what is missing."""

import json

import numpy as np
import pytest
from PIL import Image

from tests.factories.captures import process, write_cube, write_poses
from tests.factories.files import file_of
from unmix_plugin.captures.calibration.calibration import CalibratedRows, Calibration, Raster
from unmix_plugin.captures.poses.lens import Lens, Points, distort_fisheye, distort_ftheta, fit_lens
from unmix_plugin.captures.writing.resampling import Resampling

WIDTH, HEIGHT = 128, 96


def fisheye(degrees: float):
    """An equidistant lens that spans so much across the picture."""
    focal = WIDTH / 2 / np.radians(degrees / 2)
    return lambda ideal: distort_fisheye(ideal, 0.02, -0.01) * focal + (64.0, 48.0), focal


def radial_about_a_centre_of_its_own(ideal: Points) -> Points:
    """As MicMac has it: radial terms about a place a fifth of the picture from the principal point."""
    away = 90.0 * ideal + (64.0, 48.0) - (88.0, 38.0)
    squared = (away**2).sum(axis=1, keepdims=True)
    return away * (1 - 1.5e-5 * squared + 1.5e-9 * squared**2) + (88.0, 38.0)


def ftheta(ideal: Points) -> Points:
    return distort_ftheta(ideal, 160.0, 0.0, 0.015, 0.0, 4e-7) / 0.015 + (62.0, 50.0)


LENSES = {
    "fisheye of 120 degrees": (*fisheye(120.0), (64.0, 48.0)),
    "fisheye of 170 degrees": (*fisheye(170.0), (64.0, 48.0)),
    "radial about a centre of its own": (radial_about_a_centre_of_its_own, 90.0, (64.0, 48.0)),
    "ftheta": (ftheta, 1 / 0.015, (62.0, 50.0)),
}

REACH = dict.fromkeys(LENSES, (1.0, 0.8)) | {"fisheye of 120 degrees": (2.4, 1.5)}
"""Ideal coordinates over which points are drawn, over those of a lens of 90 degrees."""


def fitted(name: str) -> Lens:
    project, focal, center = LENSES[name]
    return fit_lens(project, Lens(WIDTH, HEIGHT, (focal, focal), center), name, "a file")


def whole(values: np.ndarray, missing: np.ndarray | None = None, saturated: np.ndarray | None = None):
    """Reads rows of a file that holds these numbers."""
    missing = np.zeros(values.shape[:2], bool) if missing is None else missing
    saturated = np.zeros(values.shape, bool) if saturated is None else saturated

    def read(first: int, last: int) -> CalibratedRows:
        return CalibratedRows(values[first:last], saturated[first:last], missing[first:last])

    return read


@pytest.mark.parametrize("name", LENSES)
def test_points_are_seen_where_the_scenes_lens_says(name: str):
    lens = fitted(name)
    assert lens.resampled_from is not None, lens.note
    assert "interpolated" in lens.note
    assert "170" not in name or "% of the picture lies outside and is left out" in lens.note
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    places = np.stack([columns, rows], axis=-1).astype(np.float32)  # each pixel tells where it is in the file
    resampling = Resampling.into(lens)
    parts = [resampling.rows(first, first + 32, whole(places)) for first in (0, 32, 64)]
    shown = np.concatenate([part.values for part in parts])
    missing = np.concatenate([part.missing for part in parts])
    ideal = np.random.default_rng(0).uniform(-0.55, 0.55, (2000, 2)) * REACH[name]
    wanted = LENSES[name][0](ideal)
    found, kept = looked_up(shown, missing, lens.pixels_of(ideal))
    assert kept.mean() > 0.9
    assert np.linalg.norm(found - wanted[kept], axis=1).max() < 0.1


def looked_up(picture: np.ndarray, missing: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values between pixels, linearly; and at which of the places all four pixels are there."""
    x, y = (pixels - 0.5).T
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    kept = (column >= 0) & (row >= 0) & (column < picture.shape[1] - 1) & (row < picture.shape[0] - 1)
    corners = [(0, 0), (0, 1), (1, 0), (1, 1)]
    for down, across in corners:
        kept[kept] = ~missing[row[kept] + down, column[kept] + across]
    found = np.zeros((kept.sum(), 2))
    for down, across in corners:
        weight = np.abs(1 - across - (x - column)[kept]) * np.abs(1 - down - (y - row)[kept])
        found += weight[:, None] * picture[row[kept] + down, column[kept] + across]
    return found, kept


def test_missing_pixels_and_those_outside_take_no_part():
    lens = fitted("radial about a centre of its own")
    values = np.full((HEIGHT, WIDTH, 2), 0.5, np.float32)
    missing = np.zeros((HEIGHT, WIDTH), bool)
    missing[40:44, 50:60] = True
    values[missing] = 0.0
    part = Resampling.into(lens).rows(0, HEIGHT, whole(values, missing))
    assert 40 <= part.missing[30:60, 40:70].sum() < 120
    np.testing.assert_allclose(part.values[~part.missing], 0.5, atol=1e-5)
    assert not part.values[part.missing].any()
    assert part.missing[~Resampling.into(lens).inside].all()


def test_a_square_of_pixels_with_a_missing_one_takes_no_part():
    lens = fitted("fisheye of 120 degrees")
    values = np.full((2 * HEIGHT, 2 * WIDTH, 2), 0.5, np.float32)
    values[::9, ::9] = np.nan
    calibration = Calibration(Raster.of(2 * HEIGHT, 2 * WIDTH, None, 2), np.arange(2))
    file = file_of(values)
    part = Resampling.into(lens).rows(0, HEIGHT, lambda first, last: calibration.rows(file, first, last))
    assert 0.1 < part.missing.mean() < 0.5
    np.testing.assert_allclose(part.values[~part.missing], 0.5, atol=1e-5)


def test_saturation_stays_with_its_pixels_and_labels_keep_their_numbers():
    lens = fitted("fisheye of 120 degrees")
    saturated = np.zeros((HEIGHT, WIDTH, 1), bool)
    saturated[30:50, 40:60] = True
    resampling = Resampling.into(lens)
    values = np.full((HEIGHT, WIDTH, 1), 0.5, np.float32)
    part = resampling.rows(0, HEIGHT, whole(values, saturated=saturated))
    assert 300 < part.saturated.sum() < 500
    labels = np.where(saturated[..., 0], np.uint8(7), np.uint8(3))
    assert set(np.unique(resampling.nearest(labels, outside=255))) <= {3, 7, 255}
    assert (resampling.nearest(labels, outside=255)[~resampling.inside] == 255).all()


@pytest.mark.parametrize("options", [{}, {"crop": (8, 12, 80, 104)}, {"bin_pixels": 2}])
def test_a_scene_of_an_ftheta_lens_shows_its_views_in_a_lens_that_trains(tmp_path, options):
    names = ["view_00", "view_01", "view_02"]
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    places = np.stack([columns / 200, rows / 200, 0.5 + columns / 1000], axis=-1).astype(np.float32)
    for name in names:
        write_cube(tmp_path, name, places)
    write_poses(tmp_path / "transforms.json", names, WIDTH, HEIGHT)
    content = json.loads((tmp_path / "transforms.json").read_text())
    del content["fl_x"]
    content |= {"cx": 62.0, "cy": 50.0, "ftheta_p0": 0.0, "ftheta_p1": 0.015, "ftheta_p2": 0.0}
    content |= {"ftheta_p3": 4e-7, "ftheta_p4": 0.0}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    output = tmp_path / "scene"
    process(tmp_path, output, scale=1.0, **options)
    scene = json.loads((output / "transforms.json").read_text())
    assert scene["camera_model"] == "OPENCV"
    cube = np.load(output / "cubes" / "view_00.npy") / 65535.0
    assert cube.shape[:2] == (scene["h"], scene["w"])
    keys = ("fl_x fl_y", "cx cy", "k1 k2 p1 p2", "k3 k4")
    focal, center, bends, higher = (tuple(scene[key] for key in group.split()) for group in keys)
    lens = Lens(scene["w"], scene["h"], focal, center, bends, higher)
    assert "interpolated" in (output / "report.txt").read_text()
    with Image.open(output / "masks" / "view_00.png") as mask:
        outside = np.asarray(mask.convert("L")) == 0
    assert 0 < outside.mean() < 0.2
    assert not cube[outside].any()
    ideal = np.random.default_rng(0).uniform(-0.4, 0.4, (200, 2))
    found, kept = looked_up(200 * cube[..., :2], outside, lens.pixels_of(ideal))
    assert kept.mean() > 0.9
    assert np.linalg.norm(found - ftheta(ideal)[kept], axis=1).max() < 0.1


def test_views_of_one_lens_share_their_resampling_and_a_lens_that_ours_stands_for_needs_none():
    lens = fitted("fisheye of 120 degrees")
    first, second = (lens.seen_as(64, 48, (0.0, 0.0), (0.5, 0.5)) for _ in range(2))
    assert Resampling.into(first) is Resampling.into(second)
    assert Resampling.into(first) is not Resampling.into(lens.seen_as(64, 48, (4.0, 0.0), (0.5, 0.5)))
    project, focal = fisheye(60.0)
    lens = fit_lens(project, Lens(WIDTH, HEIGHT, (focal, focal), (64.0, 48.0)), "fisheye", "a file")
    assert lens.resampled_from is None
    assert "off by at most" in lens.note
