import numpy as np
import pytest
import tifffile

from tests.captures.band_files import open_band_file, write_band_file, xmp_packet
from unmix_plugin.captures.camera_tags import XmpTags, band_of, camera_tags, parse_xmp, tag_numbers, tag_text


@pytest.mark.parametrize("as_attributes", [False, True])
def test_elements_and_attributes_read_alike(as_attributes):
    tags = parse_xmp(xmp_packet({"Camera:BandName": "Red", "drone-dji:SensorGain": "2.5"}, as_attributes))
    assert (tags["Camera:BandName"], tags["drone-dji:SensorGain"]) == ("Red", "2.5")


def test_a_list_keeps_its_order():
    tags = parse_xmp(xmp_packet({"Camera:VignettingPolynomial": ["-3.18e-05", "1.5e-07", "2"]}))
    assert tag_numbers(tags, "Camera:VignettingPolynomial") == [-3.18e-05, 1.5e-07, 2.0]


def test_numbers_in_one_text_are_split():
    assert tag_numbers({"Camera:PrincipalPoint": "2.35363, 1.79947"}, "PrincipalPoint") == [2.35363, 1.79947]


def test_the_first_tag_that_is_there_counts():
    tags: XmpTags = {"DLS:Yaw": "", "Camera:Yaw": "3"}
    assert tag_text(tags, "Camera:Pitch", "DLS:Yaw", "Camera:Yaw") == "3"


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


def test_a_band_has_its_centre_and_width():
    table = band_of({"Camera:CentralWavelength": "717", "Camera:WavelengthFWHM": "10"})
    assert table is not None
    assert table.wavelengths_nm is not None
    assert table.fwhm_nm is not None
    assert (table.wavelengths_nm.tolist(), table.fwhm_nm.tolist()) == ([717.0], [10.0])
    assert "CentralWavelength" in table.evidence


def test_half_a_width_is_doubled():
    table = band_of({"drone-dji:BandFreq": "730(+/-16) nm"})
    assert table is not None
    assert table.wavelengths_nm is not None
    assert table.fwhm_nm is not None
    assert (table.wavelengths_nm.tolist(), table.fwhm_nm.tolist()) == ([730.0], [32.0])


@pytest.mark.parametrize("centre", ["0.717", "none", ""])
def test_no_wavelength_is_made_up(centre):
    assert band_of({"Camera:CentralWavelength": centre, "Camera:BandName": "Red edge"}) is None


def test_exif_rationals_become_numbers(tmp_path):
    exif = {"ExposureTime": 0.0004725, "FNumber": 2.8, "ISOSpeed": 400, "FocalPlaneXResolution": 266.667}
    path = write_band_file(
        tmp_path / "a.tif", np.zeros((2, 3)), {}, exif, black_level=[4800, 4801, 4802, 4803]
    )
    found = open_band_file(path).metadata["exif"]
    assert {name: found[name] for name in exif} == pytest.approx(exif, rel=1e-6)
    assert found["BlackLevel"] == [4800.0, 4801.0, 4802.0, 4803.0]
    assert found["BitsPerSample"] == 16


def test_exposure_that_a_program_moved_out_of_exif_is_found(tmp_path):
    tags = [(33434, "2I", 1, (1, 250), True), (34855, "H", 1, 200, True), (41488, "H", 1, 4, True)]
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((2, 3), np.uint16), extratags=tags)
    with tifffile.TiffFile(tmp_path / "a.tif") as stream:
        exif = camera_tags(stream.pages.first.tags)["exif"]
    assert (exif["ExposureTime"], exif["ISOSpeedRatings"], exif["FocalPlaneResolutionUnit"]) == (
        0.004,
        200,
        4,
    )
