import torch
from torch.testing import assert_close

from tests.spectral.mixtures import seeded, smooth_endmembers
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.spectral.unmixing.endmembers import comparable_brightness, unmix_pixels


def landscape(dark, seed=0):
    """Shaded mixtures of three materials, the last of them dimmed; and the materials."""
    materials = smooth_endmembers(3, 24)
    generator = seeded(seed)
    shares = torch.rand(1500, 3, dtype=torch.float64, generator=generator) ** 6 + 1e-3
    shares = shares / shares.sum(dim=1, keepdim=True)
    dimmed = materials * torch.tensor([[1.0], [0.8], [dark]], dtype=torch.float64)
    shading = 0.5 + 0.4 * torch.rand(1500, 1, dtype=torch.float64, generator=generator)
    noise = 0.001 * torch.randn(1500, 24, dtype=torch.float64, generator=generator)

    return (shading * (shares @ dimmed) + noise).clamp(min=0).float(), dimmed


def matched(found, materials):
    angles = spectral_angle(materials[:, None].double(), found[None].double())
    order = angles.argmin(dim=1)
    assert sorted(order.tolist()) == [0, 1, 2]
    return order, angles.amin(dim=1)


def test_abundances_of_shaded_mixtures_are_found_whatever_the_seed():
    pixels, materials = landscape(dark=0.6)
    truth = torch.linalg.lstsq(materials.T, pixels.double().T).solution.T.clamp(min=0)
    truth = truth / truth.sum(dim=1, keepdim=True)
    found = []
    for seed in range(2):
        endmembers, abundances = unmix_pixels(pixels, 3, seeded(seed))
        order, angles = matched(endmembers, materials)
        assert float(angles.max()) < 0.06
        assert float((abundances[:, order].double() - truth).square().mean().sqrt()) < 0.08
        found.append(abundances[:, order])
    assert float((found[0] - found[1]).square().mean().sqrt()) < 0.02


def test_a_nearly_black_material_is_counted_between_spectra_of_one_peak():
    pixels, materials = landscape(dark=0.05)
    endmembers, abundances = unmix_pixels(pixels, 3, seeded())
    order, _ = matched(endmembers, materials)
    assert_close(endmembers.amax(dim=1), endmembers.amax().expand(3))
    of_one_peak = materials / materials.amax(dim=1, keepdim=True)
    truth = torch.linalg.lstsq(of_one_peak.T, pixels.double().T).solution.T.clamp(min=0)
    truth = truth / truth.sum(dim=1, keepdim=True)
    assert float((abundances[:, order].double() - truth).square().mean().sqrt()) < 0.06


def test_brightness_stays_unless_one_endmember_is_nearly_black():
    materials = smooth_endmembers(3).float()
    moderate = materials * torch.tensor([[1.0], [0.5], [0.3]])
    assert torch.equal(comparable_brightness(moderate), moderate)
    dark = comparable_brightness(materials * torch.tensor([[1.0], [0.5], [0.1]]))
    assert_close(dark.amax(dim=1), materials[0].amax().expand(3))


def test_abundances_sum_to_one_and_black_pixels_show_nothing():
    pixels, _ = landscape(dark=0.6)
    pixels = torch.cat([pixels, torch.zeros(2, 24)])
    _, abundances = unmix_pixels(pixels, 3, seeded())
    assert_close(abundances[:-2].sum(dim=1), torch.ones(1500))
    assert not abundances[-2:].any()
