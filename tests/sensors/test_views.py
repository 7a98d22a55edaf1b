from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.models import BOX, CONFIG, NUM_BANDS, WAVELENGTHS_NM, initial_data, make_model, make_rays
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.errors import ConfigError
from unmix_plugin.model import UnmixModel
from unmix_plugin.sensors.views import MeasuredPixels, SensorViews, ViewGains, smooth_terms
from unmix_plugin.settings import LossConfig, UnmixModelConfig
from unmix_plugin.spectral.sensor import SceneSensor
from unmix_plugin.spectral.unmixing.abundances import sparse_abundances
from unmix_plugin.trained.alignment import align_gain
from unmix_plugin.trained.evaluation import PredictedView, ViewTruth

WEIGHTS = (1.24, 1.24, 0.04, 1.24, 1.24)


def losses_of(model: UnmixModel, spoilt: float) -> dict[str, torch.Tensor]:
    """Of pixels whose third band is wrong by so much."""
    rays = make_rays(16)
    torch.manual_seed(0)
    spectra = 0.2 + 0.5 * torch.rand(16, NUM_BANDS)
    spectra[:, 2] += spoilt
    batch = {"spectra": spectra, "alpha": torch.ones(16), "pixels": torch.arange(16)}
    return model.get_train_loss_dict(rays, batch)[1]


def weighted(weights: tuple[float, ...]) -> UnmixModel:
    return make_model(losses=LossConfig(band_weights=weights, background="black", rgb=0.0))


def test_errors_count_by_the_weight_of_their_band_and_weights_of_1_change_no_bit():
    plain, less = weighted(()), weighted(WEIGHTS)
    grown = [losses_of(m, 0.3)["spectral"] - losses_of(m, 0.0)["spectral"] for m in (plain, less)]
    assert_close(grown[1] / grown[0], torch.tensor(0.04), rtol=0.01, atol=0)
    before, ones = losses_of(weighted(()), 0.1), losses_of(weighted((1.0,) * NUM_BANDS), 0.1)
    assert all(torch.equal(before[name], ones[name]) for name in before)


def test_a_noisy_band_hardly_moves_the_mixtures_of_pixels():
    generator = torch.Generator().manual_seed(0)
    rows = [[0.6, 0.2, 0.2, 0.2, 0.3], [0.2, 0.6, 0.8, 0.2, 0.3], [0.2, 0.2, 0.5, 0.6, 0.3]]
    endmembers = torch.tensor(rows)
    shares = torch.eye(3)[torch.randint(3, (200,), generator=generator)]
    pixels = shares @ endmembers
    pixels[:, 2] = (pixels[:, 2] + 0.3 * torch.randn(200, generator=generator)).clamp(min=0)
    errors = []
    for weights in ((), WEIGHTS):
        balance = weighted(weights).balance
        seen, corners = (balance.scaled(spectra, None) for spectra in (pixels, endmembers))
        found = sparse_abundances(seen, corners, torch.tensor(0.01))
        errors.append(float((found - shares).square().mean()))
    assert errors[1] < 0.3 * errors[0]


def test_first_endmembers_come_back_as_bright_as_they_were_seen():
    plain, less = weighted(()).endmembers, weighted(WEIGHTS).endmembers
    assert_close(less.sort(dim=0).values, plain.sort(dim=0).values, atol=0.05, rtol=0)


def test_weights_follow_from_the_data_and_only_where_bands_differ():
    def resolved(weights: np.ndarray) -> UnmixModelConfig:
        data = {**initial_data(), "band_weights": weights}
        return UnmixModelConfig(num_endmembers=3).resolve_auto(lambda: data, torch.Generator())[0]

    assert resolved(np.ones(NUM_BANDS, np.float32)).losses.band_weights == ()
    assert resolved(np.array(WEIGHTS)).losses.band_weights == pytest.approx(WEIGHTS)


@pytest.mark.parametrize("weights", [(1.0, 1.0), (1.0, -1.0, 1.0, 1.0, 1.0)])
def test_impossible_weights_are_refused(weights):
    with pytest.raises(ConfigError, match="band-weights"):
        make_model(losses=replace(CONFIG.losses, band_weights=weights))


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


def test_gains_are_relative_to_their_mean_and_only_light_per_view_has_them():
    gains = ViewGains(3, WAVELENGTHS)
    with torch.no_grad():
        gains.log_gains.copy_(torch.randn(3, 3))
    found = gains(torch.arange(3), gains.terms)
    assert_close(found.log().mean(dim=0), torch.zeros(NUM_BANDS), atol=1e-6, rtol=0)
    with torch.no_grad():
        gains.log_gains.add_(1.0)
    assert_close(gains(torch.arange(3), gains.terms), found)
    assert_close(smooth_terms(torch.tensor([550.0]))[0], torch.ones(1))  # one band has one gain
    assert make_lit_model("fixed").view_gains is make_lit_model("camera").view_gains is None


