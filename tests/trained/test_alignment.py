from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.factories.models import make_scene
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.poses.refinement import LARGEST_STEP
from unmix_plugin.spectral.sensor import SceneSensor
from unmix_plugin.trained.alignment import align_pose, align_rows, moved_camera
from unmix_plugin.trained.evaluation import ViewTruth

POSE = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4.0]]])
CAMERA = Cameras(POSE, torch.full((1, 2), 60.0), torch.full((1, 2), 16.0), torch.zeros(1, 4), 32, 32)
FINE = make_scene()
SCENE = replace(FINE, renderer=replace(FINE.renderer, step=2 * FINE.renderer.step))  # in half the time
OFF = torch.tensor([0.02, -0.015, 0.02, 0.01, 0.02, -0.01])


def turned(angle: float) -> torch.Tensor:
    return moved_camera(CAMERA, torch.tensor([angle, 0.0, 0.0, 0.0, 0.0, 0.0]), SCENE).camera_to_world


def swept() -> Cameras:
    """The same view taken row by row, while the camera turns."""
    keys = KeyPoses(torch.cat([turned(0.2), turned(-0.2)]), torch.tensor([0.5, 31.5]), (2,))
    return replace(CAMERA, key_poses=keys)


def truth_of(scene, camera: Cameras) -> ViewTruth:
    view = scene.look(camera, 2)
    valid = torch.ones(32, 32, dtype=torch.bool)
    valid[:3] = False
    return ViewTruth("a", view["spectral"], valid, alpha=view.opacity)


def off_by(found: Cameras, truth: Cameras) -> float:
    """Mean distance of points in the picture, pixels."""
    points = 0.6 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 0.3
    (mine, depths), (theirs, true_depths) = (camera.project(points, 0) for camera in (found, truth))
    both = (depths > 0) & (true_depths > 0)
    return float((mine - theirs)[both].norm(dim=1).mean())


@pytest.mark.parametrize(("camera", "share"), [(CAMERA, 1.0), (swept(), 0.4), (CAMERA, 0.0)])
def test_a_view_that_is_off_by_pixels_is_brought_back_and_one_that_is_right_stays(camera, share):
    given = moved_camera(camera, share * OFF, SCENE)
    before = off_by(given, camera)
    assert before > 1.0 or share == 0
    assert off_by(align_pose(SCENE, given, truth_of(SCENE, camera)), camera) < max(0.1 * before, 0.05)


def test_a_view_that_is_off_by_a_quarter_of_its_width_is_brought_back_too():
    given = moved_camera(CAMERA, torch.tensor([-0.1, 0.12, 0.1, 0.0, 0.0, 0.0]), SCENE)
    assert off_by(given, CAMERA) > 7
    assert off_by(align_pose(SCENE, given, truth_of(SCENE, CAMERA)), CAMERA) < 0.5


THREE = SceneSensor("three", np.eye(5)[[3, 0, 2]])


@pytest.mark.parametrize(
    ("share", "exposure", "sensor"),
    [(1.0, 1.6, THREE), (0.0, 0.6, None)],
)
def test_where_gains_are_fitted_no_pose_makes_up_for_another_exposure(share, exposure, sensor):
    fitting, given = replace(SCENE, fitted=("pose", "gain")), moved_camera(CAMERA, share * OFF, SCENE)
    truth = replace(truth_of(SCENE, CAMERA), sensor=sensor)
    found = align_pose(fitting, given, replace(truth, spectra=exposure * truth.seen(truth.spectra)))
    assert off_by(found, CAMERA) < max(0.1 * off_by(given, CAMERA), 0.05)


def test_a_view_of_something_else_does_not_leave_the_scene():
    noise = torch.rand(32, 32, 5, generator=torch.Generator().manual_seed(0))
    found = align_pose(SCENE, CAMERA, ViewTruth("a", noise, torch.ones(32, 32, dtype=torch.bool)))
    turn = found.camera_to_world[0, :, :3].diagonal().sum()
    assert float(((turn - 1) / 2).arccos()) <= LARGEST_STEP * 3**0.5 + 1e-4


def swept_rows(wobble: float) -> Cameras:
    """A view taken row by row, while the camera turns, and wobbles by so many radians."""
    y = torch.arange(32) + 0.5
    poses = []
    for row in y.tolist():
        turn = [0.2 - 0.4 * row / 32, 0.0, wobble * float(torch.sin(torch.tensor(0.3 * row)))]
        turn[1] = wobble * float(torch.cos(torch.tensor(0.25 * row)))
        poses.append(moved_camera(CAMERA, torch.tensor([*turn, 0.0, 0.0, 0.0]), SCENE).camera_to_world)
    return replace(CAMERA, key_poses=KeyPoses(torch.cat(poses), y, (32,)))


@pytest.mark.slow
def test_rows_that_wobble_are_aligned_and_those_that_are_right_or_show_nothing_stay():
    truth, given = swept_rows(0.02), swept_rows(0.0)
    measured = truth_of(FINE, truth)
    found = align_rows(FINE, given, measured)
    assert off_by(given, truth) > 0.7
    assert off_by(found, truth) < 0.3 * off_by(given, truth)
    again = align_rows(FINE, truth, measured)
    assert off_by(again, truth) < 0.1
    assert again.image_rays(0).directions.isfinite().all()
    empty = replace(measured, valid=torch.zeros_like(measured.valid))
    assert off_by(align_rows(FINE, truth, empty), truth) < 1e-3


def test_where_gains_are_fitted_no_row_makes_up_for_another_exposure():
    fitting, truth, given = replace(SCENE, fitted=("pose", "gain")), swept_rows(0.02), swept_rows(0.0)
    seen = truth_of(SCENE, truth)
    dim, bright = (replace(seen, spectra=exposure * seen.spectra) for exposure in (0.6, 1.6))
    assert off_by(align_rows(fitting, truth, dim), truth) < 0.25
    # Turns and shifts of rows can hardly be told apart here, so the picture tells.
    found = align_rows(fitting, given, bright)
    errors = [(truth_of(SCENE, camera).spectra - seen.spectra).square().mean() for camera in (given, found)]
    assert float(errors[1] / errors[0]) ** 0.5 < 0.3
