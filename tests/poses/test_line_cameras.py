"""What is kept of a line camera's views, and what the scene shows in the same channels."""

from dataclasses import replace

import torch
from torch.testing import assert_close

from tests.light.test_view_gains import make_lit_model
from tests.pose_factory import HEIGHT, WIDTH, cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.poses.line_cameras import Swept, keep, swept_view
from unmix_plugin.poses.line_registration.swept_view import columns_compared

COLUMNS = columns_compared(WIDTH, HEIGHT, 10**6)


def kept(valid: bool = True) -> tuple[Swept, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    mixed = torch.rand(HEIGHT, WIDTH, 2, generator=generator) @ torch.rand(2, 5, generator=generator)
    mask = torch.full((HEIGHT, WIDTH), valid)
    mask[:, :2] = False
    alpha = torch.rand(HEIGHT, WIDTH, generator=generator)
    return keep(cameras()[1], COLUMNS, mixed, mask, alpha, index=1), mixed


def test_the_channels_that_are_kept_hold_all_that_two_materials_show():
    view, spectra = kept()
    assert view.wanted.shape == (HEIGHT, WIDTH, 4)
    assert_close(view.wanted[:, 2:, :-1] @ view.axes.T, spectra[:, 2:], atol=1e-4, rtol=0)


def test_pixels_that_are_not_valid_do_not_count():
    view, _ = kept()
    assert bool((view.wanted[:, :2] == 0).all())
    assert bool((view.counts[:, :2] == 0).all())
    assert bool((view.counts[:, 2:] == 1).all())


def test_a_view_without_valid_pixels_moves_nothing():
    view, _ = kept(valid=False)
    box = SceneBox(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    seen = swept_view(view, view.camera, box, lambda rays: torch.ones(len(rays), 4))
    assert bool((seen.row_errors(torch.zeros(seen.num_knots, 6).double()) == 0).all())


def test_few_columns_of_large_images_are_compared_spread_evenly():
    columns = columns_compared(1000, 2000, 9000)
    assert len(columns) == 16
    assert columns.tolist() == [31 + 125 * i // 2 for i in range(16)]
    assert columns_compared(12, 40, 9000).tolist() == list(range(12))


def test_a_view_is_compared_with_the_scene_times_its_own_gain():
    model = make_lit_model("per-view")
    assert model.view_gains is not None
    with torch.no_grad():
        model.view_gains.log_gains.copy_(0.2 * torch.randn(model.view_gains.log_gains.shape))
    num_bands = model.view_gains.terms.shape[1]
    axes = torch.rand(num_bands, 3)
    view = replace(kept()[0], axes=axes)
    spectra = torch.rand(7, num_bands)
    gain = model.view_gains(torch.ones(7, dtype=torch.int64), model.view_gains.terms)
    assert_close(spectra @ model.comparison.through(view), (spectra * gain) @ axes)


def test_a_moved_camera_sends_the_rays_that_were_compared():
    camera = cameras()[1]
    box = SceneBox(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    own, _ = kept()
    seen = swept_view(own, camera, box, lambda rays: torch.cat([rays.origins, rays.directions[:, :1]], dim=1))
    steps = 0.01 * torch.randn(seen.num_knots, 6, generator=torch.Generator().manual_seed(0)).double()
    rays = seen.moved(camera, steps).image_rays(0)
    shown = seen.shown(seen.at_rows(steps)[None], slice(0, HEIGHT))[0]
    expected = torch.cat([rays.origins, rays.directions[:, :1]], dim=1)
    assert_close(shown.flatten(0, 1), expected, atol=1e-5, rtol=0)
