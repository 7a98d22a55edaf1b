"""Gains of views: smooth, relative to each other, found by training and fitted for evaluation."""

from dataclasses import replace
from typing import Literal

import pytest
import torch
from torch.testing import assert_close

from tests.method_factory import (
    BOX,
    CONFIG,
    NUM_BANDS,
    WAVELENGTHS_NM,
    initial_data,
    make_model,
    make_rays,
)
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.light.view_gains import ViewGains, smooth_terms
from unmix_plugin.losses.training_losses import LossConfig
from unmix_plugin.model import UnmixModel
from unmix_plugin.trained.alignment import align_gain
from unmix_plugin.trained.evaluation import PredictedView, ViewTruth

WAVELENGTHS = torch.tensor(WAVELENGTHS_NM)


def make_lit_model(light: Literal["fixed", "camera", "per-view"]) -> UnmixModel:
    torch.manual_seed(0)
    losses = LossConfig(background="black", abundances=0.0, rgb=0.0)
    config = replace(CONFIG, light=light, losses=losses)
    model: UnmixModel = config.setup(scene_box=BOX, metadata=make_model().metadata)
    with torch.no_grad():
        model.initialise(initial_data(), torch.Generator().manual_seed(0))
        model.field.get_parameter("table").normal_(std=0.5)
    return model.eval()


def of_views(rays: RayBundle, num_views: int) -> RayBundle:
    return replace(rays, camera_indices=torch.arange(len(rays)) % num_views)


def test_gains_are_relative_to_their_mean():
    gains = ViewGains(3, WAVELENGTHS)
    with torch.no_grad():
        gains.log_gains.copy_(torch.randn(3, 3))
    found = gains(torch.arange(3), gains.terms)
    assert_close(found.log().mean(dim=0), torch.zeros(NUM_BANDS), atol=1e-6, rtol=0)
    with torch.no_grad():
        gains.log_gains.add_(1.0)
    assert_close(gains(torch.arange(3), gains.terms), found)


def test_one_band_has_one_gain():
    assert_close(smooth_terms(torch.tensor([550.0]))[0], torch.ones(1))


def test_training_finds_the_exposure_of_each_view():
    model = make_lit_model("per-view")
    assert model.view_gains is not None
    true = torch.tensor([1.2, 0.8, 1.0])
    rays = of_views(make_rays(240), 3)
    with torch.no_grad():
        seen = model.get_outputs(rays)
        batch = {
            "spectra": seen["spectral"] * true[rays.camera_indices, None],
            "alpha": seen["accumulation"],
        }
    optimizer = torch.optim.Adam([model.view_gains.log_gains], lr=0.02)
    for _ in range(150):
        optimizer.zero_grad()
        model.get_loss_dict(dict(seen), batch)["spectral"].backward()
        optimizer.step()
    found = model.view_gains(torch.arange(3), model.view_gains.terms).detach()
    expected = (true / true.log().mean().exp())[:, None].expand(3, NUM_BANDS)
    assert_close(found, expected, atol=0.02, rtol=0)
    metric = float(model.get_metrics_dict(dict(seen), batch)["psnr"])
    assert metric > 30


def test_a_view_is_aligned_by_exposure_and_smooth_white_balance():
    generator = torch.Generator().manual_seed(0)
    shown = torch.rand(8, 9, NUM_BANDS, generator=generator) * 0.5
    gain = (torch.tensor([0.2, -0.1, 0.05]) @ smooth_terms(WAVELENGTHS)).exp()
    truth = ViewTruth("view", shown * gain, torch.ones(8, 9, dtype=torch.bool))
    ones = torch.ones(8, 9)
    predicted = PredictedView(shown, ones, ones[..., None], ones.to(torch.uint8), ones[..., None])
    assert_close(align_gain(predicted, truth, WAVELENGTHS).spectra, truth.spectra, atol=1e-4, rtol=0)


def test_a_view_without_matter_stays_as_it_is():
    spectra = torch.zeros(4, 4, NUM_BANDS)
    truth = ViewTruth("void", spectra, torch.ones(4, 4, dtype=torch.bool), torch.zeros(4, 4))
    ones = torch.ones(4, 4)
    predicted = PredictedView(spectra, ones, ones[..., None], ones.to(torch.uint8), ones[..., None])
    assert align_gain(predicted, truth, WAVELENGTHS) is predicted


@pytest.mark.parametrize("light", ["fixed", "camera"])
def test_other_lights_have_no_gains(light):
    assert make_lit_model(light).view_gains is None
