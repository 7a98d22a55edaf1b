"""transforms.json of the scene: cameras, bands, scale, paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.pose_set import Lens
from unmix_plugin.captures.writing.view_files import FULL_SCALE


@dataclass(frozen=True)
class WrittenView:
    """One frame of the scene."""

    paths: dict[str, str]
    """Files by the keys of transforms.json."""
    camera_to_world: Float64[np.ndarray, "3 4"]
    lens: Lens
    """Of the pixels as they are written."""
    sensor: str
    wavelengths_nm: Float64[np.ndarray, " B"]
    split: Literal["train", "eval"] | None


def transforms_json(views: Sequence[WrittenView], extra: dict[str, Any]) -> dict[str, Any]:
    """The content of the file.

    What all views share stands above the frames. Views of different sensors have their own lens, size, bands and the
    name of their sensor.

    Args:
        views: At least one, in order.
        extra: More keys of the scene.
    """
    shared = {
        key: value for key, value in _facts(views[0]).items() if all(_facts(v)[key] == value for v in views)
    }
    bands = np.unique(np.concatenate([view.wavelengths_nm for view in views]))
    frames = []
    for view in views:
        own = {key: value for key, value in _facts(view).items() if key not in shared}
        pose = [*view.camera_to_world.tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({**view.paths, **own, "transform_matrix": pose})
    return {
        "camera_model": "OPENCV",
        **shared,
        "wavelengths": bands.tolist(),
        "value_scale": FULL_SCALE,
        **extra,
        **_split_lists(views),
        "frames": frames,
    }


def _facts(view: WrittenView) -> dict[str, Any]:
    lens = view.lens
    facts: dict[str, Any] = {"w": lens.width, "h": lens.height}
    facts |= dict(zip(("fl_x", "fl_y"), map(float, lens.focal_px), strict=True))
    facts |= dict(zip(("cx", "cy"), map(float, lens.center_px), strict=True))
    facts |= dict(zip(("k1", "k2", "p1", "p2"), map(float, lens.distortion), strict=True))
    if view.sensor:
        facts["sensor"] = view.sensor
    facts["wavelengths"] = view.wavelengths_nm.tolist()
    return facts


def _split_lists(views: Sequence[WrittenView]) -> dict[str, list[str]]:
    """Lists of file paths, where every view is said to be for training or evaluation."""
    if not all(view.split for view in views):
        return {}
    train, evaluation = (
        [view.paths["file_path"] for view in views if view.split == split] for split in ("train", "eval")
    )
    return (
        {"train_filenames": train, "val_filenames": evaluation, "test_filenames": evaluation}
        if evaluation
        else {}
    )
