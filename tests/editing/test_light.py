"""Another light: brightness stays comparable, and what cannot be known is refused."""

import numpy as np
import pytest

from unmix_plugin.editing import Light
from unmix_plugin.editing.light import relighting_factors
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import xyz_matrix
from unmix_plugin.spectral.colour.illuminants import illuminant_power

VISIBLE = Bands.of(np.linspace(400, 700, 31))
INFRARED = Bands.of(np.linspace(750, 1000, 26))


def test_the_lights_own_spectrum_changes_nothing():
    np.testing.assert_allclose(relighting_factors(VISIBLE, None, Light("E")), 1.0)
    recorded = 0.3 * illuminant_power("FL2", VISIBLE)
    np.testing.assert_allclose(relighting_factors(VISIBLE, recorded, Light("FL2")), 1.0)


@pytest.mark.parametrize("name", ["A", "D65", "FL11", "HP1"])
def test_a_perfect_white_keeps_its_luminance_and_takes_the_lights_spectrum(name):
    recorded = illuminant_power("D50", VISIBLE)
    white = recorded * relighting_factors(VISIBLE, recorded, Light(name))
    luminance = xyz_matrix(VISIBLE).numpy()[:, 1].astype(float)
    assert white @ luminance == pytest.approx(recorded @ luminance, rel=1e-6)
    np.testing.assert_allclose(white / white.max(), illuminant_power(name, VISIBLE))


def test_where_nothing_is_visible_the_mean_radiance_is_kept():
    factors = relighting_factors(INFRARED, None, Light("A"))
    assert factors.mean() == pytest.approx(1.0, rel=1e-3)
    assert factors.std() > 0.01


def test_bands_that_the_scenes_light_left_dark_are_refused_by_wavelength():
    recorded = np.where(VISIBLE.centers_nm < 425, 0.0, 1.0)
    with pytest.raises(SpectrumError, match=r"no power in 3 bands \(400 to 420 nm\)"):
        relighting_factors(VISIBLE, recorded, Light("A"))


def test_a_light_that_ends_before_the_bands_is_held_only_when_asked():
    with pytest.raises(SpectrumError, match=r"light D65: .* 220 nm above their range.*extrapolate: true"):
        relighting_factors(INFRARED, None, Light("D65"))
    factors = relighting_factors(Bands.of(np.linspace(700, 1000, 31)), None, Light("D65", extrapolate=True))
    np.testing.assert_allclose(factors[9:], factors[9])


def test_an_invisible_light_cannot_be_as_bright_as_before(tmp_path):
    path = tmp_path / "lamp.csv"
    path.write_text("wavelength,power\n350,1\n355,0\n1000,0\n")
    with pytest.raises(SpectrumError, match="no power in any of 31 bands"):
        relighting_factors(VISIBLE, None, Light(path))
    with pytest.raises(SpectrumError, match=r"gone\.csv: can't read spectra"):
        relighting_factors(VISIBLE, None, Light(tmp_path / "gone.csv"))
