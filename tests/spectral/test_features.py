import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import lagrange
from scipy.signal import savgol_filter
from scipy.spatial import ConvexHull
from spectral import calc_stats, mnf, noise_from_diffs, remove_continuum

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.features import (
    LEAST_DEPTH,
    absorption,
    continuum,
    continuum_removed,
    derivative_matrix,
    minimum_noise_fractions,
)
from unmix_plugin.spectral.library.material_library import measured_library

KNOWN = [one for one in measured_library().materials if len(one.bands) > 60][::2][:50]
"""Fifty measured reflectances."""


@pytest.mark.parametrize("material", KNOWN, ids=lambda one: one.name)
def test_of_measured_reflectances_all_features_equal_those_of_other_programs(material):
    w, values = material.bands.centers_nm, material.reflectance
    spectrum = torch.from_numpy(values)
    removed = continuum_removed(spectrum, w).numpy()
    np.testing.assert_allclose(removed, np.asarray(remove_continuum(values, w)), atol=1e-6)
    window = np.flatnonzero((w >= 480) & (w <= 620))
    below = remove_continuum(values[window], w[window])
    lowest = 1 + int(np.argmin(below[1:-1]))
    three = slice(lowest - 1, lowest + 2)
    # Lagrange in wavelengths around the lowest, as SciPy's polynomial loses digits far from 0.
    parabola = lagrange(w[window][three] - w[window][lowest], below[three])
    offset = -parabola[1] / (2 * parabola[2]) if parabola[2] > 1e-15 else 0.0
    depth = 1 - float(parabola(offset))
    centre = w[window][lowest] + offset if depth >= LEAST_DEPTH else np.nan
    expected = {"depth": depth, "area": np.trapezoid(1 - below, w[window]), "centre": centre}
    part = spectrum[window], w[window]
    found = {what: float(absorption(*part, what)) for what in ("depth", "centre", "area")}
    assert found == pytest.approx(expected, abs=1e-6, nan_ok=True)
    for order in (1, 2):
        expected = savgol_filter(values, 5, 2, order, delta=w[1] - w[0])
        np.testing.assert_allclose(values @ derivative_matrix(w, order), np.array(expected, float), atol=1e-9)


@given(st.lists(st.floats(0.01, 1.0), min_size=3, max_size=12))
def test_the_continuum_is_the_upper_convex_hull(values):
    spectrum, wavelengths = np.array(values), np.linspace(400, 700, len(values)) ** 1.1
    scaled = (wavelengths - wavelengths[0]) / (wavelengths[-1] - wavelengths[0])
    below = np.stack([np.append(scaled, [0.0, 1.0]), np.append(spectrum, [-9.0, -9.0])], axis=1)
    equations = ConvexHull(below).equations
    upper = equations[equations[:, 1] > 1e-9]
    expected = np.min([(-offset - a * scaled) / b for a, b, offset in upper], axis=0)
    np.testing.assert_allclose(continuum(torch.from_numpy(spectrum), wavelengths), expected, rtol=1e-6)


