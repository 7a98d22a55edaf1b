"""What is known of the bands of a file under test."""

import numpy as np

from unmix_plugin.captures.spectral_file import SpectralFile


def centres_nm(file: SpectralFile) -> np.ndarray:
    """Its wavelengths, which must be there."""
    assert file.bands.wavelengths_nm is not None, file.notes
    return file.bands.wavelengths_nm


def widths_nm(file: SpectralFile) -> np.ndarray:
    """Its widths of bands, which must be there."""
    assert file.bands.fwhm_nm is not None, file.notes
    return file.bands.fwhm_nm
