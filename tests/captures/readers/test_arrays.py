"""Files of named arrays (MATLAB, HDF5, NetCDF, npz): against the libraries that wrote them."""

import io
import zipfile
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse
import torch

from tests.factories.files import (
    ARRAY_WRITERS,
    check_file,
    notes_of,
    present,
    rows_and_bands_of,
    warnings_of,
)
from unmix_plugin.captures.calibration.references import find_missing, finished_by, stated_reflectance
from unmix_plugin.captures.cube import BandTable, ReadOptions
from unmix_plugin.captures.readers import containers
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.errors import CaptureError

CUBE = np.random.default_rng(0).integers(0, 9000, (8, 9, 5)).astype(np.uint16)
NM = np.array([450.0, 500, 550, 600, 650])
PLAIN = CUBE.astype(np.int16)


WRITERS = [name for name in ARRAY_WRITERS if name != "scaled.h5"]


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("bands_at", [0, 1, 2])
def test_the_image_and_its_wavelengths_are_found(tmp_path, name, bands_at):
    stored = np.ascontiguousarray(np.moveaxis(PLAIN, 2, bands_at))
    arrays = {"thumbnail": PLAIN[..., 0], "cube": stored, "wavelengths": NM, "fwhm": NM / 100}
    ARRAY_WRITERS[name](tmp_path / name, arrays)
    file = open_spectral_file(tmp_path / name)
    rows_and_bands_of(file, PLAIN)
    check_file(file, nm=NM, fwhm=NM / 100, evidence="'wavelengths', no unit: 450 to 650 taken as nm")


@pytest.mark.parametrize("name", WRITERS)
def test_several_images_are_asked_about_and_none_is_refused(tmp_path, name):
    path = tmp_path / name
    ARRAY_WRITERS[name](path, {"first": PLAIN, "second": PLAIN + 1})
    with pytest.raises(CaptureError, match=r"2 data sets could be the image; name one.*first \(8, 9, 5\)"):
        open_spectral_file(path)
    np.testing.assert_array_equal(open_spectral_file(path, ReadOptions(dataset="second")).read(), PLAIN + 1)
    with pytest.raises(CaptureError, match="no data sets 'third'"):
        open_spectral_file(path, ReadOptions(dataset="third"))
    ARRAY_WRITERS[name](path, {"vector": NM, "table": PLAIN[..., 0]})
    with pytest.raises(CaptureError, match="no data set has three axes; name one"):
        open_spectral_file(path)


def test_lists_of_pixels_are_images_once_their_size_is_known(tmp_path):
    listed = CUBE.transpose(2, 0, 1).reshape(5, -1, order="F")  # as MATLAB's reshape does it
    path = tmp_path / "a.mat"
    for arrays, options in (
        ({"Y": listed, "A": listed[:3]}, ReadOptions(dataset="Y", size=(8, 9))),
        ({"Y": listed, "nRow": 8, "nCol": 9, "nBand": 5}, ReadOptions()),
        ({"Y": listed.T}, ReadOptions(size=(8, 9))),
    ):
        scipy.io.savemat(path, arrays)
        rows_and_bands_of(open_spectral_file(path, options), CUBE)
    with pytest.raises(CaptureError, match=r"Y \(72, 5\) is not a list of 70 pixels"):
        open_spectral_file(path, ReadOptions(dataset="Y", size=(7, 10)))


