"""TIFF images: against what tifffile decodes as a whole, in every arrangement of bands."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from tests.captures.file_factory import centres_nm, widths_nm
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import ReadOptions, SpectralFile
from unmix_plugin.errors import CaptureError

CUBE = np.random.default_rng(0).integers(0, 60000, (70, 50, 6)).astype(np.uint16)
PLANES = np.ascontiguousarray(CUBE.transpose(2, 0, 1))
ARRANGEMENTS = {
    "chunky": (CUBE, {"planarconfig": "contig"}),
    "planar": (PLANES, {"planarconfig": "separate"}),
    "pages": (PLANES, {"metadata": None}),
}
STORAGE = {
    "one strip": {},
    "strips": {"rowsperstrip": 16},
    "tiles": {"tile": (32, 16)},
    "deflated strips": {"rowsperstrip": 9, "compression": "zlib", "predictor": True},
    "deflated tiles": {"tile": (16, 32), "compression": "zlib"},
    "LZW": {"rowsperstrip": 16, "compression": "lzw"},
    "big-endian": {"byteorder": ">", "rowsperstrip": 30},
    "BigTIFF": {"bigtiff": True, "tile": (16, 16)},
}


def written(folder: Path, image: np.ndarray, **options: Any) -> SpectralFile:
    """An image as tifffile writes it, opened; bands beside each other in each pixel unless options say otherwise."""
    given: dict[str, Any] = {"photometric": "minisblack", "planarconfig": "contig"} | options
    tifffile.imwrite(folder / "a.tif", image, **given)
    return open_spectral_file(folder / "a.tif")


def write(path: Path, arrangement: str, storage: str) -> Path:
    image, options = ARRANGEMENTS[arrangement]
    tifffile.imwrite(path, image, photometric="minisblack", **options, **STORAGE[storage])
    return path


@pytest.mark.parametrize("storage", STORAGE)
@pytest.mark.parametrize("arrangement", ARRANGEMENTS)
def test_rows_and_bands_are_those_of_the_image(tmp_path, arrangement, storage):
    file = open_spectral_file(write(tmp_path / "cube.tif", arrangement, storage))
    assert (file.reader, file.shape) == ("tiff", (70, 50, 6))
    assert file.interleave == ("bip" if arrangement == "chunky" else "bsq")
    np.testing.assert_array_equal(file.read(), CUBE)
    np.testing.assert_array_equal(file.read(slice(13, 41), np.array([4, 0, 4])), CUBE[13:41][..., [4, 0, 4]])
    np.testing.assert_array_equal(file.read(slice(5, 66, 7), slice(1, 3)), CUBE[5:66:7, :, 1:3])
    assert file.read().dtype == np.uint16


@pytest.mark.parametrize("dtype", ["u1", "i2", "u4", "f4", "f8"])
def test_types_of_numbers(tmp_path, dtype):
    image = CUBE.astype(dtype)
    file = written(tmp_path, image)
    assert file.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(file.read(), image)


def test_a_picture_written_by_pillow_has_one_band_or_three(tmp_path):
    rgb = (CUBE[..., :3] // 256).astype(np.uint8)
    Image.fromarray(rgb).save(tmp_path / "rgb.tif", compression="tiff_lzw")
    Image.fromarray(CUBE[..., 0]).save(tmp_path / "grey.tif")
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "rgb.tif").read(), rgb)
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "grey.tif").read(), CUBE[..., :1])


def test_stacks_of_imagej_with_one_entry_for_all_pages(tmp_path):
    file = written(tmp_path, PLANES, imagej=True)
    np.testing.assert_array_equal(file.read(slice(3, 9), np.array([5, 1])), CUBE[3:9][..., [5, 1]])
    tifffile.imwrite(tmp_path / "b.tif", PLANES, truncate=True)
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "b.tif").read(), CUBE)


def test_rows_as_pages_are_recognised_by_the_number_of_wavelengths_or_said(tmp_path):
    nm = [450.0, 500, 550, 600, 650, 700]
    tifffile.imwrite(tmp_path / "a.tif", CUBE, photometric="minisblack", metadata={"wavelengths": nm})
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert len(file.pages) == 70
    file = open_spectral_file(tmp_path / "a.tif")
    np.testing.assert_array_equal(file.read(slice(10, 20), slice(2, 4)), CUBE[10:20, :, 2:4])
    np.testing.assert_array_equal(centres_nm(file), nm)
    tifffile.imwrite(tmp_path / "b.tif", CUBE, photometric="minisblack", compression="zlib")
    assert "axis 2 is the shortest" in open_spectral_file(tmp_path / "b.tif").warnings[0]
    file = open_spectral_file(tmp_path / "b.tif", ReadOptions(axes="yxb"))
    np.testing.assert_array_equal(file.read(slice(1, 70, 3), np.array([5, 2])), CUBE[1::3][..., [5, 2]])
    file = open_spectral_file(tmp_path / "b.tif", ReadOptions(axes="xyb"))
    np.testing.assert_array_equal(file.read(slice(3, 9)), CUBE.transpose(1, 0, 2)[3:9])


GDAL = "<GDALMetadata>{}</GDALMetadata>"


def items(name, values, more=""):
    return "".join(f'<Item name="{name}" sample="{i}"{more}>{value}</Item>' for i, value in enumerate(values))


NM, WIDE_NM = np.arange(400, 460, 10).tolist(), np.arange(400, 1000, 100).tolist()
UM = [0.4, 0.5, 0.6, 0.7, 0.8, 0.9]


@pytest.mark.parametrize(
    ("text", "nm"),
    [
        (items("wavelength", NM), NM),
        (items("wavelength", UM) + items("wavelength_units", ["Micrometers"] * 6), WIDE_NM),
        (items("CENTRAL_WAVELENGTH_UM", UM, ' domain="IMAGERY"'), WIDE_NM),
        (items("DESCRIPTION", [f"B{n % 7} ({n} nm)" for n in NM], ' role="description"'), NM),
        (
            "".join(f'<Item name="Band_{i + 1}">{n + 0.5} Nanometers</Item>' for i, n in enumerate(NM)),
            np.add(NM, 0.5),
        ),
        ('<Item name="wavelength">{400, 410, 420, 430, 440, 450}</Item>', NM),
    ],
)
def test_wavelengths_of_gdal(tmp_path, text, nm):
    tag = (42112, "s", 0, GDAL.format(text), True)
    file = written(tmp_path, CUBE, extratags=[tag])
    np.testing.assert_allclose(centres_nm(file), nm)
    assert file.notes == ()


def test_scale_width_and_no_data_of_gdal(tmp_path):
    text = items("OFFSET", [0] * 6, ' role="offset"') + items("SCALE", [0.0001] * 6, ' role="scale"')
    text += items("wavelength", NM) + items("fwhm", [5, 5, 5, 5, 5, 6])
    tags = [(42112, "s", 0, GDAL.format(text), True), (42113, "s", 0, "65535", True)]
    file = written(tmp_path, CUBE, extratags=tags)
    assert file.scale == pytest.approx(10000)
    assert file.no_data == 65535
    np.testing.assert_array_equal(widths_nm(file), [5, 5, 5, 5, 5, 6])


@pytest.mark.parametrize(
    "description",
    [
        json.dumps({"wavelengths_nm": NM}),
        json.dumps({"Wavelength": [0.4, 0.41, 0.42, 0.43, 0.44, 0.45], "wavelength_units": "um"}),
        "camera: x\nwavelengths (nm): 400, 410, 420, 430, 440, 450\nshutter: 3",
        "wavelength = {400, 410, 420, 430, 440, 450}",
    ],
)
def test_wavelengths_of_the_description(tmp_path, description):
    file = written(tmp_path, CUBE, description=description, metadata=None)
    np.testing.assert_allclose(centres_nm(file), NM)
    assert "image description" in file.bands.evidence


def test_wavelengths_of_ome(tmp_path):
    channels = {"EmissionWavelength": [450, 550, 650], "EmissionWavelengthUnit": ["nm"] * 3}
    metadata = {"axes": "CYX", "Channel": channels}
    tifffile.imwrite(tmp_path / "a.ome.tif", PLANES[:3], photometric="minisblack", metadata=metadata)
    file = open_spectral_file(tmp_path / "a.ome.tif")
    np.testing.assert_array_equal(centres_nm(file), [450, 550, 650])
    np.testing.assert_array_equal(file.read(), CUBE[..., :3])


def test_wavelengths_of_pages(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for nm, plane in zip((660, 550, 450), PLANES, strict=False):
            file.write(plane, description=f"filter {nm} nm", metadata=None)
    file = open_spectral_file(tmp_path / "a.tif")
    np.testing.assert_array_equal(centres_nm(file), [660, 550, 450])
    np.testing.assert_array_equal(file.read(), CUBE[..., :3])


XMP = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description xmlns:Camera="http://pix4d.com/1.0">
<Camera:BandName>Red edge</Camera:BandName><Camera:CentralWavelength>717</Camera:CentralWavelength>
<Camera:WavelengthFWHM>10</Camera:WavelengthFWHM></rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="w"?>"""


