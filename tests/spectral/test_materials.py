"""Names of endmembers, and colours of spectra beyond the sensor's full scale."""

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour import rgb_matrix
from unmix_plugin.spectral.composition import Coefficients, Materials, compose, default_names

BANDS = Bands.of([450, 500, 550, 600, 650])


def materials(endmembers: torch.Tensor, names: tuple[str, ...] = ()) -> Materials:
    return Materials(BANDS, endmembers, torch.zeros(0, 5), names=names)


def test_endmembers_are_numbered_unless_they_are_named():
    assert default_names(3) == ("endmember_0", "endmember_1", "endmember_2")
    assert materials(torch.ones(2, 5)).names == default_names(2)
    assert materials(torch.ones(2, 5), ("clay", "leaf")).names == ("clay", "leaf")


@pytest.mark.parametrize("names", [("clay",), ("clay", "clay"), ("clay", "leaf", "soil")])
def test_each_endmember_needs_a_name_of_its_own(names):
    with pytest.raises(SpectrumError, match="2 endmembers need 2 distinct names; found"):
        materials(torch.ones(2, 5), names)


def test_a_band_beyond_full_scale_counts_in_the_colour_with_all_that_it_has():
    spectrum = torch.tensor([[0.0, 0.0, 0.0, 0.3, 1.6]])
    one, none = torch.ones(1), torch.zeros(1, 0)
    seen = Coefficients(one, one, one[:, None], one[:, None], none)
    expected = (spectrum @ rgb_matrix(BANDS)).clamp(0, 1)
    assert_close(compose("linear_rgb", seen, materials(spectrum)), expected)
    assert not torch.allclose(expected, (spectrum.clamp(max=1) @ rgb_matrix(BANDS)).clamp(0, 1), atol=0.05)
