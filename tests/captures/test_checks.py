"""What looks wrong is found, and what is right is not complained of.

Views of a patterned ball for the checks, drawn point by point.

The contact sheet shows every view with the outline of its mask.
"""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.captures.file_factory import present
from tests.scenes.scene_factory import look_at
from unmix_plugin.captures.checks import (
    SeenView,
    _blur,
    _exposure,
    _overlap,
    _pixels,
    _ring,
    _slope_of_light,
    check_views,
    report_text,
)
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.captures.writing.scene_files import _OUTLINE, _contact_sheet
from unmix_plugin.captures.writing.view_files import ViewRecord, _detail

LAMP = np.array([2.0, 1.0, 5.0])


def _views(
    folder: Path,
    positions: list[np.ndarray],
    light: np.ndarray | None = LAMP,
    gains: dict[int, float] | None = None,
):
    return [
        view_at(folder, f"view_{index}", position, light, (gains or {}).get(index, 1.0))
        for index, position in enumerate(positions)
    ]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory):
    """Views all around of the ball under a lamp that stands still."""
    return _views(tmp_path_factory.mktemp("sound"), ring_of(32))


def test_nothing_is_wrong_with_a_good_capture(sound):
    checked = check_views(sound, ball_points())
    assert checked[0] == []
    text = report_text("a title", checked, ["something"])
    assert "none of the checks found a fault" in text
    assert max(map(len, text.splitlines())) <= 110


def test_light_that_stands_still_has_no_slope(sound):
    found = present(_slope_of_light(sound, ball_points()))
    assert abs(found[0]) < 0.08


def test_light_that_moves_with_the_camera_is_found(tmp_path: Path):
    views = _views(tmp_path, ring_of(32), light=None)
    found = present(_slope_of_light(views, ball_points()))
    assert 0.4 < found[0] < 1.6
    assert any(
        finding.startswith("light moves with the camera") for finding in check_views(views, ball_points())[0]
    )


def test_moving_light_is_not_judged_without_points_or_near_views(sound):
    assert _slope_of_light(sound, None) is None
    assert _slope_of_light(sound[::7], ball_points()) is None


def test_a_jump_of_exposure_is_found_in_its_view_alone(tmp_path: Path):
    views = _views(tmp_path, ring_of(20), gains={4: 0.7})
    findings, _ = _exposure(views, ball_points())
    assert len(findings) == 1
    assert "exposure jumps in 1 view" in findings[0]
    assert "view_4 (0.7" in findings[0]


def test_a_narrow_ring_and_a_gap_are_found(tmp_path: Path):
    findings, _ = _ring(_views(tmp_path, ring_of(12, 250.0, (10.0, 14.0))))
    assert [finding.split(":")[0] for finding in findings[:1]] == ["a narrow ring"]
    assert findings[1] == "no camera looks from 110 degrees of the circle around the object"


def test_cameras_on_one_side_are_no_ring(tmp_path: Path):
    assert _ring(_views(tmp_path, ring_of(12, 60.0, (10.0, 14.0))))[0] == []


def test_a_view_far_from_the_others_hardly_overlaps(tmp_path: Path):
    positions = [*ring_of(6, 60.0), np.array([0.0, 0.0, -4.0001])]
    positions[-1][0] = 0.01
    findings, _ = _overlap(_views(tmp_path, positions), None)
    assert len(findings) == 1
    assert findings[0].startswith("1 view with hardly any overlap with another one (view_6)")


def test_overlap_of_cameras_in_parallel_takes_sparse_points(tmp_path: Path):
    looking_down = view_at(tmp_path, "a", np.array([0.0, 0.01, 4.0]), LAMP)
    pose = looking_down.camera.camera_to_world
    views = [
        replace(looking_down, camera=replace(looking_down.camera, camera_to_world=pose + shift))
        for shift in (np.eye(3, 4, 3) * x for x in (0.0, 0.5, 1.0, 9.0))
    ]
    assert _overlap(views, None)[0] == []
    findings, said = _overlap(views, ball_points())
    assert "1 view with hardly any overlap with another one (a)" in findings[0]
    assert "least 0%" in said


def test_few_views_are_said(sound):
    assert check_views(sound[:6], None)[0][0].startswith("only 6 views")


def test_blur_is_found_against_the_other_views(sound):
    spoilt = [replace(sound[0], record=record_of("view_0", detail=0.4)), *sound[1:]]
    findings, _ = _blur(spoilt)
    assert findings == ["1 view less sharp than the others: view_0 (40% of the usual detail)"]


