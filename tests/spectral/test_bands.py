import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands


@given(st.lists(st.floats(1, 3000), min_size=1, max_size=40, unique_by=lambda x: round(x, 2)))
def test_intervals_hold_their_centres_and_tile_all_but_the_gaps(centers):
    bands = Bands.of(sorted(centers))
    edges = bands.edges_nm
    assert len(edges) == len(bands) + 1
    assert (edges[:-1] < bands.centers_nm).all()
    assert (bands.centers_nm < edges[1:]).all()
    low, high = bands.intervals_nm.T
    assert ((edges[:-1] <= low) & (low < bands.centers_nm)).all()
    assert ((bands.centers_nm < high) & (high <= edges[1:])).all()
    np.testing.assert_array_equal(bands.widths_nm, high - low)
    np.testing.assert_allclose(np.diff(bands.ranges_nm).sum(), bands.widths_nm.sum())
    assert [bands.nearest(float(nm)) for nm in bands.centers_nm] == list(range(len(bands)))
    if len(bands.ranges_nm) == 1:
        np.testing.assert_array_equal(bands.intervals_nm, np.stack([edges[:-1], edges[1:]], axis=1))


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
    assert Bands.of([379, 380, 780, 781]).visible_mask.tolist() == [False, True, True, False]


WITHOUT_WATER = Bands.of([*range(1000, 1341, 10), *range(1460, 1701, 10)])


def test_bands_beside_a_gap_reach_no_farther_into_it_than_half_their_spacing():
    bands = WITHOUT_WATER
    np.testing.assert_array_equal(bands.ranges_nm, [[995, 1345], [1455, 1705]])
    np.testing.assert_array_equal(bands.widths_nm, 10)
    assert bands.coverage == "995-1345, 1455-1705 nm"
    assert [bands.contains(nm) for nm in (1345, 1346, 1400, 1455)] == [True, False, False, True]
    assert bands.contains(1000, up_to_nm=1345)
    assert not bands.contains(1300, up_to_nm=1500)
    assert bands.nearest(1344) == bands.nearest(1340)
    with pytest.raises(SpectrumError, match=r"no band at 1395 nm: .* cover 995-1345, 1455-1705 nm"):
        bands.nearest(1395)


def test_bands_reach_as_far_into_a_gap_as_the_instrument_is_known_to_see():
    centers = WITHOUT_WATER.centers_nm
    ranges = [Bands(centers, np.full(len(centers), width)).ranges_nm for width in (30.0, 4.0, 200.0)]
    np.testing.assert_array_equal(ranges[0], [[995, 1355], [1445, 1705]])
    assert (len(ranges[1]), len(ranges[2])) == (2, 1)


def test_a_lone_band_beyond_a_gap_reaches_no_farther_than_half_the_largest_other_step():
    infrared = Bands.of([475, 560, 668, 717, 842, 1610])
    np.testing.assert_array_equal(infrared.ranges_nm, [[432.5, 885.5], [1547.5, 1672.5]])
    ultraviolet = Bands.of([200, 500, 510, 520, 530])
    np.testing.assert_array_equal(ultraviolet.ranges_nm, [[195, 205], [495, 535]])
    known = Bands(infrared.centers_nm, np.full(6, 200.0))
    np.testing.assert_array_equal(known.ranges_nm, [[432.5, 942], [1510, 1710]])
    ten = [444, 475, 531, 560, 650, 668, 705, 717, 740, 842]  # as uneven as multispectral cameras are
    np.testing.assert_array_equal(Bands.of(ten).ranges_nm[-1], [791, 893])


def test_uneven_steps_are_no_gaps():
    one_left_out, camera = [400, 410, 420, 440, 450, 460], [475, 560, 668, 717, 842]
    two_cameras = [400, 400.3, 405, 405.4, 410, 410.5, 415]
    for centers in (one_left_out, camera, two_cameras, [400, 900], [475, 842, 1610]):
        assert len(Bands.of(centers).ranges_nm) == 1, centers


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


def test_bands_compare_and_hash_by_value_and_keep_a_copy_that_nobody_can_change():
    source = np.array([400.0, 500.0])
    made = [Bands(source), Bands.of([400, 500]), Bands.of(torch.tensor([400.0, 500.0]))]
    source[0] = 1
    assert len(set(made)) == 1
    assert made[0] != Bands.of([400, 501])
    with pytest.raises(ValueError, match="read-only"):
        made[0].centers_nm[0] = 1
