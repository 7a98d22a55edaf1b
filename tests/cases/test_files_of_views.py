"""Cubes as cameras and programs write them: each is read with its right values, or refused with the right cause."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from tests.factories.files import gdal_items, gdal_tag
from tests.factories.forms import (
    FOCAL_PX,
    HEIGHT,
    RED_GREEN_BLUE,
    VIEWS,
    WAVELENGTHS_NM,
    WIDTH,
    braced,
    counts,
    cube,
    cube_of,
    not_processed,
    number_of,
    pose_of,
    processed,
    write_envi,
    write_transforms,
)

GAIN, OFFSET = np.linspace(1e-4, 4e-5, 7), np.linspace(-0.1, -0.02, 7)
LAMP = np.linspace(9000, 14000, 7)
NAMES = [f"view_{index:03d}" for index in range(VIEWS)]


def cubes(root, *words, output, poses="transforms.json"):
    return processed("cubes", "--data", root, "--poses", poses, *words, output=output)


@pytest.mark.parametrize("kind", ["envi", "tiff"])
def test_a_gain_and_an_offset_a_band_are_applied(kind, tmp_path):
    root = tmp_path / "capture"
    root.mkdir()
    for index, name in enumerate(NAMES):
        stored = np.clip(np.rint((cube(index) - OFFSET) / GAIN), 0, 65535).astype(np.uint16)
        if kind == "envi":
            linear = {"data_gain_values": braced(GAIN), "data_offset_values": braced(OFFSET)}
            write_envi(root / f"{name}.hdr", stored, "bsq", suffix=".img", **linear)
        else:
            tag = gdal_tag(
                gdal_items("WAVELENGTH", WAVELENGTHS_NM),
                gdal_items("WAVELENGTH_UNITS", ["Nanometers"] * 7),
                gdal_items("OFFSET", OFFSET, ' role="offset"'),
                gdal_items("SCALE", GAIN, ' role="scale"'),
            )
            planes = np.moveaxis(stored, -1, 0)
            tifffile.imwrite(
                root / f"{name}.tif", planes, planarconfig="separate", photometric="minisblack", extratags=tag
            )
    write_transforms(root / "transforms.json", NAMES)
    cubes(root, output=tmp_path / "scene").check_values(cube_of)


def test_integration_times_of_headers_are_divided_out(tmp_path):
    root = tmp_path / "capture"
    for index, name in enumerate(NAMES):
        tint = 20.0 if index % 2 else 10.0
        write_envi(root / f"{name}.hdr", counts(cube(index), LAMP * tint / 5, 200), tint=tint)
    write_envi(root / "white.hdr", counts(np.ones((8, WIDTH, 7)), LAMP, 200), tint=5.0)
    write_envi(root / "dark.hdr", counts(np.zeros((8, WIDTH, 7)), LAMP, 200), tint=20.0)
    write_transforms(root / "transforms.json", NAMES)
    references = "--white", root / "white.hdr", "--dark", root / "dark.hdr"
    cubes(root, *references, output=tmp_path / "scene").check_values(cube_of, 0.01)


def test_views_of_a_lumo_tree_have_their_own_references(tmp_path):
    for index in range(VIEWS):
        folder, name = tmp_path / "capture" / f"{212 + index}" / "capture", f"{212 + index}"
        lamp = LAMP * (1 + 0.1 * index)
        write_envi(folder / f"{name}.hdr", counts(cube(index), lamp, 300), tint=10)
        write_envi(folder / f"WHITEREF_{name}.hdr", counts(np.ones((8, WIDTH, 7)), lamp, 300), tint=10)
        write_envi(folder / f"DARKREF_{name}.hdr", counts(np.zeros((8, WIDTH, 7)), lamp, 300), tint=10)
        (folder.parent / "manifest.xml").write_text("<manifest/>")
    write_transforms(tmp_path / "poses.json", [f"{212 + index}.hdr" for index in range(VIEWS)])
    scene = cubes(tmp_path / "capture", output=tmp_path / "scene", poses=tmp_path / "poses.json")
    assert len(scene.views) == VIEWS
    scene.check_values(lambda name: cube(number_of(name) - 212), 0.01)


def exr(path, channels, **header):
    usual = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "spectralLayoutVersion": "1.0",
    }
    OpenEXR.File({**usual, **header}, channels).write(str(path))


def spectral(layer, values, gain=1.0):
    """Channels of a layer (H, W, B)."""
    names = [f"{layer}." + f"{nm:.6f}nm".replace(".", ",") for nm in WAVELENGTHS_NM]
    return {name: np.ascontiguousarray(values[..., b] * gain, np.float32) for b, name in enumerate(names)}


def rgb(values):
    return {key: np.ascontiguousarray(values[..., b]) for key, b in zip("RGB", RED_GREEN_BLUE, strict=True)}


def test_the_parts_of_an_exr_are_joined(tmp_path):
    for index, name in enumerate(NAMES):
        values = cube(index).astype(np.float32)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        parts = [
            OpenEXR.Part({**header, "name": "preview"}, rgb(values)),
            OpenEXR.Part({**header, "name": "spectral"}, spectral("S0", values)),
        ]
        OpenEXR.File(parts).write(str(tmp_path / f"{name}.exr"))
    write_transforms(tmp_path / "transforms.json", NAMES)
    scene = cubes(tmp_path, output=tmp_path / "scene")
    assert len(scene.wavelengths_nm) == 7
    scene.check_values(cube_of)


def more_layers(kind, values):
    """Channels beside those that count."""
    plane, names = np.full((HEIGHT, WIDTH), 7.0, np.float32), list(spectral("T", values))
    if kind == "bispectral":
        return spectral("T", values) | {
            f"{a}.{b[2:]}": plane for i, a in enumerate(names) for b in names[i + 1 :]
        }
    stokes = {
        key: one
        for s, gain in enumerate((1, 0.3, -0.2, 0.01))
        for key, one in spectral(f"S{s}", values, gain).items()
    }
    return stokes if kind == "polarised" else stokes | spectral("T", np.full_like(values, 0.5))


@pytest.mark.parametrize("kind", ["bispectral", "polarised", "polarised and reflective"])
def test_the_layer_that_a_spectral_exr_means_is_taken(kind, tmp_path):
    for index, name in enumerate(NAMES):
        values = cube(index).astype(np.float32)
        exr(tmp_path / f"{name}.exr", rgb(values) | more_layers(kind, values))
    write_transforms(tmp_path / "transforms.json", NAMES)
    cubes(tmp_path, output=tmp_path / "scene").check_values(cube_of)


def test_layers_that_no_standard_names_are_asked_for(tmp_path):
    for index, name in enumerate(NAMES):
        values, gains = cube(index).astype(np.float32), {"albedo": 0.5, "beauty": 1.0, "specular": 0.1}
        layers = {
            key: one for layer, gain in gains.items() for key, one in spectral(layer, values, gain).items()
        }
        exr(tmp_path / f"{name}.exr", rgb(values) | layers)
    write_transforms(tmp_path / "transforms.json", NAMES)
    words = "cubes", "--data", tmp_path, "--poses", "transforms.json"
    message = not_processed(*words, output=tmp_path / "scene")
    assert all(layer in message for layer in ("albedo", "beauty", "specular"))
    assert "--dataset" in message
    processed(*words, "--dataset", "beauty", output=tmp_path / "scene").check_values(cube_of)


def window_of(index):
    """First and last row and column of the part of a picture that was rendered."""
    return 2, HEIGHT - 4, 3 + index, WIDTH - 8 + index


def test_the_window_of_an_exr_lies_where_it_belongs(tmp_path):
    for index, name in enumerate(NAMES):
        top, bottom, left, right = window_of(index)
        part = cube(index).astype(np.float32)[top : bottom + 1, left : right + 1]
        windows = {
            "dataWindow": (np.array([left, top], np.int32), np.array([right, bottom], np.int32)),
            "displayWindow": (np.array([0, 0], np.int32), np.array([WIDTH - 1, HEIGHT - 1], np.int32)),
        }
        exr(tmp_path / f"{name}.exr", spectral("S0", part), **windows)
    write_transforms(tmp_path / "transforms.json", NAMES)
    scene = cubes(tmp_path, "--mask", "none", output=tmp_path / "scene")
    for view in scene.views:
        top, bottom, left, right = window_of(number_of(view.name))
        assert (view.entries["fl_x"], view.entries["cx"], view.entries["cy"]) == (
            FOCAL_PX,
            WIDTH / 2,
            HEIGHT / 2,
        )
        inside = np.zeros((HEIGHT, WIDTH), bool)
        inside[top : bottom + 1, left : right + 1] = True
        factor = (view.values * cube_of(view.name))[inside].sum() / np.square(
            cube_of(view.name)[inside]
        ).sum()
        assert np.abs(view.values / factor - cube_of(view.name))[inside].max() < 0.02
        assert not view.values[~inside].any()


@pytest.mark.parametrize("compression", ["deflate", "lzw"])
def test_compressed_strips_hold_what_was_stored(compression, tmp_path):
    told = "wavelengths = " + ", ".join(f"{nm:g}" for nm in WAVELENGTHS_NM)
    for index, name in enumerate(NAMES):
        tifffile.imwrite(
            tmp_path / f"{name}.tif",
            np.moveaxis(np.rint(cube(index) * 10000).astype(np.uint16), -1, 0),
            photometric="minisblack",
            rowsperstrip=5,
            compression=compression,
            description=told,
        )
    write_transforms(tmp_path / "transforms.json", NAMES)
    cubes(tmp_path, output=tmp_path / "scene").check_values(cube_of)


def test_a_gain_that_only_some_views_state_is_warned_of(tmp_path):
    for index, name in enumerate(NAMES):
        stored = counts(cube(index), LAMP, 0)
        stated: dict[str, Any] = {"tint": 10.0, "gain": 2.0} if index % 2 else {"tint": 10.0}
        write_envi(tmp_path / f"{name}.hdr", stored, **stated)
    write_transforms(tmp_path / "transforms.json", NAMES)
    scene = cubes(tmp_path, output=tmp_path / "scene")
    assert any("looks wrong" in line and "gain" in line for line in scene.printed.splitlines())


def test_a_header_beside_a_tiff_describes_it(tmp_path):
    for index, name in enumerate(NAMES):
        planes = np.moveaxis(cube(index).astype(np.float32), -1, 0)
        tifffile.imwrite(tmp_path / f"{name}.tif", planes, planarconfig="separate", photometric="minisblack")
        entries = {"samples": WIDTH, "lines": HEIGHT, "bands": 7, "file type": "TIFF", "data type": 4}
        entries |= {
            "interleave": "bsq",
            "wavelength": braced(WAVELENGTHS_NM / 1000),
            "bbl": "{1,1,1,1,0,1,1}",
        }
        entries |= {"byte order": 0, "wavelength units": "Micrometers"}
        lines = "".join(f"{key} = {value}\n" for key, value in entries.items())
        (tmp_path / f"{name}.hdr").write_text(f"ENVI\n{lines}")
    write_transforms(tmp_path / "transforms.json", NAMES)
    scene = cubes(tmp_path, output=tmp_path / "scene")
    np.testing.assert_allclose(scene.wavelengths_nm, np.delete(WAVELENGTHS_NM, 4))
    scene.check_values(lambda name: np.delete(cube_of(name), 4, axis=2))


def shape_of(index):
    return (HEIGHT, WIDTH) if index % 2 else (WIDTH, HEIGHT)


def test_upright_and_lying_pictures_make_one_scene(tmp_path):
    for index, name in enumerate(NAMES):
        write_envi(tmp_path / f"{name}.hdr", cube(index, *shape_of(index)).astype(np.float32))

    def lens(index):
        height, width = shape_of(index)
        return {"w": width, "h": height, "cx": width / 2, "cy": height / 2}

    write_transforms(tmp_path / "transforms.json", NAMES, of_frame=lens)
    scene = cubes(tmp_path, output=tmp_path / "scene")
    scene.check_values(lambda name: cube(number_of(name), *shape_of(number_of(name))))
    scene.check_poses(pose_of)


def test_bands_are_put_in_order(tmp_path):
    nm = np.array([980, 900, 820, 700, 620, 460, 1050, 990, 900.0])
    bad, kept = 4, [5, 3, 2, 1, 0, 7, 6]
    for index, name in enumerate(NAMES):
        stored = np.rint(cube(index, nm=nm) * 10000).astype(">u2")
        good = braced(int(band != bad) for band in range(9))
        write_envi(
            tmp_path / f"{name}.hdr",
            stored,
            "bsq",
            wavelength=braced(nm),
            bbl=good,
            reflectance_scale_factor=10000,
        )
    write_transforms(tmp_path / "transforms.json", NAMES)
    scene = cubes(tmp_path, output=tmp_path / "scene")
    np.testing.assert_allclose(scene.wavelengths_nm, nm[kept])
    scene.check_values(lambda name: cube(number_of(name), nm=nm)[..., kept])


LISTED, LISTED_UM = braced(WAVELENGTHS_NM, "{:g}"), braced(WAVELENGTHS_NM / 1000, "{:g}")
BASE = (
    f"ENVI\nsamples = {WIDTH}\nlines = {HEIGHT}\nbands = 7\nheader offset = 0\nfile type = ENVI Standard\n"
    "data type = 4\ninterleave = bil\nbyte order = 0\n"
)
ODD_HEADERS = {
    "micro sign in Latin-1": (f"{BASE}wavelength units = \xb5m\nwavelength = {LISTED_UM}\n", "latin-1"),
    "an underscore": (f"{BASE}wavelength_units = Nanometers\nwavelength = {LISTED}\n", "utf-8"),
    "unit misspelt": (f"{BASE}wavelength_unts = Micrometers\nwavelength = {LISTED_UM}\n", "utf-8"),
    "unit unknown": (f"{BASE}wavelength units = Unknown\nwavelength = {LISTED_UM}\n", "utf-8"),
    "nested brackets": (
        f"{BASE}description = {{A[B],[C]}}\nwavelength units = nm\nwavelength = {LISTED}\n",
        "utf-8",
    ),
    "tabs and CRLF": (
        f"{BASE}wavelength units = nm\nwavelength = {LISTED}\n".replace(" = ", "\t=\t").replace("\n", "\r\n"),
        "utf-8",
    ),
    "capitals": (
        f"{BASE}WAVELENGTH UNITS = NANOMETERS\nWAVELENGTH = {LISTED}\n".replace("samples", "SAMPLES"),
        "utf-8",
    ),
    "UTF-16": (f"{BASE}wavelength units = nm\nwavelength = {LISTED}\n", "utf-16"),
}


@pytest.mark.parametrize("kind", ODD_HEADERS)
def test_odd_headers_are_read(kind, tmp_path):
    text, encoding = ODD_HEADERS[kind]
    for index, name in enumerate(NAMES):
        (tmp_path / f"{name}.hdr").write_bytes(text.encode(encoding))
        (tmp_path / f"{name}.raw").write_bytes(cube(index).astype(np.float32).transpose(0, 2, 1).tobytes())
    write_transforms(tmp_path / "transforms.json", NAMES)
    scene = cubes(tmp_path, output=tmp_path / "scene")
    np.testing.assert_allclose(scene.wavelengths_nm, WAVELENGTHS_NM, rtol=1e-4)
    scene.check_values(cube_of)


def write_array(kind, path, values):
    match kind:
        case "fortran.npy":
            np.save(path, np.asfortranarray(values))
        case "big-endian.npy":
            np.save(path, values.astype(">f4"))
        case "cube.npz":
            np.savez(path, cube=values, wavelengths=WAVELENGTHS_NM)
        case "prisma.he5":
            with h5py.File(path, "w") as file:
                fields = file.create_group("HDFEOS/SWATHS/PRS_L2D_HCO/Data Fields")
                fields["VNIR_Cube"] = np.rint(values[..., ::-1] * 65535).astype(np.uint16).transpose(0, 2, 1)
                fields["SWIR_Cube"] = np.zeros((HEIGHT, 5, WIDTH), np.uint16)
                file.attrs["List_Cw_Vnir"] = WAVELENGTHS_NM[::-1].astype(np.float32)
                file.attrs["List_Cw_Swir"] = np.array([2400, 2000, 1500, 1000, 0], np.float32)
        case "emit.nc":
            with h5py.File(path, "w") as file:
                file["reflectance"] = values
                file["sensor_band_parameters/wavelengths"] = WAVELENGTHS_NM
                file["location/lat"] = np.zeros((HEIGHT, WIDTH))
        case "neon.h5":
            with h5py.File(path, "w") as file:
                stored = np.rint(values * 10000).astype(np.int16)
                data = file.create_dataset("SITE/Reflectance/Reflectance_Data", data=stored)
                data.attrs["Scale_Factor"] = 10000.0
                file["SITE/Reflectance/Metadata/Spectral_Data/Wavelength"] = WAVELENGTHS_NM
        case "arad.mat" | "icvl.mat":
            with h5py.File(path, "w", userblock_size=512) as file:
                file["cube" if kind == "arad.mat" else "rad"], file["bands"] = (
                    values.T,
                    WAVELENGTHS_NM[:, None],
                )
            with path.open("r+b") as file:
                file.write(b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("unit", ["Wavenumber", "cm-1", "Index"])
def test_a_list_in_another_unit_gives_no_wavelengths(unit, tmp_path):
    for index, name in enumerate(NAMES):
        numbers = braced(1e7 / WAVELENGTHS_NM) if unit != "Index" else braced(range(1, 8))
        write_envi(
            tmp_path / f"{name}.hdr",
            cube(index).astype(np.float32),
            wavelength=numbers,
            wavelength_units=unit,
        )
    write_transforms(tmp_path / "transforms.json", NAMES)
    message = not_processed(
        "cubes", "--data", tmp_path, "--poses", "transforms.json", output=tmp_path / "scene"
    )
    assert "the wavelengths of its 7 bands are unknown" in message


@pytest.mark.parametrize(
    "kind",
    ["fortran.npy", "big-endian.npy", "cube.npz", "prisma.he5", "emit.nc", "neon.h5", "arad.mat", "icvl.mat"],
)
def test_arrays_are_read_in_the_order_of_their_axes(kind, tmp_path):
    suffix = kind.partition(".")[2]
    for index, name in enumerate(NAMES):
        write_array(kind, tmp_path / f"{name}.{suffix}", cube(index).astype(np.float32))
    write_transforms(tmp_path / "transforms.json", NAMES)
    words = ["--dataset", "VNIR_Cube"] if suffix == "he5" else []
    words += ["--wavelengths", ",".join(f"{nm:g}" for nm in WAVELENGTHS_NM)] if suffix == "npy" else []
    scene = cubes(tmp_path, *words, output=tmp_path / "scene")
    np.testing.assert_allclose(scene.wavelengths_nm, WAVELENGTHS_NM, rtol=1e-6)
    scene.check_values(cube_of)


@pytest.mark.parametrize("interleave", ["bil", "bsq", "bip"])
@pytest.mark.parametrize("after", ["", "_rd_rf"])
def test_the_parts_of_a_scan_are_joined(after, interleave, tmp_path):
    """With the references that lie beside them, as Headwall's cameras write them."""
    for index in range(VIEWS):
        folder, lamp = tmp_path / f"scan_{index:02d}", LAMP / 5 * (0.7 + 0.1 * (index % 3))
        stored = counts(cube(index), lamp, 90)
        for first, last in ((0, 9), (9, 18), (18, HEIGHT)):  # raw_9 after raw_18 by letters
            write_envi(folder / f"raw_{first}{after}.hdr", stored[first:last], interleave)
        write_envi(folder / "darkReference.hdr", counts(np.zeros((5, WIDTH, 7)), lamp, 90), interleave)
        write_envi(folder / "whiteReference.hdr", counts(np.ones((5, WIDTH, 7)), lamp, 90), interleave)
    names = [f"scan_{index:02d}/raw_0{after}.hdr" for index in range(VIEWS)]
    write_transforms(tmp_path / "transforms.json", names)
    scene = cubes(tmp_path, output=tmp_path / "scene")
    assert len(scene.views) == VIEWS
    scene.check_values(lambda name: cube(int(name.split("_")[1])), tolerance=0.03)
    assert "parts of one scan were joined: raw_0" in scene.printed


