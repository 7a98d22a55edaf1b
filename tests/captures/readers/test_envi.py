"""ENVI images: headers as programs write them, against SPy and by hand."""

import re
import warnings
from typing import Any

import numpy as np
import pytest
import spectral.io.envi as spy
import tifffile

from tests.factories.files import AXES, check_file, header_text, present, rows_and_bands_of, write_envi
from unmix_plugin.captures.cube import ReadOptions
from unmix_plugin.captures.layouts.cubes import find_cubes
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.errors import CaptureError

CUBE = np.random.default_rng(0).integers(0, 200, (5, 7, 4))
STORED = CUBE.transpose(AXES["bil"]).tobytes()
NM = [400, 500, 600, 700]


@pytest.mark.parametrize("interleave", AXES)
@pytest.mark.parametrize(
    "dtype", ["u1", "<i2", ">i2", "<i4", ">f4", "<f8", "<u2", ">u2", "<u4", "<i8", ">u8"]
)
def test_numbers_are_those_that_spy_reads(tmp_path, interleave, dtype):
    header = write_envi(tmp_path / "cube.hdr", CUBE.astype(dtype), interleave)
    file = open_spectral_file(header)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image: Any = spy.open(str(header))
        np.testing.assert_array_equal(file.read(), np.asarray(image.load(dtype=np.float64)))
    assert file.interleave == interleave
    rows_and_bands_of(file, CUBE.astype(dtype))


def test_files_of_spy_are_read(tmp_path):
    cube = np.random.default_rng(1).random((6, 3, 5)).astype(np.float32)
    entries = {
        "wavelength": [0.45, 0.5, 0.55, 0.6, 0.7],
        "fwhm": [0.01] * 5,
        "wavelength units": "Micrometers",
    }
    spy.save_image(str(tmp_path / "cube.hdr"), cube, metadata=entries, interleave="bil")
    file = open_spectral_file(tmp_path / "cube.img")
    check_file(file, values=cube, nm=[450, 500, 550, 600, 700], fwhm=10, evidence="'wavelength', Micrometers")
    check_file(file, files=(tmp_path / "cube.hdr", tmp_path / "cube.img"))


def test_a_header_as_headwall_and_plantcv_write_it(tmp_path):
    text = """ENVI
; made by hand
description = {[CAMERA {1}]
  wavelength = nothing}
samples = 7
lines=5 ; rows
bands = 4
data type = 12
interleave = BIL
file type = ENVI
wavelength units = nm
wavelength = {
400.5
,410
;,415
,420,
430 }
bbl = {1,0,1,1}
reflectance scale factor = 10000
data ignore value = 65535
;AOI height = 1008
"""
    (tmp_path / "cube.hdr").write_text(text)
    (tmp_path / "cube").write_bytes(CUBE.astype("<u2").transpose(AXES["bil"]).tobytes())
    file = open_spectral_file(tmp_path / "cube")
    check_file(file, values=CUBE, nm=[400.5, 410, 420, 430], bad=[1], scale=10000, no_data=(65535,))
    check_file(file, path=tmp_path / "cube.hdr", warnings=(NO_BYTE_ORDER,))


