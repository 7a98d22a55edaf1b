"""The files of one view: cube, picture, mask. Rows stream through; only pictures of one view are in memory.

Masks are those of the capture's files, or of a background that is known; specks are removed and small holes are filled.

Notation: `H x W` pixels and `B` bands of the scene; `h` some rows; values in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16

from unmix_plugin.captures.calibration.calibration import CalibratedRows, Calibration, Raster
from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.spoilt import sharpness_of
from unmix_plugin.captures.writing.resampling import Resampling
from unmix_plugin.engine.runs.atomic_files import whole_file, write_errors_as, write_file
from unmix_plugin.errors import CaptureError, counted
from unmix_plugin.formats.files import indexed_png_bytes, rgba_png_bytes
from unmix_plugin.scenes.backdrops import Backdrop
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_picture, white_of
from unmix_plugin.spectral.colour.srgb import encode_srgb

if TYPE_CHECKING:
    from PIL import Image

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "GIF", "WEBP")
"""Pillow reads more, some of them with other programs."""
HALF, OPAQUE = 127, 255
"""Opacity above which a pixel counts as foreground; that of foreground that covers a pixel."""
_SMALL_SHARE = 5e-4
"""Specks and holes smaller than this share of the picture are removed."""
FULL_SCALE = 65535
"""Stored number that stands for 1; saturated values have it too."""
_BLOCK_VALUES = 1 << 22
"""Values of a file that are calibrated together: 16 MiB as float32."""
_WEIGHTS_A_PIXEL = 64
"""What the weights of a resampled pixel take, in values."""
UNLABELLED = 255
"""In pictures of true materials."""


@dataclass(frozen=True)
class BackgroundRule:
    """Which pixels are background."""

    kind: Literal["white", "black"]
    threshold: float
    """Background is at least this bright in every band (white), or at most this bright in the mean (black)."""
    level: float
    """Median of the border."""
    deviation: float
    """Robust standard deviation of the border."""

    @property
    def evidence(self) -> dict[str, Any]:
        """For the record."""
        return asdict(self)

    def foreground(self, values: Float32[np.ndarray, "h W B"]) -> Bool[np.ndarray, "h W"]:
        """Pixels that are not background."""
        brightness = self.brightness(self.kind, values)
        return brightness < self.threshold if self.kind == "white" else brightness > self.threshold

    @staticmethod
    def brightness(kind: str, values: Float32[np.ndarray, "*pixels B"]) -> np.ndarray:
        """What tells background from foreground: white is bright in every band, black is dark in the mean."""
        return values.min(axis=-1) if kind == "white" else values.mean(axis=-1)


@dataclass(frozen=True)
class ViewRecord:
    """What was written for a view, and what is worth knowing about it."""

    name: str
    sensor: str
    paths: dict[str, str]
    """Files by the keys of transforms.json, relative to the scene."""
    num_pixels: int
    saturated_pixels: int
    """Of the foreground, with at least one band at the detector's top; such bands are written as 1."""
    clipped_values: int
    """Values above the scale that are not saturated; written as 1 too."""
    negative_values: int
    """Values below 0, written as 0."""
    missing_pixels: int
    """Black in the view's mask."""
    matter_share: float
    """Of the pixels with a measurement, those that are not background."""
    specks: int
    holes: int
    """Parts of the mask that were removed and filled."""
    brightness: float
    """Median over pixels of the foreground of the mean over bands."""
    detail: float
    """Contrast of the finest structures against those twice as large."""
    mean_spectrum: list[float]
    """Over pixels of the foreground."""
    background_brightness: float = 0.0
    """Median of the same over background, before it is set to black; 0 without any."""
    background_spread: float = 0.0
    """Range from dark to bright background (10th and 90th percentile) over its median."""
    sharpness: list[float] = field(default_factory=list)
    """Contrast of fine structures over that of coarse ones, along rows and columns; empty where it is not known."""
    sources: list[dict[str, Any]] = field(default_factory=list)
    """Files it was made of: path, bytes, SHA-256."""

    def read_masks(self, scene: Path) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
        """Pixels of the foreground, and pixels with a measurement, by the pictures in the folder of the scene."""
        from PIL import Image

        with Image.open(scene / self.paths["file_path"]) as picture:
            foreground = np.asarray(picture.convert("RGBA"))[..., 3] > HALF
        if "mask_path" not in self.paths:
            return foreground, np.ones_like(foreground)
        with Image.open(scene / self.paths["mask_path"]) as mask:
            return foreground, np.asarray(mask.convert("L")) > 0


