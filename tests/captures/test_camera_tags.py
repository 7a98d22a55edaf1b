"""Tags of cameras, and each camera's formula against pixels computed one by one in plain arithmetic."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.factories.files import file_of, present, write_band_file, xmp_packet
from unmix_plugin.captures.camera_tags import (
    RadiometricModel,
    band_of,
    parse_xmp,
    radiometric_model,
    tag_numbers,
)
from unmix_plugin.captures.cube import CameraTags, Cube
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.errors import CaptureError


@pytest.mark.parametrize("as_attributes", [False, True])
@pytest.mark.parametrize("value", [["-3.18e-05", "1.5e-07", "2"], "-3.18e-05, 1.5e-07, 2"])
def test_elements_and_attributes_lists_and_texts_read_alike(as_attributes, value):
    packet = xmp_packet({"drone-dji:SensorGain": "2.5", "Camera:VignettingPolynomial": value}, as_attributes)
    tags = parse_xmp(packet)
    assert tags["drone-dji:SensorGain"] == "2.5"
    assert tag_numbers(tags, "VignettingPolynomial") == [-3.18e-05, 1.5e-07, 2.0]


@pytest.mark.parametrize(
    "packet",
    [
        b"",
        b"no xml at all",
        xmp_packet({"Camera:BandName": "Red"})[:230],
        b'<!DOCTYPE a [<!ENTITY b "c">]>' + xmp_packet({"Camera:BandName": "Red"}),
        xmp_packet({"Camera:BandName": "Red"}).replace(b"</Camera:BandName>", b""),
    ],
)
def test_a_damaged_packet_has_no_tags(packet):
    assert parse_xmp(packet) == {}


CENTRE, WIDTH, FREQUENCY = "Camera:CentralWavelength", "Camera:WavelengthFWHM", "drone-dji:BandFreq"


@pytest.mark.parametrize(
    ("tags", "centre", "width"),
    [
        ({CENTRE: "717", WIDTH: "10"}, 717, 10),
        ({FREQUENCY: "730(+/-16) nm"}, 730, 32),  # half a width is doubled
        ({CENTRE: "717", WIDTH: "0"}, 717, None),
        ({FREQUENCY: "730(+/-0) nm"}, 730, None),
        *(({CENTRE: centre, "Camera:BandName": "Red edge"}, None, None) for centre in ("0.717", "none", "")),
    ],
)
def test_a_band_has_its_centre_and_width_or_none_is_made_up(tags, centre, width):
    table = band_of(tags)
    assert (table is None) == (centre is None)
    if table is not None:
        assert table.wavelengths_nm == [centre]
        assert (table.fwhm_nm is None) if width is None else (table.fwhm_nm == [width])
        assert next(iter(tags)).rpartition(":")[2] in table.source


def test_numbers_of_10_bits_of_a_sequoia_are_as_bright_as_those_of_16():
    """Whose black level is 2046 in both."""
    numbers = np.random.default_rng(1).integers(40, 1000, (*SIZE, 1)).astype(np.uint16)
    said = [CameraTags(SEQUOIA, EXIF | {"BitsPerSample": bits}) for bits in (10, 16)]
    short, whole = (radiance_of(file_of(numbers * 64**i, camera=own)) for i, own in enumerate(said))
    np.testing.assert_allclose(short, whole, rtol=1e-5)
    assert whole.mean() > 0


def test_exif_rationals_become_numbers(tmp_path):
    exif = {"ExposureTime": 0.0004725, "FNumber": 2.8, "ISOSpeed": 400, "FocalPlaneXResolution": 266.667}
    levels = [4800, 4801, 4802, 4803]
    path = write_band_file(tmp_path / "a.tif", np.zeros((2, 3)), {}, exif, black_level=levels)
    found = open_spectral_file(path).camera.exif
    assert {name: found[name] for name in exif} == pytest.approx(exif, rel=1e-6)
    assert found["BlackLevel"] == [4800.0, 4801.0, 4802.0, 4803.0]
    assert found["BitsPerSample"] == 16


MICASENSE = {
    "MicaSense:RadiometricCalibration": ["0.00014", "1.2e-07", "1.4e-06"],
    "Camera:VignettingCenter": ["25.5", "14.25"],
    "Camera:VignettingPolynomial": ["-3e-05", "1e-05", "-3e-07", "1e-09", "-1e-11", "7e-14"],
    "DLS:SpectralIrradiance": "1.085",
}
MICASENSE_2D = {
    "MicaSense:RadiometricCalibration": ["0.00014", "1.2e-07", "1.4e-06"],
    "Camera:VignettingPolynomial2DName": ["0", "0", "1", "0", "0", "1", "2", "1"],
    "Camera:VignettingPolynomial2D": ["0.6", "0.7", "-0.2", "-0.4"],
}
SEQUOIA = {
    "Camera:SensorModel": "13220.63,2046.04,411.72",
    "Camera:VignettingPolynomial2DName": "0,0,1,0,2,0,0,1,0,2",
    "Camera:VignettingPolynomial2D": "0.4,1.2,-1.1,1.3,-1.25",
}
DJI = {
    "drone-dji:SensorGain": "2.5",
    "drone-dji:ExposureTime": "1850",
    "drone-dji:SensorGainAdjustment": "1.07",
    "drone-dji:BlackLevel": "3200",
    "drone-dji:CalibratedOpticalCenterX": "24.0",
    "drone-dji:CalibratedOpticalCenterY": "17.5",
    "drone-dji:VignettingData": "0.0002, 1e-05, -1e-07, 1e-09, 0, 0",
    "drone-dji:Irradiance": "7423.1",
}
EXIF = {"ExposureTime": 0.0008, "FNumber": 2.2, "ISOSpeed": 400, "ISOSpeedRatings": 400}
SIZE = (30, 50)


@pytest.fixture
def pixels():
    return np.random.default_rng(1).integers(6000, 60000, SIZE)


def make(tmp_path, pixels, tags, exif=EXIF, **options) -> Cube:
    return open_spectral_file(write_band_file(tmp_path / "band.tif", pixels, tags, exif, **options))


def radiance_of(file: Cube, rows: slice = slice(None)) -> np.ndarray:
    return model_of(file).apply(file.read(rows).astype(np.float64), rows)


def model_of(file: Cube) -> RadiometricModel:
    return present(radiometric_model(file))


def micasense(vignetting: float, p: int, y: int) -> float:
    row = 1 + 1.2e-07 * y / 0.0008 - 1.4e-06 * y
    return 0.00014 / (4.0 * 0.0008) * (p - 4801.5) / 65536 / vignetting / row


def micasense_by_hand(p: int, x: int, y: int) -> float:
    r = math.sqrt((x - 25.5) ** 2 + (y - 14.25) ** 2)
    return micasense(
        1 - 3e-05 * r + 1e-05 * r**2 - 3e-07 * r**3 + 1e-09 * r**4 - 1e-11 * r**5 + 7e-14 * r**6, p, y
    )


def micasense_2d_by_hand(p: int, x: int, y: int) -> float:
    u, w = x / 50, y / 30
    return micasense(0.6 + 0.7 * u - 0.2 * w - 0.4 * u**2 * w, p, y)


def sequoia_by_hand(p: int, x: int, y: int) -> float:
    u, w = x / 50, y / 30
    v = 0.4 + 1.2 * u - 1.1 * u**2 + 1.3 * w - 1.25 * w**2
    return 2.2**2 * (p - 2046.04) / (13220.63 * 0.0008 * 400 + 411.72) / v


def dji_by_hand(p: int, x: int, y: int) -> float:
    r = math.sqrt((x - 24.0) ** 2 + (y - 17.5) ** 2)
    v = 1 + 0.0002 * r + 1e-05 * r**2 - 1e-07 * r**3 + 1e-09 * r**4
    return (p - 3200) / 65536 / (2.5 * 1850e-6) * 1.07 * v


SECOND_SENSOR = {"Camera:HorizontalIrradiance": "108.5", "Camera:IrradianceScaleToSIUnits": "0.01"}
LEVELS = {"black_level": [4800, 4801, 4802, 4803]}


@pytest.mark.parametrize(
    ("tags", "options", "by_hand", "unit", "irradiance"),
    [
        (MICASENSE, LEVELS, micasense_by_hand, "W/m2/sr/nm", 1.085),
        (MICASENSE | SECOND_SENSOR, LEVELS, micasense_by_hand, "W/m2/sr/nm", 1.085),
        (MICASENSE_2D, LEVELS, micasense_2d_by_hand, "W/m2/sr/nm", None),
        (SEQUOIA, {}, sequoia_by_hand, "relative", None),
        (DJI, {"as_attributes": True}, dji_by_hand, "relative", 7423.1),
    ],
)
def test_radiance_is_that_of_a_calculation_by_hand(
    tmp_path, pixels, tags, options, by_hand, unit, irradiance
):
    file = make(tmp_path, pixels, tags, **options)
    radiance, rows, model = radiance_of(file), slice(7, 19), model_of(file)
    expected = [[by_hand(int(pixels[y, x]), x, y) for x in range(SIZE[1])] for y in range(SIZE[0])]
    np.testing.assert_allclose(radiance[..., 0], expected, rtol=1e-5)
    np.testing.assert_array_equal(radiance_of(file, rows), radiance[rows])
    assert (model.unit, model.irradiance) == (unit, irradiance and pytest.approx(irradiance))
    assert model.maker in model.description


def test_what_is_below_the_black_level_stays_below_0(tmp_path):
    assert (radiance_of(make(tmp_path, np.full(SIZE, 4700), MICASENSE, **LEVELS)) < 0.0).all()


def test_the_faulty_exposure_of_old_firmware_is_mended(tmp_path, pixels):
    file = make(tmp_path, pixels, MICASENSE, EXIF | {"ExposureTime": 1.0 / 6329.0})
    plain = radiance_of(file, slice(1))
    file = replace(file, camera=CameraTags(file.camera.xmp, {**file.camera.exif, "Model": "RedEdge"}))
    np.testing.assert_allclose(radiance_of(file, slice(1)) / plain, (1.0 / 6329.0) / 0.000274, rtol=1e-4)


@pytest.mark.parametrize(
    ("tags", "exif", "message"),
    [
        (MICASENSE | {"Camera:VignettingPolynomial": ["1"]}, EXIF, "VignettingPolynomial should hold 6 numb"),
        (MICASENSE, {"ISOSpeed": 400}, "ExposureTime should hold 1 positive number; it is absent"),
        (MICASENSE, EXIF | {"ExposureTime": 0.0}, r"ExposureTime should hold .*; found \[0.0\]"),
        (MICASENSE, EXIF | {"ExposureTime": "a while"}, "EXIF ExposureTime should hold 1 positive number"),
        (SEQUOIA, {"ExposureTime": 0.0008, "FNumber": 2.2}, "EXIF ISOSpeedRatings should hold"),
        (SEQUOIA | {"Camera:VignettingPolynomial2D": "0.4"}, EXIF, "VignettingPolynomial2D should hold 5"),
        (SEQUOIA | {"Camera:VignettingPolynomial2DName": "-1,0"}, EXIF, "powers"),
        (SEQUOIA | {"Camera:VignettingPolynomial2DName": ""}, EXIF, "expected pairs of powers"),
        (DJI | {"drone-dji:BlackLevel": ""}, EXIF, "BlackLevel should hold 1 number; it is absent"),
        (DJI | {"drone-dji:VignettingData": "-1,0,0,0,0,0"}, EXIF, "expected positive numbers"),
    ],
)
def test_a_calibration_that_lacks_a_number_is_refused(tmp_path, pixels, tags, exif, message):
    file = make(tmp_path, pixels, tags)
    file = replace(file, camera=CameraTags(file.camera.xmp, exif))
    with pytest.raises(CaptureError, match=message) as refusal:
        radiometric_model(file)
    assert "band.tif" in str(refusal.value)
    assert radiometric_model(make(tmp_path, pixels, {"Camera:BandName": "Red"})) is None
