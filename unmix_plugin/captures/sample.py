"""What is looked at before anything is decided: a few rows of every view, as they are stored and once calibrated. All
decisions on values are taken from these samples.

Notation: `B` bands of a file, `n` rows that are looked at, `W` their pixels, `P` and `N` sampled pixels, `c` bands of
the scene, `K` stored numbers that a type can hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float32, Int64, Shaped

from unmix_plugin.captures.calibration.calibration import Calibration
from unmix_plugin.captures.calibration.references import Reference, stated_values
from unmix_plugin.captures.cube import BandIndex, CaptureView, Cube, find_missing
from unmix_plugin.captures.spoilt import ViewPixels
from unmix_plugin.errors import CaptureError

BRIGHT_PERCENTILE = 99.9
_ROWS_A_VIEW = 12
_MOST_ALIKE = 4
"""Views that are looked at for bands with one value only."""
_MOST_PIXELS = 20000
"""Of all views together."""
_BORDER_SHARE = 0.02
"""Width of the border that a background is judged by, as a share of the view's."""
_MOST_BORDER_PIXELS = 20000
_BACKDROP_ROWS = 96
"""Of a view in which a backdrop is looked for."""


def sampled_rows(height: int) -> list[int]:
    """Rows spread evenly over an image."""
    count = min(height, _ROWS_A_VIEW)
    return [int((index + 0.5) * height / count) for index in range(count)]


# As stored: where does the detector end, and can values be reflectances?


@dataclass(frozen=True)
class StoredCounts:
    """How often each stored number is there in sampled rows of all views, in bands that have more than one value."""

    dtype: np.dtype
    lowest: int
    """Number of the first count."""
    counts: Int64[np.ndarray, " K"]
    num_pixels: int
    """With a measurement, in the first views."""
    num_bands: int
    """With more than one value in these."""
    are_whole: bool = True
    """Whether all numbers are whole ones that are counted; nothing was counted otherwise."""

    @property
    def is_wide(self) -> bool:
        """Whether the type holds more than a detector gives: its numbers are of one, or processed."""
        return self.dtype.kind not in "iu" or self.dtype.itemsize > 2

    @property
    def highest(self) -> int:
        """Number of the last count."""
        return self.lowest + len(self.counts) - 1


def count_stored(files: Sequence[Cube], bands: np.ndarray) -> StoredCounts:
    """Count the stored numbers of these bands; of wide types, those of 16 bits."""
    dtype = files[0].dtype
    is_wide = dtype.kind not in "iu" or dtype.itemsize > 2
    limits = np.iinfo(np.uint16 if is_wide else dtype)
    low, high = int(limits.min), int(limits.max)
    counts = np.zeros(high - low + 1, dtype=np.int64)
    rows = sampled_rows(files[0].shape[0])
    known = np.concatenate(
        [_stored_pixels(file, row, bands) for file, row in product(files[:_MOST_ALIKE], rows)]
    )
    varying = bands[np.ptp(known, axis=0) > 0] if len(known) else bands[:0]
    for file, row in product(files, rows) if len(varying) else ():
        stored = _stored_pixels(file, row, varying).ravel()
        if is_wide and not ((stored >= 0) & (stored <= high) & (stored % 1 == 0)).all():
            return StoredCounts(dtype, low, counts, len(known), len(varying), are_whole=False)
        counts += np.bincount(stored.astype(np.int64) - low, minlength=len(counts))
    return StoredCounts(dtype, low, counts, len(known), len(varying))


def bright_values(files: Sequence[Cube]) -> list[float]:
    """Values of bright pixels of some files, as these state them, before any reference."""
    bright = []
    for index in np.unique(np.linspace(0, len(files) - 1, min(len(files), _MOST_ALIKE + 1)).astype(int)):
        file = files[index]
        parts = [
            (_stored_pixels(file, row)[None], slice(row, row + 1)) for row in sampled_rows(file.shape[0])
        ]
        values = np.concatenate([stated_values(file, *part).ravel() for part in parts])
        bright += [float(np.percentile(values, BRIGHT_PERCENTILE))] if len(values) else []
    return bright


def _stored_pixels(file: Cube, row: int, bands: BandIndex = slice(None)) -> Shaped[np.ndarray, "P b"]:
    """Stored numbers of the pixels of a row that have a measurement."""
    stored = file.read(slice(row, row + 1), bands)
    return stored[~find_missing(stored, file, slice(row, row + 1), bands)]


