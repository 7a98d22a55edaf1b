"""TIFF images: against what tifffile decodes as a whole, in every arrangement of bands."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from tests.factories.files import (
    check_file,
    gdal_items,
    gdal_tag,
    present,
    rows_and_bands_of,
    warnings_of,
    xmp_packet,
)
from unmix_plugin.captures import numbers
from unmix_plugin.captures.calibration.references import find_missing
from unmix_plugin.captures.cube import Cube, ReadOptions
from unmix_plugin.captures.readers.opening import open_spectral_file
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


def written(folder: Path, image: np.ndarray, name: str = "a.tif", **options: Any) -> Cube:
    """An image as tifffile writes it, opened; bands beside each other in each pixel unless options say otherwise."""
    given: dict[str, Any] = {"photometric": "minisblack"}
    given |= {} if "metadata" in options or image.ndim == 2 else {"planarconfig": "contig"}
    tifffile.imwrite(folder / name, image, **given | options)
    return open_spectral_file(folder / name)


@pytest.mark.parametrize("storage", STORAGE)
@pytest.mark.parametrize("arrangement", ARRANGEMENTS)
def test_rows_and_bands_are_those_of_the_image(tmp_path, arrangement, storage):
    image, options = ARRANGEMENTS[arrangement]
    file = written(tmp_path, image, **options, **STORAGE[storage])
    check_file(file, reader="tiff", interleave="bip" if arrangement == "chunky" else "bsq")
    rows_and_bands_of(file, CUBE)
    np.testing.assert_array_equal(file.read(slice(13, 41), np.array([4, 0])), CUBE[13:41][..., [4, 0]])


def test_a_picture_written_by_pillow_has_one_band_or_three(tmp_path):
    rgb = (CUBE[..., :3] // 256).astype(np.uint8)
    Image.fromarray(rgb).save(tmp_path / "rgb.tif", compression="tiff_lzw")
    Image.fromarray(CUBE[..., 0]).save(tmp_path / "grey.tif")
    check_file(open_spectral_file(tmp_path / "rgb.tif"), values=rgb)
    check_file(open_spectral_file(tmp_path / "grey.tif"), values=CUBE[..., :1])


def test_stacks_of_imagej_with_one_entry_for_all_pages(tmp_path):
    rows_and_bands_of(written(tmp_path, PLANES, imagej=True, metadata={}), CUBE)
    tifffile.imwrite(tmp_path / "b.tif", PLANES, truncate=True)
    check_file(open_spectral_file(tmp_path / "b.tif"), values=CUBE)


def test_rows_as_pages_are_recognised_by_the_number_of_wavelengths_or_said(tmp_path):
    file = written(tmp_path, CUBE, metadata={"wavelengths": NM})
    with tifffile.TiffFile(tmp_path / "a.tif") as opened:
        assert len(opened.pages) == 70
    rows_and_bands_of(file, CUBE)
    check_file(file, nm=NM)
    check_file(written(tmp_path, CUBE, "b.tif", metadata=None), warning="axis 2 is the shortest")
    rows_and_bands_of(open_spectral_file(tmp_path / "b.tif", ReadOptions(axes="yxb")), CUBE)
    turned = open_spectral_file(tmp_path / "b.tif", ReadOptions(axes="xyb"))
    check_file(turned, values=CUBE.transpose(1, 0, 2))


def gdal(*entries: str, **options: Any) -> dict[str, Any]:
    """Options that write GDAL's entries."""
    return {"extratags": gdal_tag(*entries)} | options


def whole(name: str, value: object) -> str:
    """An entry of the whole file."""
    return f'<Item name="{name}">{value}</Item>'


def described(text: str) -> dict[str, Any]:
    return {"description": text, "metadata": None}


