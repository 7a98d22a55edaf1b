"""Spectra on all bands from sensors that see some of them."""

import torch
from torch.testing import assert_close

from unmix_plugin.spectral.unmixing.endmembers import distinct_spectra, fill_bands, typical_spectrum

TYPICAL = torch.tensor([0.1, 0.2, 0.4, 0.3, 0.2, 0.1])


def test_bands_that_were_seen_stay_and_others_follow_the_typical_spectrum():
    brightness = torch.tensor([[0.5], [2.0]])
    matrix = torch.eye(6)[[3, 1, 2]]
    filled = fill_bands((brightness * TYPICAL) @ matrix.T, matrix, TYPICAL)
    assert_close(filled, brightness * TYPICAL, rtol=2e-2, atol=1e-3)


def test_a_spectrum_of_another_shape_is_kept_where_it_was_seen():
    matrix = torch.eye(6)[:4]
    seen = torch.tensor([[0.4, 0.3, 0.2, 0.1]])
    filled = fill_bands(seen, matrix, TYPICAL)
    assert_close(filled[:, :4], seen, rtol=0.1, atol=0.02)
    ratios = filled / TYPICAL
    assert_close(ratios[:, 4:], ratios[:, 3:4].expand(-1, 2), rtol=1e-3, atol=1e-3)


def test_broad_channels_are_seen_again_as_they_were():
    matrix = torch.tensor([[0.5, 0.5, 0, 0, 0, 0], [0, 0, 0.5, 0.5, 0, 0], [0, 0, 0, 0, 0.5, 0.5]])
    seen = torch.tensor([[0.2, 0.3, 0.4]])
    assert_close(fill_bands(seen, matrix, TYPICAL) @ matrix.T, seen, rtol=0.03, atol=5e-3)


def test_a_typical_spectrum_agrees_with_all_sensors():
    first, second = torch.eye(6)[:3], torch.eye(6)[2:]
    found = typical_spectrum([TYPICAL[:3], TYPICAL[2:]], [first, second])
    assert_close(found, TYPICAL, rtol=0.02, atol=2e-3)
    assert (typical_spectrum([torch.zeros(3)], [first]) > 0).all()


def test_distinct_spectra_are_independent_and_in_range():
    spectra = distinct_spectra(TYPICAL, 6)
    assert int(torch.linalg.matrix_rank(spectra, rtol=1e-3)) == 6
    assert (spectra > 0).all()
    assert (spectra < 1).all()
    assert_close(spectra.mean(dim=0) / TYPICAL, torch.ones(6), rtol=0.3, atol=0)
