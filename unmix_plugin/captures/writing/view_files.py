"""The files of one view: cube, picture, mask; and the unfinished folder beside the output in which they gather.

Rows stream through; only pictures of one view are in memory. Views that are done survive a kill, and nothing takes the
folder for a scene, as it has no transforms.json and is called unfinished.

Notation: `H x W` pixels and `B` bands of the scene; `h` some rows; values in [0, 1].
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16

from unmix_plugin.captures.calibration.calibration import CalibratedRows, Calibration
from unmix_plugin.captures.masks import (
    HALF,
    OPAQUE,
    BackgroundRule,
    ViewMasks,
    clean,
    read_labels,
    read_view_masks,
)
from unmix_plugin.captures.poses.pose_set import reading
from unmix_plugin.captures.spectral_file import CaptureView
from unmix_plugin.captures.writing.resampling import Resampling
from unmix_plugin.engine.runs.atomic_files import (
    make_folder,
    remove_stale_temporaries,
    whole_file,
    write_errors_as,
    write_file,
)
from unmix_plugin.engine.runs.run_folder import RunLock
from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import indexed_png_bytes, rgba_png_bytes
from unmix_plugin.scenes.backdrops import Backdrop
from unmix_plugin.scenes.reading.faults import sha256_of
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.srgb import encode_srgb

FULL_SCALE = 65535
"""Stored number that stands for 1; saturated values have it too."""
_BLOCK_VALUES = 1 << 22
"""Values of a file that are calibrated together: 16 MiB as float32."""
_WEIGHTS_A_PIXEL = 64
"""What the weights of a resampled pixel take, in values."""
_BRIGHT_PERCENTILE = 99.0
"""Of sampled pixels; shown as white."""
UNLABELLED = 255
"""In pictures of true materials."""


@dataclass(frozen=True)
class Colours:
    """How spectra become sRGB, the same for all views of a sensor."""

    matrix: Float32[np.ndarray, "B 3"]
    """To linear red, green and blue."""
    gain: float
    """Brings bright pixels to white."""
    description: str
    """True colour, or which bands are shown as red, green and blue."""

    @staticmethod
    def of(bands: Bands, sample: Float32[np.ndarray, "N B"]) -> Colours:
        """Colours for spectra like those of the sample."""
        from unmix_plugin.spectral.colour.conversion import describe_colour, rgb_matrix

        matrix = rgb_matrix(bands).numpy()
        brightest = np.percentile((sample @ matrix).max(axis=1), _BRIGHT_PERCENTILE) if len(sample) else 0.0
        return Colours(matrix, 1.0 / float(brightest) if brightest > 0 else 1.0, describe_colour(bands))

    def linear_rgb(self, values: Float32[np.ndarray, "*pixels B"]) -> Float32[np.ndarray, "*pixels 3"]:
        """Linear light, 1 is white; not clipped."""
        return np.asarray((values @ self.matrix) * np.float32(self.gain), dtype=np.float32)


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
    background_brightness: float = 0.0
    """Median of the same over background, before it is set to black; 0 without any."""
    background_spread: float = 0.0
    """Range from dark to bright background (10th and 90th percentile) over its median."""
    sources: list[dict[str, Any]] = field(default_factory=list)
    """Files it was made of: path, bytes, SHA-256."""


@dataclass(frozen=True)
class ViewRecipe:
    """How the views of one sensor are written."""

    calibration: Calibration
    scale: float
    """Calibrated value that is written as 1."""
    colours: Colours
    background: BackgroundRule | Backdrop | None = None
    use_opacity: bool = False
    """Whether files of the capture say what is matter."""


def write_view(
    view: CaptureView, recipe: ViewRecipe, folder: Path, resampling: Resampling | None = None
) -> ViewRecord:
    """Write cube, picture and mask of a view, its pixels brought into another lens where there is a resampling. Raises
    CaptureError: a file of the view can't be read. Raises RunError: the folder can't be written."""
    raster = recipe.calibration.raster
    masks, labels = read_view_masks(view, raster, recipe.use_opacity), read_labels(view, raster)
    if resampling is not None:
        masks = _resampled_masks(masks, resampling)
        labels = None if labels is None else resampling.nearest(labels, outside=UNLABELLED)
    paths = {"file_path": f"images/{view.name}.png", "hyperspectral_file_path": f"cubes/{view.name}.npy"}
    tally = _Tally(raster.height, raster.width, recipe.calibration.num_bands, masks)
    path = folder / paths["hyperspectral_file_path"]
    with whole_file(path) as temporary:
        with write_errors_as(path), temporary.open("wb") as file:
            shape = (raster.height, raster.width, recipe.calibration.num_bands)
            described = {"descr": "<u2", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, described)
            start = file.tell()
            read = partial(recipe.calibration.rows, view.cube)
            values_a_pixel = max(len(recipe.calibration.bands), _WEIGHTS_A_PIXEL if resampling else 0)
            for first, last in raster.blocks(values_a_pixel, _BLOCK_VALUES):
                part = read(first, last) if resampling is None else resampling.rows(first, last, read)
                file.write(_stored(tally.add(first, part, recipe), part).data)
        tally.finish_masks(recipe)
        if (tally.opacity < OPAQUE).any():
            with write_errors_as(path):
                _cut_out(temporary, start, tally, recipe)
    pixels = np.rint(encode_srgb(np.clip(tally.rgb, 0.0, 1.0)) * 255).astype(np.uint8)
    if recipe.background is not None or recipe.use_opacity:
        pixels = np.dstack([pixels, tally.opacity])
    write_file(folder / paths["file_path"], rgba_png_bytes(pixels))
    if tally.missing.any():
        paths["mask_path"] = f"masks/{view.name}.png"
        grey = np.where(tally.missing, 0, 255).astype(np.uint8)
        write_file(folder / paths["mask_path"], rgba_png_bytes(np.dstack([grey] * 3)))
    if labels is not None:
        paths["seg_file_path"] = f"labels/{view.name}.png"
        greys = np.repeat(np.arange(256)[:, None] / 255.0, 3, axis=1)
        write_file(folder / paths["seg_file_path"], indexed_png_bytes(labels, greys))
    return tally.record(view, paths)


def _resampled_masks(masks: ViewMasks, resampling: Resampling) -> ViewMasks:
    """Masks in another lens; a pixel is valid where all are that it is made of."""
    valid = resampling.smooth(np.where(masks.valid, np.uint8(OPAQUE), np.uint8(0))) == OPAQUE
    return ViewMasks(valid, None if masks.opacity is None else resampling.smooth(masks.opacity))


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
        self.features: Float32[np.ndarray, "H W k"] | None = None
        """That a backdrop is known by; of the backdrop, once masks are finished."""
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
        if isinstance(recipe.background, Backdrop):
            features = recipe.background.features(np.where(part.saturated, np.float32(1.0), values))
            if self.features is None:
                self.features = np.zeros((*self.missing.shape, features.shape[-1]), np.float32)
            self.features[rows] = features
        elif recipe.background is not None:
            self.opacity[rows] = np.where(recipe.background.matter(values), OPAQUE, 0)
        self.rgb[rows] = recipe.colours.linear_rgb(values)
        self.brightness[rows] = values.mean(axis=-1)
        counted = (self.opacity[rows] > HALF) & ~self.missing[rows]
        self.sum += counted.ravel().astype(np.float32) @ values.reshape(-1, values.shape[-1])
        self.num_summed += int(counted.sum())
        return values

    def finish_masks(self, recipe: ViewRecipe) -> None:
        """Opacity without specks and holes; full for pixels without a measurement, as nothing is known there."""
        if isinstance(recipe.background, Backdrop):
            assert self.features is not None
            seen = recipe.background.find(self.features, ~self.missing)
            if seen is not None:
                matter, self.specks, self.holes = clean(~seen.shown)
                self.opacity = np.rint(seen.opacity(matter) * OPAQUE).astype(np.uint8)
                self.features = seen.behind
        elif recipe.background is not None:
            matter, self.specks, self.holes = clean(self.opacity > 0)
            self.opacity = np.where(matter, OPAQUE, 0).astype(np.uint8)
        self.opacity[self.missing] = OPAQUE

    def record(self, view: CaptureView, paths: dict[str, str]) -> ViewRecord:
        seen = (self.opacity > HALF) & ~self.missing
        behind = self.brightness[(self.opacity <= HALF) & ~self.missing]
        dark, usual, bright = np.percentile(behind, (10, 50, 90)).tolist() if len(behind) else (0.0, 0.0, 0.0)
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
            detail=_detail(self.brightness, seen),
            mean_spectrum=(self.sum / max(1, self.num_summed)).tolist(),
            background_brightness=usual,
            background_spread=(bright - dark) / usual if usual > 0 else 0.0,
        )


def _stored(values: Float32[np.ndarray, "h W B"], part: CalibratedRows) -> UInt16[np.ndarray, "h W B"]:
    np.multiply(values, FULL_SCALE, out=values)
    np.clip(np.rint(values, out=values), 0, FULL_SCALE, out=values)
    stored = values.astype("<u2")
    stored[part.saturated] = FULL_SCALE
    stored[part.missing] = 0
    return stored


def _cut_out(path: Path, start: int, tally: _Tally, recipe: ViewRecipe) -> None:
    """Take the background out of a cube that is written, row by row: cubes are as seen over black.

    Where a backdrop is known, its light is taken off pixels that it shows through; their spectra are summed anew, as
    its mask is not known while rows stream by.
    """
    num_bands, backdrop = recipe.calibration.num_bands, recipe.background
    row_bytes = tally.opacity.shape[1] * num_bands * 2
    if isinstance(backdrop, Backdrop):
        tally.sum[:], tally.num_summed = 0, 0
    with path.open("r+b") as file:
        for row, opacity in enumerate(tally.opacity):
            is_opaque = opacity == OPAQUE
            if is_opaque.all() and not isinstance(backdrop, Backdrop):
                continue
            file.seek(start + row * row_bytes)
            values = np.frombuffer(file.read(row_bytes), "<u2").reshape(-1, num_bands).copy()
            values[opacity == 0] = 0
            if isinstance(backdrop, Backdrop):
                soft = np.flatnonzero((opacity > 0) & ~is_opaque)
                assert tally.features is not None
                through = backdrop.spectra(tally.features[row, soft])
                through *= FULL_SCALE * (1 - opacity[soft, None] / np.float32(OPAQUE))
                values[soft] = np.rint(np.clip(values[soft] - through, 0, FULL_SCALE)).astype("<u2")
                counted = (opacity > HALF) & ~tally.missing[row]
                tally.sum += values[counted].sum(axis=0, dtype=np.float64) / FULL_SCALE
                tally.num_summed += int(counted.sum())
            if not is_opaque.all():
                file.seek(start + row * row_bytes)
                file.write(values.data)


def _detail(brightness: Float32[np.ndarray, "H W"], seen: Bool[np.ndarray, "H W"]) -> float:
    """Contrast of the finest structures against those twice as large; falls when a picture is blurred.

    Both are root mean squares of differences between a pixel and the mean of its neighbours, at full and at half
    resolution, over pixels of matter; 0 where there is too little of it.
    """
    height, width = (length // 2 * 2 for length in brightness.shape)
    halved = brightness[:height, :width].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    inside = np.all(seen[:height, :width].reshape(height // 2, 2, width // 2, 2), axis=(1, 3))
    coarse = _finest_contrast(halved, inside)
    return _finest_contrast(brightness, seen) / coarse if coarse > 0 else 0.0


def _finest_contrast(picture: Float32[np.ndarray, "H W"], seen: Bool[np.ndarray, "H W"]) -> float:
    """Root mean square of pixels less the mean of their four neighbours, where all five are matter."""
    around = [(slice(0, -2), slice(1, -1)), (slice(2, None), slice(1, -1))]
    around += [(columns, rows) for rows, columns in around]
    middle = (slice(1, -1), slice(1, -1))
    inside = np.logical_and.reduce([seen[middle], *(seen[place] for place in around)])
    mean = sum((picture[place] for place in around), np.zeros_like(picture[middle])) / 4
    differences = (picture[middle] - mean)[inside]
    return float(np.sqrt(np.mean(np.square(differences, dtype=np.float64)))) if inside.any() else 0.0


# The unfinished folder, and the files that views are made of.

RECORD_NAME = "process.json"
_PLAN, _VIEWS, _POSES, _LOCK = "plan.json", "views", "poses", "process.lock"


class WorkFolder:
    """The unfinished scene of one output folder."""

    def __init__(self, output: Path) -> None:
        self.output = output.resolve()
        self.path = self.output.with_name(f"{self.output.name}.unfinished")
        """Where files are written until the scene is complete."""
        self._lock: RunLock | None = None
        self.poses = self.path / _POSES
        """Where files of the estimation of poses lie while it runs, or after it failed."""

    def begin(self, plan: dict[str, Any]) -> bool:
        """Make the folder, or go on in the one that an interrupted start left.

        Views that were made with another plan (options, decisions and inputs) are thrown away.

        Returns:
            Whether an earlier start is gone on with.
        Raises:
            ConfigError: there is a folder of this name that is not ours.
            RunError: it can't be written.
        """
        plan_file, text = self.path / _PLAN, _json(plan)
        if plan_file.is_file():
            self._hold()
        if self.path.exists():
            if not plan_file.is_file() and any(self.path.iterdir()):
                raise ConfigError(f"{self.path} is in the way and was not made by unmix-process; rename it")
            if plan_file.is_file() and plan_file.read_bytes() == text:
                for folder in ("cubes", "images", "masks", _VIEWS):
                    remove_stale_temporaries(self.path / folder)
                return True
            if self._lock is not None:
                self._lock.release()  # Windows removes no file that is open
            with write_errors_as(self.path):
                shutil.rmtree(self.path)
        make_folder(self.path)
        self._hold()
        write_file(plan_file, text)
        return False

    def _hold(self) -> None:
        """Let no other process write the same scene, until this one ends; RunError where another one does."""
        if self._lock is not None:
            self._lock.release()
        self._lock = RunLock(self.path / _LOCK, "unmix-process")

    def done(self, name: str) -> ViewRecord | None:
        """What is recorded of a view that is written; None if it is not."""
        try:
            return ViewRecord(**json.loads(self._record(name).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def note(self, record: ViewRecord) -> None:
        """Record that a view is written."""
        write_file(self._record(record.name), _json(asdict(record)))

    def finish(self, overwrite: bool) -> None:
        """Give the scene its name; the record of how it was made stays in it. RunError where it can't be moved."""
        with write_errors_as(self.output):
            if self._lock is not None:
                self._lock.release()
            (self.path / _LOCK).unlink(missing_ok=True)
            old = self.output.with_name(f"{self.output.name}.old")
            if overwrite and self.output.exists():
                self.output.rename(old)
            elif self.output.exists():
                self.output.rmdir()  # empty, see refuse_output
            self.path.rename(self.output)
            # After a kill here, the scene is whole and has some files too many.
            for name in (_VIEWS, _POSES):
                shutil.rmtree(self.output / name, ignore_errors=True)
            (self.output / _PLAN).unlink()
            shutil.rmtree(old, ignore_errors=True)

    def _record(self, name: str) -> Path:
        return self.path / _VIEWS / f"{name}.json"


