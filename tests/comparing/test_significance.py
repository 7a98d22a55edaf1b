"""Differences between captures are as rare where nothing changed as their p says."""

import numpy as np
import pytest

from unmix_plugin.comparing.significance import (
    Moments,
    adjusted,
    difference,
    difference_of_heights,
    is_significant,
)


def views(seed: int, num_places: int = 3000, num_views: int = 16, change: float = 0.0) -> np.ndarray:
    """Values of two quantities whose noise differs from place to place; the first tenth of the places changed."""
    generator = np.random.default_rng(seed)
    spread = np.random.default_rng(99).uniform(0.5, 1.5, (num_places, 1))
    values = spread * generator.normal(size=(num_views, num_places, 2))
    values[:, : num_places // 10] += change
    values[generator.random((num_views, num_places)) < 0.3] = np.nan
    return values


@pytest.mark.parametrize("nominal", [0.05, 0.01])
def test_false_alarms_of_an_unchanged_pair_are_nominal(nominal):
    found = difference(views(0), views(1))
    rate = (found.p[np.isfinite(found.p)] <= nominal).mean()
    assert abs(rate - nominal) <= 0.01
    assert 0.85 < found.widening < 1.15


def test_false_alarms_are_as_rare_at_loud_places_as_at_quiet_ones():
    loudness = np.exp(np.random.default_rng(7).normal(size=(3000, 1)))
    found = difference(loudness * views(0), loudness * views(1))
    quiet = loudness[:, 0] < np.quantile(loudness, 0.3)
    for part in (quiet, loudness[:, 0] > np.quantile(loudness, 0.7)):
        assert 0.01 < (found.p[part] <= 0.05).mean() < 0.09


def test_an_error_that_is_the_same_in_all_views_of_a_capture_widens():
    shift = 0.6 * np.random.default_rng(5).normal(size=(1, 3000, 2))
    found = difference(views(0), views(1) + shift)
    assert found.widening > 1.5
    assert abs((found.p[np.isfinite(found.p)] <= 0.05).mean() - 0.05) <= 0.01


def test_changed_places_are_found_and_hardly_any_others():
    found = difference(views(0), views(1, change=2.5))
    sure = is_significant(found.q, 0.05)
    assert sure[:300].mean() > 0.95
    assert sure[300:].mean() < 0.01
    np.testing.assert_allclose(np.nanmean(found.mean[:300]), 2.5, atol=0.1)


def test_a_place_that_few_views_see_is_unknown():
    before, after = views(0), views(1)
    after[3:, 7] = np.nan
    found = difference(before, after)
    assert np.isnan(found.p[7])
    assert np.isnan(found.mean[7]).all()


def test_moments_leave_out_views_that_do_not_see_a_place():
    values = np.array([[[1.0]], [[np.nan]], [[3.0]], [[5.0]]])
    found = Moments.of(values)
    assert (found.mean, found.variance, found.count) == (3.0, 4.0, 3)


def test_heights_of_an_unchanged_pair_are_nominal_though_places_differ_in_noise():
    generator = np.random.default_rng(3)
    feature = generator.uniform(-1.5, 1.5, (4000, 1))
    noise = np.exp(feature[:, 0]) * generator.normal(size=4000)
    found = difference_of_heights(0.4 * noise, feature)
    for part in (feature[:, 0] < 0, feature[:, 0] >= 0):
        assert abs((found.p[part] <= 0.05).mean() - 0.05) <= 0.02
    dented = 0.4 * noise
    dented[:80] -= 8.0
    assert is_significant(difference_of_heights(dented, feature).q, 0.05)[:80].mean() > 0.9


def test_corrected_p_is_that_of_benjamini_and_hochberg():
    from scipy.stats import false_discovery_control

    p = np.random.default_rng(0).uniform(size=50) ** 2
    np.testing.assert_allclose(adjusted(p), false_discovery_control(p))
    assert np.isnan(adjusted(np.array([0.1, np.nan]))).tolist() == [False, True]


def test_what_rounding_leaves_of_a_run_beside_itself_is_no_change():
    generator = np.random.default_rng(0)
    rounding = np.where(generator.random(2000) < 0.1, 1e-7 * generator.normal(size=2000), 0.0)
    found = difference_of_heights(rounding, generator.normal(size=(2000, 1)))
    assert not is_significant(found.q, 0.05).any()
    assert (found.error > 0.001).all()
