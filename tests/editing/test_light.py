"""Another light: brightness stays comparable, and what cannot be known is refused."""

import numpy as np
import pytest

from tests.editing.scenes import CAMERAS, lit_scene
from unmix_plugin.editing import Light, relight
from unmix_plugin.editing.apply import relighting_factors
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, xyz_matrix

VISIBLE = Bands.of(np.linspace(400, 700, 31))
INFRARED = Bands.of(np.linspace(750, 1000, 26))


def factors_of(bands: Bands, recorded: np.ndarray | None, light: str) -> np.ndarray:
    """Of a light that covers all bands."""
    factors, notes = relighting_factors(bands, recorded, Light(light))
    assert notes == []
    return factors


def test_the_lights_own_spectrum_changes_nothing():
    np.testing.assert_allclose(factors_of(VISIBLE, None, "E"), 1.0)
    recorded = 0.3 * illuminant_power("FL2", VISIBLE)
    np.testing.assert_allclose(factors_of(VISIBLE, recorded, "FL2"), 1.0)


@pytest.mark.parametrize("name", ["A", "D65", "FL11", "HP1"])
def test_a_perfect_white_keeps_its_luminance_and_takes_the_lights_spectrum(name):
    recorded = illuminant_power("D50", VISIBLE)
    white = recorded * factors_of(VISIBLE, recorded, name)
    luminance = xyz_matrix(VISIBLE).numpy()[:, 1].astype(float)
    assert white @ luminance == pytest.approx(recorded @ luminance, rel=1e-6)
    np.testing.assert_allclose(white / white.max(), illuminant_power(name, VISIBLE))


def test_where_nothing_is_visible_the_mean_radiance_is_kept():
    factors = factors_of(INFRARED, None, "A")
    assert factors.mean() == pytest.approx(1.0, rel=1e-3)
    assert factors.std() > 0.01


def test_bands_that_the_scenes_own_light_left_dark_stay_dark_and_are_named():
    recorded = np.where(VISIBLE.centers_nm < 425, 0.0, 1.0)
    factors, [note] = relighting_factors(VISIBLE, recorded, Light("A"))
    assert (factors[:3] == 0).all()
    assert (factors[3:] > 0).all()
    assert "own light does not reach 3 of 31 bands, 400-700 nm (400 to 420 nm)" in note


def test_bands_that_the_new_light_does_not_reach_are_dark_and_the_others_are_lit_as_ever():
    wide = Bands.of(np.linspace(400, 1000, 61))
    factors, [note] = relighting_factors(wide, None, Light("D65"))
    assert (factors[:39] > 0).all()
    assert (factors[39:] == 0).all()
    assert "D65 is not known at 22 of 61 bands, 400-1000 nm (790 to 1000 nm): black there" in note
    assert "illuminant: {light: D65, extrapolate: true}" in note
    np.testing.assert_allclose(factors[:31], factors_of(VISIBLE, None, "D65"), rtol=0.02)


def test_a_light_without_luminance_keeps_the_mean_radiance_of_the_bands_that_it_reaches():
    factors, _ = relighting_factors(INFRARED, None, Light("D65"))
    assert factors[:4].mean() == pytest.approx(1.0, rel=0.05)
    assert (factors[4:] == 0).all()


def test_a_light_may_be_held_beyond_what_is_known_of_it_and_must_be_where_nothing_is():
    beyond = Bands.of(np.linspace(800, 1000, 21))
    factors, notes = relighting_factors(beyond, None, Light("D65", extrapolate=True))
    np.testing.assert_allclose(factors, 1.0)
    assert notes == []
    with pytest.raises(SpectrumError, match=r"light D65 is not known in 21 bands.*extrapolate: true"):
        relighting_factors(beyond, None, Light("D65"))


def test_an_invisible_light_cannot_be_as_bright_as_before(tmp_path):
    path = tmp_path / "lamp.csv"
    path.write_text("wavelength,power\n350,1\n355,0\n1000,0\n")
    with pytest.raises(SpectrumError, match="no power in any of 31 bands"):
        relighting_factors(VISIBLE, None, Light(path))
    with pytest.raises(SpectrumError, match=r"gone\.csv: can't read spectra"):
        relighting_factors(VISIBLE, None, Light(tmp_path / "gone.csv"))


def test_a_scene_relit_by_a_light_that_ends_among_its_bands_renders_and_says_which_are_black():
    scene = lit_scene()
    short = relight(scene, Light("ISO 7589 Sensitometric Printer"))  # known up to 560 nm
    [note] = short.notes
    assert "2 of 5 bands, 450-650 nm (600 to 650 nm): black there" in note
    view = short.render(CAMERAS[0], ["spectral", "rgb", "index:r650", "index:r500"])
    assert (view["spectral"][..., 3:] == 0).all()
    assert view["spectral"][..., :3].amax() > 0.1
    assert view["rgb"].isfinite().all()
    assert view["index:r650"].isnan().all()
    assert view["index:r500"].isfinite().any()