@pytest.mark.parametrize("do_compression", [False, True])
def test_other_variables_of_matlab_are_passed_over(tmp_path, do_compression):
    others = {
        "a_text": "some words",
        "a_structure": {"cube": CUBE, "name": "x"},
        "b_cells": np.array([CUBE, "x"], dtype=object),
        "c_complex": CUBE * 1j,
        "d_sparse": scipy.sparse.csc_matrix(np.eye(4)),
        "e_logical": CUBE > 9,
        "wl": NM[:, None],
        "bbl": CUBE[0, 0] != CUBE[0, 0, 1],
    }
    doubles = CUBE.astype(np.float64)  # MATLAB would store them in two bytes each
    scipy.io.savemat(tmp_path / "a.mat", {**others, "z_cube": doubles}, do_compression=do_compression)
    file = open_spectral_file(tmp_path / "a.mat", ReadOptions(dataset="z_cube"))
    check_file(file, dtype=np.dtype("f8"), values=doubles, nm=NM, bad=[1])
    assert "not used: a_text, a_structure, b_cells" in notes_of(file)[0]
    with pytest.raises(CaptureError, match=r"e_logical .*, wl \(5, 1\), bbl .*, z_cube \(8, 9, 5\)$"):
        open_spectral_file(tmp_path / "a.mat")


@pytest.mark.parametrize(
    "texts", ["450 500 550 600 650", [f"{nm:g}" for nm in NM], [f"{nm:g} nm" for nm in NM]]
)
@pytest.mark.parametrize("version", [5, 7, 7.3])
def test_texts_of_matlab_may_hold_wavelengths(tmp_path, texts, version):
    path = tmp_path / "a.mat"
    if version == 7.3:
        letters = np.array([list(text) for text in np.atleast_1d(texts)])
        codes = np.vectorize(ord)(letters).astype("u2").T
        content = {"cube": CUBE.T, "wavelengths": (codes, {"MATLAB_class": np.bytes_("char")})}
        write_hdf5(path, content, begin=b"MATLAB 7.3 MAT-file")
    else:
        scipy.io.savemat(path, {"cube": CUBE, "wavelengths": texts}, do_compression=version == 7)
    check_file(open_spectral_file(path), values=CUBE, nm=NM, notes=())


def test_letters_of_netcdf3_may_hold_wavelengths(tmp_path):
    with scipy.io.netcdf_file(tmp_path / "a.nc", "w") as file:
        for axis, length in (*zip("yxb", CUBE.shape, strict=True), ("letters", 3)):
            file.createDimension(axis, length)
        file.createVariable("cube", "h", tuple("yxb"))[:] = PLAIN
        letters = [list(f"{nm:g}".encode()) for nm in NM]
        file.createVariable("wavelength", "c", ("b", "letters"))[:] = np.array(letters, "u1").view("S1")
    check_file(open_spectral_file(tmp_path / "a.nc"), values=PLAIN, nm=NM)


def test_compressed_variables_of_matlab_are_unpacked_piece_by_piece(tmp_path, monkeypatch):
    monkeypatch.setattr(containers, "_PIECE_BYTES", 7)
    scipy.io.savemat(tmp_path / "a.mat", {"cube": CUBE}, do_compression=True)
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "a.mat").read(), CUBE)


def write_hdf5(path, content, begin=b""):
    """Data sets by name, with attributes if they stand in a pair; None is a group. Other bytes may precede them."""
    with h5py.File(path, "w", userblock_size=512 if begin else 0) as file:
        for name, given in content.items():
            values, attributes = given if isinstance(given, tuple) else (given, {})
            if values is None:
                file.require_group(name)
            else:
                file[name] = values
            file[name].attrs.update(attributes)
    if begin:
        with path.open("r+b") as opened:
            opened.write(begin)
    return path