def test_training_finds_the_exposure_of_each_view():
    model = make_lit_model("per-view")
    assert model.view_gains is not None
    true = torch.tensor([1.2, 0.8, 1.0])
    rays = of_views(make_rays(240), 3)
    with torch.no_grad():
        seen = model.get_outputs(rays)
        measured = seen["spectral"] * true[rays.camera_indices, None]
        pixels = [MeasuredPixels(None, 240, measured, seen["accumulation"], torch.arange(240))]
    optimizer = torch.optim.Adam([model.view_gains.log_gains], lr=0.02)
    for _ in range(150):
        optimizer.zero_grad()
        model.losses(model.training_batch(rays, pixels))["spectral"].backward()
        optimizer.step()
    found = model.view_gains(torch.arange(3), model.view_gains.terms).detach()
    expected = (true / true.log().mean().exp())[:, None].expand(3, NUM_BANDS)
    assert_close(found, expected, atol=0.02, rtol=0)
    assert float(model.comparison.psnr(model.training_batch(rays, pixels).compared)) > 30


def predicted_view(spectra: torch.Tensor, opacity: float = 1.0) -> PredictedView:
    flat = torch.full(spectra.shape[:2], opacity)
    return PredictedView(spectra, flat, flat[..., None], flat.to(torch.uint8), flat[..., None])


def random_spectra() -> torch.Tensor:
    return torch.rand(8, 9, NUM_BANDS, generator=torch.Generator().manual_seed(0)) * 0.5


def everywhere(spectra: torch.Tensor) -> torch.Tensor:
    return torch.ones(spectra.shape[:2], dtype=torch.bool)


def test_a_view_is_aligned_by_exposure_and_smooth_white_balance():
    shown = random_spectra()
    gain = (torch.tensor([0.2, -0.1, 0.05]) @ smooth_terms(WAVELENGTHS)).exp()
    truth = ViewTruth("view", shown * gain, everywhere(shown))
    found = truth.shown(align_gain(predicted_view(shown), truth, WAVELENGTHS))
    assert_close(found, truth.spectra, atol=1e-4, rtol=0)


@pytest.mark.parametrize("num_channels", [4, 2, 1])
def test_a_view_of_a_rig_is_aligned_in_the_channels_of_its_sensor_as_in_training(num_channels):
    shown, generator = random_spectra(), torch.Generator().manual_seed(1)
    responses = torch.rand(num_channels, NUM_BANDS, generator=generator).double()
    sensor = SceneSensor("colour", (responses / responses.sum(dim=1, keepdim=True)).numpy())
    gains, seen_by = ViewGains(2, WAVELENGTHS), SensorViews([sensor.to_json()], torch.zeros(NUM_BANDS, 3))
    with torch.no_grad():
        gains.log_gains.copy_(torch.tensor([[0.4, -0.2, 0.1], [-0.4, 0.2, -0.1]]))
        terms = seen_by.project(gains.terms, 0)
        measured = seen_by.project(shown, 0) * gains(torch.tensor([0]), terms / terms[:1])
    truth = ViewTruth("view", measured, everywhere(shown), sensor=sensor)
    assert float((truth.shown(predicted_view(shown)) - measured).abs().max()) > 0.05
    found = truth.shown(align_gain(predicted_view(shown), truth, WAVELENGTHS))
    assert_close(found, measured, atol=1e-4, rtol=0)


def test_a_view_in_another_light_is_aligned_without_the_pixels_that_were_measured_blown_out():
    shown = random_spectra()
    measured = shown.clone()
    measured[:2] = 1.0
    truth = ViewTruth("view", measured, everywhere(shown)).in_light(np.full(NUM_BANDS, 0.5))
    seen = truth.shown(align_gain(predicted_view(shown), truth, WAVELENGTHS))
    assert_close(seen, 0.5 * shown, atol=1e-4, rtol=0)


def test_a_view_without_matter_and_a_prediction_that_is_black_stay_as_they_are():
    black = torch.zeros(4, 4, NUM_BANDS)
    void = ViewTruth("void", black, everywhere(black), torch.zeros(4, 4))
    predicted = predicted_view(black)
    assert align_gain(predicted, void, WAVELENGTHS) is predicted
    truth = ViewTruth("view", torch.full_like(black, 0.4), everywhere(black))
    assert torch.equal(truth.shown(align_gain(predicted_view(black, 0.0), truth, WAVELENGTHS)), black)
