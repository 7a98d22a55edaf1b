"""Which run a command is about."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from unmix_plugin.engine.model import DataManager
    from unmix_plugin.scenes.scene import Scene

from unmix_plugin.engine.runs.run_folder import newest_run


def chosen_run(run: Path | None, output_dir: Path) -> Path:
    """The run folder named, or the newest under `output_dir`, which is then printed.

    Raises:
        RunError: none was named and there is none.
    """
    if run is not None:
        return run
    newest = newest_run(output_dir).path
    print(f"newest run: {newest}", flush=True)
    return newest


def spectral_scene(datamanager: DataManager) -> Scene | None:
    """The spectral scene that a data manager serves; None where it serves something else."""
    from unmix_plugin.scenes.scene import Scene

    scene = getattr(datamanager, "scene", None)
    return scene if isinstance(scene, Scene) else None
