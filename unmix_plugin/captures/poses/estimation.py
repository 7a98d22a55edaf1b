"""Poses estimated from the pictures themselves: structure from motion with COLMAP, one lens a sensor."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from unmix_plugin.captures.poses.colmap import read_colmap
from unmix_plugin.captures.poses.contrast import without_rim
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.poses.rigid import name_some
from unmix_plugin.captures.poses.sfm_process import SfmSettings, write_settings
from unmix_plugin.errors import CaptureError

Picture = UInt8[np.ndarray, "H W"] | UInt8[np.ndarray, "H W 3"]

LEAST_VIEWS = 3
LEAST_SHARE = 0.5
"""Of the views; with fewer registered ones the poses are refused."""
MOST_EXHAUSTIVE = 100
"""Views up to which all pairs are matched; beyond, neighbours in the order of names."""
RIM_PX = 4
"""Beside the edge of a mask, where features are those of the silhouette and not of the surface."""
LOG = "colmap.log"
_WHAT_TO_DO = (
    "take more views with smaller steps (10 degrees) and much overlap, mask a background that stands still while the "
    "object turns, put printed texture beside the object, or give poses with --poses FILE"
)


def estimate_poses(
    pictures: Mapping[str, Picture],
    folder: Path,
    sensor_of: Mapping[str, str] | None = None,
    masks: Mapping[str, Bool[np.ndarray, "H W"]] | None = None,
    threads: int | None = None,
) -> PoseSet:
    """Find where pictures were taken from.

    Args:
        pictures: By the name of the view; with high contrast (see `contrast`).
        folder: For COLMAP's files and its log; is made.
        sensor_of: Sensor of each view; views of one have one lens and one size. None is one for all.
        masks: True on matter; features are found there, but not on its rim.
        threads: None takes those of the machine, at most 8; with 1 the same pictures give the same poses to the bit.
    Returns:
        Poses by the name of the view, in an arbitrary world (`has_world` is False); `notes` say how many views were
        registered and the reprojection error.
    Raises:
        CaptureError: pycolmap is not installed, or fewer than half of the views, or than 3, could be registered.
    """
    _require_pycolmap()
    if len(pictures) < LEAST_VIEWS:
        raise CaptureError(
            f"{len(pictures)} views; expected at least {LEAST_VIEWS} to estimate poses from: {_WHAT_TO_DO}"
        )
    files = {name: f"{index:06d}.png" for index, name in enumerate(sorted(pictures))}
    _write_pictures(folder, {files[name]: picture for name, picture in pictures.items()}, "images")
    if masks is not None:
        shown = {
            f"{files[name]}.png": 255 * without_rim(mask, RIM_PX).astype(np.uint8)
            for name, mask in masks.items()
        }
        _write_pictures(folder, shown, "masks")
    sensors: dict[str, list[str]] = {}
    for name in sorted(pictures):
        sensors.setdefault((sensor_of or {}).get(name, ""), []).append(files[name])
    settings = SfmSettings(
        folder=str(folder.resolve()),
        sensors=tuple(map(tuple, sensors.values())),
        has_masks=masks is not None,
        sequential=len(pictures) > MOST_EXHAUSTIVE,
        threads=threads or min(os.cpu_count() or 1, 8),
    )
    models = _run(settings, folder)
    return _best(models, files, folder)


def _require_pycolmap() -> None:
    if importlib.util.find_spec("pycolmap") is None:
        raise CaptureError(
            "poses can't be estimated: pycolmap is not installed; pip install 'unmix-nerf[sfm]', or give poses of "
            "another program"
        )


def _write_pictures(folder: Path, pictures: Mapping[str, UInt8[np.ndarray, "..."]], kind: str) -> None:
    from PIL import Image

    place = folder / kind
    place.mkdir(parents=True, exist_ok=True)
    for name, pixels in pictures.items():
        Image.fromarray(pixels).save(place / name)


def _run(settings: SfmSettings, folder: Path) -> list[dict]:
    """Start the process that reconstructs, with its output in the log file."""
    result = folder / "result.json"
    result.unlink(missing_ok=True)
    command = [sys.executable, "-m", "unmix_plugin.captures.poses.sfm_process", str(write_settings(settings))]
    with (folder / LOG).open("wb") as log:
        status = subprocess.run(
            command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, check=False
        ).returncode
    if status != 0 or not result.is_file():
        lines = (folder / LOG).read_text("utf-8", "replace").strip().splitlines()
        raise CaptureError(
            f"COLMAP stopped with status {status} ({lines[-1].strip() if lines else 'without a word'}); see "
            f"{folder / LOG}"
        )
    return json.loads(result.read_text(encoding="utf-8"))


def _best(models: list[dict], files: Mapping[str, str], folder: Path) -> PoseSet:
    """The model with the most views, that with the smaller error where two have as many."""
    best = max(models, key=lambda model: (model["registered"], -model["error_px"]), default=None)
    registered = 0 if best is None else best["registered"]
    if best is None or registered < max(LEAST_VIEWS, LEAST_SHARE * len(files)):
        raise CaptureError(
            f"poses of only {registered} of {len(files)} views could be estimated; expected at least half: "
            f"{_WHAT_TO_DO} (see {folder / LOG})"
        )
    poses = read_colmap(Path(best["folder"]))
    cameras = {name: poses.cameras[file] for name, file in files.items() if file in poses.cameras}
    missing = [name for name in files if name not in cameras]
    error = f"a mean reprojection error of {best['error_px']:.2f} px"
    notes = [f"COLMAP registered {registered} of {len(files)} views with {error}"]
    if missing:
        notes.append(f"views without pose: {name_some(missing)}")
    notes += poses.notes
    return replace(poses, cameras=cameras, source="estimated by COLMAP", has_world=False, notes=tuple(notes))