NO_BYTE_ORDER = "the header has no byte order; taken as little-endian"
UNIT = "wavelength units = "
NO_UNIT = {"nm": NM, "evidence": "no unit: 400 to 700 taken as nm"}
RANGES = {"nm": NM, "fwhm": [20, 20, 40, 100], "evidence": "ranges with the unit um"}
SAID: dict[str, dict[str, Any]] = {
    "wavelength = {0.4, 0.5, 0.6, 2.5}": {"nm": [400, 500, 600, 2500], "evidence": "as micrometres"},
    "wavelength = {400, 500, 600, 700}": NO_UNIT,
    "wavelength = {400 500\n600\n700}": NO_UNIT,
    f"{UNIT}Micrometers\nwavelength = {{.4,.5,.6,.7}}": {"nm": NM, "evidence": "Micrometers"},
    "wavelength = {8, 9, 10, 11}": {"nm": [8000, 9000, 10_000, 11_000]},
    f"{UNIT}um\nwavelength = {{1, 2, 3, 4}}": {"nm": [1000, 2000, 3000, 4000]},
    "band names = {a (400 nm), b 500 nm, 600 nm, 700nm}": {"nm": NM, "evidence": "a (400 nm)"},
    "band names = {400 nm, 500 nm, 600 nm, 700 nm}\nfwhm = {5, 5, 5, 6}": {"nm": NM, "fwhm": [5, 5, 5, 6]},
    f"{UNIT}um\nband names = {{400 nm, 500 nm, 600 nm, 700 nm}}\nfwhm = {{.005, .005, .005, .006}}": {
        "nm": NM,
        "fwhm": [5, 5, 5, 6],
    },
    "band names = {a, b, c, d}\nfwhm = {5, 5, 5, 6}": {
        "nm": None,
        "fwhm": None,
        "warning": "FWHM are left out, as",
    },
    "band names = {0.4 um, 0.5 um, 0.6 um, 0.7 um}": {"nm": NM, "evidence": "unit um"},
    "band names = {A (0.39-0.41 um), B (0.49-0.51 um), C (0.58-0.62 um), D (0.65-0.75 um)}": RANGES,
    "band names = {Blue-390-410nm, 490\u2013510 nm, 580nm to 620nm, 0.65 - 0.75 um}": {"nm": NM},
    "band names = {A 400±16 nm, B 500 +/- 9 nm, 600(+/-9)nm, 700 nm ± 9 nm}": {"nm": NM, "fwhm": None},
    "band names = {2021-05-400nm, view-450-500nm, img_1-600nm, 0650-700 nm}": {"nm": NM},
    "band names = {300-400nm, 301-500nm, 302-600nm, 303-700nm}": {"nm": NM, "fwhm": None},
    "band names = {400, 500, 600, 700}": {"nm": NM, "evidence": "increase and are taken as nm"},
    "band names = {520-450 nm, 600-530 nm, 680-610 nm, 760-690 nm}": {"nm": None},
    "band names = {1 nm, 2 nm, 3 nm, 4 nm}": {"nm": None},
    "band names = {Band 201, Band 202, Band 203, Band 204}": {"nm": None},
    "band names = {400 cm-1, 500 cm-1, 600 cm-1, 700 cm-1}": {"nm": None},
    "band names = {grain 350um, grain 450um, grain 550um, grain 650um}": {"nm": None},
    "band names = {400_200ms, 500_300ms, 600 2THz, 700_400 \u00b5s}": {"nm": NM},
    "band names = {a, b, c, d}": {"nm": None, "names": "abcd"},
    "band names = {450 nm, 460 nm, red, 480 nm}": {"nm": None},
    "data ignore value = -9999 ; none measured": {"no_data": (-9999,)},
    "data ignore value = {-9999, 0}": {"no_data": (-9999, 0), "warnings": ()},
    "radiance scale factor = 500": {"linear": None, "warning": "'radiance scale factor' is 500: not applied"},
    "scale factor = {1.0}": {"linear": None, "warnings": ()},
    "data ignore value = unset": {"warning": "'data ignore value' is unset, no number: not used"},
    "sensor type = a\nsensor type = b\nwavelength = {400, 500, 600, 700}": {"nm": NM},
    "; by hand\n\nscale factor: 10000": {
        "warning": "1 line of the header not read for want of '=': 'scale f"
    },
}
LEFT_OUT = {
    "wavelength = {400, 500, 600}": "are left out: 3 for 4 bands",
    "wavelength = {400, nan, 600, 700}": "that of band 1 (from 0) is nan",
    "wavelength = {400, x, 600, 700}": "are not a list of numbers",
    "wavelength = {1, 2, 3, 40}": "with no unit can't be brought to nm",
    "wavelength = {1, 2, 3, 4}": "1 to 4 with no unit count the bands",
    "wavelength = {0, 1, 2, 3}": "0 to 3 with no unit count the bands",
    f"{UNIT}Index\nwavelength = {{1, 2, 3, 4}}": "unit 'Index' can't be",
    f"{UNIT}Micrometers\nwavelength = {{400, 500, 600, 700}}": "can't be in Micrometers",
    f"{UNIT}nm\nwavelength = {{.4, .5, .6, .7}}": "can't be in nm",
}
FINE = f"{UNIT}nm\nwavelength = {{500, 510, 520, 530}}\nfwhm = "
IN_UM = f"{UNIT}Micrometers\nwavelength = {{.5, .51, .52, .53}}\nfwhm = "
WIDTHS = {
    FINE + "{.0055, .0055, .0055, .0055}": "taken as micrometres",
    IN_UM + "{5.5, 5.5, 5.5, 5.5}": "5.5 to 5.5 taken as nm",
}
NO_WIDTHS = {
    FINE + "{900, 5.5, 5.5, 5.5}": "FWHM are left out: they would be 5.5 to 900 nm",
    FINE + "{0, 5.5, 5.5, 5.5}": "FWHM are left out: they go down to 0",
    FINE + "{.00005, 5.5, 5.5, 5.5}": "FWHM are left out: they would be 5e-05 to 5.5 nm",
}


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        *SAID.items(),
        *((text, {"nm": None, "warning": said}) for text, said in LEFT_OUT.items()),
        *((text, {"fwhm": 5.5, "warning": said}) for text, said in WIDTHS.items()),
        *((text, {"fwhm": None, "warning": said}) for text, said in NO_WIDTHS.items()),
    ],
)
def test_what_a_header_says_of_bands_is_used_or_left_out_with_a_reason(tmp_path, entries, expected):
    check_file(open_spectral_file(write_envi(tmp_path / "cube.hdr", CUBE, "bsq", entries)), **expected)