GOOD = np.array([True, False, True, True, True])
PACKED, UM = {"scale_factor": 0.1}, [3, 5, 8, 11, 12]
FACTORS = np.array([1.0, 2, 4, 5, 8])
UNKNOWN = ("parsec", 150, None, ("FWHM are left out: they would be in 'parsec'",))
BARE_AXIS = "This is a netCDF dimension but not a netCDF variable.         5"
GAINS = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
HDF5: list[tuple[dict[str, Any], dict[str, Any]]] = [
    (  # facts of groups hold for the images in them
        {
            "site/reflectance": (CUBE, {"Scale_Factor": 10000.0, "Data_Ignore_Value": -9999.0}),
            "site": (None, {"integration_time": 20.0, "integration_time_units": "us"}),
            "site/metadata/wavelength": (NM / 1000, {"Units": "micrometers"}),
            "site/metadata/bbl": [1, 0, 1, 1, 1],
            "site/observations": np.zeros((8, 9, 10)),
            "exposure": 3.0,
        },
        {"nm": NM, "scale": 10000, "no_data": (-9999,), "bad": [1], "exposure_s": 2e-5}
        | {"dataset": "site/reflectance"},
    ),
    *(  # a list may be a text, or one text a number
        ({"cube": CUBE, "/": (None, {"wavelengths": text})}, {"nm": NM})
        for text in (
            ", ".join(map(str, NM)),
            str(np.array(NM)),
            ", ".join(f"{nm:g} nm" for nm in NM),
            [str(nm) for nm in NM],
            np.bytes_(list(map(str, NM))),
        )
    ),
    *(  # also as data sets of texts
        ({"run/cube": CUBE, f"run/{name}": texts}, {"nm": NM, "notes": ()})
        for name, texts in (
            ("wavelengths", [str(nm) for nm in NM]),
            ("wavelengths", np.bytes_(list(map(str, NM)))),
            ("wavelengths", "450, 500, 550, 600, 650"),
            ("wavelengths", [f"{nm:g} nm" for nm in NM]),
            ("band", [f"{nm:g} nm" for nm in NM]),
            ("band_names", "450 nm, 500 nm, 550 nm, 600 nm, 650 nm"),
        )
    ),
    (  # the air lets no light through in these bands
        {
            "site/Reflectance": (None, {"Band_Window_1_Nanometers": [540, 610]}),
            "site/Reflectance/Reflectance_Data": CUBE,
            "site/Reflectance/Metadata/Spectral_Data/Wavelength": (NM, {"Units": "nanometers"}),
        },
        {"nm": NM, "bad": [2, 3]},
    ),
    (  # an axis of NetCDF without a variable holds nothing
        {
            "cube": CUBE,
            "wavelength": (np.zeros(5, "f4"), {"NAME": BARE_AXIS}),
            "sensor/wavelength_3d": (NM, {"units": "nm"}),
        },
        {"nm": NM, "warnings": (), "notes": ()},
    ),
    ({"run/cube": (CUBE, {"wavelengths": NM}), "run": (None, {"Scale Factor": 0.5})}, {"nm": NM, "scale": 2}),
    (  # what is nearest to an image counts, and units are those of their own list
        {
            "run/cube": CUBE,
            "run/bands": np.arange(1, 6),
            "run/more/bands": NM + 1,
            "wavelength": (NM, {"units": "um"}),
            "/": (None, {"scale_factor": 0.5}),
            "run": (None, {"Scale_Factor": 4.0}),
            "other/bands": (NM / 1000, {"units": "um"}),
        },
        {"nm": NM + 1, "scale": 4, "evidence": "'run/more/bands', no unit", "warnings": ()},
    ),
    (  # a gain is applied or part of the exposure, and never both
        {"cube": (CUBE, {"exposure_ms": 10.0, "Gain": GAINS, "offset": 0.0})},
        {"exposure_s": 0.01, "gain": None, "calibrated": CUBE * GAINS},
    ),
    ({"cube": (CUBE, {"exposure_ms": 10.0, "gain": 4.0})}, {"exposure_s": 0.01, "gain": 4.0, "linear": None}),
    # Marks of bands may be booleans, and booleans are no wavelengths.
    ({"cube": CUBE, "wavelength": NM, "bbl": GOOD, "bands": GOOD}, {"nm": NM, "bad": [1], "warnings": ()}),
    ({"cube": (CUBE, {"good_bands": GOOD}), "wavelength": NM}, {"nm": NM, "bad": [1], "warnings": ()}),
    (  # wavelengths and widths may be packed
        {
            "cube": (CUBE, {"MissingValue": -1, "nodata_value": -2, "FillValue": -3}),
            "wavelength": (np.rint(NM * 10 - 100).astype("u2"), PACKED | {"add_offset": 10}),
            "fwhm": (np.rint(NM / 10).astype("u2"), PACKED),
        },
        {"nm": NM, "fwhm": NM / 100, "no_data": (-3, -1, -2)},
    ),
    ({"cube": (CUBE, {"reflectance_scale_factor": FACTORS})}, {"calibrated": CUBE / FACTORS}),
    *(  # widths have a unit of their own
        (
            {"cube": CUBE, "wavelength": listed, "fwhm": (np.full(5, width), {"units": unit})},
            {"nm": NM, "fwhm": fwhm, "warnings": said},
        )
        for listed in ((NM, {"units": "nm"}), (NM / 1000, {"units": "um"}))
        for unit, width, fwhm, said in (("nm", 150, 150, ()), ("micrometers", 0.15, 150, ()), UNKNOWN)
    ),
    *(  # a list called bands holds wavelengths where it has their unit
        ({"cube": (CUBE, {"Bands": UM}), "bands": (UM, {"units": unit})}, {"nm": nm})
        for unit, nm in (("um", [3000, 5000, 8000, 11_000, 12_000]), ("1", None))
    ),
]


