"""What holds for every reader, what a package of one lacks, and `unmix-process inspect`."""

import json
import sys

import h5py
import numpy as np
import pytest
import tifffile

from tests.factories.files import check_file, gdal_items, gdal_tag, header_text, present, write_envi
from tests.factories.poses import llff_table, ring, transforms, write_json
from tests.fuzz.capture_samples import SAMPLES
from unmix_plugin.captures.calibration.references import finished_by, stated_reflectance
from unmix_plugin.captures.readers.opening import inspect_file, open_spectral_file
from unmix_plugin.commands.process import process
from unmix_plugin.commands.process_inspect import inspect_command
from unmix_plugin.errors import CaptureError, ConfigError

CUBE = np.random.default_rng(0).integers(0, 9000, (4, 6, 3)).astype("<u2")
BANDS = "wavelength units = nm\nwavelength = {450, 550, 650.5}\nfwhm = {5, 5, 6}\nbbl = {1, 0, 1}\nsensor type = X"
FACTS = {
    *("file", "reader", "shape", "dtype", "interleave", "wavelengths_nm", "wavelength_evidence", "fwhm_nm"),
    *("band_names", "bad_bands", "scale", "gains", "offsets", "no_data", "poses", "notes", "metadata"),
}


@pytest.mark.parametrize("package", ["tifffile", "h5py"])
def test_a_package_that_is_not_installed_is_named_with_its_extra(tmp_path, monkeypatch, package):
    tifffile.imwrite(tmp_path / "tifffile", CUBE[0])
    with h5py.File(tmp_path / "h5py", "w") as file:
        file["cube"] = CUBE
    monkeypatch.setitem(sys.modules, package, None)
    said = rf'the package {package} .*-m pip install "h5py>=.*" "imagecodecs>='
    with pytest.raises(CaptureError, match=said):
        open_spectral_file(tmp_path / package)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (None, "no such file"),
        (b"", "the file is empty"),
        (b"hello world", "of no known kind: begins with b'hello wo'"),
        (b"\x1f\x8b" + bytes(20), "compressed with gzip; unpack it first"),
        (b"<!DOCTYPE html><html>", "a web page"),
        (b"PK\x05\x06" + bytes(18), "no known kind"),
    ],
)
def test_other_files_are_refused_with_the_reason(tmp_path, data, message):
    if data is not None:
        (tmp_path / "a.raw").write_bytes(data)
    with pytest.raises(CaptureError, match=message):
        open_spectral_file(tmp_path / "a.raw")


def test_names_that_are_no_text_are_read(tmp_path):
    path = tmp_path / b"cube-\xff.npy".decode("utf-8", "surrogateescape")
    np.save(path, CUBE)
    check_file(open_spectral_file(path), values=CUBE)


def envi_of(path, shape, interleave):
    path.write_text(header_text(np.broadcast_to(np.uint16(0), shape), interleave, {}))
    with path.with_suffix("").open("wb") as file:
        file.truncate(2 * int(np.prod(shape)))


def hdf5_of(path, shape, _):
    with h5py.File(path, "w") as file:
        file.create_dataset("cube", shape, "u2", chunks=(1, 100, 500))
    with path.open("r+b") as opened:  # as large as such a file would be
        opened.truncate(10**12)


def npy_of(path, shape, _):
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<u2", "fortran_order": False, "shape": shape})
        file.truncate(file.tell() + 2 * int(np.prod(shape)))


def tiff_of(path, shape, _):
    options = {"bigtiff": True, "photometric": "minisblack", "planarconfig": "contig"}
    tifffile.memmap(path, shape=shape, dtype=np.uint16, **options)


LARGE = [("cube.h5", hdf5_of, None), ("cube.npy", npy_of, None), ("cube.tif", tiff_of, None)]
LARGE += [("cube.hdr", envi_of, interleave) for interleave in ("bsq", "bil", "bip")]


@pytest.mark.parametrize(("name", "write", "interleave"), LARGE)
def test_a_file_larger_than_memory_opens_at_once_and_gives_its_rows(tmp_path, name, write, interleave):
    shape = (20_000, 10_000, 60) if name == "cube.tif" else (10**5, 10**4, 500)
    write(tmp_path / name, shape, interleave)
    file = open_spectral_file(tmp_path / name)
    assert file.shape == shape
    assert file.read(slice(shape[0] - 2, None), slice(3, 5)).shape == (2, 10**4, 2)


GAINS, OFFSETS = np.array([0.5, 0.25, 2.0]), np.array([-1.0, 3.0, 0.25])


def listed(numbers):
    return "{" + ", ".join(f"{number:g}" for number in numbers) + "}"


def roles(**lists):
    named = {name: f' role="{name}"' if name in ("scale", "offset") else "" for name in lists}
    return gdal_tag(*(gdal_items(name, numbers, named[name]) for name, numbers in lists.items()))