NM, WIDE_NM, UM = [*range(400, 460, 10)], [*range(400, 1000, 100)], [0.4, 0.5, 0.6, 0.7, 0.8, 0.9]
RED_EDGE = {"Camera:BandName": "Red edge", "Camera:CentralWavelength": "717", "Camera:WavelengthFWHM": "10"}
PACKET = xmp_packet(RED_EDGE)
XMP = {"image": PLANES[0], "extratags": [(700, "B", len(PACKET), PACKET, True)], "metadata": None}
EXIF = [(33434, "2I", 1, (1, 4), True), (34855, "H", 1, 200, True), (33437, "2I", 1, (28, 10), True)]
EXIF_OF_GDAL = [whole("EXIF_ISOSpeedRatings", 200), whole("EXIF_FNumber", "(2.8) ")]
EXIF_OF_GDAL += [whole("EXIF_ExposureTime", "(0.25)")]
EXPOSED = {"exposure_s": 0.25, "gain": 2.0, "f_number": 2.8}
TIMES = [0.01, 0.02, 0.03, 0.04, 0.05, 0.06]
COLOURS, OPAQUE = CUBE[..., :3].astype(np.uint8), CUBE[..., :4].copy()
AS_RGB = {"image": COLOURS, "photometric": "rgb"}
WIDTHS, GOOD = [5, 5, 5, 5, 5, 6], [1, 1, 0, 1, 1, 1]
PLACES = [(33550, "d", 3, (2.0, 2.0, 0.0)), (33922, "d", 6, (0.0, 0.0, 0.0, 5e5, 4.5e6, 0.0))]
SCALE = gdal_items("SCALE", [1e-4] * 6, ' role="scale"')
OFFSET = gdal_items("OFFSET", [0] * 6, ' role="offset"')
TRIPLED = gdal_items("SCALE", [3] * 6, ' role="scale"')
IN_UM = gdal_items("wavelength_units", ["Micrometers"] * 6)
LISTED = "400, 410, 420, 430, 440, 450"
NO_DATA = (42113, "s", 0, "65535", True)
NAMED = gdal_items("DESCRIPTION", [f"B{nm % 7} ({nm} nm)" for nm in NM], ' role="description"')
GAIN, TINT, TIME = whole("gain", 4), whole("tint", 10), whole("exposure_ms", 10)
SAID: list[tuple[dict[str, Any], dict[str, Any]]] = [
    (gdal(gdal_items("wavelength", NM)), {"nm": NM, "notes": ()}),
    (gdal(gdal_items("wavelength", UM), IN_UM), {"nm": WIDE_NM}),
    (gdal(gdal_items("CENTRAL_WAVELENGTH_UM", UM, ' domain="IMAGERY"')), {"nm": WIDE_NM}),
    (gdal(NAMED), {"nm": NM}),
    (gdal(*(whole(f"Band_{i}", f"{nm} Nanometers") for i, nm in enumerate(NM, start=1))), {"nm": NM}),
    (gdal(whole("wavelength", NM), whole("fwhm", WIDTHS)), {"nm": NM, "fwhm": WIDTHS}),
    (gdal(whole("wavelength", NM), whole("bbl", GOOD)), {"nm": NM, "bad": [2]}),
    ({"extratags": [*gdal_tag(OFFSET, SCALE), NO_DATA]}, {"scale": 10000.0, "no_data": (65535,)}),
    *(
        (described(text), {"nm": NM, "evidence": "image description"})
        for text in (
            json.dumps({"wavelengths_nm": NM}),
            json.dumps({"wavelengths_nm": NM, "bands": [{"name": "red"}]}),
            json.dumps({"sensor": {"wavelengths": NM}, "bands": [{"name": "red"}]}),
            json.dumps({"note": f"wavelengths (nm): {LISTED}"}),
            json.dumps({"Wavelength": [0.4, 0.41, 0.42, 0.43, 0.44, 0.45], "wavelength_units": "um"}),
            f"camera: x\nwavelengths (nm): {LISTED}\nshutter: 3",
            f"wavelength = {{{LISTED}}}",
            "wavelengths: 400 nm, 410 nm, 420 nm, 430 nm, 440 nm, 450 nm",
            "wavelengths: 400nm 410nm 420nm 430nm 440nm 450nm",
            f"wavelengths = nm: {LISTED}",
            f"Wavelengths in nm: {LISTED}",
            f"wavelength [nm] = {LISTED}",
            f"wavelength_units = nanometers\nwavelengths = {LISTED}",
            "wavelengths: 0.4 um, 0.41 um, 0.42 um, 0.43 um, 0.44 um, 0.45 um",
            "wavelength units: um; wavelengths: 0.4, 0.41, 0.42, 0.43, 0.44, 0.45",
        )
    ),
    (XMP, {"nm": [717], "fwhm": [10], "names": ["Red edge"]}),
    ({"extratags": [(274, "H", 1, 6, True)]}, {"orientation": 6, "values": CUBE}),  # which is not followed
    ({"extratags": [(274, "H", 1, 1, True)]}, {"orientation": 1, "is_geotiff": False}),
    ({"extratags": PLACES}, {"geo_reference": "GeoTIFF"}),
    (AS_RGB | {"image": OPAQUE, "extrasamples": ["unassalpha"]}, {"values": OPAQUE, "warning": "as opacity"}),
    (AS_RGB, {"values": COLOURS, "warning": "red, green and blue are taken as light, as stored"}),
    (gdal(gdal_items("wavelength", NM[:3]), **AS_RGB), {"warnings": ()}),
    ({"image": CUBE.astype("i2"), "extratags": EXIF}, EXPOSED),
    (gdal(*EXIF_OF_GDAL), EXPOSED),
    (gdal(gdal_items("EXIF_ExposureTime", TIMES)), {"exposure_s": TIMES, "gain": None}),
    (gdal(GAIN, TIME), {"linear": None, "exposure_s": 0.01, "gain": 4.0}),
    (gdal(GAIN, whole("offset", 2)), {"calibrated": CUBE * 4.0 + 2}),
    (gdal(SCALE.replace("</Item>", "", 1)), {"linear": None, "warning": "GDAL's metadata in the file is d"}),
    # A gain that is applied is not of the camera, too.
    (gdal(gdal_items("gain", [4] * 6), TIME), {"calibrated": CUBE * 4.0, "exposure_s": 0.01, "gain": None}),
    (  # of a band without its own, nobody knows it
        gdal(gdal_items("scale", [0.5] * 3, ' role="scale"')),
        {"warning": "'scale' is stated of 3 of 6 bands: that of the others is taken for 1"},
    ),
    (gdal(GAIN, TRIPLED, TINT), {"calibrated": CUBE * 3.0, "exposure_s": 0.01, "gain": 4.0}),
]