@dataclass(frozen=True)
class WhiteSample:
    """Some rows of the panel of a white reference."""

    stored: Shaped[np.ndarray, "n columns B"]
    is_measured: Bool[np.ndarray, "n columns"]

    @staticmethod
    def of(white: Reference) -> WhiteSample:
        """Rows of its file, or of the rectangle that shows it."""
        top, left, height, width = white.rectangle or (0, 0, *white.file.shape[:2])
        columns, read, measured = slice(left, left + width), [], []
        for row in sampled_rows(height):
            line = slice(top + row, top + row + 1)
            numbers = white.file.read(line)
            read.append(numbers[:, columns])
            measured.append(~find_missing(numbers, white.file, line)[:, columns])
        return WhiteSample(np.concatenate(read), np.concatenate(measured))


# As calibrated: pixels of all views, of their borders, and of views that may show a backdrop.


@dataclass(frozen=True)
class PixelSample:
    """Calibrated pixels of all views of a sensor."""

    views: tuple[ViewPixels, ...]

    @property
    def values(self) -> Float32[np.ndarray, "N c"]:
        """Of all views."""
        return np.concatenate([view.values for view in self.views])

    @property
    def saturated(self) -> Bool[np.ndarray, "N c"]:
        """Of all views."""
        return np.concatenate([view.saturated for view in self.views])

    def require(self, path: object) -> None:
        """Refuse to go on without pixels. Raises CaptureError."""
        if not any(len(view.values) for view in self.views):
            raise CaptureError(
                f"{path}: no sampled pixel of it and of the other views has a measurement in all bands (NaN, no-data, "
                "or no light on the white panel); check these, or leave bands out with --drop-bands"
            )


def draw_pixels(views: Sequence[CaptureView], calibration: Calibration) -> list[ViewPixels]:
    """Pixels on the sampled rows of each view, evenly spaced along them, at all bands that the calibration keeps."""
    raster = calibration.raster
    rows = sampled_rows(raster.height)
    step = max(1, len(views) * len(rows) * raster.width // _MOST_PIXELS)
    drawn = []
    for view in views:
        parts = [calibration.rows(view.cube, row, row + 1) for row in rows]
        kept = np.zeros((len(rows), raster.width), bool)
        for index, row in enumerate(rows):
            kept[index, row % step :: step] = True
        kept &= ~np.concatenate([part.missing for part in parts])
        values, saturated = (
            np.concatenate([getattr(part, name) for part in parts])[kept] for name in ("values", "saturated")
        )
        drawn.append(ViewPixels(view.name, values, saturated))
    return drawn


def border_pixels(
    views: Sequence[CaptureView], calibration: Calibration, scale: float
) -> Float32[np.ndarray, "P c"]:
    """Pixels at the border of the views, in [0, 1]; saturated ones are 1, missing ones are left out."""
    raster = calibration.raster
    width = max(1, round(_BORDER_SHARE * raster.width))
    columns = np.r_[0:width, raster.width - width : raster.width]
    rows = sorted({0, raster.height - 1, *sampled_rows(raster.height)})
    step = max(1, len(views) * (2 * raster.width + 2 * width * len(rows)) // _MOST_BORDER_PIXELS)
    border = []
    for view in views:
        for row in rows:
            part = calibration.rows(view.cube, row, row + 1)
            shown = np.arange(raster.width) if row in (0, raster.height - 1) else columns
            shown = shown[row % step :: step]
            values = np.where(part.saturated[0, shown], np.float32(scale), part.values[0, shown])
            border.append(values[~part.missing[0, shown]])
    return np.clip(np.concatenate(border) / np.float32(scale), 0.0, 1.0)


def rows_behind(
    view: CaptureView, calibration: Calibration, scale: float
) -> tuple[Float32[np.ndarray, "n W c"], Bool[np.ndarray, "n W"]]:
    """Rows of a view that may show a backdrop, in [0, 1], and which of their pixels were measured."""
    height = calibration.raster.height
    rows = np.unique(np.linspace(0, height - 1, min(height, _BACKDROP_ROWS)).astype(int))
    parts = [calibration.rows(view.cube, row, row + 1) for row in rows.tolist()]
    values = np.concatenate([np.where(part.saturated, np.float32(scale), part.values) for part in parts])
    seen = np.clip(values / np.float32(scale), 0.0, 1.0)
    return seen, ~np.concatenate([part.missing for part in parts])
