"""Integrals over wavelength of spectra that are linear between their samples, exactly."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64


def integrals_up_to(
    wavelengths_nm: Float64[np.ndarray, " M"],
    spectra: Float64[np.ndarray, "S N"],
    samples_nm: Float64[np.ndarray, " N"],
) -> Float64[np.ndarray, "S M"]:
    """Integral of each spectrum from one common start to each wavelength: only differences between them mean anything.

    Args:
        wavelengths_nm: Increasing; beyond the samples the outermost values are held.
        spectra: A spectrum a row.
        samples_nm: Where their values are known, increasing.
    """
    nodes = np.union1d(samples_nm, wavelengths_nm)
    values = np.stack([np.interp(nodes, samples_nm, spectrum) for spectrum in spectra])
    areas = np.diff(nodes) * (values[:, 1:] + values[:, :-1]) / 2
    integrals = np.concatenate([np.zeros((len(areas), 1)), np.cumsum(areas, axis=1)], axis=1)
    return integrals[:, np.searchsorted(nodes, wavelengths_nm)]
