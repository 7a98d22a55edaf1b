"""Corrections of a line camera's poses: waves over its rows, and knots close enough for them."""

import torch
from torch.testing import assert_close

from unmix_plugin.pose_refinement import PoseRefinement


def test_a_line_camera_is_corrected_by_waves_over_its_rows():
    found = PoseRefinement((0, 40, 0, 40, 20))
    firsts = [0, 1, 12, 13, 24]
    with torch.no_grad():
        found.steps[firsts] = torch.arange(1.0, 6.0)[:, None].expand(5, 6)
    counts = torch.tensor(found.knots.counts)
    expected = torch.arange(1.0, 6.0).repeat_interleave(counts)[:, None].expand(-1, 6)
    assert_close(found.corrections.detach(), expected)
    with torch.no_grad():
        found.steps.zero_()
        found.steps[14, 2] = 1.0
    half = found.corrections.detach()[:, 2]
    assert_close(half[13:24] / half[13], torch.cos(torch.linspace(0, torch.pi, 11)))
    assert torch.equal(half[:13].abs().sum() + half[24:].abs().sum(), torch.tensor(0.0))


def test_knots_follow_a_wobble_of_three_waves_of_10_px_within_a_fifth_of_a_pixel():
    y = torch.linspace(0.5, 95.5, 96)
    wobble = 10 * torch.sin(2 * torch.pi * 3 * y / 96 + 0.4)
    found = PoseRefinement((96,))
    place = y / 96 * (found.knots.counts[0] - 1)
    shares = (1 - (place[:, None] - torch.arange(found.knots.counts[0])).abs()).clamp(min=0)
    fitted = shares @ torch.linalg.lstsq(shares, wobble[:, None]).solution
    assert float((fitted[:, 0] - wobble).square().mean().sqrt()) < 0.2
