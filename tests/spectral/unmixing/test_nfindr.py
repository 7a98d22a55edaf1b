from itertools import combinations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.spectral.mixtures import mixed_pixels, seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.nfindr_winter1999 import nfindr, simplex_volume


def volume_in_plane(points):
    """Volume from the Gram determinant of the edges: needs no reduced coordinates."""
    edges = points[1:] - points[0]
    factorial = torch.arange(1, len(edges) + 1, dtype=torch.float64).prod()
    return torch.linalg.det(edges @ edges.T).clamp(min=0).sqrt() / factorial


@given(st.integers(2, 7), st.integers(0, 1000))
def test_pure_pixels_of_mixtures_are_found_exactly(num_endmembers, seed):
    endmembers = smooth_endmembers(num_endmembers)
    pixels = mixed_pixels(endmembers, 400, seed=seed)
    places = torch.arange(num_endmembers) * 43 + 5
    pixels[places] = endmembers
    assert sorted(nfindr(pixels, num_endmembers, seeded(seed)).tolist()) == places.tolist()


@given(st.integers(0, 200))
def test_on_a_plane_no_single_swap_enlarges_the_simplex(seed):
    points = torch.randn(30, 2, dtype=torch.float64, generator=seeded(seed))
    pixels = torch.cat([points, torch.ones(30, 1, dtype=torch.float64)], dim=1) + 5
    chosen = nfindr(pixels, 3, seeded(seed)).tolist()
    largest = volume_in_plane(pixels[chosen])
    assert len(set(chosen)) == 3
    for corner in range(3):
        for other in range(30):
            swapped = [*chosen[:corner], other, *chosen[corner + 1 :]]
            assert volume_in_plane(pixels[swapped]) <= largest * (1 + 1e-6)


def test_the_largest_triangle_of_few_points_is_found_by_brute_force_too():
    points = torch.rand(25, 2, dtype=torch.float64, generator=seeded(12))
    pixels = torch.cat([points, torch.ones(25, 1, dtype=torch.float64)], dim=1)
    best = max(combinations(range(25), 3), key=lambda ids: float(volume_in_plane(pixels[list(ids)])))
    assert any(sorted(nfindr(pixels, 3, seeded(seed)).tolist()) == list(best) for seed in range(5))


def test_more_sweeps_never_give_a_smaller_simplex():
    pixels = mixed_pixels(smooth_endmembers(5), 3000, seed=2)
    volumes = [volume_in_plane(pixels[nfindr(pixels, 5, seeded(1), max_sweeps=n)]) for n in (0, 1, 10)]
    assert volumes[0] < volumes[1] <= volumes[2]


def test_the_same_generator_gives_the_same_pixels():
    pixels = mixed_pixels(smooth_endmembers(4), 1000, seed=5)
    assert torch.equal(nfindr(pixels, 4, seeded(3)), nfindr(pixels, 4, seeded(3)))


def test_a_flat_simplex_is_refused():
    # Rays through two corners of a plane: three independent spectra do not exist in the affine sense.
    weights = torch.rand(50, 1, dtype=torch.float64, generator=seeded())
    first, second = smooth_endmembers(2)
    with pytest.raises(SpectrumError, match=r"3 endmembers were asked for; ask for at most 2"):
        nfindr(weights * first + (1 - weights) * second, 3, seeded())


def test_pixels_on_one_ray_are_told_from_pixels_on_a_plane():
    # Three dimensions through the origin but corners on one line: VCA is content, the simplex is not.
    base = torch.tensor([0.5, 0.5, 0.5], dtype=torch.float64)
    step = torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64)
    pixels = base + torch.linspace(0, 1, 20, dtype=torch.float64)[:, None] * step
    assert sorted(nfindr(pixels, 2, seeded()).tolist()) == [0, 19]
    with pytest.raises(SpectrumError, match="at most 2"):
        nfindr(pixels, 3, seeded())


def test_volume_of_a_unit_simplex_is_one_over_the_factorial():
    for num_dimensions, volume in ((1, 1.0), (2, 1 / 2), (3, 1 / 6), (4, 1 / 24)):
        corners = torch.cat([torch.zeros(1, num_dimensions), torch.eye(num_dimensions)]).double()
        assert_close(simplex_volume(corners), torch.tensor(volume, dtype=torch.float64))
        assert_close(
            simplex_volume(3 * corners + 7), torch.tensor(volume * 3**num_dimensions, dtype=torch.float64)
        )
