"""Each camera's formula against pixels computed one by one, with the numbers of the tags in plain arithmetic."""

import math

import numpy as np
import pytest

from tests.captures.band_files import open_band_file, write_band_file
from unmix_plugin.captures.radiometry import radiometric_model
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

MICASENSE = {
    "MicaSense:RadiometricCalibration": ["0.00014", "1.2e-07", "1.4e-06"],
    "Camera:VignettingCenter": ["25.5", "14.25"],
    "Camera:VignettingPolynomial": ["-3e-05", "1e-05", "-3e-07", "1e-09", "-1e-11", "7e-14"],
    "DLS:SpectralIrradiance": "1.085",
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


def make(tmp_path, pixels, tags, exif=EXIF, **options) -> SpectralFile:
    return open_band_file(write_band_file(tmp_path / "band.tif", pixels, tags, exif, **options))


def micasense_by_hand(p: int, x: int, y: int) -> float:
    r = math.sqrt((x - 25.5) ** 2 + (y - 14.25) ** 2)
    v = 1 - 3e-05 * r + 1e-05 * r**2 - 3e-07 * r**3 + 1e-09 * r**4 - 1e-11 * r**5 + 7e-14 * r**6
    row = 1 + 1.2e-07 * y / 0.0008 - 1.4e-06 * y
    return 0.00014 / (4.0 * 0.0008) * (p - 4801.5) / 65536 / v / row


def sequoia_by_hand(p: int, x: int, y: int) -> float:
    u, w = x / 50, y / 30
    v = 0.4 + 1.2 * u - 1.1 * u**2 + 1.3 * w - 1.25 * w**2
    return 2.2**2 * (p - 2046.04) / (13220.63 * 0.0008 * 400 + 411.72) / v


def dji_by_hand(p: int, x: int, y: int) -> float:
    r = math.sqrt((x - 24.0) ** 2 + (y - 17.5) ** 2)
    v = 1 + 0.0002 * r + 1e-05 * r**2 - 1e-07 * r**3 + 1e-09 * r**4
    return (p - 3200) / 65536 / (2.5 * 1850e-6) * 1.07 * v


@pytest.mark.parametrize(
    ("tags", "options", "by_hand", "unit"),
    [
        (MICASENSE, {"black_level": [4800, 4801, 4802, 4803]}, micasense_by_hand, "W/m2/sr/nm"),
        (SEQUOIA, {}, sequoia_by_hand, "relative"),
        (DJI, {"as_attributes": True}, dji_by_hand, "relative"),
    ],
)
def test_radiance_is_that_of_a_calculation_by_hand(tmp_path, pixels, tags, options, by_hand, unit):
    file = make(tmp_path, pixels, tags, **options)
    model = radiometric_model(file)
    assert model is not None
    radiance = model.apply(file.read().astype(np.float64))
    expected = [[by_hand(int(pixels[y, x]), x, y) for x in range(SIZE[1])] for y in range(SIZE[0])]
    np.testing.assert_allclose(radiance[..., 0], expected, rtol=1e-5)
    assert model.unit == unit
    assert model.maker in model.description


@pytest.mark.parametrize("tags", [MICASENSE, SEQUOIA, DJI])
def test_some_rows_are_those_of_the_whole(tmp_path, pixels, tags):
    file = make(tmp_path, pixels, tags)
    model = radiometric_model(file)
    assert model is not None
    whole = model.apply(file.read().astype(np.float64))
    for rows in (slice(7, 19), slice(None, 4), slice(3, 30, 5)):
        part = model.apply(file.read(rows).astype(np.float64), rows)
        np.testing.assert_array_equal(part, whole[rows])
        columns = slice(11, 40)
        part = model.apply(file.read(rows)[:, columns].astype(np.float64), rows, columns)
        np.testing.assert_allclose(part, whole[rows, columns], rtol=1e-6)


def test_what_is_below_the_black_level_stays_below_0(tmp_path):
    file = make(tmp_path, np.full(SIZE, 4700), MICASENSE, black_level=[4800] * 4)
    model = radiometric_model(file)
    assert model is not None
    assert (model.apply(file.read().astype(np.float64)) < 0.0).all()


def test_twice_the_exposure_is_half_the_radiance(tmp_path, pixels):
    once, twice = (
        radiometric_model(make(tmp_path, pixels, DJI | {"drone-dji:ExposureTime": exposure}))
        for exposure in ("1000", "2000")
    )
    assert once is not None
    assert twice is not None
    values = pixels[..., None].astype(np.float64)
    np.testing.assert_allclose(once.apply(values), 2.0 * twice.apply(values), rtol=1e-6)


@pytest.mark.parametrize(("tags", "irradiance"), [(MICASENSE, 1.085), (DJI, 7423.1), (SEQUOIA, None)])
def test_the_sunshine_sensor_is_reported(tmp_path, pixels, tags, irradiance):
    model = radiometric_model(make(tmp_path, pixels, tags))
    assert model is not None
    assert model.irradiance == irradiance


def test_irradiance_of_the_second_sensor_is_scaled_to_si(tmp_path, pixels):
    tags = MICASENSE | {"Camera:HorizontalIrradiance": "108.5", "Camera:IrradianceScaleToSIUnits": "0.01"}
    model = radiometric_model(make(tmp_path, pixels, tags))
    assert model is not None
    assert model.irradiance == pytest.approx(1.085)


def test_the_faulty_exposure_of_old_firmware_is_mended(tmp_path, pixels):
    file = make(tmp_path, pixels, MICASENSE, EXIF | {"ExposureTime": 1.0 / 6329.0})
    plain = radiometric_model(file)
    file.metadata["exif"]["Model"] = "RedEdge"
    mended = radiometric_model(file)
    assert plain is not None
    assert mended is not None
    values = pixels[:1, :, None].astype(np.float64)
    np.testing.assert_allclose(
        mended.apply(values) / plain.apply(values), (1.0 / 6329.0) / 0.000274, rtol=1e-4
    )


def test_exif_that_holds_text_is_refused(tmp_path, pixels):
    file = make(tmp_path, pixels, MICASENSE)
    file.metadata["exif"]["ExposureTime"] = "a millisecond"
    with pytest.raises(CaptureError, match="EXIF ExposureTime should hold 1 positive number"):
        radiometric_model(file)


def test_a_file_without_calibration_has_no_model(tmp_path, pixels):
    assert radiometric_model(make(tmp_path, pixels, {"Camera:BandName": "Red"})) is None


@pytest.mark.parametrize(
    ("tags", "exif", "message"),
    [
        (
            MICASENSE | {"Camera:VignettingPolynomial": ["1"]},
            EXIF,
            "VignettingPolynomial should hold 6 numbers",
        ),
        (MICASENSE, {"ISOSpeed": 400}, "ExposureTime should hold 1 positive number; it is absent"),
        (
            MICASENSE,
            EXIF | {"ExposureTime": 0.0},
            r"ExposureTime should hold 1 positive number; found \[0.0\]",
        ),
        (SEQUOIA, {"ExposureTime": 0.0008, "FNumber": 2.2}, "EXIF ISOSpeedRatings should hold"),
        (SEQUOIA | {"Camera:VignettingPolynomial2D": "0.4"}, EXIF, "VignettingPolynomial2D should hold 5"),
        (SEQUOIA | {"Camera:VignettingPolynomial2DName": "-1,0"}, EXIF, "powers"),
        (DJI | {"drone-dji:BlackLevel": ""}, EXIF, "BlackLevel should hold 1 number; it is absent"),
        (DJI | {"drone-dji:VignettingData": "-1,0,0,0,0,0"}, EXIF, "expected positive numbers"),
    ],
)
def test_a_calibration_that_lacks_a_number_is_refused(tmp_path, pixels, tags, exif, message):
    with pytest.raises(CaptureError, match=message) as refusal:
        radiometric_model(make(tmp_path, pixels, tags, exif))
    assert "band.tif" in str(refusal.value)