@pytest.mark.parametrize(("options", "expected"), SAID)
def test_what_tags_say_of_the_image_is_used(tmp_path, options, expected):
    check_file(written(tmp_path, **({"image": CUBE} | options)), **expected)


def test_wavelengths_of_a_description_in_several_units_are_refused(tmp_path):
    text = "wavelengths (um): 400 nm, 410 nm, 420 nm, 430 nm, 440 nm, 450 nm"
    with pytest.raises(CaptureError, match=r"wavelengths in several units \(um, nm\)"):
        written(tmp_path, CUBE, **described(text))


@pytest.mark.parametrize(("first", "nm"), [(1, np.arange(400, 520, 10)), (0, None), (2, None)])
def test_numbered_bands_of_gdal_go_by_their_numbers_from_1(tmp_path, first, nm):
    numbered = sorted(f'<Item name="Band_{first + i}">{400 + 10 * i} Nanometers</Item>' for i in range(12))
    assert ["Band_10" in item for item in numbered].index(True) < 3  # GDAL lists it before Band_2
    file = written(tmp_path, np.tile(CUBE, (1, 1, 2)), extratags=gdal_tag(*numbered))
    check_file(file, nm=nm)


def test_wavelengths_of_ome_and_of_pages_by_their_descriptions_labels_and_names(tmp_path):
    labels = [f"{nm} nm" for nm in NM]
    channels = {"EmissionWavelength": NM, "EmissionWavelengthUnit": ["nm"] * 6}
    metadata = {"axes": "CYX", "Channel": channels}
    tifffile.imwrite(tmp_path / "a.ome.tif", PLANES, photometric="minisblack", metadata=metadata)
    tifffile.imwrite(tmp_path / "b.tif", PLANES, imagej=True, metadata={"axes": "CYX", "Labels": labels})
    with tifffile.TiffWriter(tmp_path / "c.tif") as named, tifffile.TiffWriter(tmp_path / "d.tif") as told:
        for plane, label in zip(PLANES, labels, strict=True):
            named.write(plane, metadata=None, extratags=[(285, "s", 0, f"filter {label}", True)])
            told.write(plane, metadata=None, description=f"filter {label}")
    with tifffile.TiffWriter(tmp_path / "e.tif") as each:
        for plane, nm in zip(PLANES, NM, strict=True):
            each.write(plane, metadata=None, description=f"exposure = 20\nwavelength = {nm:g}")
    for path in sorted(tmp_path.iterdir()):
        check_file(open_spectral_file(path), nm=NM, values=CUBE)


