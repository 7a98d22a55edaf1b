"""The scene that a run was trained on, where it is still at hand: what was measured, to put beside predictions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from unmix_plugin.errors import RunError, SceneError
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene, SceneOptions

_COMPARED = ("wavelengths_nm", "frames", "eval_indices", "normalisation", "input_hashes")


def scene_at_hand(summary: Mapping[str, Any], run: Path, data: Path | None) -> Scene | None:
    """The scene of a run, if it is where it was and is still the same.

    Args:
        summary: What the run remembers of its scene.
        run: Its folder.
        data: Where the scene is now; then it has to be there. None: where it was.
    Raises:
        SceneError: it is not at `data`, or malformed there.
        RunError: `data` is another scene than the run's.
    """
    root = data or Path(str(summary.get("root", "")))
    if data is None and not (root.is_absolute() and root.is_dir()):
        return None
    try:
        scene = load_scene(root, SceneOptions(**summary.get("options", {})))
    except (SceneError, TypeError):
        if data is None:
            return None
        raise
    found = scene.summary()
    differing = [key for key in _COMPARED if found[key] != summary.get(key)]
    if not differing:
        return scene
    if data is None:
        return None
    raise RunError(
        f"the scene at {root} is not the one that {run} was trained on: {', '.join(differing)} differ"
    )