def test_the_band_of_a_multispectral_camera(tmp_path):
    packet = XMP.encode()
    tag = (700, "B", len(packet), packet, True)
    file = written(tmp_path, PLANES[0], extratags=[tag, (274, "H", 1, 6, True)], metadata=None)
    assert file.shape == (70, 50, 1)  # the orientation is not followed
    assert file.bands.names == ("Red edge",)
    np.testing.assert_array_equal(centres_nm(file), [717])
    np.testing.assert_array_equal(widths_nm(file), [10])
    assert file.metadata["xmp"]["Camera:CentralWavelength"] == "717"
    assert file.metadata["exif"]["Orientation"] == 6


def test_previews_and_pages_of_other_sizes_are_left_out(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(PLANES[0], metadata=None)
        file.write(PLANES[0, ::2, ::2], subfiletype=1, metadata=None)
        file.write(PLANES[1, :9], metadata=None)
    file = open_spectral_file(tmp_path / "a.tif")
    assert file.shape == (70, 50, 1)
    assert "pages of other sizes or types are left out: 1 of 9 x 50" in file.warnings[0]


@pytest.mark.parametrize("below", [False, True])
def test_a_preview_that_is_not_marked_as_one_is_not_taken_for_the_image(tmp_path, below):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        preview = (255 * CUBE[::2, ::2, :3] / CUBE.max()).astype(np.uint8)
        file.write(preview, photometric="rgb", subifds=1 if below else 0, metadata=None)
        file.write(CUBE, photometric="minisblack", planarconfig="contig", metadata=None)
    file = open_spectral_file(tmp_path / "a.tif")
    np.testing.assert_array_equal(file.read(), CUBE)
    assert "left out: 1 of 35 x 25 x 3" in file.warnings[0]


def test_opacity_is_noted(tmp_path):
    image = CUBE[..., :4].copy()
    file = written(tmp_path, image, photometric="rgb", extrasamples=["unassalpha"])
    np.testing.assert_array_equal(file.read(), image)
    assert "marked as opacity" in file.warnings[0]


def test_time_and_gain_of_exif(tmp_path):
    tags = ImageFileDirectory_v2()
    tags[0x8769] = {0x829A: IFDRational(1, 4), 0x8827: 200}
    Image.new("I;16", (5, 4)).save(tmp_path / "a.tif", tiffinfo=tags)
    metadata = open_spectral_file(tmp_path / "a.tif").metadata
    assert (metadata["exposure_s"], metadata["gain"]) == (0.25, 2)


def test_several_colour_pages_are_refused(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for _ in range(2):
            file.write(CUBE[..., :3], photometric="rgb", metadata=None)
    with pytest.raises(CaptureError, match="2 pages of 3 numbers a pixel; expected one page with all bands"):
        open_spectral_file(tmp_path / "a.tif")


@pytest.mark.parametrize("storage", STORAGE)
@pytest.mark.parametrize("arrangement", ARRANGEMENTS)
def test_a_file_that_is_cut_short_is_refused(tmp_path, arrangement, storage):
    path = write(tmp_path / "cube.tif", arrangement, storage)
    for share in (0.9, 0.5, 0.1, 0.001):
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * share)])
        with pytest.raises(CaptureError, match=r"cube.tif: "):
            open_spectral_file(path).read()