def xml(tag, bands, attribute=""):
    """One element a band, with texts by name, numbered from 1 in an attribute if one is named."""
    own = ""
    for number, texts in enumerate(bands, start=1):
        named = f' {attribute}="{number}"' if attribute else ""
        own += f"<{tag}{named}>{''.join(f'<{name}>{text}</{name}>' for name, text in texts.items())}</{tag}>"
    return f"<x><y><bandCharacterisation>{own}</bandCharacterisation></y></x>"


def pam(*bands):
    """GDAL's file beside an image, with what it says of each of its first bands."""
    return xml("PAMRasterBand", bands, "band")


def enmap(nm, **columns):
    bands = [{name: column[i] for name, column in columns.items()} for i in range(len(nm))]
    return xml("bandID", [{"wavelengthCenterOfBand": nm[i]} | own for i, own in enumerate(bands)], "number")


def write_tiff(folder, tags=(), name="a.tif", **beside):
    """A TIFF, and texts beside it by the end of their names."""
    tifffile.imwrite(folder / name, CUBE, planarconfig="contig", photometric="minisblack", extratags=tags)
    for end, text in beside.items():
        (folder / {"aux": f"{name}.aux.xml", "hdr": "a.hdr", "xml": "a-METADATA.XML"}[end]).write_text(text)
    return folder / name


def calibrated_hdf5(folder, attributes):
    with h5py.File(folder / "a.h5", "w") as file:
        file["cube"] = CUBE
        file["cube"].attrs.update(attributes)
    return folder / "a.h5"


def by_band(gains, offsets, prefix=""):
    return f"data {prefix}gain values = {listed(gains)}\ndata_{prefix}offset_values = {listed(offsets)}\n"


AUX = pam(*({"Offset": OFFSETS[band], "Scale": GAINS[band]} for band in range(3)))
OWN = roles(scale=GAINS, offset=OFFSETS)
OF_ENVI = by_band(GAINS, OFFSETS)
OF_REFLECTANCE = by_band(GAINS, OFFSETS, "reflectance ") + "data gain values = {7, 7, 7}"
BESIDE = header_text(CUBE, "bip", {}) + "file type = TIFF\n"
CALIBRATED = {
    "ENVI": lambda folder: write_envi(folder / "a.hdr", CUBE, "bil", OF_ENVI),
    "ENVI, reflectance": lambda folder: write_envi(folder / "a.hdr", CUBE, "bil", OF_REFLECTANCE),
    "roles of GDAL": lambda folder: write_tiff(folder, OWN),
    "GDAL's metadata": lambda folder: write_tiff(folder, roles(scale_factor=GAINS, add_offset=OFFSETS)),
    "GDAL's file beside it": lambda folder: write_tiff(folder, aux=AUX),
    "its own before unusable ones beside it": lambda folder: write_tiff(folder, OWN, aux=pam({"Scale": 0})),
    "a header beside a TIFF": lambda folder: write_tiff(folder, hdr=BESIDE + OF_ENVI),
    "HDF5, by band": lambda folder: calibrated_hdf5(folder, {"scale_factor": GAINS, "add_offset": OFFSETS}),
}


@pytest.mark.parametrize("kind", CALIBRATED)
def test_a_linear_calibration_is_known_by_whatever_name_a_format_has_for_it(tmp_path, kind):
    file, wanted = open_spectral_file(CALIBRATED[kind](tmp_path)), np.array([2, 0])
    values = present(file.linear).apply(file.read(bands=wanted), wanted)
    np.testing.assert_allclose(values, CUBE[..., wanted] * GAINS[wanted] + OFFSETS[wanted])


@pytest.mark.parametrize(
    ("attributes", "scale", "values"),
    [
        ({"Scale_Factor": 10000.0}, 10000, CUBE / 10000),
        ({"Scale Factor": 10000.0}, 10000, CUBE / 10000),
        ({"scale_factor": 1.0, "add_offset": 0.0}, None, None),
        ({"scale_factor": 2.0, "add_offset": 0.0}, 0.5, 2 * CUBE),
        ({"scale_factor": 5.0}, 0.2, 5 * CUBE),
        ({"slope": 5.0}, 0.2, 5 * CUBE),
        ({"reflectance_scale_factor": 5.0}, 5, CUBE / 5),
        ({"reflectance_scale_factor": 5.0, "add_offset": -0.25}, None, CUBE / 5 - 0.25),
        ({"scale_factor": 0.25, "add_offset": 2.0}, None, CUBE * 0.25 + 2),
    ],
)
def test_a_linear_calibration_of_the_whole_file(tmp_path, attributes, scale, values):
    file = open_spectral_file(calibrated_hdf5(tmp_path, attributes))
    check_file(file, scale=scale, **({"linear": None} if values is None else {"calibrated": values}))


