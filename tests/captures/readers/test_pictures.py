"""Pictures and folders of pictures, against Pillow and imagecodecs; OpenEXR, against the channels its library reads."""

import imagecodecs
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from tests.captures.file_factory import centres_nm, widths_nm
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import ReadOptions
from unmix_plugin.errors import CaptureError
from unmix_plugin.formats.exr import write_spectral_exr
from unmix_plugin.spectral.bands import Bands

RGB = np.random.default_rng(0).integers(0, 255, (6, 9, 3)).astype(np.uint8)
DEEP = np.random.default_rng(1).integers(0, 65535, (6, 9, 3)).astype(np.uint16)


def test_colours_are_three_bands_of_unknown_wavelength(tmp_path):
    Image.fromarray(RGB).save(tmp_path / "a.png")
    Image.fromarray(RGB).save(tmp_path / "a.jpg", quality=100)
    for name in ("a.png", "a.jpg"):
        file = open_spectral_file(tmp_path / name)
        with Image.open(tmp_path / name) as picture:
            np.testing.assert_array_equal(
                file.read(slice(1, 4), np.array([2, 0])), np.asarray(picture)[1:4][..., [2, 0]]
            )
        assert file.bands.names == ("red", "green", "blue")
        assert file.bands.wavelengths_nm is None
        assert file.metadata["encoding"] == "sRGB"


def test_numbers_of_sixteen_bits_keep_them(tmp_path):
    (tmp_path / "rgb.png").write_bytes(imagecodecs.png_encode(DEEP))
    (tmp_path / "grey.png").write_bytes(imagecodecs.png_encode(DEEP[..., 0].copy()))
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "rgb.png").read(), DEEP)
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "grey.png").read(), DEEP[..., :1])


def test_opacity_palettes_and_bits(tmp_path):
    Image.fromarray(np.dstack([RGB, RGB[..., :1]])).save(tmp_path / "rgba.png")
    file = open_spectral_file(tmp_path / "rgba.png")
    np.testing.assert_array_equal(file.read(), RGB)
    assert "opacity" in file.notes[0]
    Image.fromarray(RGB).quantize(256).save(tmp_path / "palette.png")
    with Image.open(tmp_path / "palette.png") as picture:
        np.testing.assert_array_equal(
            open_spectral_file(tmp_path / "palette.png").read(), picture.convert("RGB")
        )
    Image.fromarray(RGB[..., 0] > 99).save(tmp_path / "bits.png")
    np.testing.assert_array_equal(
        open_spectral_file(tmp_path / "bits.png").read()[..., 0] > 0, RGB[..., 0] > 99
    )


@pytest.mark.parametrize(
    ("names", "nm"),
    [
        (["pot_ms_450nm", "pot_ms_500nm", "pot_ms_1000nm"], [450, 500, 1000]),
        (["0450", "0500", "0550"], [450, 500, 550]),
        (["view2_700", "view2_720.5", "view2_740"], [700, 720.5, 740]),
        (["b 0.55um", "a 0.65um", "c 0.45um"], [550, 650, 450]),
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
    np.testing.assert_allclose(centres_nm(file), np.sort(nm))
    assert "names of files" in file.bands.evidence
    np.testing.assert_array_equal(file.read()[0, 0], np.argsort(nm))
    assert "1 picture of another kind" in file.notes[-1]


def test_counted_files_keep_their_order_and_have_no_wavelengths(tmp_path):
    for band in range(1, 12):
        Image.fromarray(np.full((4, 5), band, np.uint8)).save(tmp_path / f"band_{band}.png")
    file = open_spectral_file(tmp_path)
    assert file.bands.wavelengths_nm is None
    np.testing.assert_array_equal(file.read()[0, 0], np.arange(1, 12))


def test_folders_that_are_no_image_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="no band files in this folder"):
        open_spectral_file(tmp_path)
    Image.fromarray(RGB).save(tmp_path / "a.png")
    with pytest.raises(CaptureError, match="3 bands; expected one band a file"):
        open_spectral_file(tmp_path)
    Image.fromarray(RGB[..., 0]).save(tmp_path / "a.png")
    Image.fromarray(RGB[:3, :, 0]).save(tmp_path / "b.png")
    with pytest.raises(CaptureError, match=r"b.png has 3 x 9 pixels; expected the 6 x 9"):
        open_spectral_file(tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_pictures_that_are_cut_short_are_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    Image.fromarray(RGB).save(path)
    data = path.read_bytes()
    for length in range(12, len(data) - 20, 9):
        path.write_bytes(data[:length])
        with pytest.raises(CaptureError, match=path.name):
            open_spectral_file(path).read()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the file is empty"),
        (b"hello world", "of no known kind: begins with b'hello wo'"),
        (b"\x1f\x8b" + bytes(20), "compressed with gzip; unpack it first"),
        (b"<!DOCTYPE html><html>", "a web page"),
        (b"PK\x05\x06" + bytes(18), "no known kind"),
    ],
)
def test_other_files_are_refused_with_the_reason(tmp_path, data, message):
    (tmp_path / "a.raw").write_bytes(data)
    with pytest.raises(CaptureError, match=message):
        open_spectral_file(tmp_path / "a.raw")
    with pytest.raises(CaptureError, match="no such file"):
        open_spectral_file(tmp_path / "missing.tif")


RNG = np.random.default_rng(0)


def write(path, names, dtype="f4", **attributes):
    """Channels of 4 x 6 pixels, each with numbers of its own, as they are read back."""
    channels = {name: RNG.random((4, 6)).astype(dtype) for name in names}
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **attributes}
    OpenEXR.File(header, dict(channels)).write(str(path))
    read = OpenEXR.File(str(path), separate_channels=True).channels()
    return {name: np.array(read[name].pixels) for name in names}


