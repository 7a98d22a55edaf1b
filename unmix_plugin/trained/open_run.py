"""Opening a run: from its folder to the trained scene in it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.registry import discover_methods
from unmix_plugin.engine.runs.checkpoints import TrainingRecord
from unmix_plugin.engine.runs.load_run import SceneRecord, load_model
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.snapshot import snapshot
from unmix_plugin.trained.trained_scene import TrainedScene


@dataclass(frozen=True)
class LoadedRun:
    """A trained scene, and what its run folder says of how it came about."""

    folder: RunFolder
    config: TrainerConfig
    record: SceneRecord
    """What the run keeps of its input."""
    training: TrainingRecord
    scene: RenderableScene

    @property
    def materials_scene(self) -> TrainedScene:
        """The scene, which must be one of mixed materials.

        Raises:
            ConfigError: its method does not unmix spectra.
        """
        return require_materials(self.scene, self.config.method_name)


def load_run(path: str | Path, device: str = "auto") -> LoadedRun:
    """The newest complete checkpoint of a run; reads nothing but the run folder.

    Raises:
        RunError: the run is missing, half-written, damaged, or from a newer version.
        ConfigError: the device is not there, or the method is not installed.
    """
    loaded = load_model(Path(path), device)
    scene = snapshot(loaded.model, loaded.config.method_name, loaded.scene)
    return LoadedRun(loaded.run, loaded.config, loaded.scene, loaded.training, scene)


def open_run(path: str | Path, device: str = "auto") -> TrainedScene:
    """The trained scene of a run of `unmix-nerf`.

    Args:
        path: Run folder.
        device: `auto`, `cpu` or `cuda`.
    Raises:
        RunError: the run is missing, half-written, damaged, or from a newer version.
        ConfigError: the device is not there, or the method does not unmix spectra.
    """
    return load_run(path, device).materials_scene


def require_materials(scene: RenderableScene | None, method_name: str) -> TrainedScene:
    """The scene, if it has endmembers; None stands for a method that makes none.

    Raises:
        ConfigError: it has none.
    """
    if not isinstance(scene, TrainedScene):
        own = _own_products(method_name)
        raise ConfigError(
            f"the method {method_name} makes no scene of mixed materials, as unmix-nerf does and this needs"
            + (f"; unmix-export has products of its own for it: {', '.join(own)}" if own else "")
        )
    return scene


def _own_products(method_name: str) -> list[str]:
    """Names of the products that a method brings along."""
    method = discover_methods()[0].get(method_name)
    if method is None or method.products is None:
        return []
    with suppress(Exception):  # a third party's module may fail in any way at all
        return [product.name for product in method.products()]
    return []
