import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands

samplings = st.lists(st.floats(1, 3000), min_size=1, max_size=40, unique_by=lambda x: round(x, 2)).map(
    lambda values: Bands.of(sorted(values))
)


@given(samplings)
def test_intervals_tile_the_range_and_hold_their_centres(bands):
    edges = bands.edges_nm
    assert len(edges) == len(bands) + 1
    assert (edges[:-1] < bands.centers_nm).all()
    assert (bands.centers_nm < edges[1:]).all()
    np.testing.assert_allclose(bands.widths_nm.sum(), edges[-1] - edges[0])


@given(samplings)
def test_each_centre_is_nearest_to_itself(bands):
    assert [bands.nearest(float(nm)) for nm in bands.centers_nm] == list(range(len(bands)))


def test_nearest_decides_by_distance_and_refuses_a_wavelength_outside_every_interval():
    bands = Bands.of([400, 500, 700])
    assert [bands.nearest(nm) for nm in (449, 451, 599, 601, 799)] == [0, 1, 1, 2, 2]
    bands = Bands.of([400, 410, 420])
    assert bands.nearest(425) == 2
    with pytest.raises(SpectrumError, match=r"no band at 426 nm: 3 bands, 400-420 nm cover 395-425 nm"):
        bands.nearest(426)
    assert (bands.contains(395), bands.contains(394.9)) == (True, False)


def test_edges_lie_midway_with_symmetric_outermost_bands_and_a_stated_width_of_a_lone_one():
    np.testing.assert_array_equal(Bands.of([400, 420, 480]).edges_nm, [390, 410, 450, 510])
    np.testing.assert_array_equal(Bands.of([550]).edges_nm, [545, 555])


def test_visible_mask_takes_380_to_780_nm_with_ends():
    assert Bands.of([379, 380, 780, 781]).visible_mask.tolist() == [False, True, True, False]


@pytest.mark.parametrize(
    ("centers", "message"),
    [
        ([400, 410, 410, 420], "strictly increase; found 410 nm at index 1 then 410 nm at index 2"),
        ([500, 400], "strictly increase; found 500 nm at index 0 then 400 nm at index 1"),
        ([400, float("nan"), 500], "be finite; found nan nm at index 1"),
        ([400, float("inf")], "be finite; found inf nm at index 1"),
        ([-5, 400], "be positive; found -5 nm at index 0"),
        ([0, 400], "be positive; found 0 nm at index 0"),
        ([], "at least one number"),
        ([[400, 500]], r"at least one number in nm; found an array of shape \(1, 2\)"),
        (["blue", "red"], "list of numbers in nm"),
    ],
)
def test_a_bad_sampling_is_refused_with_its_place(centers, message):
    with pytest.raises(SpectrumError, match=message):
        Bands.of(centers)


def test_lists_arrays_and_tensors_give_equal_bands_with_equal_hashes():
    made = [Bands.of([400, 500]), Bands.of(np.array([400, 500])), Bands.of(torch.tensor([400.0, 500.0]))]
    assert len(set(made)) == 1
    assert made[0] != Bands.of([400, 501])


def test_centres_are_a_copy_that_nobody_can_change():
    source = np.array([400.0, 500.0])
    bands = Bands(source)
    source[0] = 1
    assert bands.centers_nm[0] == 400
    with pytest.raises(ValueError, match="read-only"):
        bands.centers_nm[0] = 1