def test_dark_lines_at_the_end_are_no_image_but_its_dark_frame(tmp_path):
    """Specim's autodarkstartline is the first line with the shutter closed, from 0."""
    file = open_spectral_file(write_envi(tmp_path / "a.hdr", CUBE, "bil", "autodarkstartline = 3"))
    check_file(file, values=CUBE[:3], note="taken with the shutter closed", dark_lines=2)
    rows_and_bands_of(present(file.dark), CUBE[3:])
    tifffile.imwrite(tmp_path / "b.tif", CUBE, metadata=None, photometric="minisblack", planarconfig="contig")
    (tmp_path / "b.hdr").write_text(header_text(CUBE, "bip", {"autodarkstartline": "4", "file type": "TIFF"}))
    file = open_spectral_file(tmp_path / "b.tif")
    check_file(file, reader="tiff", values=CUBE[:4])
    check_file(present(file.dark), values=CUBE[4:])
    for text in ("0", "0.5", "5", "3000", "-1", "{2, 3}"):  # none are there
        file = open_spectral_file(write_envi(tmp_path / "c.hdr", CUBE, "bsq", f"autodarkstartline = {text}"))
        check_file(file, values=CUBE, dark=None)
    file = open_spectral_file(write_envi(tmp_path / "c.hdr", CUBE, "bsq", "autodarkstartline = none"))
    check_file(file, values=CUBE, warning="'autodarkstartline' is none, no number")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_headers_in_the_encodings_and_lists_of_other_programs(tmp_path, encoding):
    header = write_envi(tmp_path / "a.hdr", CUBE, "bil")
    more = "sensor = Größe [m\nwavelength_units = nm\nwavelength = [ 400 500\n   600 700]\nbbl = [1 0 1 1]\n"
    header.write_bytes((header.read_text() + more).encode(encoding))
    check_file(open_spectral_file(header), nm=NM, bad=[1], values=CUBE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"interleave": "bup"}, "'interleave' is 'bup'; expected bsq, bil or bip"),
        ({"interleave": None}, "'interleave' is missing"),
        ({"data type": "6"}, "complex"),
        ({"data type": "7"}, r"'data type' is 7; expected one of 1 \(uint8\)"),
        ({"data type": None}, "'data type' is missing; expected a whole number"),
        ({"samples": "0"}, "'samples' is 0; expected a whole number of at least 1"),
        ({"lines": "-5"}, "'lines' is -5"),
        ({"bands": "many"}, "'bands' is many"),
        ({"bands": "9" * 5000}, "'bands' is 9"),
        ({"samples": "1e400"}, "'samples' is 1e400; expected a whole number"),
        ({"header offset": "nan"}, "'header offset' is nan; expected a whole number"),
        ({"byte order": "2"}, "'byte order' is 2; expected 0"),
        ({"header offset": "1.5"}, "'header offset' is 1.5"),
        ({"file compression": "1"}, "compressed"),
        ({"file type": "ENVI Classification"}, "numbers of classes .* no light"),
        ({"file type": "ENVI Spectral Library"}, "library of spectra; expected an image"),
        ({"major frame offsets": "{0, 8}"}, "'major frame offsets' is 0, 8"),
        ({"lines": "6"}, "cut short: 280 bytes; cube.hdr promises 336"),
        ({"lines": "1000000000"}, "cut short"),
        ({"header offset": "4"}, "promises 284"),
        ({"wavelength": "{1, 2"}, "the list of 'wavelength' is never closed"),
        (
            {"wavelength": "{1, 2, 3, 4}\nwavelength = {2, 3, 4, 5}"},
            r"cube\.hdr: 'wavelength' is there twice",
        ),
        ({"data gain values": "{1, 2}"}, "'data gain values' gives 2 gains for 4 bands"),
        ({"data gain values": "{1, 2, x, 1}"}, "'data gain values' has 'x'"),
        ({"data gain values": "{1, 0, 2, 1}"}, "gains from 0 to 2; expected finite numbers above 0"),
        ({"data gain values": "2\nreflectance scale factor = 10000"}, "it is unclear which the numbers need"),
        ({"reflectance scale factor": "10,000"}, "is 10,000; expected the stored number of full reflectance"),
        ({"reflectance scale factor": "{1, 2, 3, 4}"}, "is 1, 2, 3, 4; expected"),
        ({"reflectance scale factor": "0.0001"}, "is 0.0001; expected .* 1 or more"),
        ({"data offset values": "-1000\nreflectance scale factor = 10000"}, "an offset above 1"),
        ("BYTEORDER I\nNROWS 540\n", "header of an ESRI"),
        (bytes(range(256)).decode("latin-1"), "no ENVI header: its first line is not 'ENVI'.* Convert the"),
    ],
)
def test_headers_that_cannot_be_followed_are_refused(tmp_path, change, message):
    header = write_envi(tmp_path / "cube.hdr", CUBE.astype("<i2"), "bil")
    text = change if isinstance(change, str) else header_text(CUBE.astype("<i2"), "bil", change)
    header.write_text(text, encoding="latin-1", newline="")
    with pytest.raises(CaptureError, match=message):
        open_spectral_file(header)


