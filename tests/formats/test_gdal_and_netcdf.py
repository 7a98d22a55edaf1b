"""Files exchanged with GDAL (as rasterio) and netCDF4: they read what is written here, and what they write is read."""

from typing import Any

import numpy as np
import pytest

from tests.factories.cubes import BANDS, WAVELENGTHS_NM, random_cube
from tests.factories.files import check_file, rows_and_bands_of
from unmix_plugin.captures.calibration.references import find_missing
from unmix_plugin.captures.cube import ReadOptions
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.formats.envi import write_envi_cube

COUNTS = np.random.default_rng(0).integers(0, 60000, (70, 50, 5)).astype(np.uint16)
NM = np.array(WAVELENGTHS_NM)


pytestmark = pytest.mark.filterwarnings("ignore:Dataset has no geotransform")


@pytest.fixture(scope="module")
def rasterio() -> Any:
    return pytest.importorskip("rasterio")


def write_by_gdal(rasterio, path, driver, values=COUNTS, has_names=False, **options):
    """Write with GDAL; also, if asked, wavelengths and names of bands."""
    height, width, count = values.shape
    shape = {"height": height, "width": width, "count": count, "dtype": values.dtype.name}
    with rasterio.open(path, "w", driver=driver, **shape, **options) as file:
        file.write(values.transpose(2, 0, 1))
        for band, nm in enumerate(NM if has_names else (), start=1):
            file.update_tags(band, wavelength=f"{nm:.9g}", wavelength_units="Nanometers")
            file.set_band_description(band, f"at {nm:g} nm")


def test_gdal_reads_the_cubes_that_are_written(rasterio, tmp_path):
    cube = random_cube()
    write_envi_cube(tmp_path / "view", cube, BANDS, None, "numbers")
    with rasterio.open(tmp_path / "view.img") as file:
        np.testing.assert_array_equal(file.read().transpose(1, 2, 0), cube)
        read = [file.tags(band) for band in file.indexes]
    assert [float(tags["wavelength"]) for tags in read] == list(WAVELENGTHS_NM)
    assert {tags["wavelength_units"] for tags in read} == {"Nanometers"}


@pytest.mark.parametrize("interleave", ["bip", "bil", "bsq"])
@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32", "float64"])
def test_envi_images_of_gdal_are_read(rasterio, tmp_path, interleave, dtype):
    values = (COUNTS // 256).astype(dtype)
    write_by_gdal(rasterio, tmp_path / "view.img", "ENVI", values, interleave=interleave)
    file = open_spectral_file(tmp_path / "view.hdr")
    rows_and_bands_of(file, values)
    check_file(file, reader="envi", interleave=interleave)


STORAGE = {
    "strips": {},
    "bands beside each other": {"interleave": "pixel"},
    "tiles": {"tiled": True, "blockxsize": 32, "blockysize": 16, "interleave": "band"},
    "deflate": {"compress": "deflate", "predictor": 2, "interleave": "pixel"},
    "LZW tiles": {"compress": "lzw", "predictor": 2, "tiled": True, "blockxsize": 16, "blockysize": 16},
    "Zstandard": {"compress": "zstd", "zstd_level": 1},
    "BigTIFF": {"bigtiff": "yes"},
    "big-endian": {"endianness": "big"},
}


@pytest.mark.parametrize("storage", STORAGE)
def test_geotiffs_of_gdal_are_read(rasterio, tmp_path, storage):
    write_by_gdal(rasterio, tmp_path / "view.tif", "GTiff", has_names=True, **STORAGE[storage])
    file = open_spectral_file(tmp_path / "view.tif")
    rows_and_bands_of(file, COUNTS)
    check_file(file, nm=NM, warnings=())


@pytest.mark.parametrize("driver", ["GTiff", "ENVI"])
def test_gains_offsets_and_no_data_of_gdal_hold(rasterio, tmp_path, driver):
    """In the TIFF itself; of an ENVI image in the header and in the XML that GDAL writes beside it."""
    path = tmp_path / "view.img"
    write_by_gdal(rasterio, path, driver, nodata=7)
    gains, offsets = np.linspace(1e-4, 5e-4, 5), np.linspace(-0.1, 0.1, 5)
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = gains, offsets
    file = open_spectral_file(path)
    check_file(file, values=COUNTS, no_data=(7,), calibrated=COUNTS * gains + offsets)


FORMATS = ["NETCDF4", "NETCDF4_CLASSIC", "NETCDF3_CLASSIC", "NETCDF3_64BIT_OFFSET"]


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("axes", [("y", "x", "wavelength"), ("wavelength", "y", "x")])
def test_images_of_netcdf4_are_read(tmp_path, form, axes):
    """Packed, with a fill value, by its conventions."""
    values = COUNTS.astype(np.int16) // 2
    sizes = dict(zip(("y", "x", "wavelength"), values.shape, strict=True))
    netcdf4: Any = pytest.importorskip("netCDF4")
    packing = {"zlib": True, "shuffle": True} if form.startswith("NETCDF4") else {}
    with netcdf4.Dataset(tmp_path / "view.nc", "w", format=form) as file:
        for name, size in sizes.items():
            file.createDimension(name, size)
        wavelength = file.createVariable("wavelength", "f8", ("wavelength",))
        wavelength[:], wavelength.units = NM / 1000, "um"
        image = file.createVariable("radiance", "i2", axes, fill_value=-999, **packing)
        image.set_auto_maskandscale(False)
        image.scale_factor, image.add_offset = 0.001, 0.5
        image[:] = values.transpose([list(sizes).index(name) for name in axes])
        with_gap = tuple(slice(0, 3) if name == "y" else slice(None) for name in axes)
        image[with_gap] = -999
    values[:3] = -999
    file = open_spectral_file(tmp_path / "view.nc")
    rows_and_bands_of(file, values)
    check_file(file, nm=NM, calibrated=values * 0.001 + 0.5)
    missing = find_missing(file.read(), file)
    assert missing[:3].all()
    assert not missing[3:].any()


def test_groups_of_netcdf4_are_named_by_their_paths(tmp_path):
    netcdf4: Any = pytest.importorskip("netCDF4")
    with netcdf4.Dataset(tmp_path / "view.nc", "w") as file:
        for name, factor in (("first", 1), ("second", 2)):
            group = file.createGroup(name)
            for axis, size in zip("yxb", COUNTS.shape, strict=True):
                group.createDimension(axis, size)
            group.createVariable("radiance", "u2", ("y", "x", "b"))[:] = COUNTS // factor
    asked = ReadOptions(dataset="second/radiance")
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "view.nc", asked).read(), COUNTS // 2)
