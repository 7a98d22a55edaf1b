"""The files of one view: cube, picture, mask. Rows stream through; only pictures of one view are in memory.

Notation: `H x W` pixels and `B` bands of the scene; `h` some rows.
"""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16

from unmix_plugin.captures.calibration.calibration import CalibratedRows, Calibration
from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.captures.masks import BackgroundRule, clean
from unmix_plugin.captures.pictures import Colours, detail
from unmix_plugin.captures.view_masks import HALF, OPAQUE, ViewMasks, read_labels, read_view_masks
from unmix_plugin.engine.runs.atomic_files import whole_file, write_errors_as, write_file
from unmix_plugin.formats.png import indexed_png_bytes, rgba_png_bytes

FULL_SCALE = 65535
"""Stored number that stands for 1; saturated values have it too."""
GREYS = np.arange(256)[:, None] / 255.0
"""Palette of pictures of labels."""
BLOCK_VALUES = 1 << 22
"""Values of a file that are calibrated together: 16 MiB as float32."""


@dataclass(frozen=True)
class ViewRecord:
    """What was written for a view, and what is worth knowing about it."""

    name: str
    sensor: str
    paths: dict[str, str]
    """Files by the keys of transforms.json, relative to the scene."""
    num_pixels: int
    saturated_pixels: int
    """Of matter, with at least one band at the detector's top; such bands are written as 1."""
    clipped_values: int
    """Values above the scale that are not saturated; written as 1 too."""
    negative_values: int
    """Values below 0, written as 0."""
    missing_pixels: int
    """Black in the view's mask."""
    matter_share: float
    """Share of pixels that are not background."""
    specks: int
    holes: int
    """Parts of the mask that were removed and filled."""
    brightness: float
    """Median over pixels of matter of the mean over bands."""
    detail: float
    """Contrast of the finest structures against those twice as large."""
    mean_spectrum: list[float]
    """Over pixels of matter."""
    sources: list[dict[str, Any]] = field(default_factory=list)
    """Files it was made of: path, bytes, SHA-256."""

    def to_json(self) -> dict[str, Any]:
        """Numbers, texts and lists."""
        return asdict(self)


@dataclass(frozen=True)
class ViewRecipe:
    """How the views of one sensor are written."""

    calibration: Calibration
    scale: float
    """Calibrated value that is written as 1."""
    colours: Colours
    background: BackgroundRule | None = None
    use_opacity: bool = False
    """Whether files of the capture say what is matter."""


def write_view(view: CaptureView, recipe: ViewRecipe, folder: Path) -> ViewRecord:
    """Write cube, picture and mask of a view.

    Raises:
        CaptureError: a file of the view can't be read.
        RunError: the folder can't be written.
    """
    raster = recipe.calibration.raster
    masks = read_view_masks(view, raster, recipe.use_opacity)
    paths = {"file_path": f"images/{view.name}.png", "hyperspectral_file_path": f"cubes/{view.name}.npy"}
    tally = _Tally(raster.height, raster.width, recipe.calibration.num_bands, masks)
    path = folder / paths["hyperspectral_file_path"]
    with whole_file(path) as temporary:
        with write_errors_as(path), temporary.open("wb") as file:
            file.write(_npy_header((raster.height, raster.width, recipe.calibration.num_bands)))
            start = file.tell()
            file_bands = len(recipe.calibration.bands)
            for first, last in raster.blocks(file_bands, BLOCK_VALUES):
                part = recipe.calibration.rows(view.cube, first, last)
                file.write(_stored(tally.add(first, part, recipe), part).data)
        is_shown = tally.finish_masks(recipe) > 0
        if not is_shown.all():
            with write_errors_as(path):
                _blacken(temporary, start, is_shown, recipe.calibration.num_bands)
    _write_picture(folder / paths["file_path"], tally, recipe)
    if tally.missing.any():
        paths["mask_path"] = f"masks/{view.name}.png"
        grey = np.where(tally.missing, 0, 255).astype(np.uint8)
        write_file(folder / paths["mask_path"], rgba_png_bytes(np.dstack([grey] * 3)))
    labels = read_labels(view, raster)
    if labels is not None:
        paths["seg_file_path"] = f"labels/{view.name}.png"
        write_file(folder / paths["seg_file_path"], indexed_png_bytes(labels, np.repeat(GREYS, 3, axis=1)))
    return tally.record(view, paths)


