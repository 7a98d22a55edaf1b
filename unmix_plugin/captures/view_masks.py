"""What pictures of a capture say of a view's pixels: which are matter, and which are to be ignored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from unmix_plugin.captures.calibration.raster import Raster
from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.errors import CaptureError

HALF = 127
"""Opacity above which a pixel is matter."""


@dataclass(frozen=True)
class ViewMasks:
    """Masks of one view on the scene's raster."""

    valid: Bool[np.ndarray, "H W"]
    """Pixels that are not to be ignored."""
    matter: Bool[np.ndarray, "H W"] | None
    """Pixels that are not background; None where no file says so."""


def has_matter(view: CaptureView, alpha_only: bool = False) -> bool:
    """Whether a file says what is matter: the alpha channel of the picture, or a mask that is white there."""
    return _alpha_of(view) is not None or (view.mask is not None and not alpha_only)


def read_view_masks(view: CaptureView, raster: Raster, use_matter: bool) -> ViewMasks:
    """The masks of a view.

    Args:
        view: Its picture may have an alpha channel. Its mask is black where pixels are ignored, or, if matter is looked
            for and there is no alpha channel, where background is.
        raster: Of the scene; a square of pixels is valid, or matter, where all of it is.
        use_matter: Whether to look for matter.
    Raises:
        CaptureError: a file can't be read or has another size than the cube.
    """
    valid, matter = np.ones((raster.height, raster.width), bool), None
    alpha = _alpha_of(view) if use_matter else None
    if alpha is not None:
        matter = ~raster.any_in_square(_cut(_read(alpha, "RGBA", view)[..., 3] <= HALF, raster))
    if view.mask is not None:
        kept = ~raster.any_in_square(_cut(_read(view.mask, "L", view) <= (HALF if use_matter else 0), raster))
        valid, matter = (valid, kept) if use_matter and alpha is None else (kept, matter)
    return ViewMasks(valid, matter)


def _alpha_of(view: CaptureView) -> Path | None:
    """The picture with an alpha channel: the one beside the cube, or the view itself if it is one."""
    picture = view.cube.path if view.cube.metadata.get("has_alpha") else view.picture
    return picture if picture is not None and _has_alpha(picture) else None


def _cut(pixels: np.ndarray, raster: Raster) -> np.ndarray:
    return pixels[raster.file_rows(0, raster.height), raster.columns]


def _has_alpha(path: Path) -> bool:
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return "A" in picture.getbands() or "transparency" in picture.info
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{path} can't be read as a picture ({error}); mend or remove it") from error


def _read(path: Path, mode: str, view: CaptureView) -> np.ndarray:
    from PIL import Image

    height, width, _ = view.cube.shape
    try:
        with Image.open(path) as picture:
            if picture.size != (width, height):
                raise CaptureError(
                    f"{path} has {picture.size[0]} x {picture.size[1]} pixels (width x height); expected "
                    f"{width} x {height}, as the cube of view {view.name} has"
                )
            return np.asarray(picture.convert(mode))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{path} can't be read as a picture ({error}); mend or remove it") from error