@pytest.mark.parametrize(
    ("header", "files", "meant"),
    [
        ("cube.hdr", {"cube.RAW": STORED, "cube.dat": b"notes"}, "cube.RAW"),
        ("cube.hdr", {"cube.bil": STORED, "cube.bsq": bytes(len(STORED))}, "cube.bil"),
        ("cube.hdr", {"cube": STORED, "cube.bil": bytes(2 * len(STORED))}, "cube"),
        ("cube.raw.hdr", {"cube.raw": STORED}, "cube.raw"),
        ("cube.hdr", {"cube.img": STORED, "cube.bsq": STORED}, "cube.img and cube.bsq could each be what it"),
        ("cube.hdr", {"other.raw": STORED}, "no file of numbers beside this header; expected cube or"),
        ("cube.hdr", {"cube": b"\x1f\x8b\x08" + bytes(50)}, "cube: compressed with gzip; unpack it"),
    ],
)
def test_the_numbers_of_a_header_are_the_file_that_fits_it_best(tmp_path, header, files, meant):
    """A file of numbers that is named itself is meant in any case."""
    (tmp_path / header).write_text(header_text(CUBE, "bil", {}))
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    if meant not in files:
        with pytest.raises(CaptureError, match=re.escape(meant)):
            open_spectral_file(tmp_path / header)
    else:
        assert open_spectral_file(tmp_path / header).sources == (tmp_path / meant,)
        check_file(open_spectral_file(tmp_path / meant), values=CUBE)


