"""Pictures and folders of pictures, against Pillow and imagecodecs."""

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image

from tests.captures.test_camera_tags import EXIF, MICASENSE
from tests.factories.files import (
    check_file,
    header_text,
    present,
    rows_and_bands_of,
    warnings_of,
    write_band_file,
)
from unmix_plugin.captures.calibration.references import find_missing, finished_by
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.errors import CaptureError

RGB = np.random.default_rng(0).integers(0, 255, (6, 9, 3)).astype(np.uint8)
DEEP = np.random.default_rng(1).integers(0, 65535, (6, 9, 3)).astype(np.uint16)


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_colours_are_three_bands_of_unknown_wavelength(tmp_path, name):
    Image.fromarray(RGB).save(tmp_path / name, quality=100)
    file = open_spectral_file(tmp_path / name)
    with Image.open(tmp_path / name) as picture:
        rows_and_bands_of(file, np.asarray(picture))
    check_file(file, names=("red", "green", "blue"), nm=None, encoding="sRGB")


LIGHT = "red, green and blue are taken as light, as stored"


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (DEEP, {"values": DEEP, "warning": LIGHT}),
        (DEEP[..., 0], {"values": DEEP[..., :1]}),
        (DEEP[..., :2], {"values": DEEP[..., :1], "note": "opacity"}),
        (np.dstack([RGB, RGB[..., :1]]), {"values": RGB, "note": "opacity"}),
    ],
)
def test_numbers_keep_their_bits_and_opacity_is_no_band(tmp_path, pixels, expected):
    (tmp_path / "a.png").write_bytes(imagecodecs.png_encode(pixels.copy()))
    check_file(open_spectral_file(tmp_path / "a.png"), **expected)


def test_palettes_and_bits(tmp_path):
    palette = Image.fromarray(RGB).quantize(256)
    palette.save(tmp_path / "palette.png")
    check_file(open_spectral_file(tmp_path / "palette.png"), values=palette.convert("RGB"))
    Image.fromarray(RGB[..., 0] > 99).save(tmp_path / "bits.png")
    read = open_spectral_file(tmp_path / "bits.png").read()
    np.testing.assert_array_equal(read[..., 0] > 0, RGB[..., 0] > 99)


@pytest.mark.parametrize(
    ("names", "nm"),
    [
        (["pot_ms_450nm", "pot_ms_500nm", "pot_ms_1000nm"], [450, 500, 1000]),
        (["0450", "0500", "0550"], [450, 500, 550]),
        (["view2_700", "view2_720.5", "view2_740"], [700, 720.5, 740]),
        (["b 0.55um", "a 0.65um", "c 0.45um"], [550, 650, 450]),
        (["998 nm", "1,002 nm", "998,5 nm"], [998, 1002, 998.5]),
        (["400-410nm", "410-420nm", "420-430nm"], [405, 415, 425]),
    ],
)
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_folder_is_an_image_by_rising_wavelength(tmp_path, names, nm, suffix):
    for value, name in enumerate(names):
        plane = np.full((4, 5), value, np.uint16)
        if suffix == ".png":
            (tmp_path / f"{name}.png").write_bytes(imagecodecs.png_encode(plane))
        else:
            tifffile.imwrite(tmp_path / f"{name}.tif", plane)
    Image.fromarray(RGB).save(tmp_path / "preview.jpg")
    file = open_spectral_file(tmp_path)
    check_file(file, nm=np.sort(nm), evidence="names of files", note="1 picture of another kind")
    np.testing.assert_array_equal(file.read()[0, 0], np.argsort(nm))


def test_counted_files_keep_their_order_and_have_no_wavelengths(tmp_path):
    for band in range(1, 12):
        Image.fromarray(np.full((4, 5), band, np.uint8)).save(tmp_path / f"band_{band}.png")
    file = open_spectral_file(tmp_path)
    assert file.bands.wavelengths_nm is None
    np.testing.assert_array_equal(file.read()[0, 0], np.arange(1, 12))


