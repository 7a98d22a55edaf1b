"""Rows of an evaluation view of a line camera find the poses from which the field looks like what was measured."""

from dataclasses import replace

import torch

from tests.method_factory import make_scene
from tests.trained.test_pose_alignment import CAMERA, moved, points_seen, truth_of
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.trained.alignment import align_rows


def swept(wobble: float) -> Cameras:
    """A view taken row by row, while the camera turns, and wobbles by so many radians."""
    y = torch.arange(32) + 0.5
    poses = []
    for row in y.tolist():
        turn = [0.2 - 0.4 * row / 32, 0.0, wobble * float(torch.sin(torch.tensor(0.3 * row)))]
        turn[1] = wobble * float(torch.cos(torch.tensor(0.25 * row)))
        poses.append(moved(CAMERA, torch.tensor([*turn, 0.0, 0.0, 0.0]), make_scene()).camera_to_world)
    return replace(CAMERA, key_poses=KeyPoses(torch.cat(poses), y, (32,)))


def off_by(found: Cameras, truth: Cameras) -> float:
    """Mean distance of points in the picture, pixels."""
    (mine, depths), (theirs, true_depths) = (
        camera.project(0.6 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 0.3, 0)
        for camera in (found, truth)
    )
    both = (depths > 0) & (true_depths > 0)
    return float((mine - theirs)[both].norm(dim=1).mean())


def test_rows_that_wobble_are_aligned():
    scene, truth, given = make_scene(), swept(0.02), swept(0.0)
    found = align_rows(scene, given, truth_of(scene, truth))
    assert off_by(given, truth) > 0.7
    assert off_by(found, truth) < 0.3 * off_by(given, truth)


def test_rows_that_are_right_stay():
    scene, truth = make_scene(), swept(0.02)
    found = align_rows(scene, truth, truth_of(scene, truth))
    assert off_by(found, truth) < 0.1
    assert points_seen(found).isfinite().all()


def test_a_view_that_shows_nothing_keeps_its_poses():
    scene, camera = make_scene(), swept(0.02)
    empty = truth_of(scene, camera)
    empty = replace(empty, valid=torch.zeros_like(empty.valid))
    found = align_rows(scene, camera, empty)
    assert off_by(found, camera) < 1e-3
