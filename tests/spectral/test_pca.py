"""Principal components as colours."""

import numpy as np
import torch

from unmix_plugin.spectral.subspace import PcaColours


def spectra(count=400, bands=6):
    g = np.random.default_rng(0)
    scales = np.array([3.0, 1.0, 0.3, 0.01, 0.01, 0.01])[:bands]
    axes = np.linalg.qr(g.normal(size=(bands, bands)))[0]
    return torch.tensor(g.normal(size=(count, bands)) * scales @ axes.T + 0.5), torch.tensor(axes)


def test_colours_are_the_directions_of_largest_variance_in_their_order():
    values, axes = spectra()
    found = PcaColours.fit(values)
    overlap = (found.axes.T @ axes[:, :3]).abs()
    assert (overlap.diagonal() > 0.99).all()
    torch.testing.assert_close(found.axes.T @ found.axes, torch.eye(3).double())


def test_all_but_two_percent_of_each_component_lie_between_black_and_full():
    values, _ = spectra()
    colours = PcaColours.fit(values)(values)
    assert colours.min() == 0
    assert colours.max() == 1
    inside = ((colours > 0) & (colours < 1)).double().mean(dim=0)
    torch.testing.assert_close(inside, torch.full((3,), 0.98).double(), atol=0.006, rtol=0)


def test_the_map_of_one_picture_gives_a_spectrum_the_same_colour_in_any_other():
    values, _ = spectra()
    found = PcaColours.fit(values)
    torch.testing.assert_close(found(values[:12].reshape(3, 4, 6)).reshape(12, 3), found(values)[:12])


def test_signs_do_not_depend_on_the_order_of_the_spectra():
    values, _ = spectra()
    torch.testing.assert_close(PcaColours.fit(values.flip(0)).axes, PcaColours.fit(values).axes)


def test_too_few_spectra_and_too_few_bands_give_black_where_there_is_nothing_to_tell():
    values, _ = spectra()
    assert not PcaColours.fit(values[:3])(values).any()
    colours = PcaColours.fit(values[:, :2])(values[:, :2])
    assert colours.shape == (400, 3)
    assert colours[:, :2].max() == 1
    assert not colours[:, 2].any()