def test_a_band_in_a_folder_has_what_files_beside_it_say(tmp_path):
    """In GDAL's XML: gains, and no-data numbers, which may be light in another band."""
    planes = np.full((2, 3, 4), 5000, np.uint16)
    planes[0, 0], planes[1] = 500, (500, 600, 5000, 5000)
    for plane, nm, scale in zip(planes, (500, 600), (1e-4, 2e-4), strict=True):
        tifffile.imwrite(tmp_path / f"{nm}nm.tif", plane, photometric="minisblack", metadata=None)
        own = f"<NoDataValue>{nm}</NoDataValue><Offset>-0.1</Offset><Scale>{scale}</Scale>"
        text = f'<PAMDataset><PAMRasterBand band="1">{own}</PAMRasterBand></PAMDataset>'
        (tmp_path / f"{nm}nm.tif.aux.xml").write_text(text)
    file = open_spectral_file(tmp_path)
    np.testing.assert_allclose(present(file.linear).gains, [1e-4, 2e-4])
    np.testing.assert_allclose(present(file.linear).offsets, [-0.1, -0.1])
    expected = np.array([[True] * 4, [False, True, False, False], [False, True, False, False]])
    np.testing.assert_array_equal(find_missing(file.read(), file), expected)
    assert (file.dtype, warnings_of(file)) == (np.uint16, [])
    rows, bands = slice(1, 3), np.array([0])
    assert not find_missing(file.read(rows, bands), file, rows, bands).any()


def test_a_band_in_a_folder_has_what_its_header_says(tmp_path):
    for nm in (500, 600):
        plane = np.array([[5000, 0]], np.uint16)
        tifffile.imwrite(tmp_path / f"{nm}nm.tif", plane, photometric="minisblack", metadata=None)
        stated = {"file type": "TIFF", "reflectance scale factor": 10000, "data ignore value": 0}
        entries = stated | {"wavelength": f"{{{nm}}}", "wavelength units": "nm"}
        (tmp_path / f"{nm}nm.hdr").write_text(header_text(plane[..., None], "bsq", entries))
    file = open_spectral_file(tmp_path)
    check_file(file, nm=[500, 600], scale=10000, no_data=(0,))
    assert finished_by(file) == "header field 'reflectance scale factor'"
    assert find_missing(file.read(), file).tolist() == [[False, True]]


def test_a_folder_of_the_lenses_of_a_rig_is_refused_with_the_layout_that_reads_it(tmp_path):
    for lens in (1, 2):
        write_band_file(tmp_path / f"IMG_0000_{lens}.tif", np.full((4, 5), 9), MICASENSE, EXIF)
    with pytest.raises(CaptureError, match=r"IMG_0000_1.tif: of one lens of a MicaSense.*unmix-process rig"):
        open_spectral_file(tmp_path)


def test_folders_that_are_no_image_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="no band files in this folder"):
        open_spectral_file(tmp_path)
    Image.fromarray(RGB).save(tmp_path / "a.png")
    with pytest.raises(CaptureError, match="3 bands; expected one band a file"):
        open_spectral_file(tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(CaptureError, match=r"pictures as views.*with unmix-process nerfstudio"):
        open_spectral_file(tmp_path)
    (tmp_path / "transforms.json").unlink()
    Image.fromarray(RGB[..., 0]).save(tmp_path / "a.png")
    Image.fromarray(RGB[:3, :, 0]).save(tmp_path / "b.png")
    with pytest.raises(CaptureError, match=r"b.png has 3 x 9 pixels; expected the 6 x 9"):
        open_spectral_file(tmp_path)


def test_the_exposure_of_a_picture_is_that_of_its_exif(tmp_path):
    picture = Image.new("L", (3, 2))
    exif = picture.getexif()
    exif[0x8769] = {0x829A: 0.02, 0x8827: 200, 0x829D: 2.8}
    picture.save(tmp_path / "a.png", exif=exif)
    check_file(open_spectral_file(tmp_path / "a.png"), exposure_s=0.02, gain=2.0, f_number=2.8)
    picture.save(tmp_path / "b.png")
    check_file(open_spectral_file(tmp_path / "b.png"), exposure_s=None)
