"""Metamers: built to look alike in one light, they are found, and nothing else is."""

import numpy as np
import pytest
import torch

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, xyz_matrix
from unmix_plugin.spectral.colour.difference import metameric_pairs, pair_differences

BANDS = Bands.of(np.linspace(400, 700, 31))
LIGHTS = np.stack([illuminant_power(name, BANDS) for name in ("D65", "A")])


def metamer_of(reflectance: np.ndarray, strength: float) -> np.ndarray:
    """Another reflectance of the same colour in the first light: what only the second light shows is added."""
    in_first, in_second = ((light[:, None] * xyz_matrix(BANDS, torch.float64).numpy()).T for light in LIGHTS)
    invisible = np.linalg.svd(in_first)[2][3:]
    added = (invisible @ in_second[0]) @ invisible
    return reflectance + strength * added / np.abs(added).max()


def surfaces() -> np.ndarray:
    """Grey, its metamer in daylight, a red, and a near copy of the red."""
    grey = np.full(31, 0.4)
    red = np.linspace(0.05, 0.8, 31)
    return np.stack([grey, red, metamer_of(grey, 0.3), red * 1.005])


def test_a_metamer_is_found_with_the_light_that_tells_it_apart():
    [pair] = metameric_pairs(surfaces(), LIGHTS, BANDS)
    assert (pair.first, pair.second) == (0, 2)
    assert (pair.alike_in, pair.different_in) == (0, 1)
    assert pair.differences[0] < 1e-3
    assert pair.differences[1] > 4


def test_surfaces_alike_everywhere_or_nowhere_are_no_metamers():
    differences = pair_differences(surfaces(), LIGHTS, BANDS)
    first, second = np.triu_indices(4, k=1)
    by_pair = {(int(i), int(k)): row for i, k, row in zip(first, second, differences, strict=True)}
    assert by_pair[1, 3].max() < 1
    assert by_pair[0, 1].min() > 20
    assert metameric_pairs(surfaces()[[0, 1, 3]], LIGHTS, BANDS) == []


def test_pairs_that_differ_most_come_first_and_thresholds_decide():
    grey = np.full(31, 0.4)
    three = np.stack([grey, *(metamer_of(grey, strength) for strength in (0.12, 0.3))])
    found = metameric_pairs(three, LIGHTS, BANDS, alike=0.5, different=1.0)
    greatest = [max(pair.differences) for pair in found]
    assert len(found) == 3
    assert greatest == sorted(greatest, reverse=True)
    middle = (greatest[0] + greatest[1]) / 2
    assert metameric_pairs(three, LIGHTS, BANDS, alike=0.5, different=middle) == found[:1]


@pytest.mark.parametrize(
    ("lights", "bands", "thresholds", "message"),
    [
        (LIGHTS[:1], BANDS, (2.0, 4.0), "at least two lights; found 1"),
        (LIGHTS, Bands.of(np.linspace(700, 1000, 31)), (2.0, 4.0), "can't tell colours apart"),
        (LIGHTS, BANDS, (4.0, 4.0), "found 4 and 4"),
    ],
)
def test_what_makes_no_sense_is_refused(lights, bands, thresholds, message):
    with pytest.raises(SpectrumError, match=message):
        metameric_pairs(surfaces(), lights, bands, *thresholds)
