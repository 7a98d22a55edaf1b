"""Spectral OpenEXR, read back with the OpenEXR library and checked against the layout."""

import re

import numpy as np
import OpenEXR
import pytest

from tests.factories.cubes import BANDS, WAVELENGTHS_NM, random_cube
from unmix_plugin.errors import RunError
from unmix_plugin.formats.exr import write_exr, write_spectral_exr


def opened(path):
    """Header, and pixels by channel."""
    file = OpenEXR.File(str(path), separate_channels=True)
    return file.header(), {name: channel.pixels for name, channel in file.channels().items()}


def wavelength_of(name):
    """What the layout's own expression reads in a channel's name."""
    found = re.fullmatch(r"(?:S0|T)\.(\d+(?:,\d+)?)nm", name)
    return float(found[1].replace(",", ".")) if found else 0.0


@pytest.mark.parametrize(
    ("laid_out", "quantity"),
    [
        (np.asfortranarray, "radiance"),
        (lambda cube: cube[::-1][::-1], "reflectance"),
        (lambda cube: np.moveaxis(np.moveaxis(cube, 2, 0).copy(), 0, 2), "radiance"),
    ],
)
def test_each_band_is_a_channel_named_by_its_wavelength_however_numbers_lie_in_memory(
    tmp_path, laid_out, quantity
):
    cube, path = random_cube(), tmp_path / "deep" / "view.exr"
    write_spectral_exr(path, laid_out(cube), BANDS, cube[..., :3], cube[..., 4], "of a test", quantity)
    header, channels = opened(path)
    assert (header["spectralLayoutVersion"], header["comments"]) == ("1.0", "of a test")
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    spectral = sorted((name for name in channels if wavelength_of(name)), key=wavelength_of)
    assert tuple(map(wavelength_of, spectral)) == WAVELENGTHS_NM
    assert {name[:2] for name in spectral} == {"S0" if quantity == "radiance" else "T."}
    assert header.get("emissiveUnits") == ("W.m^-2.sr^-1" if quantity == "radiance" else None)
    found = np.stack([channels[name] for name in spectral], axis=-1)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, cube)
    np.testing.assert_array_equal(np.stack([channels[name] for name in "RGB"], axis=-1), cube[..., :3])
    np.testing.assert_array_equal(channels["A"], cube[..., 4])
    with pytest.raises(ValueError, match="5 wavelengths for spectra of shape"):
        write_spectral_exr(tmp_path / "v.exr", random_cube(bands=4), BANDS, None)


def test_channels_of_any_name_keep_their_type(tmp_path):
    values = random_cube()[..., 0]
    ids = np.arange(35, dtype=np.uint32).reshape(7, 5)
    _, channels = opened(write_exr(tmp_path / "v.exr", {"Z": values, "layer.ids": ids}, {}))
    np.testing.assert_array_equal(channels["Z"], values)
    np.testing.assert_array_equal(channels["layer.ids"], ids)
    assert channels["layer.ids"].dtype == np.uint32


def test_a_file_that_cannot_be_written_is_named_and_leaves_nothing(tmp_path, monkeypatch):
    path = write_spectral_exr(tmp_path / "v.exr", random_cube(), BANDS, None)
    old = path.read_bytes()

    class Full:
        def __init__(self, *_args):
            pass

        def write(self, name):
            with open(name, "wb") as file:  # noqa: PTH123 - as the library does
                file.write(b"half")
            raise RuntimeError(f'Failed to write pixel data to image file "{name}". No space left on device.')

    monkeypatch.setattr(OpenEXR, "File", Full)
    with pytest.raises(RunError, match=r"can't write \S*v\.exr: No space left on device; make room"):
        write_spectral_exr(path, random_cube() + 1, BANDS, None)
    assert path.read_bytes() == old
    assert [file.name for file in tmp_path.glob("[!.]*")] == ["v.exr"]