def test_gains_beside_a_file_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="gains from 0 to 1; expected finite numbers above 0"):
        open_spectral_file(write_tiff(tmp_path, aux=pam({"Scale": 0})))


THREE, FIVE = (450, 550, 1650), np.array([450, 550, 650, 1650, 2250])
SCALED = {"GainOfBand": GAINS, "OffsetOfBand": OFFSETS}
AS_SCALED = CUBE * GAINS + OFFSETS
UNLIKE = "a-METADATA.XML describes {} bands, the image has 3: wavelengths and gains in it"
DESIS = [
    {"bandNumber": number, "wavelengthCenterOfBand": 400 + 100 * number, "wavelengthWidthOfBand": 3}
    | {"gainOfBand": GAINS[number - 1], "offsetOfBand": OFFSETS[number - 1]}
    for number in (2, 3, 1)
]
DESCRIBED = [
    ("", enmap(THREE, FWHMOfBand=[7, 7, 7], **SCALED), {"nm": THREE, "fwhm": 7, "calibrated": AS_SCALED}),
    *(  # a width that no band has
        ("", enmap(THREE, FWHMOfBand=[width, 7, 7]), {"nm": THREE, "fwhm": None})
        for width in ("0", "-7", "inf")
    ),
    ("", enmap((0, 450, 550)), {"nm": (450, 450, 550), "bad": [0]}),  # a dead band
    ("", xml("band", DESIS), {"nm": [500, 600, 700], "fwhm": 3, "calibrated": AS_SCALED}),
    *(  # L1B: the first bands are those of the VNIR image, the last those of the SWIR image
        (detector, enmap(FIVE, GainOfBand=gains), {"nm": nm, "calibrated": CUBE * own, "warnings": ()})
        for gains in [np.arange(1, 6)]
        for detector, nm, own in (("_VNIR", FIVE[:3], gains[:3]), ("_SWIR", FIVE[2:], gains[2:]))
    ),
    *(
        ("", enmap(FIVE[:count]), {"nm": None, "linear": None, "warning": UNLIKE.format(count)})
        for count in (0, 2, 4)
    ),
]


@pytest.mark.parametrize(("detector", "text", "expected"), DESCRIBED)
def test_every_xml_beside_an_image_is_read_or_said_not_to_describe_its_bands(
    tmp_path, detector, text, expected
):
    name = f"a-SPECTRAL_IMAGE{detector}.TIF"
    image = write_tiff(tmp_path, name=name, xml=text, aux=pam({"NoDataValue": 7}))
    check_file(open_spectral_file(image), no_data=(7,), **expected)


@pytest.mark.parametrize(
    "say",
    [
        lambda nm: {"Description": f"{nm} nm"},
        lambda nm: {
            "Metadata": f'<MDI key="wavelength">{nm / 1000}</MDI><MDI key="wavelength_units">um</MDI>'
        },
        lambda nm: {"Metadata": f'<MDI key="CENTRAL_WAVELENGTH_UM">{nm / 1000}</MDI>', "Scale": 0.5},
    ],
)
def test_names_and_wavelengths_that_gdal_keeps_beside_an_image_are_read(tmp_path, say):
    check_file(open_spectral_file(write_tiff(tmp_path, aux=pam(*map(say, THREE)))), nm=THREE, warnings=())


@pytest.mark.parametrize(
    ("product", "level", "quantity"),
    [
        ("ENMAP01-____L2A-DT0000001867_20220724T104526Z_008_V010302_20230628T165614Z", None, "reflectance"),
        ("ENMAP01-____L1C-DT0000001867_20220724T104526Z_008_V010302_20230628T165614Z", "L1C", "radiance"),
        ("DESIS-HSI-L2A-DT0485529167_001-20220712T223540-V0220", None, "reflectance"),
        ("renamed", "L2A", "reflectance"),
        ("renamed", None, None),
    ],
)
def test_the_level_of_enmap_and_desis_says_what_gains_make_of_numbers(tmp_path, product, level, quantity):
    said = f"<base><level>{level}</level></base>" if level else ""
    text = enmap(THREE, GainOfBand=[1e-4] * 3, OffsetOfBand=[0] * 3).replace("<x>", f"<x>{said}")
    image = write_tiff(tmp_path, name=f"{product}-SPECTRAL_IMAGE.TIF")
    (tmp_path / f"{product}-METADATA.XML").write_text(text)
    if product.startswith("DESIS"):  # has a header, too, with gains that are radiances elsewhere
        image.with_suffix(".hdr").write_text(BESIDE + by_band([1e-4] * 3, [0] * 3))
    file = open_spectral_file(image)
    assert (stated_reflectance(file) is not None) == (quantity == "reflectance")
    assert (finished_by(file) is not None) == (quantity is not None)


