"""Objects that were turned by known angles: what poses follow from outlines, and what is refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from tests.factories.poses import align_poses
from tests.factories.scenes import look_at
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.captures.poses.turntable import poses_from_observations, poses_from_turntable
from unmix_plugin.captures.poses.turntable_observations import Turn, gather, parse_angles
from unmix_plugin.errors import CaptureError, ConfigError

cv2 = pytest.importorskip("cv2")
LENS = Lens(240, 200, (420.0, 420.0), (120.0, 100.0))
COUNT = 18


def knobs() -> np.ndarray:
    """Points of a lump that looks different from all sides."""
    generator = np.random.default_rng(4)
    points = [np.array([0.5, 0.35, 0.0])]
    points += [np.array([x, y, z]) for x, y, z in generator.uniform(-0.6, 0.6, (12, 3))]
    ball = generator.normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    return np.concatenate([point + 0.12 * ball for point in points])


def vase() -> np.ndarray:
    """Points of a round thing."""
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 181), np.linspace(-0.5, 0.5, 40))
    radius = 0.3 + 0.1 * np.sin(5 * height)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=-1).reshape(-1, 3)


def camera_at(angle: float, height: float) -> PosedCamera:
    """As seen from the object, which is not quite in the middle of the picture."""
    place = np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), height])
    return PosedCamera(look_at(place, np.array([0.0, 0.0, 0.05]))[:3], LENS)


def silhouette(camera: PosedCamera, points: np.ndarray) -> np.ndarray:
    """Pixels whose middles the outline encloses."""
    hull = cv2.convexHull(camera.pixels_of(points).astype(np.float32))
    mask = np.zeros((LENS.height, LENS.width), np.uint8)
    cv2.fillConvexPoly(mask, np.round((hull - 0.5) * 256).astype(np.int32), 1, shift=8)
    return mask > 0


def turned(points: np.ndarray, heights=(1.2,), sense: float = 1.0, off_deg: float = 0.0):
    """Pictures without any texture, the angles, masks, and where the camera was."""
    generator = np.random.default_rng(0)
    truth, masks, turns = {}, {}, {}
    for place, height in enumerate(heights):
        for index in range(COUNT):
            name, angle = f"view_{place}_{index:02d}", 360.0 * index / COUNT
            wrong = off_deg * generator.normal()
            truth[name] = camera_at(-sense * np.radians(angle + wrong) + 0.3 * place, height)
            masks[name], turns[name] = silhouette(truth[name], points), Turn(angle, place)
    pictures = {name: np.where(mask, np.uint8(128), np.uint8(0)) for name, mask in masks.items()}
    return pictures, turns, masks, PoseSet(truth, "the truth")


@pytest.mark.slow
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_outlines_alone_tell_the_axis_the_lens_and_the_sense(sense):
    """Though some masks are too wide."""
    pictures, turns, masks, truth = turned(knobs(), sense=sense)
    wide = {name: binary_dilation(mask) if i % 3 else mask for i, (name, mask) in enumerate(masks.items())}
    found = poses_from_turntable(pictures, turns, wide if sense > 0 else masks)
    aligned = align_poses(found, truth)
    assert len(aligned.names) == COUNT
    assert aligned.rms_px < (0.6 if sense > 0 else 0.5)
    assert any(f"turned {'against' if sense > 0 else 'with'} the clock" in note for note in found.notes)


@pytest.mark.slow
def test_two_heights_of_the_camera_share_one_world():
    pictures, turns, masks, truth = turned(knobs(), heights=(0.5, 2.0))
    assert align_poses(poses_from_turntable(pictures, turns, masks), truth).rms_px < 0.5


def test_views_that_are_all_alike_or_too_few_from_one_place_are_refused():
    pictures, turns, masks, _ = turned(vase())
    with pytest.raises(CaptureError, match="as all views are alike: silhouettes overlap by 100"):
        poses_from_turntable(pictures, turns, masks)
    blank = {name: np.full_like(picture, 128) for name, picture in pictures.items()}
    with pytest.raises(CaptureError, match="all views are alike: there are no masks, and 0 of 0 points"):
        poses_from_turntable(blank, turns)
    turns["view_0_00"] = Turn(0.0, 1)
    with pytest.raises(CaptureError, match="1 views were taken from place 2 of the camera; expected 3"):
        poses_from_turntable(pictures, turns, masks)


@pytest.mark.slow
def test_wrong_angles_are_refused():
    pictures, turns, masks, _ = turned(knobs())
    halved = {name: Turn(0.5 * turn.angle_deg) for name, turn in turns.items()}
    with pytest.raises(CaptureError, match="the angles do not explain the pictures"):
        poses_from_turntable(pictures, halved, masks)
    pictures, turns, masks, _ = turned(knobs(), heights=(6.0,))
    shuffled = {name: Turn(8.0 * index, index % 3) for index, name in enumerate(turns)}
    with pytest.raises(CaptureError, match="the angles do not explain the pictures"):
        poses_from_turntable(pictures, shuffled, masks)


def test_angles_are_ranges_one_for_each_place_or_a_table(tmp_path):
    names = ["a", "b", "c", "d"]
    assert [turn.angle_deg for turn in parse_angles("0:40:10", names).values()] == [0, 10, 20, 30]
    assert parse_angles("0:-20:-10,5:25:10", names)["d"] == Turn(15.0, 1)
    table = tmp_path / "angles.csv"
    table.write_text("view,angle,camera\nb.hdr,10,low\na,0,low\nc,0,high\nd,10,high\n")
    assert parse_angles(str(table), names)["b"] == Turn(10.0, 0)
    assert parse_angles(str(table), names)["d"] == Turn(10.0, 1)


@pytest.mark.parametrize(
    "text",
    [
        "view;angle\na;0,5\nb;450,0\n",
        "sep=;\r\nView;Angle;Camera\r\na;0,5;1\r\nb;450;1\r\n",
        "view\tangle\na.hdr\t0.5\nb.hdr\t450\n",
        "turned on Monday\n\nview,angle\na,0.5\nb,450\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_tables_of_angles_are_read_as_spreadsheets_write_them(tmp_path, text, encoding):
    (tmp_path / "angles.csv").write_bytes(text.encode(encoding))
    turns = parse_angles(str(tmp_path / "angles.csv"), ["a", "b"])
    assert [turns[name].angle_deg for name in "ab"] == [0.5, 450.0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0:360:10", "gives 36 angles .* for 3 views"),
        ("0:360:1e-9", "gives 360000000000 angles"),  # which are counted and not listed
        ("0:360:0", "expected START:STOP:STEP"),
        ("ten", "expected START:STOP:STEP"),
        ("0:360:-90", "gives 0 angles"),
        ("view,angle\na,0\nb,10\n", "no angle for c"),
        ("view,angle\na,0\nb,10\nc,20\nd,30\n", "no view is called d"),
        ("view,angle\na,zero\n", "line 2: 'zero' is no angle"),
        ("name,turn\na,0\n", "expected the columns view and angle"),
        ("view,angle\na,0\nb,10\na,20\n", "line 4: the view a has an angle already"),
    ],
)
def test_angles_that_do_not_fit_the_views_are_refused(tmp_path, text, said):
    if "\n" in text:
        (tmp_path / "angles.csv").write_text(text)
        text = str(tmp_path / "angles.csv")
    with pytest.raises(ConfigError, match=said):
        parse_angles(text, ["a", "b", "c"])


@pytest.mark.slow
def test_matches_by_chance_do_not_move_the_cameras():
    pictures, turns, masks, truth = turned(knobs())
    names, generator = sorted(pictures), np.random.default_rng(2)
    columns: list[Any] = [[values[name] for name in names] for values in (pictures, turns, masks)]
    evidence = gather(cv2, *columns)
    pairs = generator.integers(0, COUNT - 1, 600)
    points = generator.uniform(70, 130, (600, 2, 2))
    disturbed = replace(evidence, first=pairs, second=pairs + 1, points=points)
    found = poses_from_observations(disturbed, names)
    assert align_poses(found, truth).rms_px < 0.5
