"""Matter and background of each view: from files of the capture, from a background that is white or black, or unknown;
backdrops.py finds those that nobody has named.

The border of the views tells how bright a background is and how much it varies; a threshold between it and the rest
follows from that. Specks are then removed and small holes are filled.

Notation: `H x W` pixels, `B` bands; values in [0, 1] as they are written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from unmix_plugin.captures.calibration.calibration import Raster
from unmix_plugin.captures.calibration.sensor import Sensor, sampled_rows
from unmix_plugin.captures.options import MaskKind
from unmix_plugin.captures.spectral_file import CaptureView
from unmix_plugin.errors import CaptureError, counted, name_some
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_picture, white_of

if TYPE_CHECKING:
    from PIL import Image

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "GIF", "WEBP")
"""Pillow reads more, some of them with other programs."""
_Background = Literal["white", "black"]

HALF, OPAQUE = 127, 255
"""Opacity above which a pixel counts as matter; that of matter that covers a pixel."""
_SMALL_SHARE = 5e-4
"""Specks and holes smaller than this share of the picture are removed."""
_DEVIATIONS = 6.0
"""Standard deviations of the background's noise between its level and the threshold."""
_LEAST_DISTANCE = 0.02
"""Between level and threshold, as a share of the brightest pixels; JPEG and shading vary a background by about this."""
_LEAST_WHITE, _MOST_BLACK = 0.5, 0.2
"""Level of a white or black background, as a share of the brightest pixels."""
_BORDER_SHARE = 0.02
"""Width of the border that a background is judged by, as a share of the view's."""
_MOST_BORDER_PIXELS = 20000
_BRIGHT_PERCENTILE = 99.0


def choose_mask(views: Sequence[CaptureView], asked: MaskKind) -> tuple[MaskKind, list[str]]:
    """What tells matter from background, `auto` where files don't, and what a user should know of it; the views of a
    rig are left whole. CaptureError where opacity is asked of files that some views don't have."""
    if asked not in ("auto", "files"):
        return asked, []
    found = [has_opacity(view, alpha_only=asked == "auto") for view in views]
    missing = [view.name for view, has_it in zip(views, found, strict=True) if not has_it]
    if not missing:
        return "files", []
    if asked == "files":
        raise CaptureError(
            f"--mask files: view {missing[0]} has no mask; expected an alpha channel, or a mask that is white where "
            "matter is, for every view"
        )
    # What the lenses of a rig see from above is ground: a field or water is as plain as a backdrop and is the scene.
    otherwise: MaskKind = "none" if any(view.release for view in views) else "auto"
    if len(missing) == len(views):
        return otherwise, []
    has = "has" if len(missing) == 1 else "have"
    note = (
        f"{len(missing)} of {len(views)} views {has} no alpha channel ({name_some(missing)}), so that of the others is "
        "not used: give all views one, or choose --mask"
    )
    return otherwise, [note]


@dataclass(frozen=True)
class BackgroundRule:
    """Which pixels are background."""

    kind: _Background
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

    def matter(self, values: Float32[np.ndarray, "h W B"]) -> Bool[np.ndarray, "h W"]:
        """Pixels that are not background."""
        brightness = _brightness(self.kind, values)
        return brightness < self.threshold if self.kind == "white" else brightness > self.threshold


def _brightness(kind: _Background, values: Float32[np.ndarray, "*pixels B"]) -> np.ndarray:
    """What tells background from matter: white is bright in every band, black is dark in the mean."""
    return values.min(axis=-1) if kind == "white" else values.mean(axis=-1)


def background_rule(
    kind: _Background, border: Float32[np.ndarray, "M c"], sample: Float32[np.ndarray, "N c"]
) -> BackgroundRule:
    """The rule that fits the border of the views, beside a sample of all their pixels. CaptureError where most of the
    border is not of this kind."""
    brightness = _brightness(kind, border)
    everywhere = np.concatenate([_brightness(kind, sample), brightness])
    brightest = float(np.percentile(np.clip(everywhere, 0.0, 1.0), _BRIGHT_PERCENTILE))
    level = float(np.median(brightness))
    deviation = 1.4826 * float(np.median(np.abs(brightness - level)))
    distance = max(_DEVIATIONS * deviation, _LEAST_DISTANCE * brightest)
    share = level / brightest if brightest > 0 else 0.0
    if (kind == "white" and share < _LEAST_WHITE) or (kind == "black" and share > _MOST_BLACK):
        expected = f"more than {_LEAST_WHITE:.0%}" if kind == "white" else f"less than {_MOST_BLACK:.0%}"
        raise CaptureError(
            f"--mask {kind}: the border of the views is at {share:.0%} of the brightest pixels; expected {expected}, "
            "as the background should reach to the border: choose another --mask"
        )
    threshold = level - distance if kind == "white" else level + distance
    return BackgroundRule(kind, threshold, level, deviation)