def test_detail_falls_when_a_picture_is_blurred():
    from scipy.ndimage import gaussian_filter

    sharp = np.random.default_rng(0).random((80, 80)).astype(np.float32)
    seen = np.ones((80, 80), bool)
    details = [_detail(gaussian_filter(sharp, sigma), seen) for sigma in (0.3, 0.7, 1.2)]
    assert details[0] > 1.2 * details[1] > 1.4 * details[2]


def test_saturated_missing_and_empty_views_are_named(sound):
    views = [
        replace(sound[0], record=record_of("view_0", saturated_pixels=2000)),
        replace(sound[1], record=record_of("view_1", missing_pixels=2000)),
        replace(sound[2], record=record_of("view_2", matter_share=0.0)),
        *sound[3:],
    ]
    named = [finding.split(":")[1].split(" (")[0].strip() for finding in _pixels(views)]
    assert named == ["view_0", "view_1", "view_2"]


SIDE = 120
LENS = Lens(SIDE, SIDE, (150.0, 150.0), (SIDE / 2, SIDE / 2))
RADIUS = 1.0


def record_of(name: str, **facts: float) -> ViewRecord:
    """A record of a view in which nothing is wrong, but for the facts."""
    values = {
        "num_pixels": SIDE * SIDE, "saturated_pixels": 0, "clipped_values": 0, "negative_values": 0,
        "missing_pixels": 0, "matter_share": 0.5, "specks": 0, "holes": 0, "brightness": 0.5, "detail": 1.0,
    }  # fmt: skip
    return ViewRecord(name=name, sensor="", paths={}, mean_spectrum=[], **{**values, **facts})  # type: ignore[arg-type]


def ring_of(
    count: int, span_deg: float = 360.0, elevations_deg: tuple[float, ...] = (10.0, 35.0)
) -> list[np.ndarray]:
    """Positions of cameras around the ball, in turn at the elevations."""
    angles = np.radians(np.linspace(0.0, span_deg, count, endpoint=span_deg < 360.0))
    heights = np.radians([elevations_deg[index % len(elevations_deg)] for index in range(count)])
    flat = np.cos(heights)
    return list(4.0 * np.column_stack([np.cos(angles) * flat, np.sin(angles) * flat, np.sin(heights)]))


def view_at(
    folder: Path, name: str, position: np.ndarray, light: np.ndarray | None, gain: float = 1.0, **facts: float
):
    """A view of the ball.

    Args:
        light: Where the lamp is; None is at the camera.
        gain: On the brightness of the picture.
        facts: Of its record.
    """
    pose = look_at(position, np.zeros(3))
    x, y = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    rays = np.stack([(x - SIDE / 2) / 150, -(y - SIDE / 2) / 150, -np.ones_like(x)], -1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    towards = rays @ position
    root = towards**2 - (position @ position - RADIUS**2)
    hit = root > 0
    points = position + (-towards - np.sqrt(np.maximum(root, 0)))[..., None] * rays
    lamp = position if light is None else light
    shade = np.clip(points @ (lamp / np.linalg.norm(lamp)), 0.0, None)
    pattern = 0.6 + 0.3 * np.sin(9 * points[..., 0]) * np.sin(9 * points[..., 1]) * np.sin(9 * points[..., 2])
    linear = np.clip(gain * 0.6 * pattern * (0.1 + 0.9 * shade), 0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    rgba = np.dstack([srgb, srgb, srgb, hit.astype(float)])
    folder.mkdir(exist_ok=True)
    Image.fromarray(np.rint(255 * rgba).astype(np.uint8)).save(folder / f"{name}.png")
    return SeenView(record_of(name, **facts), PosedCamera(pose[:3], LENS), folder / f"{name}.png")


def ball_points(count: int = 1500) -> np.ndarray:
    """Points on the ball."""
    directions = np.random.default_rng(0).standard_normal((count, 3))
    return RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.filterwarnings("ignore:No artists")
def test_every_view_stands_on_the_sheet_with_its_outline(tmp_path: Path):
    views = [view_at(tmp_path, f"view_{i}", place, None) for i, place in enumerate(ring_of(7))]
    sheet = _contact_sheet(views, {}, PoseSet({}, "", points=ball_points(200)), "seven views")
    pixels = np.asarray(Image.open(io.BytesIO(sheet)).convert("RGB")).astype(int)
    outline = np.abs(pixels - np.array(_OUTLINE)).max(axis=-1) < 40
    columns = np.flatnonzero(outline.any(axis=0))
    rows = np.flatnonzero(outline.any(axis=1))
    assert (np.diff(columns) > 10).sum() + 1 == 4  # columns of the grid
    assert (np.diff(rows) > 10).sum() + 1 == 2  # and rows
