"""Lamps and environments of many bands."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.errors import SceneError, SpectrumError
from unmix_plugin.formats.exr import write_exr
from unmix_plugin.formats.spectral_exr import write_spectral_exr
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.lighting.lamp import mean_spectrum, of_lamp, read_environment_of_bands, read_lamp
from unmix_plugin.spectral.bands import Bands

BANDS = Bands.of([450, 550, 650, 750])


def _csv(path, text):
    path.write_text(text)
    return str(path)


def test_a_lamp_is_a_table_or_a_name_with_its_greatest_band_1(tmp_path):
    lamp = _csv(tmp_path / "lamp.csv", "wavelength,power\n400,0\n500,2\n700,6\n800,6\n")
    np.testing.assert_allclose(read_lamp(lamp, BANDS), np.array([1, 3, 5, 6]) / 6)
    assert read_lamp("d65", BANDS).max() == 1
    envi = tmp_path / "lamp.hdr"
    envi.write_text(
        "ENVI\nsamples = 4\nlines = 1\nbands = 1\nheader offset = 0\nfile type = ENVI Spectral Library\n"
        "data type = 4\ninterleave = bsq\nbyte order = 0\nwavelength units = Nanometers\n"
        "spectra names = {lamp}\nwavelength = {450, 550, 650, 750}\n"
    )
    np.array([1, 2, 4, 3], dtype="<f4").tofile(tmp_path / "lamp.sli")
    np.testing.assert_allclose(read_lamp(str(envi), BANDS), [0.25, 0.5, 1, 0.75])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("wavelength,power\n500,1\n800,1\n", "do not reach"),
        ("wavelength,a,b\n400,1,1\n800,1,1\n", "one spectrum; found 2"),
        ("wavelength,power\n400,0\n460,0\n800,1\n", "no power at 450 nm"),
    ],
)
def test_lamps_that_tell_nothing_of_some_band_are_refused(tmp_path, text, expected):
    with pytest.raises(SpectrumError, match=expected):
        read_lamp(_csv(tmp_path / "lamp.csv", text), BANDS)


def test_colours_of_an_environment_get_the_lamps_spectrum_by_their_luminance():
    lamp = torch.tensor([0.1, 0.5, 1.0, 0.2])
    image = torch.rand(4, 8, 3, generator=torch.Generator().manual_seed(0))
    light = of_lamp(Environment(image, 30.0, 1.0), lamp)
    luminance = 0.2126 * image[..., 0] + 0.7152 * image[..., 1] + 0.0722 * image[..., 2]
    assert_close(light.image, luminance[..., None] * lamp)
    assert (light.rotation_deg, light.exposure_stops) == (30.0, 1.0)
    assert_close(mean_spectrum(light), lamp)


def test_a_spectral_environment_is_brought_to_the_bands(tmp_path):
    source = Bands.of([400, 600, 800])
    image = np.ones((4, 8, 1), np.float32) * np.array([1, 2, 6], np.float32)
    path = write_spectral_exr(tmp_path / "light.exr", image, source, None)
    light = read_environment_of_bands(path, BANDS, None, 10.0)
    assert_close(light.image[0, 0], torch.tensor([1.25, 1.75, 3.0, 5.0]))
    assert light.rotation_deg == 10.0


def test_environments_whose_light_is_not_known_in_every_band_are_refused(tmp_path):
    grey = np.ones((4, 8), np.float32)
    colours = write_exr(tmp_path / "rgb.exr", dict.fromkeys("RGB", grey), {})
    with pytest.raises(SceneError, match=r"light's spectrum is not known; give the lamp's"):
        read_environment_of_bands(colours, BANDS, None)
    short = write_spectral_exr(
        tmp_path / "short.exr", np.ones((4, 8, 2), np.float32), Bands.of([500, 700]), None
    )
    with pytest.raises(SceneError, match=r"do not match: .* 50 nm below and 50 nm above"):
        read_environment_of_bands(short, BANDS, None)
    nameless = write_exr(tmp_path / "two.exr", dict.fromkeys("PQ", grey), {})
    with pytest.raises(SceneError, match="needs R, G and B"):
        read_environment_of_bands(nameless, BANDS, np.ones(4))
