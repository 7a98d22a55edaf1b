"""What holds for every reader, with ENVI images against SPy and by hand, and `unmix-process inspect`."""

import json
import sys
import warnings
from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest
import spectral.io.envi as spy
import tifffile

from tests.captures.file_factory import (
    centres_nm,
    header_text,
    linear_values_of,
    present,
    widths_nm,
    write_envi,
)
from unmix_plugin.captures.layouts.cubes import find_cubes
from unmix_plugin.captures.readers.opening import inspect_file, open_spectral_file
from unmix_plugin.captures.spectral_file import (
    BandTable,
    ReadOptions,
    SpectralFile,
    linear_values,
    stack_bands,
)
from unmix_plugin.commands.process import process
from unmix_plugin.commands.process_inspect import inspect_command
from unmix_plugin.errors import CaptureError, ConfigError

PLAIN = np.arange(60, dtype=np.uint16).reshape(3, 4, 5)


@pytest.mark.parametrize("package", ["tifffile", "h5py"])
def test_a_package_that_is_not_installed_is_named_with_its_extra(tmp_path, monkeypatch, package):
    tifffile.imwrite(tmp_path / "tifffile", PLAIN[0])
    with h5py.File(tmp_path / "h5py", "w") as file:
        file["cube"] = PLAIN
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        CaptureError, match=rf'the package {package} .*-m pip install "h5py>=.*" "imagecodecs>='
    ):
        open_spectral_file(tmp_path / package)


def test_names_that_are_no_text_are_read(tmp_path):
    path = tmp_path / b"cube-\xff.npy".decode("utf-8", "surrogateescape")
    np.save(path, PLAIN)
    np.testing.assert_array_equal(open_spectral_file(path).read(), PLAIN)


def part(tmp_path, value, **metadata):
    values = np.full((2, 3, 1), value)
    table = BandTable(np.array([400.0 + value]), "test")
    return SpectralFile(
        tmp_path / str(value),
        "npy",
        (2, 3, 1),
        values.dtype,
        lambda rows, bands: values[rows][..., bands],
        table,
        metadata=metadata,
        linear=linear_values(tmp_path, 1, [1 / metadata["scale"]], [], "test")
        if "scale" in metadata
        else None,
    )


def test_a_stack_keeps_what_its_parts_share_and_lists_the_rest(tmp_path):
    parts = [part(tmp_path, 1, camera="a", exposure_s=0.1, scale=2.0)]
    parts.append(part(tmp_path, 2, camera="a", exposure_s=0.2))
    stack = stack_bands(parts, tmp_path)
    assert stack.metadata == {
        "camera": "a",
        "exposure_s": [0.1, 0.2],
        "parts": [{"exposure_s": 0.1, "scale": 2.0}, {"exposure_s": 0.2}],
    }
    assert stack.scale is None
    np.testing.assert_array_equal(stack.read(slice(1, 2), np.array([1, 0]))[0, 0], [2, 1])
    alike = stack_bands([part(tmp_path, 1, scale=3.0), part(tmp_path, 2, scale=3.0)], tmp_path)
    assert (alike.bands.evidence, stack.bands.evidence) == ("test", "test")
    unknown = replace(part(tmp_path, 3), bands=BandTable())
    mixed = stack_bands([*parts, unknown], tmp_path).bands
    assert (mixed.wavelengths_nm, mixed.evidence) == (None, "only some of the files give wavelengths")
    assert (alike.scale, alike.metadata) == (3.0, {"scale": 3.0})
    assert (alike.warnings, "only some of the files of one view state gains" in stack.warnings[0]) == (
        (),
        True,
    )


def test_what_a_library_raises_while_reading_is_an_error_of_the_file(tmp_path):
    def file_that_raises(error):
        def read_part(*_):
            raise error

        return SpectralFile(tmp_path / "a", "npy", (2, 3, 1), np.dtype("u1"), read_part)

    with pytest.raises(CaptureError, match=r"a: can't be read \(RuntimeError: no luck at all\)"):
        file_that_raises(RuntimeError("no luck\nat all")).read()
    with pytest.raises(CaptureError, match="a: too little memory"):
        file_that_raises(MemoryError()).read()


CUBE = np.random.default_rng(0).integers(0, 9000, (4, 6, 3)).astype("<u2")
BANDS = "wavelength units = nm\nwavelength = {450, 550, 650.5}\nfwhm = {5, 5, 6}\nbbl = {1, 0, 1}\nsensor type = X"