@pytest.mark.parametrize(("content", "expected"), HDF5)
def test_what_hdf5_says_of_its_image_is_used(tmp_path, content, expected):
    check_file(open_spectral_file(write_hdf5(tmp_path / "a.h5", content)), **expected)


def write_unreadable(path, *names):
    """An image whose attributes of these names have a type that NumPy has no word for."""
    with h5py.File(path, "w") as file:
        cube = file.create_dataset("cube", data=CUBE)
        kind = h5py.h5t.TIME_D if hasattr(h5py.h5t, "TIME_D") else h5py.h5t.UNIX_D32LE
        for name in names:
            h5py.h5a.create(cube.id, name.encode(), kind, h5py.h5s.create(h5py.h5s.SCALAR))
    return path


def test_what_numbers_stand_for_is_never_passed_over_where_it_cannot_be_read(tmp_path):
    """A scale that is there and not used would make all values false, a no-data value measured ones of others."""
    with pytest.raises(CaptureError, match="'scale_factor' is of a type that can't be read: without it all"):
        open_spectral_file(write_unreadable(tmp_path / "a.h5", "scale_factor"))
    file = open_spectral_file(write_unreadable(tmp_path / "a.h5", "_FillValue", "wavelengths", "remark"))
    assert [text for text in warnings_of(file) if "can't be read: not used" in text] == [
        f"attribute '{name}' can't be read: not used" for name in ("_FillValue", "wavelengths")
    ]
    with pytest.raises(CaptureError, match="'add_offset' is 'unknown', no number"):
        open_spectral_file(write_hdf5(tmp_path / "b.h5", {"cube": (CUBE, {"add_offset": "unknown"})}))
    unset = open_spectral_file(write_hdf5(tmp_path / "b.h5", {"cube": (CUBE, {"missing_value": "unset"})}))
    check_file(unset, no_data=(), warning="attribute 'missing_value' is 'unset', no number: not used")


def test_axes_by_the_names_of_netcdf4(tmp_path):
    square = CUBE[:5, :5]
    with h5py.File(tmp_path / "a.nc", "w") as opened:
        file: Any = opened
        for name, values in (("wavelength", NM), ("lat", np.arange(5.0)), ("lon", np.arange(5.0))):
            file[name] = values
            file[name].make_scale(name)
        file["radiance"] = square.transpose(2, 0, 1)
        for axis, name in enumerate(("wavelength", "lat", "lon")):
            file["radiance"].dims[axis].attach_scale(file[name])
        file["radiance"].attrs["scale_factor"] = 0.0001
    check_file(open_spectral_file(tmp_path / "a.nc"), values=square, scale=10000, notes=())