def test_two_names_of_one_file_of_numbers_are_one_file(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", CUBE, "bsq")
    (tmp_path / "cube").rename(tmp_path / "cube.img")
    if not (tmp_path / "cube.IMG").exists():  # as on a disk that ignores case
        (tmp_path / "cube.IMG").hardlink_to(tmp_path / "cube.img")
    check_file(open_spectral_file(header), values=CUBE)


def test_a_file_that_is_cut_while_open_is_reported(tmp_path):
    file = open_spectral_file(write_envi(tmp_path / "cube.hdr", CUBE, "bip"))
    (tmp_path / "cube").write_bytes(b"")
    with pytest.raises(CaptureError, match="the file was cut"):
        file.read()


def test_the_header_beside_a_tiff_describes_it(tmp_path):
    cube = CUBE.astype("<u2")
    tifffile.imwrite(tmp_path / "a.tif", cube, planarconfig="contig", photometric="minisblack")
    more = "file type = TIFF\nbbl = {1, 0, 1, 1}\ntint = 5\nwavelength = {400, 500, 600, 700}\n"
    (tmp_path / "a.hdr").write_text(header_text(cube, "bip", {}) + more)
    for name in ("a.tif", "a.hdr"):
        file = open_spectral_file(tmp_path / name)
        check_file(file, reader="tiff", values=cube, nm=NM, bad=[1], exposure_s=0.005)
    (tmp_path / "a.hdr").write_text(header_text(cube[:2], "bip", {}) + more)
    check_file(open_spectral_file(tmp_path / "a.tif"), warning="describes 2 x 7 x 4")


@pytest.mark.parametrize(
    ("new", "said"), [("data type = 6;", "'data type' is 6"), ("kind = ", "'data type' is missing")]
)
def test_a_faulty_header_of_numbers_is_refused_and_not_read_as_that_of_a_quick_look(tmp_path, new, said):
    header = write_envi(tmp_path / "x.hdr", CUBE, "bil")
    (tmp_path / "x").rename(tmp_path / "x.img")
    tifffile.imwrite(tmp_path / "x.tif", CUBE[..., 0])
    header.write_text(header.read_text().replace("data type = ", new))
    with pytest.raises(CaptureError, match=said):
        open_spectral_file(header)
    assert open_spectral_file(tmp_path / "x.tif").shape == (*CUBE.shape[:2], 1)
    with pytest.raises(CaptureError, match="would both be the view 'x'"):
        find_cubes(tmp_path, ReadOptions())


@pytest.mark.parametrize("other", [".mat", ".tif", ".npy"])
def test_a_header_beside_numbers_of_its_own_describes_no_other_file(tmp_path, other):
    header = write_envi(tmp_path / "s.hdr", CUBE, "bil")
    (tmp_path / "s").rename(tmp_path / "s.spe")
    (tmp_path / f"s{other}").write_bytes(b"another kind of file")
    check_file(open_spectral_file(header), values=CUBE)
    with pytest.raises(CaptureError, match="would both be the view 's'"):
        find_cubes(tmp_path, ReadOptions())


@pytest.mark.parametrize(("gain", "factor"), [("0.0", 1.0), ("12.0412", 4.0), ("6.0206 dB", 2.0)])
def test_gains_of_resonon_are_decibels_and_that_is_said(tmp_path, gain, factor):
    """Told by the names beside them, and of no other camera."""
    more = f"shutter = 20.0\ngain = {gain}\nframerate = 40.0\n"
    file = open_spectral_file(write_envi(tmp_path / "a.hdr", CUBE, "bil", more))
    check_file(file, exposure_s=0.02, gain=pytest.approx(factor, rel=1e-4), warnings=())
    check_file(file, gain_evidence="header field 'gain', taken as decibels, as Resonon writes")
    other = open_spectral_file(write_envi(tmp_path / "b.hdr", CUBE, "bil", "shutter = 20.0\ngain = 6\n"))
    check_file(other, gain=6.0)