@pytest.mark.parametrize("below", [False, True])
def test_previews_and_pages_of_other_sizes_are_left_out(tmp_path, below):
    """Also a preview that is not marked as one."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        preview = (255 * CUBE[::2, ::2, :3] / CUBE.max()).astype(np.uint8)
        file.write(preview, photometric="rgb", subifds=1 if below else 0, metadata=None)
        file.write(CUBE, photometric="minisblack", planarconfig="contig", metadata=None)
        file.write(PLANES[0, ::2, ::2], subfiletype=1, metadata=None)
    check_file(open_spectral_file(tmp_path / "a.tif"), values=CUBE, warning="left out: 1 of 35 x 25 x 3")


def test_a_damaged_strip_is_an_error_of_the_rows_that_it_has(tmp_path, monkeypatch):
    monkeypatch.setattr(numbers, "_PIECE_BYTES", 1)
    file, path = written(tmp_path, CUBE, **STORAGE["deflated strips"]), tmp_path / "a.tif"
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as opened:
        page = opened.pages[0]
        start, count = page.dataoffsets[2], page.databytecounts[2]
        data[start : start + count] = bytes(count)
    path.write_bytes(data)
    np.testing.assert_array_equal(file.read(slice(0, 18)), CUBE[:18])
    with pytest.raises(CaptureError, match="can't be read"):
        file.read(slice(18, 19))


@pytest.mark.parametrize(
    ("dtype", "stated", "no_data", "is_told"),
    [
        ("f4", "-9999", (-9999,), False),
        ("f4", None, (), True),
        ("u2", "65535", (65535,), False),
        ("u2", "-9999", (-9999, 0), True),
        ("u2", None, (0,), True),
    ],
)
@pytest.mark.parametrize("compression", ["zlib", None])
def test_tiles_that_are_left_out_in_the_file_are_missing(
    tmp_path, dtype, stated, no_data, is_told, compression
):
    """As GDAL leaves them out (GTiff driver, sparse files)."""
    image = (CUBE[:64, :48] + 1).astype(dtype)
    corners = [(y, x) for y in (0, 32) for x in (0, 16, 32)]
    tiles = (
        None if corner == (32, 16) else image[corner[0] :, corner[1] :][:32, :16, band]
        for band in range(6)
        for corner in corners
    )
    tags = [] if stated is None else [(42113, "s", 0, stated, True)]
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        options: dict[str, Any] = {"photometric": "minisblack", "planarconfig": "separate", "tile": (32, 16)}
        file.write(tiles, shape=(6, 64, 48), dtype=dtype, compression=compression, extratags=tags, **options)
    opened = open_spectral_file(tmp_path / "a.tif")
    missing = find_missing(opened.read(), opened)
    assert (opened.no_data, missing[32:, 16:32].all(), missing.sum()) == (no_data, True, 32 * 16)
    np.testing.assert_array_equal(opened.read()[~missing], image[~missing])
    assert any("6 blocks of the image left out" in text for text in warnings_of(opened)) == is_told


@pytest.mark.parametrize("options", [{}, {"compression": "zlib", "tile": (16, 32)}])
@pytest.mark.parametrize("dtype", [bool, np.uint8])
def test_pixels_of_0_in_a_mask_of_the_file_are_missing(tmp_path, dtype, options):
    """As GDAL writes internal masks: of one bit, or of 0 and 255."""
    mask = np.random.default_rng(0).random((70, 50)) < 0.5
    stored = mask if dtype is bool else 255 * mask.astype(np.uint8)
    planes: dict[str, Any] = {"photometric": "minisblack", "planarconfig": "separate", "metadata": None}
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(PLANES, **planes)
        file.write(stored, subfiletype=1, photometric="minisblack", metadata=None, **options)
        file.write(stored[::2, ::2], subfiletype=1, photometric="minisblack", metadata=None)
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        for page, kind in zip(file.pages[1:], (4, 5), strict=True):  # tifffile writes masks of one bit alone
            present(page.tags.get(254)).overwrite(kind)
            present(page.tags.get(262)).overwrite(4)
    opened = open_spectral_file(tmp_path / "a.tif")
    check_file(opened, values=CUBE, note="where the mask in page 1 is 0 count as not measured", warnings=())
    np.testing.assert_array_equal(find_missing(opened.read(), opened), ~mask)
    rows, bands = slice(11, 60), np.array([3])
    np.testing.assert_array_equal(find_missing(opened.read(rows, bands), opened, rows, bands), ~mask[rows])


@pytest.mark.parametrize("bands", [1, 6])
def test_pixels_of_0_in_a_mask_beside_the_file_are_missing(tmp_path, bands):
    mask = np.random.default_rng(0).choice(np.array([0, 255], np.uint8), (*CUBE.shape[:2], bands))
    beside: dict[str, Any] = {"photometric": "minisblack"} | ({"planarconfig": "contig"} if bands > 1 else {})
    tifffile.imwrite(tmp_path / "a.tif.msk", mask[..., 0] if bands == 1 else mask, **beside)
    file = written(tmp_path, CUBE)
    check_file(file, values=CUBE, note="where a.tif.msk is 0 count as not measured", warnings=())
    np.testing.assert_array_equal(find_missing(file.read(), file), (mask == 0).any(axis=-1))
    rows, wanted = slice(5, 30), np.array([4, 2])
    expected = mask[rows][..., wanted if bands > 1 else slice(None)] == 0
    found = find_missing(file.read(rows, wanted), file, rows, wanted)
    np.testing.assert_array_equal(found, expected.any(axis=-1))
    tifffile.imwrite(tmp_path / "a.tif.msk", mask[1:, :, 0], photometric="minisblack")
    check_file(written(tmp_path, CUBE), warning="the mask a.tif.msk has 69 x 50", masks=())


def test_a_plain_page_that_is_left_out_in_the_file_is_missing(tmp_path):
    planes = PLANES.astype("f4")
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for plane in planes:
            file.write(plane, photometric="minisblack", metadata=None)
    data = bytearray((tmp_path / "a.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        for code in (273, 279):  # where its strip begins, and its length
            start = file.pages[2].tags[code].valueoffset
            data[start : start + 4] = bytes(4)
    (tmp_path / "a.tif").write_bytes(data)
    opened = open_spectral_file(tmp_path / "a.tif")
    planes[2] = np.nan
    check_file(opened, values=planes.transpose(1, 2, 0), warning="1 block of the image left out")


BYTES = CUBE[..., 0].astype(np.uint8)
PALETTE = {"photometric": "palette", "colormap": np.zeros((3, 256), np.uint16)}
MOSAIC = {"photometric": "cfa", "extratags": [(33421, "H", 2, (2, 2)), (33422, "B", 4, b"\0\1\1\2")]}


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (BYTES, {"photometric": "miniswhite"}, "whose numbers grow with darkness"),
        (BYTES, PALETTE, "places in a table of colours"),
        (BYTES, MOSAIC, "CFA"),
        (COLOURS, {"photometric": "cielab"}, "colour space of the eye"),
        (
            np.stack([COLOURS] * 2),
            {"photometric": "rgb"},
            "2 pages of 3 numbers per pixel; expected one page",
        ),
        (CUBE.astype(np.complex64), {}, "the image holds complex64; expected real numbers"),
    ],
)
def test_pages_whose_numbers_are_no_light_are_refused(tmp_path, image, options, message):
    with pytest.raises(CaptureError, match=message):
        written(tmp_path, image, **options)
