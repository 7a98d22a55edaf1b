import numpy as np
import pytest

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import LibraryMaterial, MaterialLibrary, measured_library
from unmix_plugin.trained.run_materials import match_json, relit, shown_matches

BANDS = Bands.of([450, 500, 550, 600, 650])
LIGHT = np.array([0.2, 0.4, 0.6, 0.8, 1.0])


def test_a_match_is_shown_in_the_light_and_brightness_of_the_spectrum():
    leaf = measured_library().reflectance("ColorChecker/foliage", BANDS)
    [[best, *_]] = shown_matches(0.3 * (LIGHT * leaf)[None], BANDS, LIGHT, measured_library())
    assert best.match.name == "ColorChecker/foliage"
    np.testing.assert_allclose(best.spectrum, 0.3 * LIGHT * leaf, rtol=1e-9)
    assert match_json(best.match) == {
        "name": "ColorChecker/foliage",
        "angle_rad": pytest.approx(0, abs=1e-7),
        "bands_compared": 5,
        "source": "ColorChecker, Ohta 1997",
    }


def test_a_match_is_not_drawn_where_it_was_not_measured():
    material = LibraryMaterial("short", Bands.of([500, 650]), np.array([0.2, 0.8]), "made up")
    [[found]] = shown_matches(np.ones((1, 5)), BANDS, None, MaterialLibrary((material,)))
    assert np.isnan(found.spectrum[0])
    assert np.isfinite(found.spectrum[1:]).all()
    assert found.match.num_bands == 4
    assert shown_matches(np.zeros((1, 5)), BANDS, None, measured_library()) == [[]]  # black resembles nothing


@pytest.mark.parametrize("recorded", [None, [0.5, 0.5, 0.25, 1.0, 0.0]])
def test_measured_radiance_is_brought_into_the_light_of_the_model(recorded):
    measured = np.full((2, 5), 0.5, dtype=np.float32)
    same = relit(measured, recorded, None if recorded is None else np.array(recorded))
    expected = measured if recorded is None else measured * [1, 1, 1, 1, 0]
    np.testing.assert_allclose(same, expected)
    other = relit(measured, recorded, LIGHT)
    factors = LIGHT if recorded is None else LIGHT * [2, 2, 4, 1, 0]
    np.testing.assert_allclose(other, measured * factors)
