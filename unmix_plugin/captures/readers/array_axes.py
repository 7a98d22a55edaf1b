"""Which axis of a stored array is which.

Axes are letters, the slowest first: `y` rows, `x` columns, `b` bands.
"""

from __future__ import annotations

import numpy as np

from unmix_plugin.captures.readers.read_options import Axes
from unmix_plugin.captures.spectral_file import BandIndex

_WITH_BANDS_AT: tuple[Axes, Axes, Axes] = ("byx", "ybx", "yxb")


def choose_axes(
    shape: tuple[int, ...], given: Axes | None, num_wavelengths: int | None, default: Axes = "yxb"
) -> tuple[Axes, tuple[str, ...]]:
    """Axes of a 3-D array, and notes.

    Args:
        shape: Of the array.
        given: What the user says, which overrides everything.
        num_wavelengths: Length that the axis of bands has, if it is known.
        default: Where no length tells.

    >>> choose_axes((31, 64, 48), None, 31)
    ('byx', ())
    """
    if given is not None:
        return given, ()
    fitting = [axis for axis in (2, 0, 1) if shape[axis] == num_wavelengths]
    if _WITH_BANDS_AT.index(default) in fitting:
        fitting.insert(0, _WITH_BANDS_AT.index(default))
    if fitting:
        several = len(set(fitting)) > 1
        note = f"{num_wavelengths} wavelengths fit several axes of {shape}; bands are taken to be axis {fitting[0]}"
        return _WITH_BANDS_AT[fitting[0]], (note,) if several else ()
    bands = _WITH_BANDS_AT.index(default)
    shortest = int(np.argmin(shape))
    if shape[shortest] < shape[bands]:
        note = f"bands are taken to be axis {bands} of {shape}, though axis {shortest} is the shortest"
        return default, (f"{note}; if that is wrong, say which axis is which (--axes {_other(default)})",)
    return default, ()


def _other(default: Axes) -> Axes:
    return "byx" if default == "yxb" else "yxb"


def image_shape(shape: tuple[int, ...], axes: Axes) -> tuple[int, int, int]:
    """Rows, columns and bands of a stored array.

    >>> image_shape((31, 64, 48), "byx")
    (64, 48, 31)
    """
    return shape[axes.index("y")], shape[axes.index("x")], shape[axes.index("b")]


def take_part(stored: np.ndarray, axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
    """A copy (h, W, b) of some rows and bands of a stored array."""
    return np.array(stored.transpose([axes.index(axis) for axis in "yxb"])[rows][:, :, bands], order="C")
