"""Files that hold many arrays by name: which is the image, and which describe its bands.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from unmix_plugin.captures.readers.read_options import Axes, ReadOptions
from unmix_plugin.captures.spectral_file import BandIndex
from unmix_plugin.errors import CaptureError

TakePart: TypeAlias = Callable[[Axes, slice, BandIndex], np.ndarray]
"""(h, W, b) numbers of a stored array whose axes are these."""

_CENTRES = re.compile(
    r"(list_cw_.*)|((band_?|cent(er|re|ral)_?|sensor_?)*(wavelengths?|wavelen|wvls?|wls?|lambdas?|waves?))(_?(nm|um))?"
)
_WIDTHS = re.compile(r"(fwhms?|band_?widths?|list_fwhm_.*)(_?(nm|um))?")
_GOOD = re.compile(r"bbl|good_(wavelengths?|bands?)")
_LISTED = 12
"""How many arrays a message names."""


@dataclass(frozen=True)
class FoundArray:
    """One array of a file."""

    name: str
    """With the groups that it is in, separated by `/`."""
    shape: tuple[int, ...]
    dtype: np.dtype
    whole: Callable[[], np.ndarray]
    """All its numbers, mapped or loaded."""
    take: TakePart | None = None
    """A faster way to some rows and bands than through `whole`."""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    dimensions: tuple[str, ...] | None = None
    """Names of its axes."""

    @property
    def own_name(self) -> str:
        """Without groups, in lower case."""
        return self.name.rpartition("/")[2].lower()

    @property
    def is_vector(self) -> bool:
        """Whether it is a list of numbers, also as MATLAB's matrix of one row or column."""
        return (
            self.dtype.kind in "iuf" and sum(length != 1 for length in self.shape) <= 1 and bool(self.shape)
        )

    @property
    def length(self) -> int:
        """Of a vector."""
        return int(np.prod(self.shape))


def find_image(path: Path, arrays: Sequence[FoundArray], options: ReadOptions) -> FoundArray:
    """The array that is the image: the one that is named, otherwise the only one of three axes.

    Raises:
        CaptureError: there is none, or several that could be it.
    """
    numeric = [array for array in arrays if array.dtype.kind in "iuf" and 0 not in array.shape]
    if [(array.name, len(array.shape)) for array in arrays] == [("", 2)] and options.dataset is None:
        return arrays[0]  # the file is one matrix: one band
    listed = (
        ", ".join(f"{array.name or 'one array'} {array.shape}" for array in numeric[:_LISTED])
        or "no arrays of numbers"
    )
    if options.dataset is not None:
        wanted = options.dataset.strip("/")
        named = [array for array in numeric if array.name.strip("/") == wanted]
        named = named or [array for array in numeric if array.name.rpartition("/")[2] == wanted]
        if len(named) != 1:
            raise CaptureError(
                f"{path}: {len(named) or 'no'} data sets '{options.dataset}'; the file holds {listed}"
            )
        return named[0]
    images = [array for array in numeric if len(array.shape) == 3]
    if not images:
        images = [array for array in numeric if pixel_list_size(array, arrays, options) is not None]
    if len(images) > 1:
        fitting = [image for image in images if find_vector(arrays, image, _CENTRES) is not None]
        images = fitting or images
    if len(images) != 1:
        found = f"{len(images)} data sets could be the image" if images else "no data set has three axes"
        advice = (
            "name one (--dataset)"
            if images
            else "name one (--dataset), and give rows and columns if it is a list of pixels"
        )
        raise CaptureError(f"{path}: {found}; {advice}. The file holds {listed}")
    return images[0]


def find_vector(arrays: Sequence[FoundArray], image: FoundArray, names: re.Pattern[str]) -> FoundArray | None:
    """The list of one number a band with such a name; of several the one in the nearest group."""
    found = [
        array
        for array in arrays
        if array.is_vector and array.length in image.shape and names.fullmatch(array.own_name)
    ]
    return max(found, key=lambda array: _common_groups(array.name, image.name), default=None)


def describing_vectors(
    arrays: Sequence[FoundArray], image: FoundArray
) -> tuple[FoundArray | None, FoundArray | None, FoundArray | None]:
    """Lists of the centres, widths and marks of an image's bands."""
    centres, widths, good = (find_vector(arrays, image, names) for names in (_CENTRES, _WIDTHS, _GOOD))
    return centres, widths, good


def names_wavelengths(name: str) -> bool:
    """Whether an attribute of this name holds wavelengths."""
    return _CENTRES.fullmatch(name.lower()) is not None


def pixel_list_size(
    array: FoundArray, arrays: Sequence[FoundArray], options: ReadOptions
) -> tuple[int, int] | None:
    """Rows and columns of an image that is stored as a matrix of bands and pixels; None if it is not such a matrix."""
    size = options.size or _stated_size(arrays)
    if len(array.shape) != 2 or size is None or size[0] * size[1] not in array.shape:
        return None
    return size


def _stated_size(arrays: Sequence[FoundArray]) -> tuple[int, int] | None:
    """Rows and columns as files of unmixing scenes give them: numbers `nRow` and `nCol`."""
    numbers = {array.own_name.rstrip("s"): array for array in arrays if array.is_vector and array.length == 1}
    if "nrow" not in numbers or "ncol" not in numbers:
        return None
    rows, columns = (float(numbers[name].whole().reshape(-1)[0]) for name in ("nrow", "ncol"))
    return (int(rows), int(columns)) if 1 <= rows < 2**31 and 1 <= columns < 2**31 else None


def _common_groups(first: str, second: str) -> int:
    pairs = zip(first.strip("/").split("/")[:-1], second.strip("/").split("/")[:-1], strict=False)
    return next(
        (count for count, (a, b) in enumerate(pairs) if a != b), min(first.count("/"), second.count("/"))
    )
