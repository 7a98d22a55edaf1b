"""What makes a scene the one that a run was trained on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from unmix_plugin.scenes.reading.transforms_json import FILE_NAME

_COMPARED = ("wavelengths_nm", "frames", "train_indices", "eval_indices", "cameras", "normalisation")
_OF_RIGS = ("sensors", "frame_sensors")


def scene_identity(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a `Scene.summary` that must agree: views, cameras, bands, and the content of what was measured.

    Where the scene lies doesn't matter, nor its labels and other truth, nor how transforms.json is written: all that
    it says is compared as numbers.
    """
    hashes = dict(summary.get("input_hashes") or {})
    hashes.pop(FILE_NAME, None)
    rig = {key: summary[key] for key in _OF_RIGS if key in summary}
    return {**{key: summary.get(key) for key in _COMPARED}, **rig, "files": hashes}
