"""Line cameras that were registered to the scene: their poses are those that were found."""

import torch
from torch.testing import assert_close

from tests.pose_factory import cameras, refinement, some_pixels
from unmix_plugin.engine.geometry.key_poses import rotation_matrix
from unmix_plugin.engine.processes.processes import Processes
from unmix_plugin.poses.refinement import LARGEST_STEP, PoseRefinement
from unmix_plugin.poses.settings import PoseConfig


def registered(size: float) -> PoseRefinement:
    """The line camera's poses as a registration found them."""
    found = refinement()
    steps = size * torch.ones(11, 6, dtype=torch.float64)
    found.take_registered(1, steps, distance=4.0)
    return found


def test_a_registered_line_camera_has_the_poses_that_were_found():
    found = registered(0.02)
    assert_close(found.steps_of(1, 4.0), 0.02 * torch.ones(11, 6, dtype=torch.float64), atol=1e-7, rtol=0)
    views, coords = some_pixels(1)
    given = cameras().generate_rays(views, coords)
    turn = rotation_matrix(torch.full((1, 3), 0.02))[0]
    moved = found(given)
    assert_close(moved.origins, given.origins + 4.0 * 0.02, atol=1e-5, rtol=0)
    assert_close(moved.directions, given.directions @ turn.T, atol=1e-5, rtol=0)


def test_gradients_and_penalties_leave_a_registered_line_camera_alone():
    found = registered(0.02)
    views, coords = some_pixels(1)
    moved = found(cameras().generate_rays(views, coords))
    found.is_free[[0, 2]] = False
    loss = moved.directions.sum() + moved.origins.sum() + found.penalty(PoseConfig(penalty=1.0))
    assert float(loss.detach()) != 0
    (slope,) = torch.autograd.grad(loss, found.steps)
    assert bool((slope[1:12] == 0).all())


def test_registration_looks_through_the_lens_as_it_is_corrected():
    found, given = refinement("radial"), cameras()
    seen = found.lens.of(given)
    assert_close(seen.focal_px, given.focal_px * float(found.lens.steps[0].detach().exp()))
    assert_close(seen.distortion[:, :2], found.lens.steps[1:].detach().expand(3, 2))
    assert torch.equal(seen.camera_to_world, given.camera_to_world)


def test_a_registration_that_leads_too_far_is_not_taken():
    found = registered(2 * LARGEST_STEP)
    assert not bool(found.is_found.any())
    assert_close(found.corrections, refinement().corrections)


def test_a_line_camera_that_was_undone_is_free_again_once_it_is_registered():
    found = refinement()
    found.is_free[1] = False
    found.take_registered(1, torch.zeros(11, 6, dtype=torch.float64), distance=4.0)
    assert bool(found.is_free[1])
    found.undo_runaways()
    assert bool(found.is_found[1])


def test_registered_poses_are_those_of_the_first_process():
    found, others = registered(0.02), refinement()

    class First(Processes):
        """Hands on what the first process has."""

        def of_first(self, values: torch.Tensor) -> torch.Tensor:
            source = {78: found.found, 3: found.is_found.float()}[values.numel()]
            return values.copy_(source)

    others.agree(First())
    assert torch.equal(others.found, found.found)
    assert torch.equal(others.is_found, found.is_found)
