import math
from itertools import combinations, pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize
from torch.testing import assert_close

from tests.factories.mixtures import seeded, smooth_endmembers, surface_pixels, worst_angle
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.abundances import nnls
from unmix_plugin.spectral.unmixing.two_material_mixtures import (
    distances_to_pairs,
    two_material_endmembers,
    two_material_fits,
)


@settings(max_examples=15)
@given(st.integers(1, 6), st.integers(0, 100))
def test_materials_are_found_among_more_mixtures_under_any_shading(num_endmembers, seed):
    materials = smooth_endmembers(num_endmembers)
    found = two_material_endmembers(surface_pixels(materials, seed).float(), num_endmembers, seeded(seed))
    assert worst_angle(found, materials) < 0.03
    assert_close(found.norm(dim=1), torch.ones(num_endmembers))


SHADES = torch.linspace(0.1, 1, 150, dtype=torch.float64)[:, None]


@pytest.mark.parametrize(
    ("pixels", "count", "said"),
    [
        (torch.rand(100, 80, generator=seeded()), 65, "1 to 64 endmembers; 65 were asked for"),
        (torch.rand(100, 80, generator=seeded()), 0, "0 were asked for"),
        (torch.zeros(0, 4), 2, "non-zero length"),
        (torch.tensor([[0.0, 0.0], [0.1, 0.2], [0.2, 0.1]]), 2, "non-zero length; found 1 that are zero"),
        (smooth_endmembers(3).repeat(50, 1) * SHADES, 4, "only 3 distinct spectral shapes among 150 pixels"),
    ],
)
def test_numbers_out_of_range_no_or_black_pixels_and_too_few_shapes_are_refused(pixels, count, said):
    with pytest.raises(SpectrumError, match=said):
        two_material_endmembers(pixels, count, seeded())


def test_a_material_inside_the_cone_of_the_others_is_found_and_a_frequent_mixture_is_none():
    corners = smooth_endmembers(3)
    materials = torch.cat([corners, corners.mean(0, keepdim=True)])
    # Nothing but the three corners is needed to explain every pixel, if three may be mixed.
    pixels = surface_pixels(materials, noise=0.001)
    assert worst_angle(two_material_endmembers(pixels, 4, seeded()), materials) < 0.03
    blend = (0.5 * corners[0] + 0.5 * corners[1]).repeat(600, 1)
    pixels = torch.cat([surface_pixels(corners, noise=0.002), blend])
    assert worst_angle(two_material_endmembers(pixels, 3, seeded()), corners) < 0.03


@given(st.integers(0, 100))
def test_distances_are_those_of_least_squares_on_each_pair(seed):
    spectra = normalize(torch.rand(12, 6, dtype=torch.float64, generator=seeded(seed)), dim=1)
    candidates, shapes = spectra[:4], spectra[4:]
    distances = distances_to_pairs(shapes, candidates)
    for first in range(4):
        for second in range(4):
            pair = candidates[sorted({first, second})]
            expected = (shapes - nnls(shapes, pair) @ pair).norm(dim=1)
            assert_close(distances[first, second].double(), expected, atol=1e-6, rtol=0)


def test_the_search_finds_the_best_set_that_brute_force_finds():
    pixels = torch.rand(9, 5, dtype=torch.float64, generator=seeded(3))
    shapes = normalize(pixels, dim=1)
    distances = distances_to_pairs(shapes, shapes)
    threes = [list(ids) for ids in combinations(range(9), 3)]
    best = min(float(distances[ids][:, ids].flatten(0, 1).amin(0).mean()) for ids in threes)
    # Nine distinct pixels: every one is a candidate and a judge.
    assert two_material_fits(pixels, 3, seeded())[-1].mean_distance == pytest.approx(best, abs=1e-6)


def test_more_endmembers_never_explain_less():
    pixels = torch.rand(300, 8, dtype=torch.float64, generator=seeded(1))
    distances = [fit.mean_distance for fit in two_material_fits(pixels, 8, seeded())]
    assert len(distances) == 8
    assert all(after <= before + 1e-6 for before, after in pairwise(distances))
    assert 0 < distances[-1] < distances[0] < math.pi / 2
