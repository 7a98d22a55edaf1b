"""What holds for every reader."""

import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
import tifffile

from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile, stack_bands
from unmix_plugin.errors import CaptureError

CUBE = np.arange(60, dtype=np.uint16).reshape(3, 4, 5)


@pytest.mark.parametrize("package", ["tifffile", "h5py"])
def test_a_package_that_is_not_installed_is_named_with_its_extra(tmp_path, monkeypatch, package):
    tifffile.imwrite(tmp_path / "tifffile", CUBE[0])
    with h5py.File(tmp_path / "h5py", "w") as file:
        file["cube"] = CUBE
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(CaptureError, match=rf"the package {package}, .*pip install 'unmix-nerf\[captures\]'"):
        open_spectral_file(tmp_path / package)


def test_names_that_are_no_text_are_read(tmp_path):
    path = tmp_path / b"cube-\xff.npy".decode("utf-8", "surrogateescape")
    np.save(path, CUBE)
    np.testing.assert_array_equal(open_spectral_file(path).read(), CUBE)


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
        scale=metadata.get("scale"),
    )


def test_a_stack_keeps_what_its_parts_share_and_lists_the_rest(tmp_path):
    parts = [
        part(tmp_path, 1, camera="a", exposure_s=0.1, scale=2.0),
        part(tmp_path, 2, camera="a", exposure_s=0.2),
    ]
    stack = stack_bands(parts, tmp_path)
    assert stack.metadata == {
        "camera": "a",
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


def test_what_a_library_raises_while_reading_is_an_error_of_the_file(tmp_path):
    def file_that_raises(error):
        def read_part(*_):
            raise error

        return SpectralFile(tmp_path / "a", "npy", (2, 3, 1), np.dtype("u1"), read_part)

    with pytest.raises(CaptureError, match=r"a: can't be read \(RuntimeError: no luck at all\)"):
        file_that_raises(RuntimeError("no luck\nat all")).read()
    with pytest.raises(CaptureError, match="a: too little memory"):
        file_that_raises(MemoryError()).read()