@pytest.mark.parametrize(
    ("names", "nm"),
    [
        (["S0.1000,000000nm", "S0.450,000000nm", "S0.460,500000nm"], [450, 460.5, 1000]),
        (["T.380,0nm", "T.390,0nm"], [380, 390]),
        (["S0.0,55um", "S0.450nm"], [450, 550]),
        (["T.600,0THz", "T.500,0THz"], [499.654097, 599.584916]),
        (["700", "450", "550.5"], [450, 550.5, 700]),
    ],
)
@pytest.mark.parametrize("dtype", ["f4", "f2"])
def test_channels_are_bands_by_rising_wavelength(tmp_path, names, nm, dtype):
    channels = write(tmp_path / "a.exr", [*names, "R", "G", "B"], dtype)
    file = open_spectral_file(tmp_path / "a.exr")
    assert (file.shape, file.dtype) == ((4, 6, len(nm)), np.dtype(dtype))
    np.testing.assert_allclose(centres_nm(file), nm, atol=1e-5)
    assert file.bands.names is not None
    for band, name in enumerate(file.bands.names):
        np.testing.assert_array_equal(file.read(bands=np.array([band]))[..., 0], channels[name])
    np.testing.assert_array_equal(file.read(slice(1, 3)), file.read()[1:3])
    assert file.metadata["other_channels"] == ["B", "G", "R"]


def test_ranges_of_mitsuba(tmp_path):
    channels = write(tmp_path / "a.exr", ["407.00-454.00nm", "360.00-407.00nm"])
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_allclose(centres_nm(file), [383.5, 430.5])
    np.testing.assert_allclose(widths_nm(file), [47, 47])
    np.testing.assert_array_equal(file.read()[..., 0], channels["360.00-407.00nm"])


def test_what_this_package_writes_is_read(tmp_path):
    spectra = RNG.random((3, 5, 2)).astype(np.float32)
    write_spectral_exr(tmp_path / "a.exr", spectra, Bands.of([450, 550.25]), spectra[..., [0, 1, 1]])
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_array_equal(file.read(), spectra)
    np.testing.assert_array_equal(centres_nm(file), [450, 550.25])
    assert file.metadata["emissiveUnits"] == "W.m^-2.sr^-1"


def test_one_of_several_layers_is_taken_or_named(tmp_path):
    channels = write(tmp_path / "a.exr", ["S1.450,0nm", "S0.450,0nm", "T.450,0nm"])
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_array_equal(file.read()[..., 0], channels["S0.450,0nm"])
    assert "layer 'S0' is taken; the file also has" in file.warnings[0]
    file = open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="T"))
    np.testing.assert_array_equal(file.read()[..., 0], channels["T.450,0nm"])
    with pytest.raises(CaptureError, match="no layer, part or channel 'S3'"):
        open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="S3"))


def test_channels_of_two_wavelengths_are_left_out(tmp_path):
    write(tmp_path / "a.exr", ["T.380,000000nm.410,000000nm", "T.380,000000nm", "T.410,000000nm"])
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_array_equal(centres_nm(file), [380, 410])
    assert (file.notes, file.metadata["other_channels"]) == ((), ["T.380,000000nm.410,000000nm"])


def test_channels_without_wavelengths_are_bands_without_them(tmp_path):
    channels = write(tmp_path / "a.exr", ["s0", "s1", "A"])
    file = open_spectral_file(tmp_path / "a.exr")
    assert file.bands.names == ("s0", "s1")
    assert file.bands.wavelengths_nm is None
    named = open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="s1"))
    np.testing.assert_array_equal(named.read()[..., 0], channels["s1"])
    channels = write(tmp_path / "rgb.exr", ["R", "G", "B"])
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "rgb.exr").read()[..., 0], channels["R"])


def test_plain_numbers_that_count_are_no_wavelengths(tmp_path):
    write(tmp_path / "a.exr", ["1", "2", "3"])
    assert open_spectral_file(tmp_path / "a.exr").bands.wavelengths_nm is None


def test_files_that_are_cut_short_are_refused(tmp_path):
    write(tmp_path / "a.exr", ["S0.450,0nm", "S0.460,0nm"])
    data = (tmp_path / "a.exr").read_bytes()
    for length in range(4, len(data) - 1, 7):
        (tmp_path / "b.exr").write_bytes(data[:length])
        with pytest.raises(CaptureError, match=r"b\.exr"):
            open_spectral_file(tmp_path / "b.exr").read()


def test_damaged_numbers_are_reported_in_the_error_alone(tmp_path, capsys):
    write(tmp_path / "a.exr", ["S0.450,0nm", "S0.460,0nm"])
    data = bytearray((tmp_path / "a.exr").read_bytes())
    data[-200:-190] = bytes(10)  # the head of the only chunk
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(CaptureError, match=r"a\.exr: damaged: "):
        open_spectral_file(tmp_path / "a.exr").read()
    assert capsys.readouterr().out == ""


def test_the_exposure_of_a_picture_is_that_of_its_exif(tmp_path):
    picture = Image.new("L", (3, 2))
    exif = picture.getexif()
    exif[0x8769] = {0x829A: 0.02, 0x8827: 200}
    picture.save(tmp_path / "a.png", exif=exif)
    metadata = open_spectral_file(tmp_path / "a.png").metadata
    assert (metadata["exposure_s"], metadata["gain"]) == (pytest.approx(0.02), 2.0)
    picture.save(tmp_path / "b.png")
    assert "exposure_s" not in open_spectral_file(tmp_path / "b.png").metadata
