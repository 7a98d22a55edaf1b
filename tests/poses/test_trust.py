"""Poses that disagree with all others: their pixels hardly shape the scene, but still pull at the pose."""

from typing import Any

import torch
from torch.testing import assert_close

from tests.method_factory import make_model
from tests.pose_factory import cameras, refinement, some_pixels
from unmix_plugin.engine.processes import Processes
from unmix_plugin.poses.trust import LARGEST_RATIO, PoseTrust

KNOTS = 10


def observed(errors: torch.Tensor, matter: torch.Tensor | None = None, steps: int = 20) -> PoseTrust:
    """After steps in which each knot had one pixel with this error."""
    trust = PoseTrust(len(errors))
    shown = torch.ones(len(errors), dtype=torch.bool) if matter is None else matter
    for _ in range(steps):
        trust.observe(torch.arange(len(errors)), errors, shown)
    trust.judge(Processes())
    return trust


def test_all_count_alike_while_their_errors_are_alike():
    errors = torch.linspace(1.0, LARGEST_RATIO, KNOTS) * 1e-3
    assert_close(observed(errors).weights, torch.ones(KNOTS))


def test_what_is_far_worse_than_the_median_weighs_less_by_the_square():
    errors = torch.full((KNOTS,), 1e-3)
    errors[3] *= 10 * LARGEST_RATIO
    expected = torch.ones(KNOTS)
    expected[3] = 0.01
    assert_close(observed(errors).weights, expected)


def test_pixels_that_show_nothing_tell_nothing_of_a_pose():
    errors, matter = torch.full((KNOTS,), 1e-3), torch.ones(KNOTS, dtype=torch.bool)
    errors[3], matter[3] = 1.0, False
    assert_close(observed(errors, matter).weights, torch.ones(KNOTS))


def test_a_pose_that_fits_again_is_believed_again():
    errors = torch.full((KNOTS,), 1e-3)
    errors[3] = 1.0
    trust = observed(errors)
    assert trust.weights[3] < 0.01
    for _ in range(600):
        trust.observe(torch.arange(KNOTS), torch.full((KNOTS,), 1e-3), torch.ones(KNOTS, dtype=torch.bool))
    trust.judge(Processes())
    assert_close(trust.weights, torch.ones(KNOTS))


def test_before_anything_was_seen_all_count():
    trust = PoseTrust(KNOTS)
    trust.judge(Processes())
    assert_close(trust.weights, torch.ones(KNOTS))


def gradients(weight: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Of the scene and of the poses, where the pixels of one view weigh this much."""
    poses: Any = refinement()
    poses.trust.weights.fill_(weight)
    model: Any = make_model().train()
    model.generator = torch.Generator().manual_seed(0)
    views, coords = some_pixels(0)
    bundle = cameras().generate_rays(views, coords)
    rays = poses(bundle)
    outputs = poses.believed(model.get_outputs(rays), rays)
    outputs["spectral"].sum().backward()
    return model.field.get_parameter("table").grad, poses.steps.grad


def test_a_pose_that_is_not_believed_still_feels_what_its_pixels_show():
    (table, steps), (hardly, still) = gradients(1.0), gradients(0.01)
    assert float(steps.abs().max()) > 0
    assert_close(hardly, 0.01 * table)
    assert_close(still, steps, rtol=1e-4, atol=1e-7)
