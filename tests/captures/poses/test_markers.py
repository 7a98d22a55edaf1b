"""Printed markers: how exactly corners are found, what poses follow from them, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.factories.commands import done, refused
from tests.factories.files import present
from tests.factories.poses import align_poses, elsewhere
from tests.factories.scenes import look_at
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.marker_detection import FAMILIES, count_markers, find_markers, parse_family
from unmix_plugin.captures.poses.markers import metric_poses, poses_from_markers
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.commands.process import process
from unmix_plugin.errors import CaptureError, ConfigError
from unmix_plugin.scenes.placement import Placement
from unmix_plugin.scenes.reading.loader import load_scene

cv2 = pytest.importorskip("cv2")
SIDE = 0.05
LENS = Lens(320, 240, (350.0, 350.0), (160.0, 120.0), (-0.12, 0.03, 0.0, 0.0))
PINHOLE = replace(LENS, distortion=(0.0, 0.0, 0.0, 0.0))
SQUARE = SIDE * np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
FAMILY = "DICT_4X4_50"


def board(columns: int = 4, rows: int = 3) -> dict[int, np.ndarray]:
    """Corners of markers on a table, at height 0.3."""
    step = 1.4 * SIDE
    places = [(step * (i - 1.5), step * (j - 1.0), 0.3) for j in range(rows) for i in range(columns)]
    return {number: SQUARE + np.array(place) for number, place in enumerate(places)}


BOARD = board()
BIGGER = BOARD | {7: BOARD[7].mean(axis=0) + 1.5 * SQUARE}
MOVED = {number: points + np.array([0.02, 0.01, 0.0]) * (number > 5) for number, points in BOARD.items()}


def cameras(count: int = 8, lens: Lens = LENS, corners: dict[int, np.ndarray] = BOARD) -> PoseSet:
    """Around the board, at several heights; the corners are its points."""
    found = {}
    for index in range(count):
        angle, height = 2.1 * index, 0.25 + 0.06 * (index % 4)
        place = np.array([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.3 + height])
        found[f"view_{index}"] = PosedCamera(look_at(place, np.array([0.0, 0.0, 0.3]))[:3], lens)
    return PoseSet(found, "the truth", np.concatenate(list(corners.values())))


def seen(truth: PoseSet, corners: dict[int, np.ndarray] = BOARD) -> dict[str, dict]:
    """What every camera sees of the markers, each with an error of a tenth of a pixel."""
    generator = np.random.default_rng(0)

    def by(camera: PosedCamera):
        errors = 0.1 * generator.normal(size=(len(corners), 4, 2))
        return {n: camera.pixels_of(corners[n]) + error for n, error in zip(corners, errors, strict=True)}

    return {name: by(camera) for name, camera in truth.cameras.items()}


def solved(sightings: dict[str, dict], lens: Lens | None = None, marker_size: float | None = SIDE):
    lenses = {"": (LENS.width, LENS.height) if lens is None else lens}
    return poses_from_markers(sightings, dict.fromkeys(sightings, ""), lenses, marker_size)


def picture(camera: PosedCamera, corners: dict[int, np.ndarray], family: str = FAMILY) -> np.ndarray:
    """Light of printed markers on white paper, with shades of grey where a pixel is partly black."""
    assert camera.lens is not None
    fine, (width, height) = 6, (camera.lens.width, camera.lens.height)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
    light = np.ones((fine * height, fine * width), np.float32)
    for number, points in corners.items():
        marker = cv2.aruco.generateImageMarker(dictionary, number, 240).astype(np.float32) / 255
        target = (camera.pixels_of(points) * fine - 0.5).astype(np.float32)
        source = np.array([[0, 0], [240, 0], [240, 240], [0, 240]], np.float32) - 0.5
        warp = cv2.getPerspectiveTransform(source, target)
        light = np.minimum(light, cv2.warpPerspective(marker, warp, light.shape[::-1], borderValue=1.0))
    return 0.05 + 0.8 * light.reshape(height, fine, width, fine).mean(axis=(1, 3))


def test_corners_are_found_to_a_few_hundredths_of_a_pixel():
    truth, corners = cameras(4, PINHOLE), BOARD
    pictures = {name: picture(camera, corners) for name, camera in truth.cameras.items()}
    found, notes = find_markers(pictures, FAMILY)
    assert notes == []
    errors = []
    for name, those in found.items():
        errors += [
            pixels - truth.cameras[name].pixels_of(corners[number]) for number, pixels in those.items()
        ]
    assert len(errors) >= 0.95 * 4 * len(corners)
    assert np.sqrt(np.mean(np.square(errors))) < 0.06
    assert np.abs(np.mean(errors)) < 0.02, "black and white have no influence on where an edge is"


@pytest.mark.slow
def test_the_family_is_that_of_the_markers():
    truth = cameras(2, PINHOLE).cameras.values()
    shown = [picture(camera, BOARD, "DICT_APRILTAG_36H11") for camera in truth]
    counts = count_markers(shown)
    assert max(counts, key=lambda name: counts[name]) == "DICT_APRILTAG_36H11"
    assert counts["DICT_APRILTAG_36H11"] >= 20
    assert count_markers(shown, FAMILY) == {FAMILY: 0}


def test_a_family_is_named_as_opencv_does_or_shorter():
    assert all(hasattr(cv2.aruco, name) for name in FAMILIES)
    assert parse_family("4x4_50") == FAMILY
    with pytest.raises(ConfigError, match="did you mean DICT_APRILTAG_36H11"):
        parse_family("april_36h11")


def test_a_number_twice_in_a_picture_is_left_out_and_said():
    corners = board(2, 2)
    camera = cameras(1, PINHOLE).cameras["view_0"]
    again = {0: corners[3] + np.array([0.08, 0.0, 0.0])}
    shown = np.minimum(picture(camera, corners), picture(camera, again))
    found, notes = find_markers({"one": shown}, FAMILY)
    assert 0 not in found["one"]
    assert set(found["one"]) >= {1, 2}
    assert "twice in a picture, left out there: 0" in notes[0]


def test_poses_lens_scale_and_up_follow_from_markers():
    truth = cameras()
    found = solved(seen(truth))
    aligned = align_poses(found, truth)
    assert aligned.names == tuple(truth.cameras)
    assert aligned.rms_px < 0.15
    assert aligned.similarity.scale == pytest.approx(1.0, abs=0.005)
    assert_corners(found, aligned.similarity)
    lens = present(found.cameras["view_0"].lens)
    assert lens.focal_px[0] == pytest.approx(350.0, rel=0.01)
    assert lens.distortion[0] == pytest.approx(-0.12, abs=0.05)
    assert found.has_world
    np.testing.assert_allclose(aligned.similarity.rotation[2], [0, 0, 1], atol=2e-3)  # the table is level
    heights = [camera.camera_to_world[2, 3] for camera in found.cameras.values()]
    expected = [camera.camera_to_world[2, 3] - 0.3 for camera in truth.cameras.values()]
    np.testing.assert_allclose(heights, expected, atol=2e-3)


def test_a_lens_that_is_given_stays_and_markers_may_lie_anywhere():
    turns = Rotation.from_euler("xyz", np.random.default_rng(1).uniform(-0.5, 0.5, (12, 3))).as_matrix()
    places = {number: points.mean(axis=0) for number, points in BOARD.items()}
    raised = {number: place + np.array([0, 0, 0.02 * (number % 3)]) for number, place in places.items()}
    corners = {number: place + SQUARE @ turns[number].T for number, place in raised.items()}
    truth = cameras(corners=corners)
    found = solved(seen(truth, corners), lens=LENS, marker_size=None)
    assert {camera.lens for camera in found.cameras.values()} == {LENS}
    assert align_poses(found, truth).rms_px < 0.15
    assert not found.has_world
    assert found.metres_per_unit is None
    assert any("no scale: give --marker-size" in note for note in found.notes)


@pytest.mark.slow
def test_wrong_sightings_are_left_out_and_views_without_markers_named():
    truth = cameras()
    sightings = seen(truth)
    sightings["view_1"][3] = sightings["view_1"][3] + 9.0
    sightings["view_5"] = {}
    sensor_of = dict.fromkeys(sightings, "rgb") | {"nir_0": "nir", "nir_1": "nir"}
    lenses = {"rgb": LENS, "nir": (LENS.width, LENS.height)}
    found = poses_from_markers(sightings | {"nir_0": {}, "nir_1": {}}, sensor_of, lenses)
    assert "poses of 7 of 10 views" in found.notes[0]
    assert "views without enough markers: view_5, nir_0, nir_1" in found.notes
    assert any("1 sighting of markers left out" in note for note in found.notes)
    assert not any("focal length" in note for note in found.notes)
    assert align_poses(found, truth).rms_px < 0.15


def test_sightings_where_a_lens_folds_its_picture_over_are_left_out():
    lens = replace(LENS, distortion=(-0.5, 0.0, 0.0, 0.0))
    truth = cameras(lens=lens)
    in_the_corner = np.array([[300.0, 220.0], [318.0, 220.0], [318.0, 238.0], [300.0, 238.0]])
    sightings = seen(truth)
    sightings["view_1"][3] = in_the_corner
    found = solved(sightings, lens=lens)
    assert align_poses(found, truth).rms_px < 0.15
    assert "1 sighting of markers left out where a lens folds its picture over" in found.notes
    said = r"in 0 of 8 views.*\(8 sightings of markers left out where a lens folds.*: calibrate"
    with pytest.raises(CaptureError, match=said):
        solved({name: {3: in_the_corner} for name in truth.cameras}, lens=lens)


def test_a_board_in_one_view_only_is_refused():
    truth = cameras()
    sightings: dict[str, dict] = {name: {} for name in truth.cameras}
    sightings["view_2"] = seen(truth)["view_2"]
    with pytest.raises(CaptureError, match="seen in 1 of 8 views, the same ones in 0; expected at least 3"):
        solved(sightings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "after", "said"),
    [(BIGGER, BIGGER, r"several sizes: .*, 7 \(1\.[45]"), (BOARD, MOVED, "did not keep their places")],
)
def test_markers_of_two_sizes_and_boards_that_moved_are_refused(before, after, said):
    truth = cameras()
    first, later = seen(truth, before), seen(truth, after)
    sightings = {name: (first if index < 4 else later)[name] for index, name in enumerate(truth.cameras)}
    with pytest.raises(CaptureError, match=said):
        solved(sightings)


def assert_corners(found: PoseSet, to_truth: Placement) -> None:
    """The corners of all markers are where they are."""
    assert set(found.markers) == {str(number) for number in BOARD}
    for number, corners in BOARD.items():
        np.testing.assert_allclose(to_truth.to_scene(found.markers[str(number)]), corners, atol=0.02 * SIDE)


def test_markers_give_scale_and_up_to_poses_that_have_none():
    truth = cameras()
    tilted = replace(elsewhere(truth), has_world=False)
    found = metric_poses(tilted, seen(truth), SIDE)
    aligned = align_poses(found, truth)
    assert aligned.similarity.scale == pytest.approx(1.0, abs=0.005)
    np.testing.assert_allclose(aligned.similarity.rotation[2], [0, 0, 1], atol=5e-3)
    assert found.has_world
    assert_corners(found, aligned.similarity)
    with pytest.raises(CaptureError, match="none of them seen by two cameras that agree"):
        metric_poses(tilted, {"view_0": seen(truth)["view_0"]}, SIDE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Pictures of the board, and where they were taken from."""
    path = tmp_path_factory.mktemp("capture")
    truth = cameras(4, PINHOLE)
    for name, camera in truth.cameras.items():
        light = picture(camera, BOARD)
        grey = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        Image.fromarray(np.dstack([np.round(255 * grey).astype(np.uint8)] * 3)).save(path / f"{name}.png")
    return path, truth


