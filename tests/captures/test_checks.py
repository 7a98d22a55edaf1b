"""What looks wrong is found, and what is right is not complained of: a patterned ball, drawn point by point."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from tests.factories.captures import record_of
from tests.factories.files import present
from tests.factories.scenes import look_at
from unmix_plugin.captures.checks import SeenView, check_views
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.captures.report import Code, Kind, report_text, sentences
from unmix_plugin.captures.writing.scene_files import OUTLINE, contact_sheet
from unmix_plugin.captures.writing.view_files import detail_of
from unmix_plugin.spectral.colour.srgb import encode_srgb

LAMP = np.array([2.0, 1.0, 5.0])


def _views(folder: Path, positions: list[np.ndarray], light: np.ndarray | None = LAMP, gains=None):
    """Pictures by that light, some of another brightness."""
    gains = gains or {}
    return [view_at(folder, f"view_{i}", at, light, gains.get(i, 1.0)) for i, at in enumerate(positions)]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory):
    """Views all around of the ball under a lamp that stands still."""
    return _views(tmp_path_factory.mktemp("sound"), ring_of(32))


def test_nothing_is_wrong_with_a_good_capture(sound):
    remarks = check_views(sound, ball_points())
    findings, measured = (sentences(remarks, kind) for kind in (Kind.WRONG, Kind.MEASURED))
    assert findings == []
    text = report_text("a title", findings, measured, ["something"])
    assert "none of the checks found a fault" in text
    assert max(map(len, text.splitlines())) <= 110


FAR_AWAY = np.array([0.01, 0.0, -4.0001])


def narrow(folder: Path):
    return _views(folder, ring_of(12, 250.0, (10.0, 14.0)))


SEEN = "degrees away), take views in smaller steps: view_6"
JUMP = "1 view with a jump of exposure, judged by sparse points: view_4 (0.7"
GAP = "no camera looks from 110 degrees of the circle around the object"
BLUR = "1 view less sharp than the others: view_0 (40% of the usual detail)"
FAULTS = {
    "moving light": (lambda folder: _views(folder, ring_of(32), light=None), "light moves with the camera"),
    "a jump of exposure": (lambda folder: _views(folder, ring_of(20), gains={4: 0.7}), JUMP),
    "a narrow ring": (narrow, "a narrow ring"),
    "a gap": (narrow, GAP),
    "a far view": (lambda folder: _views(folder, [*ring_of(6, 60.0), FAR_AWAY]), SEEN),
    "few views": (lambda folder: _views(folder, ring_of(6)), "only 6 views"),
    "blur": (lambda folder: recorded(folder, view_0={"detail": 0.4}), BLUR),
    "saturated": (lambda folder: recorded(folder, view_0={"saturated_pixels": 2000}), "view_0"),
    "missing": (lambda folder: recorded(folder, view_1={"missing_pixels": 2000}), "view_1"),
    "a lens that folds": (lambda folder: folded(folder), "the distortion of 20 views folds the picture over"),
    "a wall in parts": (lambda folder: with_a_wall(folder), "contradict each other"),
    "empty": (lambda folder: recorded(folder, view_2={"matter_share": 0.0}), "view_2"),
}


def recorded(folder, **facts: dict[str, float]):
    """Good views whose records say something else."""
    views = _views(folder, ring_of(20))
    return [replace(view, record=record_of(view.name, **facts.get(view.name, {}))) for view in views]


def folded(folder):
    """Good views that are said to be of a lens that does not reach their corners."""
    views = []
    for view in _views(folder, ring_of(20)):
        lens = replace(present(view.camera.lens), distortion=(-0.6, 0.0, 0.0, 0.0))
        views.append(replace(view, camera=replace(view.camera, lens=lens)))
    return views


def with_a_wall(folder):
    """Good views, every third of which has kept a part of the wall behind the ball."""
    views = _views(folder, ring_of(20))
    for view in views[::3]:
        pixels = np.array(Image.open(view.picture))
        pixels[: SIDE // 3, : SIDE // 3] = (90, 90, 90, 255)
        Image.fromarray(pixels).save(view.picture)
    return views


@pytest.mark.parametrize("kind", FAULTS)
def test_what_looks_wrong_is_found_once_with_the_views_it_is_in(tmp_path: Path, kind: str):
    make, said = FAULTS[kind]
    views = make(tmp_path)
    findings = sentences(check_views(views, ball_points()), Kind.WRONG)
    assert sum(said in finding for finding in findings) == 1, findings
    assert len(views) < 15 or len(findings) == 1


def test_what_can_not_be_judged_is_not_found_wrong(tmp_path: Path):
    flashed = _views(tmp_path, ring_of(32), light=None, gains={4: 0.7})
    one_side = _views(tmp_path, ring_of(16, 60.0, (10.0, 14.0)))
    for views in (flashed, one_side):  # without points
        assert sentences(check_views(views, None), Kind.WRONG) == []
    assert Code.LIGHT_MOVES not in {remark.code for remark in check_views(flashed[::7], ball_points())}


def test_overlap_of_cameras_in_parallel_takes_sparse_points(tmp_path: Path):
    down = view_at(tmp_path, "a", np.array([0.0, 0.01, 4.0]), LAMP)
    poses = [down.camera.camera_to_world + np.eye(3, 4, 3) * x for x in (0.0, 0.5, 1.0, 9.0)]
    views = [replace(down, camera=replace(down.camera, camera_to_world=pose)) for pose in poses]
    assert Code.OVERLAP_UNJUDGED in {remark.code for remark in check_views(views, None)}
    found = {remark.code: remark for remark in check_views(views, ball_points())}
    assert found[Code.OVERLAP].values["least"] == "0%"
    alone = found[Code.VIEWS_ALONE].sentence
    assert "1 view with hardly any overlap with another one (at most 0%, from 0 degrees" in alone


def test_detail_falls_when_a_picture_is_blurred():
    sharp = np.random.default_rng(0).random((80, 80)).astype(np.float32)
    seen = np.ones((80, 80), bool)
    details = [detail_of(gaussian_filter(sharp, sigma), seen) for sigma in (0.3, 0.7, 1.2)]
    assert details[0] > 1.2 * details[1] > 1.4 * details[2]


SIDE = 120
LENS = Lens(SIDE, SIDE, (150.0, 150.0), (SIDE / 2, SIDE / 2))


def ring_of(count: int, span_deg: float = 360.0, elevations_deg=(10.0, 35.0)) -> list[np.ndarray]:
    """Positions of cameras around the ball, in turn at the elevations."""
    angles = np.radians(np.linspace(0.0, span_deg, count, endpoint=span_deg < 360.0))
    heights = np.radians([elevations_deg[index % len(elevations_deg)] for index in range(count)])
    flat = np.cos(heights)
    return list(4.0 * np.column_stack([np.cos(angles) * flat, np.sin(angles) * flat, np.sin(heights)]))


def view_at(folder: Path, name: str, position: np.ndarray, light: np.ndarray | None, gain: float = 1.0):
    """A view of the ball by a lamp at `light`, or at the camera; `gain` is on the brightness of its picture."""
    pose = look_at(position, np.zeros(3))
    x, y = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    rays = np.stack([(x - SIDE / 2) / 150, -(y - SIDE / 2) / 150, -np.ones_like(x)], -1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    towards = rays @ position
    root = towards**2 - (position @ position - 1.0)
    points = position + (-towards - np.sqrt(np.maximum(root, 0)))[..., None] * rays
    lamp = position if light is None else light
    shade = np.clip(points @ (lamp / np.linalg.norm(lamp)), 0.0, None)
    pattern = 0.6 + 0.3 * np.sin(9 * points).prod(axis=-1)
    srgb = encode_srgb(np.clip(gain * 0.6 * pattern * (0.1 + 0.9 * shade), 0, 1))
    rgba = np.dstack([srgb, srgb, srgb, root > 0])
    Image.fromarray(np.rint(255 * rgba).astype(np.uint8)).save(folder / f"{name}.png")
    return SeenView(record_of(name), PosedCamera(pose[:3], LENS), folder / f"{name}.png")


def ball_points(count: int = 1500) -> np.ndarray:
    """Points on the ball."""
    directions = np.random.default_rng(0).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.filterwarnings("ignore:No artists")
def test_every_view_stands_on_the_sheet_with_its_outline(tmp_path: Path):
    views = _views(tmp_path, ring_of(7), None)
    sheet = contact_sheet(views, {}, PoseSet({}, "", points=ball_points(200)), "seven views")
    pixels = np.asarray(Image.open(io.BytesIO(sheet)).convert("RGB")).astype(int)
    outline = np.abs(pixels - np.array(OUTLINE)).max(axis=-1) < 40
    columns, rows = (np.flatnonzero(outline.any(axis=axis)) for axis in (0, 1))
    assert ((np.diff(columns) > 10).sum() + 1, (np.diff(rows) > 10).sum() + 1) == (4, 2)  # of the grid
