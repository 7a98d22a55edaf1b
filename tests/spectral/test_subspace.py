"""Few components hold all of spectra but noise, and errors within them are those of all bands."""

import pytest
import torch

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.subspace import find_subspace

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
    torch.testing.assert_close(
        subspace.weights[20:25], torch.full((5,), float(subspace.noise) / 0.1), rtol=0.1, atol=0
    )
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
