"""The surface of a scene: where its cameras see it, closed or cut to what they see."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from tests.factories.ball_model import FROM_ABOVE, INNER_RADIUS, RADIUS, BallField, ball_scene, cameras_around
from tests.factories.cameras import around
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.surface import SeenSurface
from unmix_plugin.trained.surface_mesh import TriangleMesh, surface_of, without_stray_pieces

ALL = around(14)
SCENE = replace(ball_scene(), views=tuple(RunView(str(index), ALL[index]) for index in range(len(ALL))))
ABOVE = tuple(RunView(str(index), camera) for index, camera in enumerate(cameras_around(FROM_ABOVE)))


def test_a_hollow_ball_is_one_closed_surface_where_the_ball_ends():
    found, unseen = surface_of(SCENE, keeps_unseen=True)
    mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert radius.min() > INNER_RADIUS
    assert abs(radius.mean() - RADIUS) < SCENE.pixel_size / 4
    assert mesh.volume > 0
    assert 0 <= unseen < 1


class LeakingBall(BallField):
    """A hollow ball with a hole along a line of sight from its middle."""

    def __init__(self, towards: torch.Tensor) -> None:
        super().__init__()
        self.towards = torch.nn.functional.normalize(towards, dim=0)

    def density_of(self, encoded: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        along = encoded @ self.towards
        beside = (encoded - along[:, None] * self.towards).norm(dim=-1)
        density, features = super().density_of(encoded)
        return torch.where((along > 0) & (beside < 0.25), 0.0, density), features


def test_a_solid_has_no_hollow_that_one_camera_alone_looks_into():
    below = (0.05, 0.0, -1.0)
    ring = [
        (math.cos(angle), math.sin(angle), 1.0) for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ]
    cameras = cameras_around([*ring, below])
    views = tuple(RunView(str(index), camera) for index, camera in enumerate(cameras))
    leaking = replace(SCENE, field=LeakingBall(torch.tensor(below)), views=views)
    closed, _ = surface_of(leaking, keeps_unseen=True)
    assert np.linalg.norm(closed.vertices, axis=1).min() > 0.9 * RADIUS
    shown, _ = surface_of(leaking)
    assert np.linalg.norm(shown.vertices, axis=1).min() < INNER_RADIUS


def test_normals_are_of_length_1_and_face_outwards():
    mesh, _ = surface_of(SCENE)
    outwards = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-9)
    assert (mesh.normals * outwards).sum(axis=1).min() > 0.5


def test_a_side_that_no_camera_sees_is_closed_and_counted_or_cut_away():
    scene = replace(SCENE, views=ABOVE)
    whole, unseen = surface_of(scene, keeps_unseen=True)
    assert trimesh.Trimesh(whole.vertices, whole.faces, process=False).is_watertight
    assert unseen > 0.2
    shown, same = surface_of(scene)
    assert same == unseen
    assert shown.vertices[:, 2].max() > 0.55
    assert shown.vertices[:, 2].min() > -0.5
    assert shown.areas().sum() == pytest.approx((1 - unseen) * whole.areas().sum(), rel=0.05)


def test_distances_are_those_to_what_is_seen_in_pixels():
    seen = SeenSurface(SCENE, 20_000, [view.camera for view in SCENE.views])
    reach = 2.0
    outside, at, inside = ((RADIUS + step) for step in (0.35, 0.0, -0.4))
    points = torch.tensor([[outside, 0.0, 0.0], [at, 0.0, 0.0], [inside, 0.0, 0.0]])
    far, near, within = seen.signed_distance(points, reach).tolist()
    assert far > 0.9
    assert abs(near) < 0.5
    assert within == -1
    assert float(seen.signed_distance(torch.full((1, 3), 50.0), reach)) == 1  # in no image


def test_a_coarse_grid_finds_the_same_surface_as_a_fine_one():
    for cells in (16, 96):
        mesh, _ = surface_of(SCENE, cells, keeps_unseen=True)
        cell = float(SCENE.scene_box.size.max()) / cells
        radii = np.linalg.norm(mesh.vertices, axis=1)
        assert abs(radii.mean() - RADIUS) < max(SCENE.pixel_size, 0.5 * cell) / 2


def ribbon(count, left):
    """Vertices and faces of `count` triangles in a row, each sharing an edge with the next."""
    index = np.arange(count)
    places = np.arange(count + 2)
    vertices = np.stack([left + 0.5 * places, places % 2, np.zeros(count + 2)], axis=1)
    return vertices, np.stack([index, index + 1, index + 2], axis=1)


def test_stray_pieces_go_and_large_ones_stay():
    (large, large_faces), (middle, middle_faces) = ribbon(1200, 0.0), ribbon(20, 2000.0)
    two, two_faces = ribbon(2, 610.0)
    vertices = np.concatenate([large, middle, two])
    faces = np.concatenate([large_faces, middle_faces + len(large), two_faces + len(large) + len(middle)])
    kept = without_stray_pieces(TriangleMesh(vertices, faces))
    assert len(kept.faces) == 1200 + 20
    assert len(kept.vertices) == len(large) + len(middle)
    assert len(without_stray_pieces(TriangleMesh(*ribbon(2, 0.0))).faces) == 2
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert len(without_stray_pieces(empty).faces) == 0


def test_nothing_seen_is_refused(monkeypatch):
    monkeypatch.setattr(SeenSurface, "signed_distance", lambda _, points, *__, **___: torch.ones(len(points)))
    with pytest.raises(RunError, match="train longer"):
        surface_of(SCENE)
    with pytest.raises(ConfigError, match="--resolution is 4; choose 8 to 1024"):
        surface_of(SCENE, 4)


def test_pieces_that_no_camera_sees_are_no_holes_of_the_surface():
    """What corners of the box hide from all cameras counts as solid, but is no part of a ball in the middle."""
    mesh, _ = surface_of(ball_scene(), 48)
    assert np.unique(mesh.pieces()).tolist() == [0]
    assert np.abs(mesh.vertices).max() < 0.7


def test_smoothed_normals_of_a_rough_ball_are_nearer_to_those_of_the_ball():
    ball = trimesh.creation.icosphere(subdivisions=4)
    rough = np.random.default_rng(0).normal(1, 0.02, len(ball.vertices))[:, None] * ball.vertices
    mesh = TriangleMesh(rough, ball.faces.astype(np.int64))
    angles = [np.degrees(np.arccos((each * ball.vertices).sum(axis=1).clip(-1, 1))).mean()
              for each in (mesh.normals, mesh.smoothed_normals)]  # fmt: skip
    assert angles[1] < 0.4 * angles[0]
    np.testing.assert_allclose(np.linalg.norm(mesh.smoothed_normals, axis=1), 1)
