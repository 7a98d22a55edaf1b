import numpy as np
import pytest
import torch

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.subspace import PcaColours, find_subspace


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
    torch.testing.assert_close(PcaColours.fit(values.flip(0)).axes, PcaColours.fit(values).axes)


def test_too_few_spectra_and_too_few_bands_give_black_where_there_is_nothing_to_tell():
    values, _ = spectra()
    assert not PcaColours.fit(values[:3])(values).any()
    colours = PcaColours.fit(values[:, :2])(values[:, :2])
    assert (colours[:, :2].max(), colours[:, 2].max()) == (1, 0)


BANDS = 60


def mixtures(count: int, num_materials: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    nm = torch.linspace(0, 1, BANDS)
    centres = (torch.arange(num_materials) + 0.5) / num_materials
    materials = 0.2 + 0.6 * torch.exp(-(((nm - centres[:, None]) / 0.2) ** 2))
    shares = torch.rand(count, num_materials, generator=generator)
    return shares / shares.sum(dim=1, keepdim=True) @ materials


def test_mixtures_of_four_spectra_are_four_numbers():
    pixels = mixtures(2000, 4)
    subspace = find_subspace(pixels)
    assert len(subspace) <= 4
    components = subspace.components(pixels)
    assert (subspace.residuals(pixels, components) < 1.5).all()
    exact = find_subspace(pixels, 4)
    torch.testing.assert_close(exact.spectra(exact.components(pixels)), pixels, atol=1e-5, rtol=0)
    assert torch.equal(exact.components(torch.zeros(1, BANDS)), torch.zeros(1, 4))


def test_noise_of_one_band_is_not_taken_for_a_spectrum():
    generator = torch.Generator().manual_seed(1)
    sigmas = torch.full((BANDS,), 0.01)
    sigmas[20:25] = 0.1
    clean = mixtures(4000, 3)
    pixels = clean + sigmas * torch.randn(clean.shape, generator=generator)
    subspace = find_subspace(pixels)
    assert len(subspace) <= 4
    assert subspace.weights[20:25].tolist() == pytest.approx([float(subspace.noise) / 0.1] * 5, rel=0.1)
    assert subspace.noise == pytest.approx(0.01, rel=0.1)
    residuals = subspace.residuals(pixels, subspace.components(pixels))
    assert float(residuals.square().mean().sqrt()) == pytest.approx(1.0, abs=0.05)
    found = subspace.spectra(subspace.components(pixels))
    assert float((found - clean).square().mean()) < 0.2 * float((pixels - clean).square().mean())


def test_errors_within_the_subspace_differ_from_those_in_all_bands_by_a_constant():
    generator = torch.Generator().manual_seed(2)
    pixels = mixtures(1000, 5) + 0.02 * torch.randn(1000, BANDS, generator=generator)
    subspace = find_subspace(pixels)
    target = subspace.components(pixels)
    constants = []
    for seed in (3, 4):
        rendered = subspace.spectra(subspace.components(mixtures(1000, 5, seed)))
        everywhere = ((rendered - pixels) * subspace.weights).square().sum()
        within = (subspace.components(rendered) - target).square().sum()
        constants.append(float(everywhere - within))
    assert constants[0] == pytest.approx(constants[1], rel=1e-3)
    assert constants[0] > 1


@pytest.mark.parametrize(("pixels", "components"), [(BANDS, None), (100, BANDS + 1), (100, 0)])
def test_too_few_pixels_and_too_many_components_are_refused(pixels, components):
    with pytest.raises(SpectrumError, match=f"found {pixels} pixels of {BANDS} bands"):
        find_subspace(mixtures(pixels, 3), components)