class _Tally:
    """What is gathered while rows stream by."""

    def __init__(self, height: int, width: int, bands: int, masks: ViewMasks) -> None:
        self.rgb: Float32[np.ndarray, "H W 3"] = np.zeros((height, width, 3), np.float32)
        self.brightness: Float32[np.ndarray, "H W"] = np.zeros((height, width), np.float32)
        self.missing: Bool[np.ndarray, "H W"] = ~masks.valid
        self.opacity: UInt8[np.ndarray, "H W"] = np.full((height, width), OPAQUE, np.uint8)
        if masks.opacity is not None:
            self.opacity = masks.opacity
        self.saturated: Bool[np.ndarray, "H W"] = np.zeros((height, width), bool)
        self.counts = np.zeros(2, dtype=np.int64)
        self.sum: Float64[np.ndarray, " B"] = np.zeros(bands)
        self.num_summed = 0
        self.specks, self.holes = 0, 0

    def add(self, first: int, part: CalibratedRows, recipe: ViewRecipe) -> Float32[np.ndarray, "h W B"]:
        """Take note of some rows; gives their values on the scene's scale."""
        rows = slice(first, first + len(part.values))
        values = part.values * np.float32(1.0 / recipe.scale)
        self.missing[rows] |= part.missing
        if values.max() > 1.0:
            self.counts[0] += ((values > 1.0) & ~part.saturated).sum()
        if values.min() < 0.0:
            self.counts[1] += (values < 0.0).sum()
        self.saturated[rows] = part.saturated.any(axis=-1)
        if recipe.background is not None:
            self.opacity[rows] = np.where(recipe.background.matter(values), OPAQUE, 0)
        self.rgb[rows] = recipe.colours.linear_rgb(values)
        self.brightness[rows] = values.mean(axis=-1)
        counted = (self.opacity[rows] > HALF) & ~self.missing[rows]
        self.sum += counted.ravel().astype(np.float32) @ values.reshape(-1, values.shape[-1])
        self.num_summed += int(counted.sum())
        return values

    def finish_masks(self, recipe: ViewRecipe) -> UInt8[np.ndarray, "H W"]:
        """Opacity without specks and holes; full for pixels without a measurement, as nothing is known there."""
        if recipe.background is not None:
            done = clean(self.opacity > 0)
            self.opacity = np.where(done.matter, OPAQUE, 0).astype(np.uint8)
            self.specks, self.holes = done.specks, done.holes
        self.opacity[self.missing] = OPAQUE
        return self.opacity

    def record(self, view: CaptureView, paths: dict[str, str]) -> ViewRecord:
        seen = (self.opacity > HALF) & ~self.missing
        return ViewRecord(
            name=view.name,
            sensor=view.sensor,
            paths=paths,
            num_pixels=seen.size,
            saturated_pixels=int((self.saturated & seen).sum()),
            clipped_values=int(self.counts[0]),
            negative_values=int(self.counts[1]),
            missing_pixels=int(self.missing.sum()),
            matter_share=float((self.opacity > HALF).mean()),
            specks=self.specks,
            holes=self.holes,
            brightness=float(np.median(self.brightness[seen])) if seen.any() else 0.0,
            detail=detail(self.brightness, seen),
            mean_spectrum=(self.sum / max(1, self.num_summed)).tolist(),
        )


def _stored(values: Float32[np.ndarray, "h W B"], part: CalibratedRows) -> UInt16[np.ndarray, "h W B"]:
    np.multiply(values, FULL_SCALE, out=values)
    np.clip(np.rint(values, out=values), 0, FULL_SCALE, out=values)
    stored = values.astype("<u2")
    stored[part.saturated] = FULL_SCALE
    stored[part.missing] = 0
    return stored


def _npy_header(shape: tuple[int, int, int]) -> bytes:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<u2", "fortran_order": False, "shape": shape})
    return header.getvalue()


def _blacken(path: Path, start: int, is_shown: Bool[np.ndarray, "H W"], bands: int) -> None:
    """Set background to 0 in a cube that is written, row by row: cubes are as seen over black."""
    row_bytes = is_shown.shape[1] * bands * 2
    with path.open("r+b") as file:
        for row in np.flatnonzero(~is_shown.all(axis=1)).tolist():
            file.seek(start + row * row_bytes)
            values = np.frombuffer(file.read(row_bytes), "<u2").reshape(-1, bands).copy()
            values[~is_shown[row]] = 0
            file.seek(start + row * row_bytes)
            file.write(values.data)


def _write_picture(path: Path, tally: _Tally, recipe: ViewRecipe) -> None:
    srgb = recipe.colours.srgb(tally.rgb)
    if recipe.background is not None or recipe.use_opacity:
        srgb = np.dstack([srgb, tally.opacity])
    write_file(path, rgba_png_bytes(srgb))
