"""The scene that a run was trained on, where it can still be found: measurements to put beside predictions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from unmix_plugin.engine.runs.scene_record import differences, name_differences
from unmix_plugin.errors import RunError, SceneError
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene, SceneOptions, scene_identity


def find_scene(summary: Mapping[str, Any], run: Path, data: Path | None) -> Scene | None:
    """The scene of a run, if it is where it was and has not changed.

    Args:
        summary: What the run recorded of its scene.
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
    differing = differences(scene_identity(summary), scene_identity(scene.summary()))
    if not differing:
        return scene
    if data is None:
        return None
    raise RunError(
        f"the scene at {root} is not the one that {run} was trained on: {name_differences(differing)}"
    )
