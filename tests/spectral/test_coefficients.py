"""Packed coefficients return what they were made of, whatever the axes before them."""

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients

PARTS = ("accumulation", "distance", "abundances", "scaled_abundances", "specular")
counts = st.integers(0, 4)
shapes = st.lists(st.integers(1, 4), max_size=3).map(tuple)


def parts_of(shape: tuple[int, ...], num_endmembers: int, num_specular: int) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    last = ((), (), (num_endmembers,), (num_endmembers,), (num_specular,))
    return {name: torch.rand((*shape, *axis), generator=g) for name, axis in zip(PARTS, last, strict=True)}


@given(shapes, st.integers(1, 5), counts)
def test_what_is_packed_comes_back(shape, num_endmembers, num_specular):
    parts = parts_of(shape, num_endmembers, num_specular)
    packed = Coefficients.of(*parts.values())
    assert packed.packed.shape == (*shape, 2 + 2 * num_endmembers + num_specular)
    for name, expected in parts.items():
        assert torch.equal(getattr(packed, name), expected), name


def test_an_image_and_its_rays_in_rows_are_the_same():
    image = Coefficients.of(*parts_of((3, 5), 2, 1).values())
    rays = image.flatten()
    assert rays.abundances.shape == (15, 2)
    assert torch.equal(rays.unflatten(3, 5).packed, image.packed)
    halves = [rays.map(lambda packed, half=half: packed[half]) for half in (slice(0, 7), slice(7, None))]
    together = Coefficients.concatenate(halves)
    assert torch.equal(together.packed, rays.packed)
    assert together.num_endmembers == 2


def test_a_ray_of_nothing_has_no_distance_and_shows_no_material():
    parts = parts_of((3,), 2, 0)
    parts["accumulation"] = torch.tensor([0.0, OCCUPIED_ACCUMULATION, 0.8])
    parts["distance"] = torch.tensor([0.0, 1.0, 2.0])
    found = Coefficients.of(*parts.values())
    assert_close(found.ray_distance, torch.tensor([0.0, 2.0, 2.5]))
    assert found.is_occupied.tolist() == [False, False, True]
