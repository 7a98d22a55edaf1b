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
    release: str = ""
    """Of the shutter; frames of one were taken at one moment."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Widths of the bands, where the files tell them."""


def transforms_json(views: Sequence[WrittenView], extra: dict[str, Any]) -> dict[str, Any]:
    """The content of the file.

    What all views share is written above the frames. Views of different sensors have their own lens and size, `bands`
    as indices into the `wavelengths` of the scene, and the name of their sensor.

    Args:
        views: At least one, in order.
        extra: More keys of the scene.
    """
    bands = np.unique(np.concatenate([view.wavelengths_nm for view in views]))
    facts = [_facts(view, bands) for view in views]
    shared = {key: value for key, value in facts[0].items() if all(own.get(key) == value for own in facts)}
    frames = []
    for view, known in zip(views, facts, strict=True):
        own = {key: value for key, value in known.items() if key not in shared}
        pose = [*view.camera_to_world.tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({**view.paths, **own, "transform_matrix": pose})
    return {
        "camera_model": "OPENCV",
        **shared,
        "wavelengths": bands.tolist(),
        **_widths(views, bands),
        "value_scale": FULL_SCALE,
        **extra,
        **_split_lists(views),
        "frames": frames,
    }


def _widths(views: Sequence[WrittenView], bands: Float64[np.ndarray, " B"]) -> dict[str, Any]:
    """Widths of all bands, if all are known."""
    known = {
        float(band): float(width)
        for view in views
        if view.fwhm_nm is not None
        for band, width in zip(view.wavelengths_nm, view.fwhm_nm, strict=True)
    }
    return {"fwhm": [known[band] for band in bands.tolist()]} if len(known) == len(bands) else {}


def _facts(view: WrittenView, bands: Float64[np.ndarray, " B"]) -> dict[str, Any]:
    lens = view.lens
    facts: dict[str, Any] = {"w": lens.width, "h": lens.height}
    facts |= dict(zip(("fl_x", "fl_y"), map(float, lens.focal_px), strict=True))
    facts |= dict(zip(("cx", "cy"), map(float, lens.center_px), strict=True))
    bends = zip(("k1", "k2", "p1", "p2", "k3", "k4"), (*lens.distortion, *lens.higher_radial), strict=True)
    facts |= {key: float(value) for key, value in bends}
    if view.sensor:
        facts["sensor"] = view.sensor
    if view.release:
        facts["capture"] = view.release
    if len(view.wavelengths_nm) < len(bands):
        facts["bands"] = np.searchsorted(bands, view.wavelengths_nm).tolist()
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