def test_the_first_rows_of_a_compressed_file_are_read_without_the_rest(tmp_path):
    path = write(tmp_path / "cube.tif", "chunky", "deflated strips")
    file = open_spectral_file(path)
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as opened:
        page = opened.pages[0]
        start, count = page.dataoffsets[2], page.databytecounts[2]
        data[start : start + count] = bytes(count)
    path.write_bytes(data)
    np.testing.assert_array_equal(file.read(slice(0, 18)), CUBE[:18])
    with pytest.raises(CaptureError, match="can't be read"):
        file.read(slice(18, 19))


def test_a_file_of_many_gigabytes_opens_at_once(tmp_path):
    path = tmp_path / "big.tif"
    options = {"bigtiff": True, "photometric": "minisblack", "planarconfig": "contig"}
    tifffile.memmap(path, shape=(20000, 10000, 60), dtype=np.uint16, **options)
    file = open_spectral_file(path)
    assert file.shape == (20000, 10000, 60)
    assert file.read(slice(19999, 20000), slice(58, 60)).shape == (1, 10000, 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"photometric": "miniswhite"}, "whose numbers grow with darkness"),
        (
            {"photometric": "palette", "colormap": np.zeros((3, 256), np.uint16)},
            "places in a table of colours",
        ),
        ({"photometric": "cfa", "extratags": [(33421, "H", 2, (2, 2)), (33422, "B", 4, b"\0\1\1\2")]}, "CFA"),
    ],
)
def test_pages_whose_numbers_are_no_light_are_refused(tmp_path, options, message):
    with pytest.raises(CaptureError, match=message):
        written(tmp_path, CUBE[..., 0].astype(np.uint8), planarconfig=None, **options)
    with pytest.raises(CaptureError, match="colour space of the eye"):
        written(tmp_path, CUBE[..., :3].astype(np.uint8), photometric="cielab")