def refuse_output(output: Path, overwrite: bool) -> None:
    """Look before anything is computed whether the scene can get its name. Raises ConfigError: the folder holds
    something; with `overwrite`, something that this command did not make."""
    if not output.resolve().name:
        raise ConfigError(f"{output} can't be a scene; give a folder of its own with --output-dir")
    if output.is_file():
        raise ConfigError(f"{output} is a file; give a folder with --output-dir")
    if not output.is_dir() or not any(output.iterdir()):
        return
    if not (output / RECORD_NAME).is_file():
        raise ConfigError(f"{output} is not empty; give a new folder with --output-dir")
    if not overwrite:
        raise ConfigError(f"{output} holds a scene already; replace it with --overwrite, or choose another")


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True) + "\n").encode()


def stamps(paths: Iterable[Path]) -> list[list[Any]]:
    """Path, size and time of change of each file: what tells quickly whether it is still the same. CaptureError where
    one is gone."""
    found = []
    for file in _files_of(paths):
        with reading(file):
            facts = file.stat()
        found.append([os.fspath(file.absolute()), facts.st_size, facts.st_mtime_ns])
    return found


def hashes(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Path, size and SHA-256 of each file. CaptureError where one can't be read."""
    found = []
    for file in _files_of(paths):
        with reading(file):
            found.append({"path": os.fspath(file), "bytes": file.stat().st_size, "sha256": sha256_of(file)})
    return found


def _files_of(paths: Iterable[Path]) -> Iterator[Path]:
    """Files, and those of a folder that a reader takes as one."""
    for path in paths:
        yield from sorted(child for child in path.iterdir() if child.is_file()) if path.is_dir() else [path]