@pytest.mark.parametrize(
    "names",
    [("wavelength", "lat", "lon"), ("nbands", "nrows", "ncols"), ("wavelength_nm", "nlines", "nsamples")],
)
def test_axes_without_coordinates_by_their_names(tmp_path, names):
    with h5py.File(tmp_path / "a.nc", "w") as opened:
        file: Any = opened
        file["radiance"] = CUBE[:5, :5].transpose(2, 0, 1)
        for axis, name in enumerate(names):
            file["radiance"].dims[axis].label = name
    check_file(open_spectral_file(tmp_path / "a.nc"), values=CUBE[:5, :5], warnings=())


@pytest.mark.parametrize(
    ("dtype", "fill", "attributes", "no_data", "warnings"),
    [
        ("f4", None, {}, (0,), 1),
        ("u2", 65535, {}, (65535,), 1),
        ("u2", 65535, {"_FillValue": np.uint16(65535)}, (65535,), 0),
        ("i2", -1, {"_Unsigned": "true"}, (65535,), 1),
        ("f4", -9999, {"missing_value": -1.0}, (-1, -9999), 0),
        ("f4", np.nan, {}, (), 0),
    ],
)
@pytest.mark.parametrize("chunks", [(4, 9, 2), None])
def test_parts_of_hdf5_that_were_never_written_are_missing(
    tmp_path, dtype, fill, attributes, no_data, warnings, chunks
):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        image = file.create_dataset("cube", CUBE.shape, dtype, chunks=chunks, fillvalue=fill)
        image.attrs.update(attributes)
        if chunks:
            image[:4] = 7
    opened = open_spectral_file(tmp_path / "a.h5")
    assert tuple(number for number in opened.no_data if np.isfinite(number)) == no_data
    told = [text for text in warnings_of(opened) if "never written" in text]
    assert len(told) == warnings, warnings_of(opened)
    missing = find_missing(opened.read(), opened)
    assert missing[4:].all()
    assert missing[:4].any() == (chunks is None)


def test_two_marks_that_are_no_number_are_one(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        image = file.create_dataset("cube", data=CUBE.astype("f4"), fillvalue=np.nan)
        image.attrs.update({"_FillValue": np.float32(np.nan), "missing_value": np.float64(np.nan)})
    assert len(open_spectral_file(tmp_path / "a.h5").no_data) == 1


def test_numbers_of_hdf5_outside_the_file_are_not_followed(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(range(60)))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("cube", (3, 4, 5), "u1", external=[(str(tmp_path / "secret"), 0, 60)])
        file.create_dataset("wavelength", (5,), "u1", external=[(str(tmp_path / "secret"), 0, 5)])
    with pytest.raises(CaptureError, match="the numbers of cube lie in other files"):
        open_spectral_file(tmp_path / "a.h5")


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["f2", ">f4", "u1", "f8"])
def test_npy_arrays_are_mapped(tmp_path, order, dtype):
    np.save(tmp_path / "a.npy", np.asarray(CUBE.astype(dtype), order=order))
    rows_and_bands_of(open_spectral_file(tmp_path / "a.npy"), CUBE.astype(dtype))


def test_the_order_of_axes_can_be_said(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, CUBE.transpose(2, 0, 1))
    check_file(open_spectral_file(path), warning="axis 0 is the shortest")
    check_file(open_spectral_file(path, ReadOptions(axes="byx")), values=CUBE)
    given = open_spectral_file(path, ReadOptions(bands=BandTable(NM, "the test")))
    check_file(given, values=CUBE, evidence="the test")
    with pytest.raises(CaptureError, match="3 wavelengths were given for 5 rows x 8 columns x 9 bands"):
        open_spectral_file(path, ReadOptions(bands=BandTable(NM[:3])))


@pytest.mark.parametrize("kind", ["npy", "npz"])
def test_pickles_are_never_loaded(tmp_path, kind):
    path = tmp_path / f"a.{kind}"
    objects = np.array([[[print]]], dtype=object)
    if kind == "npy":
        np.save(path, objects, allow_pickle=True)
    else:
        np.savez(path, cube=objects)
    with pytest.raises(CaptureError, match=r"a\..*(objects|no data set)"):
        open_spectral_file(path)


