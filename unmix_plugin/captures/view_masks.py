"""What pictures of a capture say of a view's pixels: how opaque they are, which are to be ignored, what they show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from unmix_plugin.captures.calibration.raster import Raster
from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.errors import CaptureError

HALF = 127
"""Grey above which a mask is white."""
OPAQUE = 255


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
            there is no alpha channel, where background is.
        raster: Of the scene; a square of pixels is valid where all of it is, and as opaque as its mean.
        use_opacity: Whether to look for it.
    Raises:
        CaptureError: a file can't be read or has another size than the cube.
    """
    valid, opacity = np.ones((raster.height, raster.width), bool), None
    alpha = _alpha(view) if use_opacity else None
    if alpha is not None:
        mean = raster.averaged(_cut(alpha, raster).astype(np.float32))
        opacity = np.rint(mean).astype(np.uint8)
    if view.mask is not None:
        mask = _cut(_read(view.mask, "L", view), raster)
        if use_opacity and opacity is None:
            opacity = np.where(raster.any_in_square(mask <= HALF), 0, OPAQUE).astype(np.uint8)
        else:
            valid = ~raster.any_in_square(mask == 0)
    return ViewMasks(valid, opacity)


def read_labels(view: CaptureView, raster: Raster) -> UInt8[np.ndarray, "H W"] | None:
    """True materials of a view; None if it has none, or if pixels are averaged.

    Raises:
        CaptureError: the file can't be read or has another size than the cube.
    """
    if view.labels is None or raster.binning > 1:
        return None
    return _cut(_read(view.labels, None, view), raster).astype(np.uint8)


def _alpha(view: CaptureView) -> UInt8[np.ndarray, "H W"] | None:
    if view.alpha is not None:
        if view.alpha.shape[:2] != view.cube.shape[:2]:
            raise CaptureError(
                f"{view.alpha.path} has {view.alpha.shape[0]} x {view.alpha.shape[1]} pixels; expected "
                f"{view.cube.shape[0]} x {view.cube.shape[1]}, as the cube has"
            )
        return np.rint(np.clip(view.alpha.read()[..., 0], 0.0, 1.0) * OPAQUE).astype(np.uint8)
    picture = _alpha_picture(view)
    return None if picture is None else _read(picture, "RGBA", view)[..., 3]


def _alpha_picture(view: CaptureView) -> Path | None:
    """The picture with an alpha channel: the one beside the cube, or the view itself if it is one."""
    from PIL import Image

    picture = view.cube.path if view.cube.reader == "picture" else view.picture
    if picture is None:
        return None
    try:
        with Image.open(picture) as opened:
            has_alpha = "A" in opened.getbands() or "transparency" in opened.info
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{picture} can't be read as a picture ({error}); mend or remove it") from error
    return picture if has_alpha else None


def _cut(pixels: np.ndarray, raster: Raster) -> np.ndarray:
    return pixels[raster.file_rows(0, raster.height), raster.columns]


def _read(path: Path, mode: str | None, view: CaptureView) -> np.ndarray:
    """A picture with the pixels of the cube, converted to a mode of Pillow or as it is."""
    from PIL import Image

    height, width, _ = view.cube.shape
    try:
        with Image.open(path) as picture:
            if picture.size != (width, height):
                raise CaptureError(
                    f"{path} has {picture.size[0]} x {picture.size[1]} pixels (width x height); expected "
                    f"{width} x {height}, as the cube of view {view.name} has"
                )
            return np.asarray(picture if mode is None else picture.convert(mode))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{path} can't be read as a picture ({error}); mend or remove it") from error