@pytest.mark.parametrize("name", [name for name in SAMPLES if name != "cube.hdr"])
@pytest.mark.parametrize("share", [0.7, 0.3, 0.05])
def test_files_that_are_cut_short_are_refused(tmp_path, name, share):
    for data in SAMPLES[name]():
        (tmp_path / name).write_bytes(data[: int(len(data) * share)])
        with pytest.raises(CaptureError, match=name):
            open_spectral_file(tmp_path / name).read()


@pytest.fixture
def header(tmp_path):
    return write_envi(tmp_path / "cube.hdr", CUBE, "bil", BANDS + "\ndata ignore value = nan")


@pytest.fixture
def poses(tmp_path):
    placed = {f"{i}.png": np.eye(4)[:3] + np.eye(3, 4, k=3) * i for i in range(3)}
    return write_json(tmp_path / "transforms.json", transforms(placed))


def test_facts_of_an_image_are_those_of_its_header_and_damaged_numbers_are_found_out(header, tmp_path):
    facts = inspect_file(header)
    assert set(facts) == FACTS
    expected = {"file": str(header), "reader": "envi", "shape": [4, 6, 3], "dtype": "uint16"}
    expected |= {"wavelengths_nm": [450, 550, 650.5], "wavelength_evidence": "header field 'wavelength', nm"}
    expected |= {"fwhm_nm": [5, 5, 6], "bad_bands": [1], "scale": None, "no_data": "nan", "poses": None}
    assert {key: facts[key] for key in expected} == expected
    assert (facts["interleave"], facts["metadata"]["header"]["sensor type"]) == ("bil", "X")
    np.savez_compressed(tmp_path / "a.npz", cube=CUBE)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[len(data) // 2] ^= 255
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(CaptureError, match=r"a\.npz"):
        inspect_file(tmp_path / "a.npz")


def test_facts_of_poses(poses, tmp_path):
    facts = inspect_file(poses)
    assert set(facts) == FACTS
    assert (facts["poses"], facts["shape"]) == (3, None)
    np.save(tmp_path / "poses_bounds.npy", llff_table(ring(5).values()))
    assert inspect_file(tmp_path / "poses_bounds.npy")["poses"] == 5


def test_one_json_object_a_file_and_status_2_if_one_is_refused(header, poses, tmp_path, capsys):
    assert inspect_command([str(header), str(poses), "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [json.loads(line)["file"] for line in lines] == [str(header), str(poses)]
    missing = str(tmp_path / "missing.hdr")
    with pytest.raises(SystemExit) as left:  # as the command of captures passes it on
        process(["inspect", "--json", missing, str(header)])
    assert left.value.code == 2
    refused, good = map(json.loads, capsys.readouterr().out.splitlines())
    assert refused == {"file": missing, "error": f"{missing}: no such file"}
    assert good["reader"] == "envi"


def test_files_are_inspected_with_the_options_of_reading_and_those_that_do_nothing_are_said(
    header, tmp_path, capsys
):
    np.savez(tmp_path / "a.npz", first=CUBE, second=CUBE[:2])
    asked = ["--dataset", "second", "--axes", "bxy"]
    process(["inspect", "--json", str(tmp_path / "a.npz"), *asked])
    assert json.loads(capsys.readouterr().out)["shape"] == [3, 6, 2]
    process(["inspect", str(header), *asked])
    out = " ".join(capsys.readouterr().out.split())
    assert "--dataset does nothing: the format envi leaves no choice" in out
    assert "--axes does nothing" in out
    assert "--size" not in out
    with pytest.raises(ConfigError, match="no file is named"):
        inspect_command([])


def test_the_table_for_people_has_every_number_that_values_depend_on(header, poses, tmp_path, capsys):
    (tmp_path / "a.raw").write_bytes(b"nothing known")
    more = "data gain values = {1, 1, 4}\ndata offset values = {0, 0, -3}\ntint = 20\n"
    more += "map info = {UTM, 1, 1, 500000, 4500000, 2, 2, 33, North, WGS-84}\n"
    measured = write_envi(tmp_path / "measured.hdr", CUBE, "bsq", more)
    assert inspect_command([str(header), str(poses), str(tmp_path / "a.raw"), str(measured)]) == 2
    out = " ".join(capsys.readouterr().out.split())
    for said in (
        "4 rows x 6 columns x 3 bands, uint16, bil, read as envi",
        "450 to 650.5 nm, FWHM 5 to 6 nm (header field 'wavelength', nm)",
        "bad bands 1 (550 nm), counted from 0",
        "3 cameras",
        "of no known kind",
        "gains 1 to 4 offsets -3 to 0",
        "exposure 0.02 s (header field 'tint', no unit: taken as milliseconds)",
        "map info UTM, 1, 1, 500000, 4500000, 2, 2, 33, North, WGS-84",
    ):
        assert said in out, said
