import inspect
from typing import Any

import numpy as np
import pytest
import spectral.io.envi as envi
import torch

from tests.factories.mixtures import mixed_pixels, seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.spectral.unmixing.image import unmix_image


def image_of(materials, size=40, seed=0, noise=0.002):
    """Left half pure, right half mixtures, all shaded; a shadow without light in a corner."""
    num = size * size
    pure = materials[torch.arange(num // 2) % len(materials)]
    pixels = torch.cat([pure, mixed_pixels(materials, num - num // 2, seed=seed)])
    pixels = pixels * (0.3 + 0.7 * torch.rand(num, 1, dtype=torch.float64, generator=seeded(seed)))
    pixels = pixels + noise * torch.randn(pixels.shape, dtype=torch.float64, generator=seeded(seed + 1))
    pixels[0] = 0
    return pixels.clamp(min=0).numpy().reshape(size, size, -1)


def test_materials_and_their_shares_are_found_in_whole_numbers_of_any_unit():
    materials = smooth_endmembers(3)
    cube = image_of(materials)
    found = unmix_image((cube * 4000).astype(np.uint16), 3)
    angles = spectral_angle(materials[:, None].float(), torch.from_numpy(found.endmembers)[None])
    assert float(angles.amin(1).max()) < 0.03
    assert found.endmembers.max() > 400  # in the image's unit
    shares = found.abundances.reshape(-1, 3)
    assert shares.min() >= 0
    assert np.allclose(shares[1:].sum(axis=1), 1, atol=1e-5)
    assert not shares[0].any()
    assert found.confidence[0, 0] == 0
    pure = shares[1:800].argmax(axis=1)
    assert (pure == angles.argmin(1).numpy()[np.arange(1, 800) % 3]).all()
    assert found.misfit.max() < 0.2


@pytest.mark.usefixtures("few_searches")
@pytest.mark.parametrize("endmembers", [3, "auto"])
def test_in_few_bands_there_may_be_as_many_materials_as_bands(endmembers):
    """No band follows from the others then, so that noise is unknown."""
    materials = torch.tensor([[0.8, 0.1, 0.1], [0.1, 0.7, 0.2], [0.1, 0.2, 0.9]], dtype=torch.float64)
    found = inspect.unwrap(unmix_image)(image_of(materials), endmembers, seed=np.int64(1))
    angles = spectral_angle(materials[:, None].float(), torch.from_numpy(found.endmembers)[None])
    assert angles.shape == (3, 3)
    assert float(angles.amin(1).max()) < 0.03
    assert not {"HySime:", "noise,"} & {*found.evidence.split()}


def test_the_misfit_of_an_exact_mixture_is_0():
    shade = torch.rand(20, 20, 1, generator=seeded()) + 0.2
    assert unmix_image((shade * smooth_endmembers(1)[0].float()).numpy(), 1).misfit.max() < 1e-5


@pytest.mark.usefixtures("few_searches")
def test_an_image_that_spy_loaded_is_unmixed_as_the_array_of_its_numbers(tmp_path):
    cube = image_of(smooth_endmembers(3)).astype(np.float32)
    envi.save_image(str(tmp_path / "a.hdr"), cube)
    opened: Any = envi.open(str(tmp_path / "a.hdr"))
    found, expected = (unmix_image(image, 3) for image in (opened.load(), cube))
    np.testing.assert_array_equal(found.abundances, expected.abundances)
    np.testing.assert_array_equal(found.endmembers, expected.endmembers)


@pytest.mark.usefixtures("few_searches")
def test_confidence_is_high_where_a_pixel_is_pure_and_low_at_a_tie():
    materials = smooth_endmembers(2)
    share = torch.cat([torch.ones(700), torch.zeros(700), 0.5 * torch.ones(200)])[:, None].double()
    noise = 0.002 * torch.randn(1600, materials.shape[1], dtype=torch.float64, generator=seeded())
    cube = (share * materials[0] + (1 - share) * materials[1] + noise).clamp(min=0).reshape(40, 40, -1)
    found = unmix_image(cube.numpy(), 2, shares="light").confidence.ravel()
    assert found[:1400].min() > 0.9
    assert found.max() < 0.96  # what all searches get wrong, their agreement doesn't show
    assert np.median(found[1400:]) < 0.6


@pytest.mark.usefixtures("few_searches")
def test_shares_of_area_and_of_light_differ_by_the_brightness_of_materials():
    bright, dark = smooth_endmembers(2)
    share = torch.linspace(0, 1, 1600, dtype=torch.float64)[:, None]
    cube = (share * bright + (1 - share) * 0.1 * dark).reshape(40, 40, -1).numpy()
    area, light, auto = (unmix_image(cube, 2, shares=shares) for shares in ("area", "light", "auto"))
    assert auto.shares == "light"
    np.testing.assert_array_equal(auto.abundances, light.abundances)
    # Where each covers half, nearly all light comes from the bright one.
    own, shone = (found.abundances.reshape(-1, 2)[800] for found in (area, light))
    assert abs(own[0] - 0.5) < 0.2  # how bright a material is, mixed pixels tell too
    assert shone.max() > own.max() + 0.2


@pytest.mark.usefixtures("few_searches")
def test_pixels_outside_of_the_mask_take_no_part():
    cube = image_of(smooth_endmembers(3))
    mask = np.ones((40, 40), bool)
    mask[:5] = False
    spoilt = cube.copy()
    spoilt[:5] = np.nan
    found = unmix_image(spoilt, 3, mask=mask)
    assert not found.abundances[:5].any()
    np.testing.assert_array_equal(found.abundances[5:], unmix_image(cube, 3, mask=mask).abundances[5:])


@pytest.mark.usefixtures("few_searches")
def test_what_an_array_masks_takes_no_part_though_its_numbers_are_finite():
    stored = np.round(image_of(smooth_endmembers(3)) * 10_000).astype(np.uint16)
    hole = np.zeros((40, 40), bool)
    hole[:5] = True
    stored[hole] = 65535  # no measurement, as a file marks it
    some_bands = hole[..., None] & (np.arange(stored.shape[2]) < 2)
    found = unmix_image(np.ma.masked_array(stored, some_bands), 3)
    expected = unmix_image(stored, 3, mask=~hole)
    assert not found.abundances[hole].any()
    np.testing.assert_array_equal(found.abundances, expected.abundances)
    np.testing.assert_array_equal(found.endmembers, expected.endmembers)
    left = np.zeros((40, 40), bool)
    left[3:10] = True
    both = unmix_image(np.ma.masked_array(stored, some_bands), 3, mask=left)
    assert ((both.abundances.sum(axis=2) > 0) <= (left & ~hole)).all()


CUBE = image_of(smooth_endmembers(3))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"cube": CUBE.tolist()}, "is a NumPy array; found list"),
        ({"cube": torch.ones(4, 4, 3)}, "is a NumPy array; found Tensor"),
        ({"shares": "areas"}, "shares must be auto, area, light; found 'areas'"),
        ({"endmembers": "3"}, "endmembers must be a whole number or 'auto'; found '3'"),
        ({"endmembers": 3.0}, "endmembers must be a whole number or 'auto'; found 3.0"),
        ({"cube": CUBE[:, :, 0]}, "rows, columns and bands"),
        ({"cube": CUBE + 1j}, "real numbers; found complex128"),
        ({"cube": -CUBE}, "the image is black"),
        ({"cube": np.where(CUBE.max() * 0.9 < CUBE, np.nan, CUBE)}, "hold NaN or infinite values; leave"),
        ({"cube": np.full_like(CUBE, 0.3)}, "only 1 distinct pixels .* ask for at most 1"),
        ({"cube": CUBE[:, :, :2]}, "between 1 and the number of bands, 2; found 3"),
        ({"seed": 1.5}, "seed must be a whole number .* found 1.5"),
        ({"seed": 2**63}, "seed must be a whole number"),
        ({"endmembers": 0}, "between 1 and the number of bands"),
        ({"endmembers": 12}, "at most [3-5] materials can be told apart; 12 were asked for"),
        ({"mask": np.ones((3, 3), bool)}, "mask must be 40 x 40"),
        ({"mask": np.zeros((40, 40), bool)}, "leaves no pixel"),
        ({"cube": np.ma.masked_array(CUBE, True)}, "leaves no pixel"),
    ],
)
def test_what_cannot_be_unmixed_is_refused_with_one_message(words, message):
    plain = inspect.unwrap(unmix_image)  # types may be checked before, as tests are run
    with pytest.raises(SpectrumError, match=message):
        plain(**{"cube": CUBE, "endmembers": 3, **words})


@pytest.mark.usefixtures("few_searches")
def test_one_material_is_unmixed_and_a_number_proposed_with_its_evidence():
    cube = np.full((6, 6, 5), 0.4, np.float32) * np.linspace(0.2, 1, 5, dtype=np.float32)
    found = unmix_image(cube, 1)
    assert np.allclose(found.abundances, 1)
    assert np.allclose(found.confidence, 0.952, atol=1e-3)  # what all searches get wrong alike is left
    assert len(unmix_image(cube, "auto").endmembers) == 1
    four = unmix_image(image_of(smooth_endmembers(4)))
    assert len(four.endmembers) == 4
    assert "proposed" in four.evidence


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


def error_of(pixels, materials, true_materials, seed=0):
    """Root mean square error of abundances, those in the order of the materials, and the largest angle to these."""
    found = unmix_image(pixels[None].numpy(), 3, seed=seed)
    angles = spectral_angle(materials[:, None].double(), torch.from_numpy(found.endmembers)[None].double())
    order = angles.argmin(dim=1)
    assert sorted(order.tolist()) == [0, 1, 2]
    truth = torch.linalg.lstsq(true_materials.T, pixels.double().T).solution.T.clamp(min=0)
    truth = truth / truth.sum(dim=1, keepdim=True)
    abundances = torch.from_numpy(found.abundances[0])[:, order].double()
    return float((abundances - truth).square().mean().sqrt()), abundances, float(angles.amin(dim=1).max())


@pytest.mark.slow
def test_abundances_of_shaded_mixtures_are_found_whatever_the_seed():
    pixels, materials = landscape(dark=0.6)
    found = [error_of(pixels, materials, materials, seed) for seed in range(2)]
    errors, abundances, angles = zip(*found, strict=True)
    assert max(errors) < 0.08
    assert max(angles) < 0.06
    assert float((abundances[0] - abundances[1]).square().mean().sqrt()) < 0.02


@pytest.mark.usefixtures("few_searches")
def test_a_nearly_black_material_is_counted_between_spectra_of_one_peak():
    pixels, materials = landscape(dark=0.05)
    assert error_of(pixels, materials, materials / materials.amax(dim=1, keepdim=True))[0] < 0.06


@pytest.mark.usefixtures("few_searches")
def test_intervals_of_a_noisy_image_are_wider_and_both_hold_most_true_shares():
    materials, widths = smooth_endmembers(3), []
    for noise in (0.002, 0.03):
        found = inspect.unwrap(unmix_image)(image_of(materials, noise=noise), 3)
        interval = found.interval()
        assert np.isnan(interval.low[0, 0]).all()  # it is black
        widths.append(float(np.nanmedian(interval.width)))
        seen = found.abundances.sum(axis=-1) > 0
        assert ((interval.low <= found.abundances) & (found.abundances <= interval.high))[seen].all()
        assert (interval.width <= found.interval(0.99).width)[seen].all()
        angles = spectral_angle(materials[:, None].float(), torch.from_numpy(found.endmembers)[None])
        own = angles.argmin(dim=1).numpy()[np.arange(1, 800) % 3]  # the first half is pure
        high = interval.high.reshape(-1, 3)[1:800]
        assert (high[np.arange(799), own] > 0.99).mean() > 0.86
    assert widths[0] < 0.1
    assert widths[1] > 1.5 * widths[0]


@pytest.mark.usefixtures("few_searches")
def test_of_one_material_no_interval_is_given():
    shade = torch.rand(20, 20, 1, generator=seeded()) + 0.2
    interval = inspect.unwrap(unmix_image)((shade * smooth_endmembers(1)[0].float()).numpy(), 1).interval()
    assert "one material" in interval.not_determined
    assert np.isnan(interval.width).all()