def test_colours_that_may_be_a_pictures_are_questioned_unless_they_have_wavelengths(tmp_path):
    colours = CUBE[..., :3].astype(np.uint8)
    assert (
        "red, green and blue are taken as light, as stored"
        in written(tmp_path, colours, photometric="rgb").warnings[0]
    )
    tag = (42112, "s", 0, GDAL.format(items("wavelength", NM[:3])), True)
    assert not written(tmp_path, colours, photometric="rgb", extratags=[tag]).warnings


def test_lists_of_gdal_for_the_whole_file(tmp_path):
    entries = {"wavelength": NM, "fwhm": [5, 5, 5, 5, 5, 6], "bbl": [1, 1, 0, 1, 1, 1]}
    text = "".join(
        f'<Item name="{name}">{{{", ".join(map(str, own))}}}</Item>' for name, own in entries.items()
    )
    file = written(tmp_path, CUBE, extratags=[(42112, "s", 0, GDAL.format(text), True)])
    np.testing.assert_array_equal(centres_nm(file), NM)
    np.testing.assert_array_equal(widths_nm(file), entries["fwhm"])
    assert file.bands.bad is not None
    assert file.bands.bad.tolist() == [False, False, True, False, False, False]


def test_labels_of_imagej_and_names_of_pages_are_wavelengths(tmp_path):
    labels = [f"{nm} nm" for nm in NM]
    tifffile.imwrite(tmp_path / "a.tif", PLANES, imagej=True, metadata={"axes": "CYX", "Labels": labels})
    np.testing.assert_array_equal(centres_nm(open_spectral_file(tmp_path / "a.tif")), NM)
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        for plane, label in zip(PLANES, labels, strict=True):
            file.write(plane, metadata=None, extratags=[(285, "s", 0, f"filter {label}", True)])
    np.testing.assert_array_equal(centres_nm(open_spectral_file(tmp_path / "b.tif")), NM)


def test_a_geo_reference_is_told(tmp_path):
    tags = [(33550, "d", 3, (2.0, 2.0, 0.0), True), (33922, "d", 6, (0.0, 0.0, 0.0, 5e5, 4.5e6, 0.0), True)]
    assert written(tmp_path, CUBE, extratags=tags).metadata["geo_reference"] == "GeoTIFF"
    assert "geo_reference" not in written(tmp_path, CUBE).metadata


def test_the_orientation_of_a_page_is_told(tmp_path):
    assert written(tmp_path, CUBE, extratags=[(274, "H", 1, 6, True)]).metadata["orientation"] == 6
    assert "orientation" not in written(tmp_path, CUBE, extratags=[(274, "H", 1, 1, True)]).metadata


def test_numbers_that_are_not_real_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="the image holds complex64; expected real numbers"):
        written(tmp_path, CUBE.astype(np.complex64))
