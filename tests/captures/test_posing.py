"""Where cameras stand in the world of a scene, and how the lenses of a rig share poses."""

import json
from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from tests.factories.files import file_of, present
from tests.factories.ground_views import flight_poses
from tests.factories.poses import SIMILARITY, elsewhere, in_a_row, ring_set, transforms, write_json
from tests.factories.scenes import make_scene, ring_poses
from unmix_plugin.captures.cube import CameraTags, CaptureView, Cube
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.posing import complete_rigs, place_poses, pose_views
from unmix_plugin.captures.process import refuse_late_lenses
from unmix_plugin.captures.report import Code, Kind, sentences
from unmix_plugin.captures.writing.scene_files import write_points
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.loader import load_scene

FAR = np.array([500_123.0, 5_400_321.0, 300.0])


@pytest.mark.parametrize("is_flight", [False, True])
def test_a_ring_stands_upright_around_the_origin_whatever_its_world_was_and_what_took_it(is_flight):
    placed, _placement, notes = place_poses(elsewhere(ring_set(12)), is_flight=is_flight)
    assert Code.UP_BY_AXES in {note.code for note in notes}
    stacked = np.stack([camera.camera_to_world for camera in placed.cameras.values()])
    np.testing.assert_allclose(np.linalg.norm(stacked[:, :, 3], axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(stacked[:, 2, 0], 0, atol=1e-9)  # horizontal axes lie flat
    assert (stacked[:, 2, 1] > 0).all()
    heights = [pose[2, 3] / 4 for pose in ring_poses(12)]
    np.testing.assert_allclose(stacked[:, 2, 3], heights, atol=1e-9)


def test_a_known_up_axis_is_kept_and_cameras_in_parallel_have_their_points_in_the_middle():
    points = np.array([[1.0, 2.0, -3.0], [2.0, 2.0, -3.0], [3.0, 2.0, -3.0]])
    _, placement, notes = place_poses(ring_set(up=np.array([0.0, 0.0, 1.0])))
    np.testing.assert_array_equal(placement.rotation, np.eye(3))
    assert Code.UP_OF_SOURCE in {note.code for note in notes}
    _, placement, notes = place_poses(replace(in_a_row(), points=points))
    np.testing.assert_allclose(placement.to_source(np.zeros(3)), [2, 2, -3])
    assert Code.UP_BY_MEAN in {note.code for note in notes}


def test_land_lies_level_below_the_cameras_of_a_flight():
    """Which sway above land at z = 0, in a world that knows no up."""
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * np.array([1, 1, 0.01])
    cameras = {f"{n}": PosedCamera(pose[:3], None) for n, pose in enumerate(flight_poses(6))}
    placed, placement, notes = place_poses(PoseSet(cameras, "a flight", points), is_flight=True)
    land = present(placed.points)
    assert np.ptp(land[:, 2]) < 0.1 * np.ptp(land[:, 0])
    assert all(camera.camera_to_world[2, 3] > 0.5 for camera in placed.cameras.values())
    assert Code.UP_AGAINST_FLIGHT in {note.code for note in notes}
    np.testing.assert_allclose(placement.to_source(np.zeros(3)), np.median(points, axis=0), atol=1e-9)


def test_sparse_points_are_written_with_their_colours(tmp_path):
    points, colours = np.arange(6.0).reshape(2, 3), np.array([[1, 2, 3], [4, 5, 255]], np.uint8)
    assert write_points(tmp_path, ring_set()) == {}
    written = write_points(tmp_path, ring_set(points=points, colours=colours))
    assert written == {"ply_file_path": "points.ply"}
    vertex = PlyData.read(tmp_path / "points.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[name] for name in "xyz"], 1), points)
    np.testing.assert_array_equal(np.stack([vertex[name] for name in ("red", "green", "blue")], 1), colours)


def test_what_was_placed_returns_to_the_source_also_when_it_was_written(tmp_path):
    poses = elsewhere(ring_set(points=np.ones((2, 3)), offset=FAR))
    placed, placement, _notes = place_poses(poses)
    stacked = {name: camera.camera_to_world for name, camera in placed.cameras.items()}
    found = read_poses(write_json(tmp_path / "transforms.json", transforms(stacked, **placement.to_json())))
    for name, camera in poses.cameras.items():
        source, mine = camera.camera_to_world, found.cameras[name].camera_to_world
        back, there = placement.to_source(stacked[name][:, 3]), source[:, 3] + FAR
        np.testing.assert_allclose(back, there, rtol=0, atol=1e-8)
        np.testing.assert_allclose(mine[:, :3], source[:, :3], atol=1e-9)
        np.testing.assert_allclose(mine[:, 3] + found.offset, there, rtol=0, atol=1e-7)
    points = placement.to_source(present(placed.points))
    np.testing.assert_allclose(points, 1 + np.stack([FAR, FAR]), rtol=0, atol=1e-8)


@pytest.mark.parametrize("offset", [np.zeros(3), FAR])
def test_a_scene_with_a_placement_has_the_sources_world(tmp_path, offset):
    folder = make_scene(tmp_path / "scene")
    plain = load_scene(folder.root)
    marked = {"markers": {"7": [[1.0, 2.0, 3.0]]}}
    folder.edit(lambda content: content.update({**SIMILARITY.to_json(), "offset": offset.tolist(), **marked}))
    scene = load_scene(folder.root)
    np.testing.assert_allclose(scene.cameras.camera_to_world, plain.cameras.camera_to_world)
    marker = SIMILARITY.to_source(np.array([[1.0, 2.0, 3.0]])) + offset
    np.testing.assert_allclose(scene.markers["7"], marker, rtol=0, atol=1e-8)
    corners = scene.scene_box.aabb.double().numpy()
    expected = SIMILARITY.to_source(plain.normalisation.to_world(corners)) + offset
    np.testing.assert_allclose(scene.normalisation.to_world(corners), expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(scene.normalisation.to_model(expected), corners, rtol=0, atol=1e-7)
    recorded = json.loads(json.dumps(scene.normalisation.to_json()))
    again = type(scene.normalisation).from_json(recorded)
    np.testing.assert_array_equal(again.to_world(corners), scene.normalisation.to_world(corners))


SMALL_LENS = Lens(4, 3, (5.0, 5.0), (2.0, 1.5))
FLIP = np.diag([1.0, -1.0, -1.0])
ANGLES = {"a": "0,0,0", "b": "2,-3,1.5", "c": "-1,0.5,4"}


def cube_of(height: int, width: int, **xmp: str) -> Cube:
    return file_of(np.broadcast_to(np.uint16(0), (height, width, 1)), camera=CameraTags(xmp))


SCALED = "lenses given for 640 x 480 pixels were scaled to {} x {}"
CUT = "given for 640 x 480 pixels, its file has 400 x 300: taken as scaled. If it was cut"


@pytest.mark.parametrize(
    ("width", "height", "note", "finding"),
    [(640, 480, "", ""), (320, 240, SCALED, ""), (1280, 960, SCALED, ""), (400, 300, "", CUT)],
)
def test_lenses_that_were_scaled_to_their_pictures_are_said(width, height, note, finding):
    views = [CaptureView(f"view_{index}", cube_of(height, width)) for index in range(6)]
    posed = pose_views(views, ring_set())
    assert [text for text in sentences(posed.remarks, Kind.DONE) if "scaled" in text] == [
        note.format(width, height)
    ] * bool(note)
    assert [finding in text for text in sentences(posed.remarks, Kind.WRONG)] == [True] * bool(finding)


def rig_view(shot: str, sensor: str, angles: str | None = None) -> CaptureView:
    cube = cube_of(3, 4, **({} if angles is None else {"Camera:RigRelatives": angles}))
    return CaptureView(f"{shot}{sensor}", cube, sensor, lens=SMALL_LENS, shot=shot)


def turned_camera(seed: int) -> PosedCamera:
    rotation = Rotation.from_euler("xyz", [seed, 0.3, 2.0 * seed]).as_matrix()
    return PosedCamera(np.column_stack([rotation, seed * np.array([1.0, 2.0, 3.0])]), SMALL_LENS)


def test_rotations_in_the_files_turn_a_lens_against_another():
    views = [rig_view("r1", sensor, ANGLES[sensor]) for sensor in "abc"]
    posed = {"r1b": turned_camera(3)}
    completed, notes = complete_rigs(views, posed)
    numbers = {sensor: np.array(angles.split(","), float) for sensor, angles in ANGLES.items()}
    to_reference = {x: Rotation.from_euler("XYZ", n, degrees=True).as_matrix() for x, n in numbers.items()}
    base = posed["r1b"].camera_to_world
    for sensor in "ac":
        expected = base[:, :3] @ FLIP @ to_reference["b"].T @ to_reference[sensor] @ FLIP
        found = completed[f"r1{sensor}"].camera_to_world
        np.testing.assert_allclose(found[:, :3], expected, atol=1e-12)
        np.testing.assert_allclose(found[:, 3], base[:, 3], atol=1e-12)
        assert completed[f"r1{sensor}"].lens == SMALL_LENS
    assert {note.code for note in notes} == {Code.RIG_AS_FILES_SAY}


def test_offsets_and_lenses_that_were_found_go_before_those_in_the_files():
    offset, lens = np.eye(4), replace(SMALL_LENS, focal_px=(6.0, 6.0))
    offset[:3, :3] = Rotation.from_euler("xyz", [1, 2, 3], degrees=True).as_matrix()
    offset[:3, 3] = (0.1, -0.2, 0.3)
    shots = ("r1", "r2", "r3")
    views = [rig_view(shot, sensor, ANGLES[sensor]) for shot in shots for sensor in "ab"]
    posed = {f"{shot}a": turned_camera(index) for index, shot in enumerate(shots, start=1)}
    moved = {name[:2]: np.vstack([one.camera_to_world, [0, 0, 0, 1]]) @ offset for name, one in posed.items()}
    posed |= {f"{shot}b": PosedCamera(moved[shot][:3], lens) for shot in shots[:2]}
    completed, (note,) = complete_rigs(views, posed)
    np.testing.assert_allclose(completed["r3b"].camera_to_world, moved["r3"][:3], atol=1e-12)
    assert completed["r3b"].lens == lens
    assert (note.code, note.values["lens"]) == (Code.RIG_AS_OTHER_SHOTS, "b")


def test_views_without_any_help_are_left_out_and_said_and_those_of_no_shot_left_alone():
    views = [rig_view("r1", "a"), rig_view("r1", "b"), *(rig_view("r2", x, ANGLES[x]) for x in "ab")]
    completed, notes = complete_rigs(views, {"r1a": turned_camera(1)})
    assert set(completed) == {"r1a"}
    codes = [(note.code, note.values["lens"]) for note in notes]
    assert (Code.RIG_OFFSET_UNKNOWN, "b") in codes
    assert [code for code, _ in codes].count(Code.RIG_WITHOUT_POSE) == 2
    single = [replace(views[0], name=name, sensor="", shot="") for name in ("one", "two")]
    completed, notes = complete_rigs(single, {"one": turned_camera(1)})
    assert (set(completed), notes) == ({"one"}, [])


def test_a_lens_that_pixels_would_be_brought_into_is_refused_once_they_are_written():
    bent = replace(SMALL_LENS, resampled_from=SMALL_LENS.pixels_of)
    refuse_late_lenses({})
    with pytest.raises(CaptureError, match="the lens of a is not found in the pictures"):
        refuse_late_lenses({"a": bent})