@pytest.mark.parametrize("is_zip", [True, False])
def test_tensors_are_refused_with_what_to_do(tmp_path, is_zip):
    torch.save(torch.tensor(PLAIN), tmp_path / "a.pt", _use_new_zipfile_serialization=is_zip)
    with pytest.raises(
        CaptureError, match=r"a\.pt: tensors of PyTorch, which are not read; save them as \.npy"
    ):
        open_spectral_file(tmp_path / "a.pt")


def test_bare_arrays_of_two_axes_are_images(tmp_path):
    np.save(tmp_path / "a.npy", CUBE[..., 0])
    check_file(open_spectral_file(tmp_path / "a.npy"), values=CUBE[..., :1])


def test_members_that_promise_too_much_are_refused(tmp_path):
    header = io.BytesIO()
    described = {"descr": "<u2", "fortran_order": False, "shape": (10**6, 10**6, 9)}
    np.lib.format.write_array_header_1_0(header, described)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("cube.npy", header.getvalue() + bytes(20))
    with pytest.raises(CaptureError, match=r"cube\.npy holds 148 bytes; its header promises 18000000000000$"):
        open_spectral_file(tmp_path / "a.npz")


def prisma(path, zeros=(0, 1), level="L2D"):
    """Two cubes of rows, bands and columns, with wavelengths as attributes of the file."""
    nm = np.linspace(900, 500, 5).astype("f4")
    nm[list(zeros)] = 0
    with h5py.File(path, "w") as file:
        group = file.create_group(f"HDFEOS/SWATHS/PRS_{level}_HCO/Data Fields")
        group["VNIR_Cube"] = CUBE.transpose(0, 2, 1)
        group["SWIR_Cube"] = CUBE[..., :4].transpose(0, 2, 1)
        group["VNIR_PIXEL_L2_ERR"] = np.zeros((8, 5, 9), np.uint8)
        file.attrs["List_Cw_Vnir"] = nm
        file.attrs["List_Cw_Swir"] = np.array([2400, 1800, 1200, 1000], "f4")
        file.attrs["List_Cw_Vnir_Flags"] = (nm > 0).astype("u1")
        file.attrs["List_Fwhm_Vnir"] = np.where(nm > 0, 11, 0).astype("f4")
        numbers = {"L2ScaleVnirMin": -0.1, "L2ScaleVnirMax": 0.9, "ScaleFactor_Swir": 100, "Offset_Swir": 2}
        file.attrs.update({name: np.float32(number) for name, number in numbers.items()})
    return path


def test_a_prisma_cube_has_the_wavelengths_that_fit_it_and_zeros_are_unused_bands(tmp_path):
    path = prisma(tmp_path / "a.he5")
    file = open_spectral_file(path, ReadOptions(dataset="VNIR_Cube"))
    check_file(file, values=CUBE, bad=[0, 1], fwhm=11, calibrated=CUBE / 65535 - 0.1)
    np.testing.assert_array_equal(present(file.bands.wavelengths_nm)[2:], [700, 600, 500])
    other = open_spectral_file(path, ReadOptions(dataset="SWIR_Cube"))
    check_file(other, nm=[2400, 1800, 1200, 1000], calibrated=CUBE[..., :4] / 100 - 2)
    with pytest.raises(CaptureError, match="2 data sets could be the image"):  # none of them their errors
        open_spectral_file(path)


@pytest.mark.parametrize(
    ("level", "is_reflectance"), [("L1", False), ("L2B", False), ("L2C", True), ("L2D", True)]
)
def test_prisma_has_radiance_up_to_level_2b_and_then_reflectance(tmp_path, level, is_reflectance):
    name = "SWIR_Cube" if level == "L1" else "VNIR_Cube"
    file = open_spectral_file(prisma(tmp_path / "a.he5", level=level), ReadOptions(dataset=name))
    assert (stated_reflectance(file) is not None) == is_reflectance
    assert f"of {'reflectance' if is_reflectance else 'radiance'}" in present(finished_by(file))


