"""Bands that count less: in the loss, in unmixing and in the first endmembers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.method_factory import CONFIG, NUM_BANDS, initial_data, make_model, make_rays
from unmix_plugin.errors import ConfigError
from unmix_plugin.losses.training_losses import LossConfig
from unmix_plugin.model import UnmixModel
from unmix_plugin.model_settings import UnmixModelConfig
from unmix_plugin.spectral.unmixing.abundances import sparse_abundances

WEIGHTS = (1.24, 1.24, 0.04, 1.24, 1.24)


def losses_of(model: UnmixModel, spoilt: float) -> dict[str, torch.Tensor]:
    """Of pixels whose third band is wrong by so much."""
    rays = make_rays(16)
    torch.manual_seed(0)
    spectra = 0.2 + 0.5 * torch.rand(16, NUM_BANDS)
    spectra[:, 2] += spoilt
    batch = {"spectra": spectra, "alpha": torch.ones(16), "pixels": torch.arange(16)}
    return model.get_loss_dict(model.get_outputs(rays), batch)


def weighted(weights: tuple[float, ...]) -> UnmixModel:
    return make_model(losses=LossConfig(band_weights=weights, background="black", rgb=0.0))


def test_errors_count_by_the_weight_of_their_band():
    plain, less = weighted(()), weighted(WEIGHTS)
    grown = [losses_of(m, 0.3)["spectral"] - losses_of(m, 0.0)["spectral"] for m in (plain, less)]
    assert_close(grown[1] / grown[0], torch.tensor(0.04), rtol=0.01, atol=0)


def test_weights_of_1_change_no_bit():
    plain, ones = losses_of(weighted(()), 0.1), losses_of(weighted((1.0,) * NUM_BANDS), 0.1)
    assert all(torch.equal(plain[name], ones[name]) for name in plain)


def test_a_noisy_band_hardly_moves_the_mixtures_of_pixels():
    generator = torch.Generator().manual_seed(0)
    endmembers = torch.tensor(
        [[0.6, 0.2, 0.2, 0.2, 0.3], [0.2, 0.6, 0.8, 0.2, 0.3], [0.2, 0.2, 0.5, 0.6, 0.3]]
    )
    shares = torch.eye(3)[torch.randint(3, (200,), generator=generator)]
    pixels = shares @ endmembers
    pixels[:, 2] = (pixels[:, 2] + 0.3 * torch.randn(200, generator=generator)).clamp(min=0)
    errors = []
    for weights in ((), WEIGHTS):
        balance = weighted(weights).balance
        found = sparse_abundances(
            balance.scaled(pixels, None), balance.scaled(endmembers, None), torch.tensor(0.01)
        )
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