@pytest.mark.slow
def test_a_scene_of_marked_pictures_has_their_poses_in_metres(folder, tmp_path):
    data, truth = folder
    words = ["cubes", "--data", data, "--wavelengths", "610,550,465", "--mask", "white"]
    words += ["--output-dir", tmp_path / "scene", "--poses", "markers", "--marker-size", SIDE]
    done(process, *words)
    found = read_poses(tmp_path / "scene" / "transforms.json")
    names = {name: name.split("/")[-1].removesuffix(".png") for name in found.cameras}
    aligned = align_poses(found, truth, names)
    assert len(names) == 4
    assert aligned.rms_px < 0.3
    assert len(load_scene(tmp_path / "scene").markers) == len(BOARD)
    assert aligned.similarity.scale == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--poses markers --marker-family 5x5_50", "no markers of DICT_5X5_50 are in the pictures, but"),
        ("--poses markers --marker-size 50", "--marker-size 50: expected metres"),
        ("--poses markers --angles 0:360:60", "--poses turntable and --angles go together"),
        ("--poses turntable", "--poses turntable and --angles go together"),
        ("--poses turntable --angles 0:360:10", "gives 36 angles"),
        ("--marker-size 0.05", "--marker-size goes with --poses estimate, markers, turntable"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(folder, tmp_path, words, said):
    asked = ["cubes", "--data", folder[0], "--wavelengths", "610,550,465", "--output-dir", tmp_path / "scene"]
    assert said in refused(process, *asked, *words.split())
    assert list(tmp_path.iterdir()) == []
