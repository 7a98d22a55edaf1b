"""Check every picture of a scene: colours with alpha, masks, labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.images import Size, UnreadableImageError, read_colour, read_labels, read_mask
from unmix_plugin.scenes.reading.transforms_json import FrameEntry, SceneEntry
from unmix_plugin.scenes.scene import UNLABELLED

Pictures = list[Bool[np.ndarray, "_ _"] | None]
"""For each frame, None where it has no such picture."""


def check_colours(
    entry: SceneEntry, located: tuple[dict[str, Path], ...], sizes: Sequence[Size | None], faults: Faults
) -> Pictures | None:
    """Check all pictures; returns where each is not fully transparent, or None if the scene has no alpha.

    It has if some pixel of a picture is not opaque; then every frame must have a picture with an alpha channel.
    """
    seen: Pictures = []
    is_readable = []
    example = None
    for frame, paths, size in zip(entry.frames, located, sizes, strict=True):
        noted = faults.noted
        pixels = _read(frame, paths, "file_path", read_colour, size, faults)
        is_readable.append(faults.noted == noted and ("file_path" in paths) == ("file_path" in frame.paths))
        alpha = pixels[..., 3] if pixels is not None and pixels.shape[2] == 4 else None
        seen.append(None if alpha is None else alpha > 0)
        if alpha is not None and example is None and (alpha < 255).any():
            example = frame.where
    if example is None:
        return None
    for frame, mask, is_fine in zip(entry.frames, seen, is_readable, strict=True):
        if mask is None and is_fine:  # a picture that is missing or can't be read has its own fault already
            message = f"has no picture with alpha, while {example} is transparent in places"
            faults.add(frame.name_of("file_path"), f"{message}; give alpha to all or to none")
    return seen


def check_masks(
    entry: SceneEntry, located: tuple[dict[str, Path], ...], sizes: Sequence[Size | None], faults: Faults
) -> Pictures:
    """Check all masks; returns which pixels they keep."""
    masks: Pictures = []
    for frame, paths, size in zip(entry.frames, located, sizes, strict=True):
        masks.append(_read(frame, paths, "mask_path", read_mask, size, faults))
        if masks[-1] is not None and not masks[-1].any():
            faults.add(
                frame.name_of("mask_path"),
                "the mask is black everywhere, so no pixel of the frame counts; drop the frame",
            )
    return masks


def check_labels(
    entry: SceneEntry,
    located: tuple[dict[str, Path], ...],
    sizes: Sequence[Size | None],
    num_materials: int | None,
    faults: Faults,
) -> None:
    """Check the true materials of all frames."""
    for frame, paths, size in zip(entry.frames, located, sizes, strict=True):
        labels = _read(frame, paths, "seg_file_path", read_labels, size, faults)
        greatest = 0 if labels is None else int(labels.max(where=labels != UNLABELLED, initial=0))
        if num_materials is not None and greatest >= num_materials:
            faults.add(
                frame.name_of("seg_file_path"),
                f"has label {greatest}; expected 0 to {num_materials - 1} for the materials, or {UNLABELLED}",
            )


def _read(
    frame: FrameEntry,
    paths: dict[str, Path],
    key: str,
    read: Callable[[Path, Size], np.ndarray],
    size: Size | None,
    faults: Faults,
) -> np.ndarray | None:
    """One picture; None if there is none, or if its size can't be judged because no cube told it."""
    if key not in paths or size is None:
        return None
    try:
        return read(paths[key], size)
    except UnreadableImageError as error:
        faults.add(frame.name_of(key), str(error))
        return None
