import pytest
import torch

from unmix_plugin.spectral.bad_values import REACH_PX, BandNoise, deviation_limits, judge_bands, repaired

SIDE, NUM_BANDS = 24, 16


def image() -> torch.Tensor:
    """Two materials that meet at an edge, one with a step in its spectrum, and a thin line; with noise."""
    generator = torch.Generator().manual_seed(0)
    x = torch.linspace(0, 1, NUM_BANDS)
    flat, step = 0.3 + 0.1 * x, torch.where(x > 0.5, 0.5, 0.1)
    seen = flat.expand(SIDE, SIDE, -1).clone()
    seen[:, :8] = step
    seen[:, 15] = step
    return seen + 0.003 * torch.randn(seen.shape, generator=generator)


def mend(seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Which values are bad, and the image without them."""
    places, values = repaired(seen, deviation_limits(seen.flatten(0, 1)))
    is_bad, mended = torch.zeros_like(seen, dtype=torch.bool), seen.clone()
    is_bad[places] = True
    mended[places] = values
    return is_bad, mended


def test_nothing_is_bad_in_a_sound_image_nor_a_feature_that_the_pixels_around_share():
    seen = image()
    assert not mend(seen)[0].any()
    seen[10:14, 18:22, 9] += 0.5
    assert not mend(seen)[0].any()


SPIKES = torch.tensor([[3, 4, 5], [12, 20, 0], [0, 0, 15], [20, 12, 1], [9, 15, 4]])
STRIPE = torch.tensor([[row, 11, 6] for row in range(SIDE)])


@pytest.mark.parametrize(("places", "factor", "added"), [(SPIKES, 1.0, 0.5), (STRIPE, 0.2, 0.0)])
def test_spikes_and_stripes_are_replaced_by_what_is_around_them_and_a_real_line_is_not(places, factor, added):
    sound = image()
    seen = sound.clone()
    seen[places.unbind(dim=1)] *= factor
    seen[places.unbind(dim=1)] += added
    is_bad, mended = mend(seen)
    assert is_bad.nonzero().tolist() == sorted(places.tolist())
    assert float((mended - sound).abs().max()) < 0.05


def test_parts_of_an_image_have_the_bad_values_of_the_whole():
    seen = image()
    seen[[0, 7, 8, 9, 23], [3, 4, 4, 20, 0], [5, 5, 9, 0, 15]] += 0.5
    seen[:, 11, 6] *= 0.2
    limits = deviation_limits(seen.flatten(0, 1))
    whole = repaired(seen, limits)
    parts = []
    for first in range(0, SIDE, 8):
        above, below = max(first - REACH_PX, 0), min(first + 8 + REACH_PX, SIDE)
        (rows, *others), values = repaired(seen[above:below], limits, range(first - above, first + 8 - above))
        parts.append((rows + above, *others, values))
    assert len(whole[1]) == SIDE + 5
    for found, expected in zip(zip(*parts, strict=True), (*whole[0], whole[1]), strict=True):
        assert torch.equal(torch.cat(found), expected)


NOISY_BANDS, NUM_PIXELS = 20, 4000


def mixtures(noise: float = 0.005) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    x = torch.linspace(0, 1, NOISY_BANDS)
    materials = torch.stack([0.2 + 0.6 * x, 0.7 - 0.5 * x, 0.5 + 0.3 * torch.sin(6 * x)])
    shares = torch.rand(NUM_PIXELS, 3, generator=generator)
    clean = 0.7 * shares / shares.sum(dim=1, keepdim=True) @ materials
    return clean + noise * torch.randn(clean.shape, generator=generator)


def noisier(band: int, noise: float) -> torch.Tensor:
    pixels = mixtures()
    pixels[:, band] += noise * torch.randn(NUM_PIXELS, generator=torch.Generator().manual_seed(1))
    return pixels


def test_even_noise_and_spikes_leave_all_weights_exactly_1():
    spiked = mixtures()
    spiked[::50, 4] += 0.5
    for pixels in (mixtures(0.0), mixtures(), mixtures(0.05), spiked):
        found = judge_bands(pixels)
        assert torch.equal(found.weights, torch.ones(NOISY_BANDS))
        assert not (found.mostly_noise | found.dead).any()


def test_noise_is_measured_and_weighs_a_band_down_by_its_variance():
    weak, strong = judge_bands(noisier(7, 0.05)), judge_bands(noisier(7, 0.1))
    assert float(weak.sigmas[7]) == pytest.approx(0.05, rel=0.1)
    assert float(weak.weights.mean()) == pytest.approx(1, abs=1e-5)
    assert int(weak.weights.argmin()) == 7
    assert len(weak.weights.unique()) == 2
    ratio = [float(found.weights[7] / found.weights[0]) for found in (weak, strong)]
    assert ratio[0] / ratio[1] == pytest.approx(4, rel=0.1)


def test_a_band_of_noise_alone_and_a_dead_one_are_named():
    pixels = mixtures()
    pixels[:, 3] = 0.2 + 0.1 * torch.randn(NUM_PIXELS, generator=torch.Generator().manual_seed(1))
    pixels[:, 12] = 0.4
    found = judge_bands(pixels)
    assert found.mostly_noise.nonzero().flatten().tolist() == [3]
    assert found.dead.nonzero().flatten().tolist() == [12]
    assert float(found.weights[12] / found.weights[0]) == pytest.approx(1e-4, rel=1e-3)


def test_too_little_data_and_a_scene_of_dead_bands_tell_nothing():
    for pixels in (mixtures()[:, :3], mixtures()[:50], torch.full((500, NOISY_BANDS), 0.3)):
        found = judge_bands(pixels)
        assert torch.equal(found.weights, BandNoise.unknown(pixels.shape[1]).weights)
    assert found.dead.all()