LARGE = CUBE + np.uint16(50_000)
UNUSED = "also in the file, and not used: scale, mask"


@pytest.mark.parametrize(
    ("stored", "attributes", "valid_range", "no_data"),
    [
        (CUBE, {"valid_min": 0, "valid_max": 5000, "_FillValue": -1}, (0, 5000), (-1, -32767)),
        (CUBE, {"missing_value": np.array([-9, -8], "i2"), "_FillValue": -7}, None, (-7, -9, -8, -32767)),
        (CUBE, {"scale_factor": 0.5, "valid_range": np.array([1.5, 9.5])}, (2.5, 19.5), (-32767,)),
        (LARGE, {"_Unsigned": "true", "_FillValue": -1}, None, (65535,)),
        (LARGE, {"_Unsigned": "true", "valid_min": 0, "valid_max": -5536}, (0, 60_000), ()),
        (LARGE, {"_Unsigned": "true", "valid_range": np.array([1, -5536], "i2")}, (1, 60_000), ()),
    ],
)
def test_what_netcdf_does_not_measure_is_known_by_all_names(
    tmp_path, stored, attributes, valid_range, no_data
):
    """In stored numbers; signed ones may stand for unsigned ones."""
    with scipy.io.netcdf_file(tmp_path / "a.nc", "w") as file:
        for axis, length in zip("yxb", CUBE.shape, strict=True):
            file.createDimension(axis, length)
        variable = file.createVariable("cube", "h", tuple("yxb"))
        variable[:] = stored.view(np.int16)
        for name, value in attributes.items():
            setattr(variable, name, value)
    found = open_spectral_file(tmp_path / "a.nc")
    check_file(found, values=stored, valid_range=valid_range, no_data=no_data)
    assert found.dtype.kind == ("u" if "_Unsigned" in attributes else "i")


@pytest.mark.parametrize(
    ("arrays", "dataset", "expected"),
    [
        ({"rad": CUBE, "rgb": CUBE[..., :3], "bands": NM}, None, {"nm": NM}),
        ({"rad": CUBE, "rgb": CUBE[..., :3], "bands": np.arange(1.0, 6)}, "rad", {"nm": None}),
        ({"cube": CUBE, "bands": [UM]}, None, {"nm": None, "warnings": ()}),
        ({"cube": CUBE, "bands": NM / 1000}, None, {"nm": NM}),
        ({"cube": CUBE, "wavelength": NM, "fwhm_nm": NM / 100}, None, {"nm": NM, "fwhm": NM / 100}),
        ({"cube": CUBE, "wavelength_um": NM / 1000, "fwhm_nm": NM / 100}, None, {"nm": NM, "fwhm": NM / 100}),
        ({"cube": CUBE, "wavelengths": [1, 2, 3, 4, 5]}, None, {"nm": None, "warning": "1 to 5 with no un"}),
        ({"cube": CUBE, "bbl": GOOD}, None, {"bad": [1], "warnings": ()}),
        ({"cube": CUBE, "exposure_ms": [5.0]}, None, {"notes": (), "exposure_s": 0.005}),
        ({"cube": CUBE, "exposure_ms": 5.0}, None, {"notes": (), "exposure_s": 0.005}),
        ({"cube": CUBE, "scale": 1e4, "mask": CUBE[..., 0] > 0}, None, {"notes": (UNUSED,)}),
    ],
)
def test_arrays_beside_the_image_are_used_by_their_names_or_said_not_to_be(
    tmp_path, arrays, dataset, expected
):
    np.savez(tmp_path / "a.npz", **arrays)
    check_file(open_spectral_file(tmp_path / "a.npz", ReadOptions(dataset=dataset)), **expected)