@dataclass(frozen=True)
class ViewRecipe:
    """How the views of one sensor are written."""

    calibration: Calibration
    scale: float
    """Calibrated value that is written as 1."""
    to_rgb: Float32[np.ndarray, "B 3"]
    """From spectra to linear red, green and blue, 1 is white; the same for all views of a sensor."""
    background: BackgroundRule | Backdrop | None = None
    use_opacity: bool = False
    """Whether files of the capture say what is foreground."""


def write_view(
    view: CaptureView, recipe: ViewRecipe, folder: Path, resampling: Resampling | None = None
) -> ViewRecord:
    """Write cube, picture and mask of a view, its pixels brought into another lens where there is a resampling. Raises
    CaptureError: a file of the view can't be read. Raises RunError: the folder can't be written."""
    raster = recipe.calibration.raster
    masks, labels = read_view_masks(view, raster, recipe.use_opacity), read_labels(view, raster)
    if resampling is not None:
        # A pixel is valid where all are that it is made of.
        valid = resampling.smooth(np.where(masks.valid, np.uint8(OPAQUE), np.uint8(0))) == OPAQUE
        opacity = None if masks.opacity is None else resampling.smooth(masks.opacity)
        masks = replace(masks, valid=valid, opacity=opacity)
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
            read = partial(recipe.calibration.rows, view.cube, opacity=masks.straight)
            values_a_pixel = max(len(recipe.calibration.bands), _WEIGHTS_A_PIXEL if resampling else 0)
            for first, last in raster.blocks(values_a_pixel, _BLOCK_VALUES):
                part = read(first, last) if resampling is None else resampling.rows(first, last, read)
                file.write(tally.add(first, part, recipe).data)
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

    def add(self, first: int, part: CalibratedRows, recipe: ViewRecipe) -> UInt16[np.ndarray, "h W B"]:
        """Take note of some rows; gives the numbers that are stored of them."""
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
            self.opacity[rows] = np.where(recipe.background.foreground(values), OPAQUE, 0)
        self.rgb[rows] = values @ recipe.to_rgb
        self.brightness[rows] = values.mean(axis=-1)
        counted = (self.opacity[rows] > HALF) & ~self.missing[rows]
        self.sum += counted.ravel().astype(np.float32) @ values.reshape(-1, values.shape[-1])
        self.num_summed += int(counted.sum())

        np.multiply(values, FULL_SCALE, out=values)
        np.clip(np.rint(values, out=values), 0, FULL_SCALE, out=values)
        stored = values.astype("<u2")
        stored[part.saturated] = FULL_SCALE
        stored[part.missing] = 0
        return stored

    def finish_masks(self, recipe: ViewRecipe) -> None:
        """Opacity without specks and holes; full for pixels without a measurement, as nothing is known there."""
        if isinstance(recipe.background, Backdrop):
            assert self.features is not None
            seen = recipe.background.find(self.features, ~self.missing)
            if seen is not None:
                foreground, self.specks, self.holes = clean_mask(~seen.shown)
                self.opacity = np.rint(seen.opacity(foreground) * OPAQUE).astype(np.uint8)
                self.features = seen.behind
        elif recipe.background is not None:
            foreground, self.specks, self.holes = clean_mask(self.opacity > 0)
            self.opacity = np.where(foreground, OPAQUE, 0).astype(np.uint8)
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
            matter_share=float(seen.sum() / max(1, np.sum(~self.missing))),
            specks=self.specks,
            holes=self.holes,
            brightness=float(np.median(self.brightness[seen])) if seen.any() else 0.0,
            detail=detail_of(self.brightness, seen),
            mean_spectrum=(self.sum / max(1, self.num_summed)).tolist(),
            background_brightness=usual,
            background_spread=(bright - dark) / usual if usual > 0 else 0.0,
            sharpness=sharpness_of(self.brightness, seen),
        )


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


