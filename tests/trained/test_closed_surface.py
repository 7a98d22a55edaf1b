"""The closed surface of a scene: where the cameras see it, without holes and hollows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from tests.factories.ball_model import INNER_RADIUS, RADIUS, ball_scene
from tests.factories.cameras import around
from unmix_plugin.errors import RunError
from unmix_plugin.trained import closed_surface as module
from unmix_plugin.trained.closed_surface import closed_surface
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.surface import SeenSurface

ALL = around(14)
SCENE = replace(ball_scene(), views=tuple(RunView(str(index), ALL[index]) for index in range(len(ALL))))


def test_a_hollow_ball_is_one_closed_surface_with_so_many_triangles():
    found = closed_surface(SCENE, 400)
    mesh = trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False)
    assert len(mesh.faces) == 400 < found.num_found
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert mesh.volume > 0
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert radius.min() > INNER_RADIUS
    assert abs(radius.mean() - RADIUS) < SCENE.pixel_size
    assert 0 <= found.unseen < 1


def test_a_side_that_no_camera_sees_is_closed_and_counted():
    found = closed_surface(replace(SCENE, views=SCENE.views[:1]), 10**6)
    mesh = trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False)
    assert mesh.is_watertight
    assert found.unseen > 0.2


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


def test_nothing_seen_is_refused(monkeypatch):
    monkeypatch.setattr(module.SeenSurface, "signed_distance", lambda _, points, __: torch.ones(len(points)))
    with pytest.raises(RunError, match="train longer"):
        closed_surface(SCENE, 100)