def border_pixels(sensor: Sensor, views: Sequence[CaptureView], scale: float) -> Float32[np.ndarray, "M c"]:
    """Pixels at the border of the views, in [0, 1]; saturated ones are 1, missing ones are left out."""
    raster = sensor.calibration.raster
    width = max(1, round(_BORDER_SHARE * raster.width))
    columns = np.r_[0:width, raster.width - width : raster.width]
    rows = sorted({0, raster.height - 1, *sampled_rows(raster.height)})
    step = max(1, len(views) * (2 * raster.width + 2 * width * len(rows)) // _MOST_BORDER_PIXELS)
    border = []
    for view in views:
        for row in rows:
            part = sensor.calibration.rows(view.cube, row, row + 1)
            shown = np.arange(raster.width) if row in (0, raster.height - 1) else columns
            shown = shown[row % step :: step]
            values = np.where(part.saturated[0, shown], np.float32(scale), part.values[0, shown])
            border.append(values[~part.missing[0, shown]])
    return np.clip(np.concatenate(border) / np.float32(scale), 0.0, 1.0)


def clean(matter: Bool[np.ndarray, "H W"]) -> tuple[Bool[np.ndarray, "H W"], int, int]:
    """Remove specks, then fill holes, each connected by edges and smaller than `_SMALL_SHARE` of the picture.

    Returns:
        The mask, and how many specks were removed and holes filled.

    >>> mask = np.zeros((100, 100), bool)
    >>> mask[20:80, 20:80] = True
    >>> mask[40, 40] = False
    >>> mask[5, 5] = True
    >>> cleaned, specks, holes = clean(mask)
    >>> int(cleaned.sum()), specks, holes
    (3600, 1, 1)
    """
    smallest = max(4, round(_SMALL_SHARE * matter.size))
    kept, specks = _without_small(matter, smallest)
    background, holes = _without_small(~kept, smallest)
    return ~background, specks, holes


def _without_small(mask: Bool[np.ndarray, "H W"], smallest: int) -> tuple[Bool[np.ndarray, "H W"], int]:
    from scipy import ndimage

    parts = np.empty(mask.shape, np.int32)
    ndimage.label(mask, output=parts)
    is_small = np.bincount(parts.ravel()) < smallest
    is_small[0] = False
    return mask & ~is_small[parts], int(is_small.sum())


@dataclass(frozen=True)
class ViewMasks:
    """Masks of one view on the scene's raster."""

    valid: Bool[np.ndarray, "H W"]
    """Pixels that are not to be ignored."""
    opacity: UInt8[np.ndarray, "H W"] | None
    """255 where matter covers a pixel; None where no file says so."""


def has_opacity(view: CaptureView, alpha_only: bool = False) -> bool:
    """Whether a file says what is matter: an alpha channel, or a mask that is white there."""
    has_alpha = view.alpha is not None or _alpha_picture(view) is not None
    return has_alpha or (view.mask is not None and not alpha_only)


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
    valid, opacity = np.ones((raster.height, raster.width), bool), None
    alpha = _alpha(view) if use_opacity else None
    if alpha is not None:
        opacity = np.rint(raster.averaged(_cut(alpha, raster).astype(np.float32))).astype(np.uint8)
    if view.mask is not None:
        is_black = raster.any_in_square(~_cut(_read(view.mask, white_of, view), raster))
        if use_opacity and opacity is None:
            opacity = np.where(is_black, 0, OPAQUE).astype(np.uint8)
        else:
            valid = ~is_black
    return ViewMasks(valid, opacity)


def read_labels(view: CaptureView, raster: Raster) -> UInt8[np.ndarray, "H W"] | None:
    """True materials of a view; None if it has none, or if pixels are averaged. Raises CaptureError: the file can't be
    read, has another size than the cube, or is a picture in colour."""
    if view.labels is None or raster.binning > 1:
        return None
    labels = _read(view.labels, np.asarray, view)
    if (
        labels.ndim != 2
        or labels.dtype.kind not in "bui"
        or not 0 <= int(labels.min()) <= int(labels.max()) <= 255
    ):
        channels = counted(1 if labels.ndim == 2 else labels.shape[2], "channel")
        raise CaptureError(
            f"{view.labels}: {channels} of {labels.dtype.name}; expected labels of 0 to 255 in one channel"
        )
    return _cut(labels, raster).astype(np.uint8)


def _alpha(view: CaptureView) -> UInt8[np.ndarray, "H W"] | None:
    if view.alpha is not None:
        if view.alpha.shape[:2] != view.cube.shape[:2]:
            raise CaptureError(
                f"{view.alpha.path} has {view.alpha.shape[0]} x {view.alpha.shape[1]} pixels; expected "
                f"{view.cube.shape[0]} x {view.cube.shape[1]}, as the cube has"
            )
        return np.rint(np.clip(view.alpha.read()[..., 0], 0.0, 1.0) * OPAQUE).astype(np.uint8)
    picture = _alpha_picture(view)
    return None if picture is None else _read(picture, _opacity_of, view)


def _opacity_of(image: Image.Image) -> np.ndarray:
    return np.asarray(image.convert("RGBA"))[..., 3]


def _alpha_picture(view: CaptureView) -> Path | None:
    """The picture with an alpha channel: the one beside the cube, or the view itself if it is one."""
    from PIL import Image

    picture = view.cube.path if view.cube.reader == "picture" else view.picture
    if picture is None:
        return None
    try:
        with Image.open(picture, formats=_FORMATS) as opened:
            has_alpha = "A" in opened.getbands() or "transparency" in opened.info
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{picture} can't be read as a picture ({error}); mend or remove it") from error
    return picture if has_alpha else None


def _cut(pixels: np.ndarray, raster: Raster) -> np.ndarray:
    return pixels[raster.file_rows(0, raster.height), raster.columns]


def _read(path: Path, pixels_of: Callable[[Image.Image], np.ndarray], view: CaptureView) -> np.ndarray:
    """What `pixels_of` makes of a picture with the pixels of the cube."""
    try:
        return read_picture(path, view.cube.shape[:2], pixels_of, _FORMATS)
    except UnreadableImageError as error:
        raise CaptureError(f"{path} of view {view.name} {error}") from error