def detail_of(brightness: Float32[np.ndarray, "H W"], seen: Bool[np.ndarray, "H W"]) -> float:
    """Contrast of the finest structures against those twice as large; falls when a picture is blurred.

    What users are warned by: the slightest blur changes it, but so does noise, so that no view is left out for it; that
    is `sharpness_of`'s task, which looks at wider structures.

    Both are root mean squares of differences between a pixel and the mean of its neighbours, at full and at half
    resolution, over pixels that are seen; 0 where there are too few of these.
    """
    height, width = (length // 2 * 2 for length in brightness.shape)
    halved = brightness[:height, :width].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    inside = np.all(seen[:height, :width].reshape(height // 2, 2, width // 2, 2), axis=(1, 3))
    coarse = _finest_contrast(halved, inside)
    return _finest_contrast(brightness, seen) / coarse if coarse > 0 else 0.0


def _finest_contrast(picture: Float32[np.ndarray, "H W"], seen: Bool[np.ndarray, "H W"]) -> float:
    """Root mean square of pixels less the mean of their four neighbours, where all five are foreground."""
    around = [(slice(0, -2), slice(1, -1)), (slice(2, None), slice(1, -1))]
    around += [(columns, rows) for rows, columns in around]
    middle = (slice(1, -1), slice(1, -1))
    inside = np.logical_and.reduce([seen[middle], *(seen[place] for place in around)])
    mean = sum((picture[place] for place in around), np.zeros_like(picture[middle])) / 4
    differences = (picture[middle] - mean)[inside]
    return float(np.sqrt(np.mean(np.square(differences, dtype=np.float64)))) if inside.any() else 0.0


# Masks: what the files of a view say, and what is left of them and of a background that is known.


@dataclass(frozen=True)
class ViewMasks:
    """Masks of one view on the scene's raster."""

    valid: Bool[np.ndarray, "H W"]
    """Pixels that are not to be ignored."""
    opacity: UInt8[np.ndarray, "H W"] | None
    """255 where foreground covers a pixel; None where no file says so."""
    straight: UInt8[np.ndarray, "h w"] | None = None
    """Opacity of the raster's pixels before they are averaged, where the cube is a picture whose colours are not
    multiplied by it. Source: PNG specification, whose colours never are."""


def read_view_masks(view: CaptureView, raster: Raster, use_opacity: bool) -> ViewMasks:
    """The masks of a view.

    Args:
        view: It may have an alpha channel. Its mask is black where pixels are ignored, or, if opacity is looked for and
            there is no alpha channel, where background is; see `white_of`.
        raster: Of the scene; a square of pixels is valid where all of it is, and as opaque as its mean.
        use_opacity: Whether to look for it.
    Raises:
        CaptureError: a file can't be read or has another size than the cube.
    """
    valid, opacity, straight = np.ones((raster.height, raster.width), bool), None, None
    alpha = None
    if use_opacity and view.alpha is not None:
        if view.alpha.shape[:2] != view.cube.shape[:2]:
            raise CaptureError(
                f"{view.alpha.path} has {view.alpha.shape[0]} x {view.alpha.shape[1]} pixels; expected "
                f"{view.cube.shape[0]} x {view.cube.shape[1]}, as the cube has"
            )
        alpha = np.rint(np.clip(view.alpha.read()[..., 0], 0.0, 1.0) * OPAQUE).astype(np.uint8)
    elif use_opacity and (picture := alpha_picture(view)) is not None:
        alpha = _read(picture, lambda image: np.asarray(image.convert("RGBA"))[..., 3], view)
    if alpha is not None:
        of_file = alpha[raster.pixels]
        opacity = np.rint(raster.averaged(of_file.astype(np.float32))).astype(np.uint8)
        if view.alpha is None and _is_picture(view):
            straight = of_file
    if view.mask is not None:
        is_black = raster.any_in_square(~_read(view.mask, white_of, view)[raster.pixels])
        if use_opacity and opacity is None:
            opacity = np.where(is_black, 0, OPAQUE).astype(np.uint8)
        else:
            valid = ~is_black
    return ViewMasks(valid, opacity, straight)


def read_labels(view: CaptureView, raster: Raster) -> UInt8[np.ndarray, "H W"] | None:
    """True materials of a view, none where several share a square that is averaged; None if it has no labels. Raises
    CaptureError: the file can't be read, has another size than the cube, or is a picture in colour."""
    if view.labels is None:
        return None
    labels = _read(view.labels, np.asarray, view)
    is_flat = labels.ndim == 2 and labels.dtype.kind in "bui"
    if not is_flat or not 0 <= int(labels.min()) <= int(labels.max()) <= 255:
        channels = counted(1 if labels.ndim == 2 else labels.shape[2], "channel")
        raise CaptureError(
            f"{view.labels}: {channels} of {labels.dtype.name}; expected labels of 0 to 255 in one channel"
        )
    labels, side = labels[raster.pixels].astype(np.uint8), raster.binning
    first = labels[::side, ::side]
    mixed = raster.any_in_square(labels != first.repeat(side, axis=0).repeat(side, axis=1))
    return np.where(mixed, np.uint8(UNLABELLED), first)


def alpha_picture(view: CaptureView) -> Path | None:
    """The picture with an alpha channel: the one beside the cube, or the view itself if it is one."""
    from PIL import Image

    picture = view.cube.path if _is_picture(view) else view.picture
    if picture is None:
        return None
    try:
        with Image.open(picture, formats=_FORMATS) as opened:
            has_alpha = "A" in opened.getbands() or "transparency" in opened.info
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{picture} can't be read as a picture ({error}); mend or remove it") from error
    return picture if has_alpha else None


def _is_picture(view: CaptureView) -> bool:
    """Whether the cube is one picture; a folder of them, one a band, has no opacity of its own."""
    return view.cube.reader == "picture" and not view.cube.path.is_dir()


def _read(path: Path, pixels_of: Callable[[Image.Image], np.ndarray], view: CaptureView) -> np.ndarray:
    """What `pixels_of` makes of a picture with the pixels of the cube, or of its dark lines too."""
    height, width = view.cube.shape[:2]
    try:
        return read_picture(path, (height, width), pixels_of, _FORMATS)
    except UnreadableImageError as error:
        with suppress(UnreadableImageError):
            return read_picture(path, (height + view.cube.dark_lines, width), pixels_of, _FORMATS)[:height]
        raise CaptureError(f"{path} of view {view.name} {error}") from error


def clean_mask(foreground: Bool[np.ndarray, "H W"]) -> tuple[Bool[np.ndarray, "H W"], int, int]:
    """Remove specks, then fill holes, each connected by edges and smaller than `_SMALL_SHARE` of the picture.

    Returns:
        The mask, and how many specks were removed and holes filled.

    >>> mask = np.zeros((100, 100), bool)
    >>> mask[20:80, 20:80] = True
    >>> mask[40, 40] = False
    >>> mask[5, 5] = True
    >>> cleaned, specks, holes = clean_mask(mask)
    >>> int(cleaned.sum()), specks, holes
    (3600, 1, 1)
    """
    smallest = max(4, round(_SMALL_SHARE * foreground.size))
    kept, specks = _without_small(foreground, smallest)
    background, holes = _without_small(~kept, smallest)
    return ~background, specks, holes


def _without_small(mask: Bool[np.ndarray, "H W"], smallest: int) -> tuple[Bool[np.ndarray, "H W"], int]:
    from scipy import ndimage

    parts = np.empty(mask.shape, np.int32)
    ndimage.label(mask, output=parts)
    is_small = np.bincount(parts.ravel()) < smallest
    is_small[0] = False
    return mask & ~is_small[parts], int(is_small.sum())