FACTS = {
    *("file", "reader", "shape", "dtype", "interleave", "wavelengths_nm", "wavelength_evidence", "fwhm_nm"),
    *("band_names", "bad_bands", "scale", "gains", "offsets", "no_data", "poses", "notes", "metadata"),
}


@pytest.fixture
def header(tmp_path):
    return write_envi(tmp_path / "cube.hdr", CUBE, "bil", BANDS + "\ndata ignore value = nan")


@pytest.fixture
def poses(tmp_path):
    placed = [np.eye(4) + np.eye(4, k=3) * distance for distance in range(3)]
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(placed)]
    (tmp_path / "transforms.json").write_text(
        json.dumps({"camera_angle_x": 0.7, "w": 6, "h": 4, "frames": frames})
    )
    return tmp_path / "transforms.json"


def test_facts_of_an_image(header):
    facts = inspect_file(header)
    assert set(facts) == FACTS
    expected = {
        "file": str(header),
        "reader": "envi",
        "shape": [4, 6, 3],
        "dtype": "uint16",
        "interleave": "bil",
        "wavelengths_nm": [450, 550, 650.5],
        "wavelength_evidence": "header field 'wavelength', nm",
        "fwhm_nm": [5, 5, 6],
        "bad_bands": [1],
        "scale": None,
        "no_data": "nan",
        "poses": None,
    }
    assert {key: facts[key] for key in expected} == expected
    assert facts["metadata"]["header"]["sensor type"] == "X"


def test_facts_of_poses(poses, tmp_path):
    facts = inspect_file(poses)
    assert set(facts) == FACTS
    assert (facts["poses"], facts["shape"]) == (3, None)
    rows = np.zeros((5, 17))
    for distance, row in enumerate(rows):
        row[:15] = np.hstack([np.eye(3), [[distance], [0], [0]], [[480], [640], [500]]]).reshape(-1)
        row[15:] = 1, 9
    np.save(tmp_path / "poses_bounds.npy", rows)
    assert inspect_file(tmp_path / "poses_bounds.npy")["poses"] == 5


