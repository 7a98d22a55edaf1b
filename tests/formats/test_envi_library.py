"""ENVI spectral libraries, read back with Spectral Python."""

from typing import Any

import numpy as np
import pytest
import spectral.io.envi as envi

from tests.formats.cubes import BANDS, WAVELENGTHS_NM, full_disk
from unmix_plugin.errors import RunError
from unmix_plugin.formats.envi import write_envi_library

SPECTRA = np.random.default_rng(1).random((3, len(WAVELENGTHS_NM)))
NAMES = ("wood", "clay, wet", "leaf")


def test_another_reader_gets_spectra_names_and_wavelengths(tmp_path):
    files = write_envi_library(tmp_path / "lib", SPECTRA, BANDS, NAMES, "radiance")
    assert files == [tmp_path / "lib.hdr", tmp_path / "lib.sli"]
    library: Any = envi.open(str(files[0]), str(files[1]))
    assert isinstance(library, envi.SpectralLibrary)
    np.testing.assert_array_equal(library.spectra, SPECTRA.astype(np.float32))
    assert library.names == ["wood", "clay- wet", "leaf"]
    bands: Any = library.bands
    assert tuple(bands.centers) == WAVELENGTHS_NM
    assert bands.band_unit == "Nanometers"


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    full_disk(monkeypatch, after=10)
    with pytest.raises(RunError, match=r"can't write .*lib\.sli: No space left"):
        write_envi_library(tmp_path / "lib", SPECTRA, BANDS, NAMES)
    assert list(tmp_path.iterdir()) == []


def test_names_must_be_as_many_as_spectra(tmp_path):
    with pytest.raises(ValueError, match="2 names and 5 wavelengths"):
        write_envi_library(tmp_path / "lib", SPECTRA, BANDS, NAMES[:2])
