"""Matched filter and adaptive coherence against closed forms, laws and an independent implementation."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from spectral import GaussianStats, ace
from spectral import matched_filter as spy_matched_filter
from torch.testing import assert_close

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.maps.targets import LOADING, Background, adaptive_coherence, matched_filter

# Mean (0.4, 0.3), sample covariance diag(0.02, 0.08) / 3.
FOUR = torch.tensor([[0.5, 0.3], [0.3, 0.3], [0.4, 0.5], [0.4, 0.1]], dtype=torch.float64)


def pixels(count=300, bands=5, seed=0):
    g = np.random.default_rng(seed)
    return torch.tensor(
        g.uniform(0, 1, (count, 3)) @ g.uniform(0, 0.3, (3, bands)) + g.normal(0, 0.02, (count, bands))
    )


SAMPLE = Background.fit(pixels())


def loaded_covariance(background):
    covariance = np.cov(background.numpy().T)
    return covariance + LOADING * np.trace(covariance) / len(covariance) * np.eye(len(covariance))


def test_the_matched_filter_of_two_bands_is_the_closed_form():
    target, pixel = torch.tensor([0.8, 0.3]).double(), torch.tensor([[0.5, 0.9], [0.0, 0.0]]).double()
    # With a diagonal covariance and a target that differs in the first band only, that band alone counts.
    assert_close(matched_filter(pixel, target, Background.fit(FOUR)), torch.tensor([0.25, -1.0]).double())


def test_adaptive_coherence_of_two_bands_is_the_closed_form():
    target, pixel = torch.tensor([0.8, 0.3]).double(), torch.tensor([[0.5, 0.5]]).double()
    first, second = 0.02 / 3 + LOADING * 0.05 / 3, 0.08 / 3 + LOADING * 0.05 / 3
    expected = (0.01 / first) / (0.01 / first + 0.04 / second)
    assert_close(adaptive_coherence(pixel, target, Background.fit(FOUR)), torch.tensor([expected]).double())


def test_the_matched_filter_is_one_at_the_target_zero_at_the_mean_and_linear_between():
    target = torch.linspace(0.2, 0.9, 5).double()
    background = Background.fit(pixels())
    shares = torch.tensor([0.0, 0.25, 1.0, 2.0]).double()
    mixed = background.mean + shares[:, None] * (target - background.mean)
    assert_close(matched_filter(mixed, target, background), shares)


@given(st.floats(0.01, 100.0))
def test_adaptive_coherence_ignores_how_far_a_pixel_lies_from_the_mean(gain):
    background, target = SAMPLE, torch.linspace(0.2, 0.9, 5).double()
    offsets = pixels(seed=1) - background.mean
    near, far = (adaptive_coherence(background.mean + k * offsets, target, background) for k in (1.0, gain))
    assert_close(near, far, atol=1e-9, rtol=0)


def test_adaptive_coherence_is_one_towards_the_target_and_zero_on_the_opposite_side():
    background, target = Background.fit(pixels()), torch.linspace(0.2, 0.9, 5).double()
    away = target - background.mean
    opposite = torch.stack([background.mean + 0.1 * away, background.mean - 0.1 * away])
    assert_close(adaptive_coherence(opposite, target, background), torch.tensor([1.0, 0.0]).double())


def test_adaptive_coherence_of_the_backgrounds_mean_is_undefined():
    background = Background.fit(FOUR)
    assert adaptive_coherence(background.mean, torch.tensor([0.8, 0.3]).double(), background).isnan()


def test_both_detectors_agree_with_spy():
    (background, seen), target = pixels(600).split(300), torch.linspace(0.2, 0.9, 5).double()
    stats = GaussianStats(background.mean(dim=0).numpy(), loaded_covariance(background))
    found = Background.fit(background)
    image = seen.reshape(20, 15, 5)
    expected = spy_matched_filter(image.numpy(), target.numpy(), background=stats)
    assert_close(matched_filter(image, target, found), torch.tensor(expected))
    unsigned = torch.tensor(ace(image.numpy(), target.numpy(), background=stats))
    is_alike = torch.tensor(expected) > 0
    assert 30 < is_alike.sum() < 270
    assert_close(adaptive_coherence(image, target, found), torch.where(is_alike, unsigned, 0.0))


def test_a_background_of_fewer_pixels_than_bands_still_gives_one_and_zero():
    target = torch.linspace(0.2, 0.9, 40).double()
    background = Background.fit(pixels(count=5, bands=40))
    scores = matched_filter(torch.stack([target, background.mean]), target, background)
    assert_close(scores, torch.tensor([1.0, 0.0]).double())


def test_empty_and_unknown_pixels_do_not_count_as_background():
    holes = torch.tensor([[0.0, 0.0], [torch.nan, 0.5], [0.2, torch.inf]]).double()
    found = Background.fit(torch.cat([holes, FOUR]))
    assert_close(found.mean, Background.fit(FOUR).mean)
    assert_close(found.whitening, Background.fit(FOUR).whitening)


@pytest.mark.parametrize(
    ("background", "message"),
    [
        (torch.zeros(0, 3), "background has 0 pixels .*2 or more needed"),
        (torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]), "background has 1 pixels"),
        (torch.tensor([[0.1, 0.2, 0.3]] * 7), "all 7 pixels of the background are equal"),
    ],
)
def test_a_background_that_tells_nothing_is_refused(background, message):
    with pytest.raises(SpectrumError, match=message):
        Background.fit(background)
