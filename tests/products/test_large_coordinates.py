"""Exports of a scene whose poses are geo-referenced: they are where the source says, to a millionth of the scene."""

import json

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from tests.factories.ball_model import ALL_ROUND, ball_scene, seen_surface
from tests.factories.cameras import FRAME, around
from tests.factories.outputs import loaded_mesh
from unmix_plugin.products.mesh import gltf_content, write_mesh
from unmix_plugin.products.point_cloud import write_point_cloud
from unmix_plugin.products.volume import write_volume
from unmix_plugin.scenes.placement import Placement
from unmix_plugin.trained.camera_files import camera_file_bytes, read_camera_file
from unmix_plugin.trained.run_views import RunView, positions_for_files
from unmix_plugin.trained.surface import GridPoints, SurfaceAppearance
from unmix_plugin.trained.surface_mesh import TriangleMesh

SCENE = ball_scene()
MIDDLE = np.array([-2_499_366.0, -4_256_836.0, 4_029_217.0])
TURN = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
PLACEMENT = Placement(TURN, np.array([1.0, 2.0, -3.0]), 0.08, MIDDLE)
FAR = FRAME.after(PLACEMENT)
EXTENT = 2.0 / FAR.scale


def source_of(scene_points):
    """Points of the placed scene in the source's coordinates."""
    return (scene_points / PLACEMENT.scale - PLACEMENT.translation) @ TURN + MIDDLE


def assert_close(found, expected):
    assert found.dtype == np.float64
    assert np.abs(found - expected).max() <= 1e-6 * EXTENT


def columns(path):
    vertex = PlyData.read(path)["vertex"]
    return np.stack([np.asarray(vertex[name]) for name in "xyz"], axis=1)


def test_points_are_where_the_source_says(tmp_path):
    points = seen_surface(SCENE, ALL_ROUND, 6_000).points()
    for name, frame in (("near", FRAME), ("far", FAR)):
        write_point_cloud([tmp_path / name], points, 300, SCENE, frame)
    near, far = columns(tmp_path / "near"), columns(tmp_path / "far")
    assert near.dtype == np.float32
    assert_close(far, source_of(near.astype(np.float64)))


def test_meshes_of_all_formats_are_where_the_source_says(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    mesh = TriangleMesh(np.array(ball.vertices), np.array(ball.faces))
    ply, obj, _, glb = write_mesh(tmp_path, ("ply", "obj", "glb"), mesh, SCENE, FAR, up="z")
    expected = source_of(FRAME.to_world(mesh.vertices))
    assert_close(columns(ply), expected)
    lines = [line.split()[1:4] for line in obj.read_text().splitlines() if line.startswith("v ")]
    assert_close(np.array(lines, dtype=np.float64), expected)
    loaded = loaded_mesh(glb)
    assert_close(np.array(loaded.vertices, dtype=np.float64) + loaded.metadata["offset"], expected)


def test_volumes_are_where_the_source_says(tmp_path):
    grid = GridPoints.over(SCENE.scene_box.aabb, 8)
    path = tmp_path / "volume.npz"
    write_volume(path, SCENE, grid, FAR, range(grid.shape[0]))
    matrix = np.load(path)["index_to_world"]
    index = np.array([1.0, 2.0, 3.0])
    model = grid.origin.astype(np.float64) + grid.cell * index
    assert_close((matrix @ [*index, 1.0])[:3], source_of(FRAME.to_world(model)))


def test_cameras_are_written_where_the_source_says_and_a_placed_scenes_frames_are_read_alike(tmp_path):
    views = [RunView(f"v{index}", around(3)[index]) for index in range(3)]
    path = tmp_path / "cameras.json"
    path.write_bytes(camera_file_bytes(views, None, FAR))
    content = json.loads(path.read_text())
    for view, entry in zip(views, content["frames"], strict=True):
        position = view.camera.camera_to_world[0, :, 3].double().numpy()
        assert_close(np.array(entry["transform_matrix"])[:3, 3], source_of(FRAME.to_world(position)))
    placed = json.loads(camera_file_bytes(views, None, FRAME)) | PLACEMENT.to_json()
    (tmp_path / "placed.json").write_text(json.dumps(placed))
    for name in ("cameras.json", "placed.json"):
        for view, again in zip(views, read_camera_file(tmp_path / name, FAR).views, strict=True):
            found, expected = again.camera.camera_to_world, view.camera.camera_to_world
            torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("distance", "expected"), [(5.0, np.float32), (500.0, np.float64)])
def test_positions_take_the_type_that_keeps_them_to_a_millionth(distance, expected):
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3)) + np.array([distance, 0.0, 0.0])
    stored = positions_for_files(points)
    assert stored.dtype == expected
    assert np.abs(stored - points).max() <= 2e-6


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e3])
def test_gltf_keeps_positions_to_a_millionth_in_units_of_any_size(unit):
    vertices = unit * (np.array([500_400.3, 300_700.1, 12.0]) + np.random.default_rng(0).random((50, 3)))
    mesh = TriangleMesh(positions_for_files(vertices), np.array([[0, 1, 2]]))
    looks = SurfaceAppearance(SCENE.materials, torch.eye(3), torch.ones(3, len(SCENE.bands)))
    positions, _, extras = gltf_content(mesh, looks, "a surface")
    assert np.abs(positions.astype(np.float64) + extras["offset"] - vertices).max() <= 1e-6 * unit