def test_parts_of_a_scan_with_a_line_missing_are_refused(tmp_path):
    for index in range(VIEWS):
        stored = counts(cube(index), LAMP, 90)
        for name, rows in (("raw_0", stored[:14]), ("raw_15", stored[14:])):
            write_envi(tmp_path / f"scan_{index:02d}" / f"{name}.hdr", rows)
    write_transforms(tmp_path / "transforms.json", [f"scan_{index:02d}/raw_0.hdr" for index in range(VIEWS)])
    words = "cubes", "--data", tmp_path, "--poses", "transforms.json"
    message = not_processed(*words, output=tmp_path / "scene")
    assert "raw_0.hdr and raw_15.hdr are named like parts of one scan" in message


MOSAIC_NM = np.random.default_rng(0).permutation(np.linspace(460, 630, 16))
"""The filters of a sensor are not in the order of their wavelengths."""


def write_mosaics(root, suffix, filters=(4, 4), rest=0):
    rows, columns = filters
    for index, name in enumerate(NAMES):
        values = np.rint(cube(index, nm=MOSAIC_NM[: rows * columns]) * 1000)
        mosaic = np.zeros((rows * HEIGHT + rest, columns * WIDTH + rest), np.uint16)
        for band, plane in enumerate(np.moveaxis(values, -1, 0)):
            mosaic[band // columns : rows * HEIGHT : rows, band % columns : columns * WIDTH : columns] = plane
        if suffix == ".png":
            Image.fromarray(mosaic).save(root / f"{name}.png")
        else:
            tifffile.imwrite(
                root / f"{name}.tif", mosaic, compression="zlib" if suffix == ".zip.tif" else None
            )
    lens = {
        "w": columns * WIDTH + rest,
        "h": rows * HEIGHT + rest,
        "cx": columns * WIDTH / 2,
        "cy": rows * HEIGHT / 2,
    }
    names = [f"{name}.png" if suffix == ".png" else f"{name}.tif" for name in NAMES]
    write_transforms(root / "transforms.json", names, focal_px=FOCAL_PX * columns, **lens)


@pytest.mark.parametrize(
    ("suffix", "filters", "rest"), [(".png", (4, 4), 0), (".tif", (4, 4), 0), (".zip.tif", (3, 3), 0)]
)
def test_a_mosaic_is_taken_apart_with_the_wavelengths_of_its_filters(suffix, filters, rest, tmp_path):
    write_mosaics(tmp_path, suffix, filters, rest)
    nm = MOSAIC_NM[: filters[0] * filters[1]]
    words = "--mosaic", f"{filters[0]}x{filters[1]}", "--wavelengths", ",".join(f"{one:.3f}" for one in nm)
    scene = cubes(tmp_path, *words, output=tmp_path / "scene")
    np.testing.assert_allclose(scene.wavelengths_nm, np.sort(nm), atol=1e-3)
    scene.check_values(lambda name: cube(number_of(name), nm=nm)[..., np.argsort(nm)])
    np.testing.assert_allclose(scene.views[0].entries["fl_x"], FOCAL_PX, rtol=1e-6)
    scene.check_poses(pose_of)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_mosaic_is_called_one_with_what_to_do(suffix, tmp_path):
    write_mosaics(tmp_path, suffix)
    words = "cubes", "--data", tmp_path, "--poses", "transforms.json"
    for more in ((), ("--wavelengths", ",".join(f"{nm:.1f}" for nm in MOSAIC_NM))):
        message = not_processed(*words, *more, output=tmp_path / "scene")
        assert "mosaic camera, 4 x 4 filters: give --mosaic 4x4" in message


def test_a_grey_picture_is_no_mosaic(tmp_path):
    for index, name in enumerate(NAMES):
        grey = np.kron(np.rint(cube(index)[..., 2] * 60000).astype(np.uint16), np.ones((4, 4), np.uint16))
        Image.fromarray(grey).save(tmp_path / f"{name}.png")
    write_transforms(tmp_path / "transforms.json", NAMES, w=4 * WIDTH, h=4 * HEIGHT)
    words = "cubes", "--data", tmp_path, "--poses", "transforms.json"
    message = not_processed(*words, output=tmp_path / "scene")
    assert "wavelengths of its 1 bands are unknown" in message
    assert "mosaic" not in message


@pytest.mark.parametrize("of_cube", ["_cube", ""])
def test_previews_beside_cubes_are_left_out_and_named(of_cube, tmp_path):
    """As Cubert's export writes them."""
    names = [f"session_{index:03d}{of_cube}" for index in range(VIEWS)]
    for index, name in enumerate(names):
        stored = np.rint(cube(index) * 10000).astype(np.uint16)
        told = "wavelengths = " + ", ".join(f"{nm:g}" for nm in WAVELENGTHS_NM)
        planes = np.moveaxis(stored, -1, 0)
        tifffile.imwrite(tmp_path / f"{name}.tiff", planes, photometric="minisblack", description=told)
        shown = np.kron(stored[..., 0], np.ones((2, 2), np.uint16))
        tifffile.imwrite(tmp_path / f"session_{index:03d}_pan.tiff", shown)
        colours = np.rint(cube(index)[..., RED_GREEN_BLUE] * 255).astype(np.uint8)
        tifffile.imwrite(tmp_path / f"session_{index:03d}_view.tiff", colours, photometric="rgb")
    write_transforms(tmp_path / "transforms.json", [f"{name}.tiff" for name in names])
    scene = cubes(tmp_path, output=tmp_path / "scene")
    assert [view.name for view in scene.views] == names
    scene.check_values(lambda name: cube(int(name.split("_")[1])))
    scene.check_poses(lambda name: pose_of(name.removesuffix("_cube")))
    assert "session_000_pan.tiff, session_000_view.tiff" in scene.printed


@pytest.mark.parametrize("empty", [np.nan, -9999.0])
def test_a_band_that_is_marked_as_bad_changes_nothing_but_itself(empty, tmp_path):
    """Atmospheric correction leaves bands without a number; the exposures of its floats stay those of the raw files."""
    for index in range(VIEWS):
        values = cube(index).astype(np.float32)
        values[..., 2] = empty
        entries: dict[str, Any] = {
            "tint": 10 + 10 * (index % 2),
            "bbl": "{1, 1, 0, 1, 1, 1, 1}",
            "data_ignore_value": -9999,
        }
        write_envi(tmp_path / "capture" / f"view_{index}.hdr", values, **entries)
    write_transforms(tmp_path / "capture/transforms.json", [f"view_{index}" for index in range(VIEWS)])
    given = "cubes", "--data", tmp_path / "capture", "--poses", "transforms.json"
    scene = processed(*given, output=tmp_path / "scene")
    scene.check_values(lambda name: np.delete(cube_of(name), 2, axis=2))


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_a_no_data_value_that_no_file_names_is_said(dtype, tmp_path):
    for index in range(VIEWS):
        values = np.rint(cube(index) * 10000).astype(dtype)
        values[3:6] = -9999
        entries: dict[str, Any] = {"reflectance_scale_factor": 10000}
        write_envi(tmp_path / "capture" / f"view_{index}.hdr", values, **entries)
    write_transforms(tmp_path / "capture/transforms.json", [f"view_{index}" for index in range(VIEWS)])
    given = "cubes", "--data", tmp_path / "capture", "--poses", "transforms.json"
    said = processed(*given, output=tmp_path / "scene").printed
    assert "many pixels hold -9999 in every band" in said
    assert "dark frame is brighter" not in said


def test_a_refusal_for_want_of_wavelengths_says_why_those_of_the_file_are_none(tmp_path):
    for index in range(VIEWS):
        entries: dict[str, Any] = {"wavelength_units": "Micrometers"}
        write_envi(tmp_path / "capture" / f"view_{index}.hdr", cube(index).astype(np.float32), **entries)
    write_transforms(tmp_path / "capture/transforms.json", [f"view_{index}" for index in range(VIEWS)])
    given = "cubes", "--data", tmp_path / "capture", "--poses", "transforms.json"
    assert "450 to 900 can't be in Micrometers" in not_processed(*given, output=tmp_path / "scene")
