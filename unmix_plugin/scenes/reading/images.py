"""The PNG, JPEG or TIFF pictures of a scene: colour with alpha, labels, masks.

Pictures whose size isn't the one expected are refused by their header: a few hundred bytes can decode to gigabytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, UInt8

from unmix_plugin.errors import SceneError
from unmix_plugin.limits import allow_decoded
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.reading.entries import FrameEntry, Shape
from unmix_plugin.scenes.reading.faults import Faults

if TYPE_CHECKING:
    from PIL import Image


FORMATS = ("PNG", "JPEG", "TIFF")
"""Pillow reads more formats, some of which start other programs."""
_COLOUR_MODES = {"RGB": "RGB", "RGBA": "RGBA", "L": "RGB", "LA": "RGBA", "1": "RGB", "P": "RGB"}
"""How each pillow mode of 8 bits is brought to RGB or RGBA, where no colour stands for transparency."""

UNLABELLED = 255
"""Label of a pixel whose material is unknown."""


class UnreadableImageError(ValueError):
    """A file is not a picture of the kind needed; the text says why and what to do."""


def read_colour(path: Path, size: Shape | None) -> UInt8[np.ndarray, "H W C"]:
    """Read sRGB (C = 3) or sRGB with alpha (C = 4), 8 bits; None: of any size. Raises UnreadableImageError: not a
    readable picture of this size with 8 bits a channel; SceneError: too large a one."""

    def convert(image: Image.Image) -> np.ndarray:
        if image.mode not in _COLOUR_MODES:
            raise UnreadableImageError(
                Message.PICTURE_MODE.sentence(mode=image.mode, expected="8-bit RGB or RGBA")
            )
        has_clear_colour = "transparency" in image.info  # tRNS of a PNG: a colour, or entries of the palette
        return np.asarray(image.convert("RGBA" if has_clear_colour else _COLOUR_MODES[image.mode]))

    return read_picture(path, size, convert)


def read_labels(path: Path, size: Shape) -> UInt8[np.ndarray, "H W"]:
    """Read class indices from an 8-bit picture of one channel (grey or palette; 255 = unlabelled). Raises
    UnreadableImageError: not a readable picture of this size with one 8-bit channel."""

    def convert(image: Image.Image) -> np.ndarray:
        if image.mode not in ("L", "P"):
            raise UnreadableImageError(
                Message.PICTURE_MODE.sentence(mode=image.mode, expected="one 8-bit channel")
            )
        return np.asarray(image)

    return read_picture(path, size, convert)


def read_mask(path: Path, size: Shape) -> Bool[np.ndarray, "H W"]:
    """Read a mask: True where a pixel counts, False where it is black (nerfstudio's convention). Raises
    UnreadableImageError: not a readable picture of this size, or neither black and white nor two numbers."""
    return read_picture(path, size, white_of)


def white_of(image: Image.Image) -> Bool[np.ndarray, "H W"]:
    """Where a mask is white. The one rule for masks: white is what is brighter than half of the range.

    A mask whose numbers are all dark holds 0 and one other number, such as 1, which is its white. Opacity counts as
    brightness over black. Raises UnreadableImageError: all is dark and there are several greys, so that white is
    ambiguous.
    """
    grey, top = _grey_of(image)
    brightest = grey.max(initial=0)
    if brightest > top // 2 or image.format == "JPEG":  # which has noise where all is black
        return grey > top // 2
    levels = np.unique(grey)
    if len(levels[levels > 0]) > 1:
        raise UnreadableImageError(
            Message.MASK_GREYS.sentence(greys=len(levels), brightest=brightest, white=top)
        )
    return grey > 0


def _grey_of(image: Image.Image) -> tuple[np.ndarray, int]:
    """Brightness of a mask's pixels, and that of white."""
    if image.mode.startswith("I"):
        grey = np.asarray(image).astype(np.int64)
        return grey, 65535 if grey.max(initial=0) > 255 else 255
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        pixels = np.asarray(image.convert("LA")).astype(np.int64)
        over_black = pixels[..., 0] * pixels[..., 1] // 255
        return (over_black if over_black.any() else pixels[..., 1] * (np.ptp(pixels[..., 1]) > 0)), 255
    return np.asarray(image.convert("L")).astype(np.int64), 255


def read_picture(
    path: Path,
    size: Shape | None,
    convert: Callable[[Image.Image], np.ndarray],
    formats: tuple[str, ...] = FORMATS,
) -> np.ndarray:
    """What `convert` makes of a picture of this size. Raises UnreadableImageError: not a readable picture of this size
    and of these formats."""
    from PIL import Image

    try:
        with Image.open(path, formats=formats) as image:
            if size is None:
                allow_decoded(path, image.height * image.width * 16, SceneError)  # as float32
            elif (image.height, image.width) != size:
                values = {"width": image.width, "height": image.height, "wide": size[1], "high": size[0]}
                raise UnreadableImageError(Message.PICTURE_SIZE.sentence(**values))
            return convert(image)
    except (UnreadableImageError, SceneError):
        raise
    # pillow reports damage as OSError, SyntaxError, ValueError, EOFError or a bomb error, by format
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise UnreadableImageError(
            Message.NO_PICTURE_FILE.sentence(formats=", ".join(formats), reason=reason)
        ) from error


_Pictures = list[Bool[np.ndarray, "_ _"] | None]
"""For each frame, None where it has no such picture."""


def check_colours(
    frames: Sequence[FrameEntry], sizes: Sequence[Shape | None], faults: Faults
) -> _Pictures | None:
    """Check all pictures; returns where each is not fully transparent, or None if the scene has no alpha.

    It has if some pixel of a picture is not opaque; then every frame must have a picture with an alpha channel.
    """
    seen: _Pictures = []
    transparent, without = None, list[FrameEntry]()
    for frame, size in zip(frames, sizes, strict=True):
        pixels = _checked(frame, "file_path", read_colour, size, faults)
        alpha = pixels[..., 3] if pixels is not None and pixels.shape[2] == 4 else None
        seen.append(None if alpha is None else alpha > 0)
        if transparent is None and alpha is not None and (alpha < 255).any():
            transparent = frame
        if alpha is None and (
            pixels is not None or "file_path" not in frame.paths
        ):  # others have their own fault
            without.append(frame)
    if transparent is None:
        return None
    for frame in without:
        faults.note(frame.name_of("file_path"), Message.NO_ALPHA, other=transparent.where)
    return seen


def check_masks(frames: Sequence[FrameEntry], sizes: Sequence[Shape | None], faults: Faults) -> _Pictures:
    """Check all masks; returns which pixels they keep."""
    masks: _Pictures = []
    for frame, size in zip(frames, sizes, strict=True):
        mask = _checked(frame, "mask_path", read_mask, size, faults)
        if mask is not None and not mask.any():
            faults.note(frame.name_of("mask_path"), Message.MASK_BLACK)
        masks.append(mask)
    return masks


def check_labels(
    frames: Sequence[FrameEntry], sizes: Sequence[Shape | None], num_materials: int | None, faults: Faults
) -> None:
    """Check the true materials of all frames."""
    for frame, size in zip(frames, sizes, strict=True):
        labels = _checked(frame, "seg_file_path", read_labels, size, faults)
        greatest = 0 if labels is None else int(labels.max(where=labels != UNLABELLED, initial=0))
        if num_materials is not None and greatest >= num_materials:
            values = {"label": greatest, "last": num_materials - 1}
            faults.note(frame.name_of("seg_file_path"), Message.LABEL_OUTSIDE, **values)


def _checked(
    frame: FrameEntry, key: str, read: Callable[[Path, Shape], np.ndarray], size: Shape | None, faults: Faults
) -> np.ndarray | None:
    """One picture; None if there is none, or if its size is unknown because there is no cube."""
    if key not in frame.files or size is None:
        return None
    try:
        return read(frame.files[key], size)
    except UnreadableImageError as error:
        return faults.add(frame.name_of(key), str(error))
