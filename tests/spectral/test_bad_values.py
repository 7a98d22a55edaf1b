"""Stripes and spikes are found and replaced; edges, thin things and spectra with features are not."""

import torch

from unmix_plugin.spectral.bad_values import deviation_limits, repaired

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
    is_bad, values = repaired(seen, deviation_limits(seen.flatten(0, 1)))
    mended = seen.clone()
    mended[is_bad] = values
    return is_bad, mended


def test_nothing_is_bad_in_a_sound_image():
    assert not mend(image())[0].any()


def test_spikes_are_replaced_by_what_is_around_them():
    sound = image()
    places = torch.tensor([[3, 4, 5], [12, 20, 0], [0, 0, 15], [20, 12, 1], [9, 15, 4]]).unbind(dim=1)
    seen = sound.clone()
    seen[places] += 0.5
    is_bad, mended = mend(seen)
    assert is_bad.nonzero().tolist() == sorted(torch.stack(places, dim=1).tolist())
    assert float((mended - sound).abs().max()) < 0.05


def test_a_stripe_is_replaced_and_a_real_line_is_not():
    sound = image()
    seen = sound.clone()
    seen[:, 11, 6] *= 0.2
    is_bad, mended = mend(seen)
    assert is_bad[:, 11, 6].all()
    assert int(is_bad.sum()) == SIDE
    assert float((mended - sound).abs().max()) < 0.05


def test_a_feature_that_the_pixels_around_share_is_real():
    seen = image()
    seen[10:14, 18:22, 9] += 0.5
    assert not mend(seen)[0].any()