def test_many_spectra_at_once_are_each_on_its_own_and_undefined_ones_stay_so():
    w = np.linspace(400, 700, 31)
    spectra = torch.rand(4, 5, 31, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    spectra[1, 2, 7], spectra[3, 0] = torch.nan, 0.0
    together = continuum_removed(spectra, w)
    alone = torch.stack([continuum_removed(row, w) for row in spectra.flatten(0, 1)]).view_as(together)
    torch.testing.assert_close(together, alone, equal_nan=True, rtol=0, atol=0)
    assert together.isnan().all(dim=-1).nonzero().tolist() == [[1, 2], [3, 0]]
    assert absorption(spectra, w, "depth").isnan().sum() == 2


def test_an_absorption_is_found_at_its_place_on_any_slope_and_at_any_brightness():
    w = np.concatenate([np.arange(2100.0, 2200, 7), np.arange(2203.0, 2300, 9)])
    dip = 1 - 0.3 * np.exp(-(((w - 2208) / 30) ** 2))

    def measured(values):
        return [float(absorption(torch.from_numpy(values), w, what)) for what in ("depth", "centre", "area")]

    for slope in (np.ones(len(w)), (w - 1900) / 600):
        depth, centre, area = measured(slope * dip)
        assert (depth, centre) == (pytest.approx(0.3, abs=0.003), pytest.approx(2208, abs=0.5))
        assert area == pytest.approx(0.3 * 30 * np.pi**0.5, rel=0.02)
    depth, centre, _ = measured((w - 1900) / 600)
    assert depth == pytest.approx(0, abs=1e-12)
    assert np.isnan(centre)


def test_a_spectrum_that_begins_and_ends_at_0_has_absorptions_all_the_same():
    w = np.array([400.0, 450, 500, 550, 600])
    for end in (0.0, -0.001):
        spectrum = torch.tensor([end, 0.5, 0.2, 0.5, end], dtype=torch.float64)
        assert continuum_removed(spectrum, w).tolist() == pytest.approx([1, 1, 0.4, 1, 1])
        assert float(absorption(spectrum, w, "depth")) == pytest.approx(0.6)
        assert float(absorption(spectrum, w, "area")) == pytest.approx(0.6 * 50)
        assert continuum_removed(spectrum.clamp(max=0), w).isnan().all()


def test_derivatives_allow_for_uneven_steps_and_refuse_too_few_bands():
    w = np.array([400.0, 410, 425, 470, 480, 500, 580])
    parabola = 3e-5 * (w - 450) ** 2 + 0.1
    np.testing.assert_allclose(parabola @ derivative_matrix(w), 6e-5 * (w - 450), atol=1e-12)
    np.testing.assert_allclose(parabola @ derivative_matrix(w, 2), 6e-5, atol=1e-12)
    with pytest.raises(SpectrumError, match="a derivative takes 5 bands or more; found 4"):
        derivative_matrix(w[:4])


def noisy_image():
    generator = np.random.default_rng(0)
    rows, columns = np.mgrid[:30, :40] / 40
    smooth = np.stack([rows, columns, np.sin(5 * rows)], axis=-1) @ generator.uniform(0, 1, (3, 8))
    return smooth + generator.normal(0, np.linspace(0.01, 0.1, 8), smooth.shape)


def test_minimum_noise_fractions_are_those_of_spectral_python():
    image = noisy_image()
    mask = torch.ones(30, 40, dtype=torch.bool)
    found = minimum_noise_fractions(torch.from_numpy(image), mask, 8)
    assert (found.signal_to_noise.diff() <= 0).all()
    steps = (image[:, 1:] - image[:, :-1]).reshape(-1, 8)
    noise = noise_from_diffs(image, "right")
    noise.cov = np.cov(steps.T) / 2
    noise._sqrt_inv_cov = None
    other = mnf(calc_stats(image), noise)
    np.testing.assert_allclose(found.signal_to_noise, other.napc.eigenvalues - 1, rtol=1e-6)
    ours, theirs = found.components.numpy(), other.reduce(image, num=8)
    along = [np.corrcoef(ours[..., axis].ravel(), theirs[..., axis].ravel())[0, 1] for axis in range(3)]
    np.testing.assert_allclose(np.abs(along), 1, atol=1e-6)
    np.testing.assert_allclose(np.var(np.diff(ours, axis=1), axis=(0, 1)) / 2, 1, rtol=0.02)


def test_the_minimum_noise_fraction_of_one_band_is_the_band_in_units_of_its_noise():
    band = noisy_image()[..., :1]
    found = minimum_noise_fractions(torch.from_numpy(band), torch.ones(30, 40, dtype=torch.bool), 1)
    noise = np.diff(band, axis=1).std(ddof=1) / 2**0.5
    np.testing.assert_allclose(found.components.abs(), np.abs(band - band.mean()) / noise)


def test_minimum_noise_fractions_refuse_bands_without_noise_of_their_own():
    image = torch.from_numpy(noisy_image())
    mask = torch.ones(30, 40, dtype=torch.bool)
    repeated = torch.cat([image, image[..., :1]], dim=-1)
    with pytest.raises(SpectrumError, match="some bands have no noise of their own"):
        minimum_noise_fractions(repeated, mask, 3)
    mask[:, ::2] = False
    with pytest.raises(SpectrumError, match="takes more pairs of neighbours; found 0"):
        minimum_noise_fractions(image, mask, 3)