def test_numbers_that_are_not_there_are_found_out(tmp_path):
    header = tmp_path / "cube.hdr"
    header.write_text(header_text(CUBE, "bsq", {}))
    with pytest.raises(CaptureError, match="no file of numbers"):
        inspect_file(header)
    np.savez_compressed(tmp_path / "a.npz", cube=CUBE)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[len(data) // 2] ^= 255
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(CaptureError, match=r"a\.npz"):
        inspect_file(tmp_path / "a.npz")


def test_one_json_object_a_file_and_status_2_if_one_is_refused(header, poses, tmp_path, capsys):
    assert inspect_command([str(header), str(poses), "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [json.loads(line)["file"] for line in lines] == [str(header), str(poses)]
    assert inspect_command(["--json", str(tmp_path / "missing.hdr"), str(header)]) == 2
    refused, good = map(json.loads, capsys.readouterr().out.splitlines())
    missing = str(tmp_path / "missing.hdr")
    assert refused == {"file": missing, "error": f"{missing}: no such file"}
    assert good["reader"] == "envi"


def test_the_command_of_captures_passes_it_on_with_options(header, tmp_path, capsys):
    process(["inspect", "--json", str(header)])
    assert json.loads(capsys.readouterr().out)["shape"] == [4, 6, 3]
    with pytest.raises(SystemExit) as left:
        process(["inspect", "--json", str(tmp_path / "missing.hdr")])
    assert left.value.code == 2
    np.savez(tmp_path / "a.npz", first=CUBE, second=CUBE[:2])
    capsys.readouterr()
    assert inspect_command(["--json", str(tmp_path / "a.npz"), "--dataset", "second", "--axes", "bxy"]) == 0
    assert json.loads(capsys.readouterr().out)["shape"] == [3, 6, 2]


def test_the_table_for_people(header, poses, tmp_path, capsys):
    (tmp_path / "a.raw").write_bytes(b"nothing known")
    assert inspect_command([str(header), str(poses), str(tmp_path / "a.raw")]) == 2
    out = " ".join(capsys.readouterr().out.split())
    assert "4 rows x 6 columns x 3 bands, uint16, bil, read as envi" in out
    assert "450 to 650.5 nm, FWHM 5 to 6 nm (header field 'wavelength', nm)" in out
    assert "bad bands 1 (550 nm), counted from 0" in out
    assert "3 cameras" in out
    assert "of no known kind" in out


def test_the_table_has_every_number_that_values_depend_on(tmp_path, capsys):
    more = "data gain values = {1, 1, 2, 4}\ndata offset values = {0, 0, 0, -3}\ntint = 20\n"
    more += "map info = {UTM, 1, 1, 500000, 4500000, 2, 2, 33, North, WGS-84}\n"
    assert inspect_command([str(write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", more))]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert (
        "gains 1 to 4 offsets -3 to 0 exposure 0.02 s (header field 'tint', no unit: taken as milliseconds)"
        in out
    )
    assert "map info UTM, 1, 1, 500000, 4500000, 2, 2, 33, North, WGS-84" in out


def test_options_that_change_nothing_are_said(header, capsys):
    assert inspect_command([str(header), "--dataset", "cube", "--axes", "byx"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "--dataset does nothing: the format envi leaves no choice" in out
    assert "--axes does nothing" in out
    assert "--size" not in out


def test_no_file_is_an_error():
    with pytest.raises(ConfigError, match="no file is named"):
        inspect_command([])


ENVI_CUBE = np.random.default_rng(0).integers(0, 200, (5, 7, 4))
AXES = {"bsq": (2, 0, 1), "bil": (0, 2, 1), "bip": (0, 1, 2)}


@pytest.mark.parametrize("interleave", AXES)
@pytest.mark.parametrize(
    "dtype", ["u1", "<i2", ">i2", "<i4", ">f4", "<f8", "<u2", ">u2", "<u4", "<i8", ">u8"]
)
def test_numbers_are_those_that_spy_reads(tmp_path, interleave, dtype):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE.astype(dtype), interleave)
    file = open_spectral_file(header)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image: Any = spy.open(str(header))
        expected = np.asarray(image.load(dtype=np.float64))
    assert file.shape == (5, 7, 4)
    assert file.interleave == interleave
    assert file.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(file.read(), expected)
    np.testing.assert_array_equal(file.read(slice(1, 4), np.array([3, 0])), expected[1:4][..., [3, 0]])
    np.testing.assert_array_equal(file.read(slice(-2, None), slice(1, 3)), expected[-2:, :, 1:3])
    assert file.read().dtype == np.dtype(dtype).newbyteorder("=")


def test_files_of_spy_are_read(tmp_path):
    cube = np.random.default_rng(1).random((6, 3, 5)).astype(np.float32)
    entries = {
        "wavelength": [0.45, 0.5, 0.55, 0.6, 0.7],
        "wavelength units": "Micrometers",
        "fwhm": [0.01] * 5,
    }
    spy.save_image(str(tmp_path / "cube.hdr"), cube, metadata=entries, interleave="bil")
    file = open_spectral_file(tmp_path / "cube.img")
    np.testing.assert_array_equal(file.read(), cube)
    np.testing.assert_allclose(centres_nm(file), [450, 500, 550, 600, 700])
    np.testing.assert_allclose(widths_nm(file), [10.0] * 5)
    assert file.bands.evidence == "header field 'wavelength', Micrometers"
    assert file.files == (tmp_path / "cube.hdr", tmp_path / "cube.img")


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
    (tmp_path / "cube").write_bytes(ENVI_CUBE.astype("<u2").transpose(AXES["bil"]).tobytes())
    file = open_spectral_file(tmp_path / "cube")
    assert file.path == tmp_path / "cube.hdr"
    np.testing.assert_array_equal(centres_nm(file), [400.5, 410, 420, 430])
    np.testing.assert_array_equal(file.bands.bad, [False, True, False, False])
    assert (file.scale, file.no_data) == (10000, 65535)
    assert file.warnings == ("the header has no byte order; taken as little-endian",)
    np.testing.assert_array_equal(file.read(), ENVI_CUBE)


@pytest.mark.parametrize(
    ("entries", "nm", "evidence"),
    [
        ("wavelength = {0.4, 0.5, 0.6, 2.5}", [400, 500, 600, 2500], "0.4 to 2.5 taken as micrometres"),
        ("wavelength = {400, 500, 600, 700}", [400, 500, 600, 700], "no unit: 400 to 700 taken as nm"),
        ("wavelength = {400 500\n600\n700}", [400, 500, 600, 700], "no unit: 400 to 700 taken as nm"),
        ("wavelength units = Micrometers\nwavelength = {.4,.5,.6,.7}", [400, 500, 600, 700], "Micrometers"),
        ("band names = {a (450.5 nm), b 460 nm, 470 nm, 480nm}", [450.5, 460, 470, 480], "a (450.5 nm)"),
        ("band names = {0.45 um, 0.46 um, 0.47 um, 0.48 um}", [450, 460, 470, 480], "unit um"),
        ("band names = {450.2, 460, 470, 480}", [450.2, 460, 470, 480], "increase and are taken as nm"),
    ],
)
def test_wavelengths_come_with_their_evidence(tmp_path, entries, nm, evidence):
    file = open_spectral_file(write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", entries))
    np.testing.assert_allclose(centres_nm(file), nm)
    assert evidence in file.bands.evidence


@pytest.mark.parametrize(
    ("entries", "note"),
    [
        ("wavelength = {400, 500, 600}", "wavelengths are left out: 3 for 4 bands"),
        ("wavelength = {400, nan, 600, 700}", "that of band 1 (from 0) is nan"),
        ("wavelength = {400, x, 600, 700}", "are not a list of numbers"),
        ("wavelength units = Index\nwavelength = {1, 2, 3, 4}", "unit 'Index' can't be brought to nm"),
        ("wavelength units = Micrometers\nwavelength = {400, 500, 600, 700}", "can't be in Micrometers"),
        ("wavelength units = nm\nwavelength = {0.4, 0.5, 0.6, 0.7}", "can't be in nm"),
        ("wavelength = {1, 2, 3, 40}", "with no unit can't be brought to nm"),
    ],
)
def test_wavelengths_that_cannot_be_used_are_left_out_with_a_note(tmp_path, entries, note):
    file = open_spectral_file(write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", entries))
    assert file.bands.wavelengths_nm is None
    assert any(note in text for text in file.warnings), file.warnings


@pytest.mark.parametrize(
    "names", ["Band 201, Band 202, Band 203, Band 204", "a, b, c, d", "450 nm, 460 nm, red, 480 nm"]
)
def test_names_without_wavelengths_give_none(tmp_path, names):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", f"band names = {{{names}}}")
    file = open_spectral_file(header)
    assert file.bands.wavelengths_nm is None
    assert file.bands.names == tuple(names.split(", "))


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
        ({"file type": "ENVI Spectral Library"}, "library of spectra; expected an image"),
        ({"major frame offsets": "{0, 8}"}, "'major frame offsets' is 0, 8"),
        ({"lines": "6"}, "cut short: 280 bytes; cube.hdr promises 336"),
        ({"lines": "1000000000"}, "cut short"),
        ({"header offset": "4"}, "promises 284"),
        ({"wavelength": "{1, 2"}, "the list of 'wavelength' is never closed"),
    ],
)
def test_headers_that_cannot_be_followed_are_refused(tmp_path, change, message):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE.astype("<i2"), "bil")
    header.write_text(header_text(ENVI_CUBE.astype("<i2"), "bil", change))
    with pytest.raises(CaptureError, match=message):
        open_spectral_file(header)


def test_files_that_are_no_pair_are_refused(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bil")
    header.with_suffix("").rename(tmp_path / "other.raw")
    with pytest.raises(CaptureError, match="no file of numbers beside this header; expected cube or"):
        open_spectral_file(header)
    with pytest.raises(CaptureError, match="of no known kind"):
        open_spectral_file(tmp_path / "other.raw")
    header.write_text("BYTEORDER I\nNROWS 540\n")
    with pytest.raises(CaptureError, match="header of an ESRI"):
        open_spectral_file(header)
    header.write_bytes(bytes(range(256)))
    with pytest.raises(CaptureError, match="no ENVI header: its first line is not 'ENVI'"):
        open_spectral_file(header)
    header = write_envi(tmp_path / "packed.hdr", ENVI_CUBE, "bil")
    (tmp_path / "packed").write_bytes(b"\x1f\x8b\x08" + bytes(50))
    with pytest.raises(CaptureError, match="packed: compressed with gzip; unpack it"):
        open_spectral_file(header)


def test_of_several_files_of_numbers_the_one_that_is_large_enough_is_taken(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bil")
    (tmp_path / "cube").rename(tmp_path / "cube.RAW")
    (tmp_path / "cube.dat").write_bytes(b"notes")
    assert open_spectral_file(header).sources == (tmp_path / "cube.RAW",)


def test_of_two_files_of_the_right_size_the_one_named_after_the_interleave_is_meant(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq")
    (tmp_path / "cube").rename(tmp_path / "cube.bsq")
    (tmp_path / "cube.bil").write_bytes(bytes(ENVI_CUBE.nbytes))
    np.testing.assert_array_equal(open_spectral_file(header).read(), ENVI_CUBE)
    (tmp_path / "cube.bsq").rename(tmp_path / "cube.img")
    with pytest.raises(CaptureError, match=r"cube\.img and cube\.bil could each be what it describes"):
        open_spectral_file(header)
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "cube.img").read(), ENVI_CUBE)


def test_two_names_of_one_file_of_numbers_are_one_file(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq")
    (tmp_path / "cube").rename(tmp_path / "cube.img")
    if not (tmp_path / "cube.IMG").exists():  # as on a disk that ignores case
        (tmp_path / "cube.IMG").hardlink_to(tmp_path / "cube.img")
    np.testing.assert_array_equal(open_spectral_file(header).read(), ENVI_CUBE)


def test_a_file_of_just_the_size_goes_before_a_larger_one_of_any_suffix(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bil")
    (tmp_path / "cube.bil").write_bytes(bytes(2 * ENVI_CUBE.nbytes))
    np.testing.assert_array_equal(open_spectral_file(header).read(), ENVI_CUBE)


def test_a_key_that_says_two_things_is_refused(tmp_path):
    bands = "wavelength = {400, 500, 600, 700}\n"
    write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", bands + "sensor type = a\nsensor type = b\n" + bands)
    assert centres_nm(open_spectral_file(tmp_path / "cube.hdr"))[0] == 400
    write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", bands + bands.replace("400", "410"))
    with pytest.raises(CaptureError, match=r"cube\.hdr: 'wavelength' is there twice, with different values"):
        open_spectral_file(tmp_path / "cube.hdr")


def test_a_no_data_value_is_read_before_a_comment_or_said_to_be_none(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", "data ignore value = -9999 ; none measured")
    assert open_spectral_file(header).no_data == -9999
    write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", "data ignore value = unset")
    assert "'data ignore value' is unset, no number: not used" in open_spectral_file(header).warnings


@pytest.mark.parametrize(("nm", "unit", "fwhm"), [(500, "Micrometers", 5.5), (500, "nm", 0.0055)])
def test_widths_in_another_unit_than_the_wavelengths_are_left_out_and_said(tmp_path, nm, unit, fwhm):
    numbers = [nm + 10 * band if unit == "nm" else (nm + 10 * band) / 1000 for band in range(4)]
    more = f"wavelength = {{{', '.join(map(str, numbers))}}}\nwavelength units = {unit}\nfwhm = {{{fwhm}"
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bsq", more + f", {fwhm}" * 3 + "}")
    file = open_spectral_file(header)
    assert file.bands.fwhm_nm is None
    assert "FWHM are left out: they would be" in file.warnings[0]


def test_a_header_named_after_the_whole_file_is_found(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bip")
    header.rename(tmp_path / "cube.raw.hdr")
    (tmp_path / "cube").rename(tmp_path / "cube.raw")
    for name in ("cube.raw", "cube.raw.hdr"):
        np.testing.assert_array_equal(open_spectral_file(tmp_path / name).read(), ENVI_CUBE)


def test_text_that_is_not_utf8_is_read(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bip")
    names = "band names = {rouge é, b, c, d}\n".encode("latin-1")
    header.write_bytes(b"\xef\xbb\xbf" + header.read_bytes() + names)
    assert open_spectral_file(header).bands.names is not None


@pytest.mark.parametrize("interleave", AXES)
def test_a_file_of_a_terabyte_opens_at_once_and_gives_its_rows(tmp_path, interleave):
    lines = 10**6
    header = tmp_path / "cube.hdr"
    header.write_text(header_text(np.broadcast_to(np.uint16(0), (lines, 1000, 500)), interleave, {}))
    with (tmp_path / "cube").open("wb") as file:
        file.truncate(lines * 1000 * 500 * 2)
    opened = open_spectral_file(header)
    assert opened.shape == (lines, 1000, 500)
    assert opened.read(slice(lines - 2, lines), slice(3, 5)).shape == (2, 1000, 2)


def test_a_file_that_is_cut_while_open_is_reported(tmp_path):
    header = write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bip")
    file = open_spectral_file(header)
    (tmp_path / "cube").write_bytes(b"")
    with pytest.raises(CaptureError, match="the file was cut"):
        file.read()


def test_bands_that_are_not_there_are_an_index_error(tmp_path):
    file = open_spectral_file(write_envi(tmp_path / "cube.hdr", ENVI_CUBE, "bip"))
    with pytest.raises(IndexError):
        file.read(bands=np.array([4]))
    assert file.read(slice(2, 2)).shape == (0, 7, 4)
    np.testing.assert_array_equal(file.read(slice(0, 5, 2), slice(None, None, -1)), ENVI_CUBE[::2, :, ::-1])


GAINS, OFFSETS = np.array([0.5, 0.25, 2.0]), np.array([-1.0, 3.0, 0.25])


def listed(numbers):
    return "{" + ", ".join(f"{number:g}" for number in numbers) + "}"


def gdal_items(**lists):
    roles = {"scale": 'role="scale"', "offset": 'role="offset"'}
    items = "".join(
        f'<Item name="{name}" sample="{band}" {roles.get(name, "")}>{number}</Item>'
        for name, numbers in lists.items()
        for band, number in enumerate(numbers)
    )
    return [(42112, "s", 0, f"<GDALMetadata>{items}</GDALMetadata>", True)]


def calibrated_envi(folder, more):
    return write_envi(folder / "a.hdr", CUBE, "bil", more)


def calibrated_tiff(folder, tags, aux=""):
    tifffile.imwrite(folder / "a.tif", CUBE, planarconfig="contig", photometric="minisblack", extratags=tags)
    if aux:
        (folder / "a.tif.aux.xml").write_text(aux)
    return folder / "a.tif"


def calibrated_tiff_with_header(folder):
    path = calibrated_tiff(folder, [])
    text = f"file type = TIFF\ndata gain values = {listed(GAINS)}\ndata offset values = {listed(OFFSETS)}\n"
    (folder / "a.hdr").write_text(header_text(CUBE, "bip", {}) + text)
    return path


def calibrated_hdf5(folder, attributes):
    with h5py.File(folder / "a.h5", "w") as file:
        file["cube"] = CUBE
        file["cube"].attrs.update(attributes)
    return folder / "a.h5"


AUX = "<PAMDataset>" + "".join(
    f'<PAMRasterBand band="{band}"><Offset>{offset}</Offset><Scale>{gain}</Scale></PAMRasterBand>'
    for band, (gain, offset) in enumerate(zip(GAINS, OFFSETS, strict=True), start=1)
)
CALIBRATED = {
    "ENVI": lambda folder: calibrated_envi(
        folder, f"data gain values = {listed(GAINS)}\ndata offset values = {listed(OFFSETS)}"
    ),
    "ENVI, reflectance": lambda folder: calibrated_envi(
        folder,
        f"data reflectance gain values = {listed(GAINS)}\ndata_reflectance_offset_values = {listed(OFFSETS)}\n"
        "data gain values = {7, 7, 7}",
    ),
    "roles of GDAL": lambda folder: calibrated_tiff(folder, gdal_items(scale=GAINS, offset=OFFSETS)),
    "names in GDAL's metadata": lambda folder: calibrated_tiff(
        folder, gdal_items(scale_factor=GAINS, add_offset=OFFSETS)
    ),
    "GDAL's file beside it": lambda folder: calibrated_tiff(folder, [], AUX + "</PAMDataset>"),
    "a header beside a TIFF": calibrated_tiff_with_header,
    "HDF5, by band": lambda folder: calibrated_hdf5(folder, {"scale_factor": GAINS, "add_offset": OFFSETS}),
}


@pytest.mark.parametrize("kind", CALIBRATED)
def test_a_linear_calibration_is_known_by_whatever_name_a_format_has_for_it(tmp_path, kind):
    file, wanted = open_spectral_file(CALIBRATED[kind](tmp_path)), np.array([2, 0])
    values = present(file.linear).apply(file.read(bands=wanted), wanted)
    np.testing.assert_allclose(values, CUBE[..., wanted] * GAINS[wanted] + OFFSETS[wanted])


def test_a_linear_calibration_of_the_whole_file(tmp_path):
    file = open_spectral_file(calibrated_envi(tmp_path, "data gain values = 0.25\ndata offset values = 2"))
    np.testing.assert_allclose(linear_values_of(file), CUBE * 0.25 + 2)
    assert file.scale is None
    assert open_spectral_file(calibrated_hdf5(tmp_path, {"Scale_Factor": 10000.0})).scale == 10000
    plain = calibrated_hdf5(tmp_path, {"scale_factor": 1.0, "add_offset": 0.0})
    assert open_spectral_file(plain).linear is None
    doubled = calibrated_hdf5(tmp_path, {"scale_factor": 2.0, "add_offset": 0.0})
    np.testing.assert_allclose(linear_values_of(open_spectral_file(doubled)), 2 * CUBE)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("data gain values = {1, 2}", "'data gain values' gives 2 gains for 3 bands"),
        ("data gain values = {1, 2, x}", "'data gain values' has 'x'"),
        ("data gain values = {1, 0, 2}", "gains from 0 to 2; expected finite numbers above 0"),
        ("data gain values = 2\nreflectance scale factor = 10000", "it is unclear which the numbers need"),
    ],
)
def test_a_calibration_that_cannot_be_applied_is_refused(tmp_path, more, message):
    with pytest.raises(CaptureError, match=message):
        open_spectral_file(calibrated_envi(tmp_path, more))


def test_the_header_beside_a_tiff_describes_it(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", CUBE, planarconfig="contig", photometric="minisblack")
    more = "file type = TIFF\nbbl = {1, 0, 1}\ntint = 5\n"
    more += "wavelength units = Micrometers\nwavelength = {0.45, 0.5, 0.6}\n"
    (tmp_path / "a.hdr").write_text(header_text(CUBE, "bip", {}) + more)
    for name in ("a.tif", "a.hdr"):
        file = open_spectral_file(tmp_path / name)
        np.testing.assert_allclose(centres_nm(file), [450, 500, 600])
        np.testing.assert_array_equal(file.bands.bad, [False, True, False])
        assert (file.reader, file.metadata["exposure_s"]) == ("tiff", 0.005)
        np.testing.assert_array_equal(file.read(), CUBE)
    (tmp_path / "a.hdr").write_text(header_text(CUBE[:2], "bip", {}) + more)
    assert any("describes 2 x 6 x 3" in text for text in open_spectral_file(tmp_path / "a.tif").warnings)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_headers_in_the_encodings_and_lists_of_other_programs(tmp_path, encoding):
    header = write_envi(tmp_path / "a.hdr", CUBE, "bil")
    more = "sensor = Größe [m\nwavelength_units = nm\nwavelength = [ 450.0 550.0\n   650.0]\nbbl = [1 0 1]\n"
    header.write_bytes((header.read_text() + more).encode(encoding))
    file = open_spectral_file(header)
    np.testing.assert_array_equal(centres_nm(file), [450, 550, 650])
    np.testing.assert_array_equal(file.bands.bad, [False, True, False])


def test_the_metadata_of_enmap_describe_its_image(tmp_path):
    tifffile.imwrite(
        tmp_path / "ENMAP01-L2A-SPECTRAL_IMAGE.TIF", CUBE, planarconfig="contig", photometric="minisblack"
    )
    bands = "".join(
        f'<bandID number="{number}"><wavelengthCenterOfBand>{nm}</wavelengthCenterOfBand><FWHMOfBand>7</FWHMOfBand>'
        f"<GainOfBand>{gain}</GainOfBand><OffsetOfBand>{offset}</OffsetOfBand></bandID>"
        for number, nm, gain, offset in zip((1, 2, 3), (450, 550, 1650), GAINS, OFFSETS, strict=True)
    )
    text = f"<level_X><specific><bandCharacterisation>{bands}</bandCharacterisation></specific></level_X>"
    (tmp_path / "ENMAP01-L2A-METADATA.XML").write_text(text)
    file = open_spectral_file(tmp_path / "ENMAP01-L2A-SPECTRAL_IMAGE.TIF")
    np.testing.assert_array_equal(centres_nm(file), [450, 550, 1650])
    np.testing.assert_array_equal(widths_nm(file), 7)
    np.testing.assert_allclose(linear_values_of(file), CUBE * GAINS + OFFSETS)


def test_every_xml_beside_an_image_is_read(tmp_path):
    tifffile.imwrite(tmp_path / "a-SPECTRAL_IMAGE.TIF", CUBE, planarconfig="contig", photometric="minisblack")
    bands = "".join(
        f'<bandID number="{i + 1}"><wavelengthCenterOfBand>{nm}</wavelengthCenterOfBand></bandID>'
        for i, nm in enumerate((450, 550, 650))
    )
    (tmp_path / "a-METADATA.XML").write_text(
        f"<x><y><bandCharacterisation>{bands}</bandCharacterisation></y></x>"
    )
    no_data = '<PAMRasterBand band="1"><NoDataValue>7</NoDataValue></PAMRasterBand>'
    (tmp_path / "a-SPECTRAL_IMAGE.TIF.aux.xml").write_text(f"<PAMDataset>{no_data}</PAMDataset>")
    file = open_spectral_file(tmp_path / "a-SPECTRAL_IMAGE.TIF")
    assert file.no_data == 7
    np.testing.assert_array_equal(centres_nm(file), [450, 550, 650])


@pytest.mark.parametrize("width", ["0", "-7", "inf"])
def test_widths_in_an_xml_that_no_band_has_are_unknown(tmp_path, width):
    tifffile.imwrite(tmp_path / "a-SPECTRAL_IMAGE.TIF", CUBE, planarconfig="contig", photometric="minisblack")
    bands = "".join(
        f'<bandID number="{i}"><wavelengthCenterOfBand>{nm}</wavelengthCenterOfBand>'
        f"<FWHMOfBand>{width if i == 1 else 7}</FWHMOfBand></bandID>"
        for i, nm in enumerate((450, 550, 650), start=1)
    )
    (tmp_path / "a-METADATA.XML").write_text(
        f"<x><y><bandCharacterisation>{bands}</bandCharacterisation></y></x>"
    )
    file = open_spectral_file(tmp_path / "a-SPECTRAL_IMAGE.TIF")
    np.testing.assert_array_equal(centres_nm(file), [450, 550, 650])
    assert file.bands.fwhm_nm is None


def test_gains_beside_a_file_that_has_its_own_are_not_looked_at(tmp_path):
    unusable = '<PAMDataset><PAMRasterBand band="1"><Scale>0</Scale></PAMRasterBand></PAMDataset>'
    file = open_spectral_file(calibrated_tiff(tmp_path, gdal_items(scale=GAINS, offset=OFFSETS), unusable))
    np.testing.assert_allclose(linear_values_of(file), CUBE * GAINS + OFFSETS)
    with pytest.raises(CaptureError, match="gains from 0 to 1; expected finite numbers above 0"):
        open_spectral_file(calibrated_tiff(tmp_path, [], unusable))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("data type = ", "data type = 6;", "'data type' is 6"),
        ("data type = ", "kind = ", "'data type' is missing"),
    ],
)
def test_a_faulty_header_of_numbers_is_refused_and_not_read_as_that_of_a_quick_look(tmp_path, old, new, said):
    header = write_envi(tmp_path / "x.hdr", CUBE, "bil", BANDS)
    (tmp_path / "x").rename(tmp_path / "x.img")
    tifffile.imwrite(tmp_path / "x.tif", CUBE[..., 0])
    header.write_text(header.read_text().replace(old, new))
    with pytest.raises(CaptureError, match=said):
        open_spectral_file(header)
    assert open_spectral_file(tmp_path / "x.tif").shape == (*CUBE.shape[:2], 1)
    with pytest.raises(CaptureError, match="would both be the view 'x'"):
        find_cubes(tmp_path, ReadOptions())


@pytest.mark.parametrize("other", [".mat", ".tif", ".npy"])
def test_a_header_beside_numbers_of_its_own_describes_no_other_file(tmp_path, other):
    header = write_envi(tmp_path / "s.hdr", CUBE, "bil", BANDS)
    (tmp_path / "s").rename(tmp_path / "s.spe")
    np.save(tmp_path / "s.npy", CUBE[:2])
    (tmp_path / "s.npy").rename(tmp_path / f"s{other}")
    np.testing.assert_array_equal(open_spectral_file(header).read(), CUBE)
    with pytest.raises(CaptureError, match="would both be the view 's'"):
        find_cubes(tmp_path, ReadOptions())
