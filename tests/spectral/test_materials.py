from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.materials import (
    OCCUPIED_ACCUMULATION,
    Coefficients,
    Materials,
    default_names,
    find_endmember,
)

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


BANDS = Bands.of([450, 500, 550, 600, 650])


def materials(endmembers: torch.Tensor, names: tuple[str, ...] = ()) -> Materials:
    return Materials(BANDS, endmembers, torch.zeros(0, 5), names=names)


def test_endmembers_are_numbered_unless_they_are_named_and_each_needs_a_name_of_its_own():
    assert materials(torch.ones(2, 5)).names == default_names(2) == ("material 1", "material 2")
    assert materials(torch.ones(2, 5), ("clay", "leaf")).names == ("clay", "leaf")
    for names in (("clay",), ("clay", "clay"), ("clay", "leaf", "soil")):
        with pytest.raises(SpectrumError, match="2 endmembers need 2 distinct names; found"):
            materials(torch.ones(2, 5), names)


def test_materials_are_called_by_their_colours_with_a_number_each_and_without_colours_by_number():
    bands = Bands.of(np.linspace(400, 700, 31))
    nm = bands.centers_nm
    red, blue = (np.exp(-(((nm - centre) / 40) ** 2)) for centre in (650, 450))
    spectra = torch.tensor(np.stack([red, np.full(31, 0.5), blue, 0.8 * red, np.full(31, 0.01)])).float()
    named = Materials(bands, spectra, torch.zeros(0, 31)).called_by_colour()
    assert named.names == ("red 1", "grey 1", "blue 1", "red 2", "black 1")
    assert_close(named.endmembers, spectra)
    infrared = Materials(Bands.of([1000.0, 1100.0, 1200.0]), spectra[:2, :3], torch.zeros(0, 3))
    assert infrared.called_by_colour().names == ("material 1", "material 2")


def test_an_endmember_is_found_by_its_name_its_number_and_the_name_of_earlier_releases():
    names = ("tan 1", "3", "endmember_0", "green 1")
    assert [find_endmember(asked, names) for asked in ("tan 1", "0", "endmember_1", "endmember 3")] == [
        0,
        0,
        1,
        3,
    ]
    assert find_endmember("3", names) == 1, "names come before numbers"
    assert find_endmember("endmember_0", names) == 2
    for asked in ("tan 2", "4", "endmember_4", "-1", "1.0", ""):
        assert find_endmember(asked, names) is None


def test_a_band_beyond_full_scale_counts_in_the_colour_with_all_that_it_has():
    spectrum = torch.tensor([[0.0, 0.0, 0.0, 0.3, 1.6]])
    one, none = torch.ones(1), torch.zeros(1, 0)
    seen = Coefficients.of(one, one, one[:, None], one[:, None], none)
    expected = (spectrum @ rgb_matrix(BANDS)).clamp(0, 1)
    assert_close(materials(spectrum).through(seen, rgb_matrix(BANDS)).clamp(0, 1), expected)
    assert not torch.allclose(expected, (spectrum.clamp(max=1) @ rgb_matrix(BANDS)).clamp(0, 1), atol=0.05)


def shared(*shares, opacity=1.0):
    """Rays of these abundances, one each."""
    abundances = opacity * torch.tensor(shares)
    accumulation = torch.full((len(shares),), opacity)
    return Coefficients.of(accumulation, accumulation, abundances, abundances, torch.zeros(len(shares), 0))


def test_confidence_is_how_probably_the_largest_share_is_so_in_truth():
    spectra = torch.eye(3, 5)
    known = replace(materials(spectra), margin_error=torch.tensor(0.2))
    mixtures = ([0.4, 0.4, 0.2], [0.5, 0.3, 0.2], [0.1, 0.1, 0.8])
    for opacity in (1.0, 0.7):
        found = known.confidence(shared(*mixtures, opacity=opacity))
        assert found.tolist() == pytest.approx([0.5, 0.8413, 0.9998], abs=1e-3)
    assert known.confidence(shared(*mixtures, opacity=0.2)).tolist() == [0, 0, 0]
    margin = materials(spectra).confidence(shared([0.5, 0.3, 0.2], opacity=0.8))  # where no error is known
    assert margin.tolist() == pytest.approx([0.2])
    lone = materials(torch.ones(1, 5))
    assert [lone.confidence(shared([1.0], opacity=opacity)).item() for opacity in (0.9, 0.4)] == [1, 0]


def test_confidence_rates_the_material_that_the_segmentation_names_as_probes_do():
    """By angle a ray can be of another material than that of its largest abundance, which then is not a sign for it."""
    bright_and_dark = torch.tensor([[0.9, 0.1, 0.0, 0.0, 0.0], [0.0, 0.0, 0.01, 0.0, 0.0]])
    seen = shared([0.2, 0.8])
    for method, material, confidence in (("abundances", 1, 0.6), ("probe", 0, 0.0)):
        mixed = replace(materials(bright_and_dark, ("clay", "leaf")), segmentation=method)
        assert mixed.ids(seen).tolist() == [material]
        assert mixed.confidence(seen).tolist() == pytest.approx([confidence])
        place = mixed.spectra(seen)[0].double().numpy(), seen.abundances[0].double().numpy()
        assert mixed.name_of(*place) == mixed.names[material]


def test_a_linear_map_of_spectra_needs_no_spectra():
    matrix = torch.rand(5, 2, generator=torch.Generator().manual_seed(1))
    mixed = Materials(BANDS, torch.rand(3, 5), torch.rand(1, 5))
    half = torch.full((2,), 0.5)
    seen = Coefficients.of(half, half, torch.rand(2, 3), torch.rand(2, 3), torch.rand(2, 1))
    assert_close(mixed.through(seen, matrix), mixed.spectra(seen) @ matrix)
    assert_close(mixed.through(seen, matrix, specular=False), mixed.diffuse(seen) @ matrix)
    assert_close(mixed.through(seen, matrix, diffuse=False), mixed.specular(seen) @ matrix)
