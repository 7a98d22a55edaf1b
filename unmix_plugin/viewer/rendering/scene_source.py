"""Where the viewer's scene comes from: a finished run, or a training that is under way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.engine.training.training_control import DeviceShare, TrainingControl
from unmix_plugin.trained.open_run import LoadedRun, require_materials
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.snapshot import snapshot
from unmix_plugin.trained.trained_scene import TrainedScene


@dataclass(frozen=True)
class SceneSource:
    """A scene, renewed after each training step in which it is asked for."""

    run: RunFolder
    """Where what the viewer writes goes."""
    record: SceneRecord
    """What the run keeps of its input."""
    device: DeviceShare
    """Turns with training, if there is one."""
    take: Callable[[], RenderableScene]
    """The scene at this moment; called while training waits."""
    control: TrainingControl | None = None
    """The training under way; None for a finished run."""
    _taken: dict[int, RenderableScene] = field(default_factory=dict, repr=False)

    @contextmanager
    def borrowed(self, cost: float = 1.0) -> Iterator[RenderableScene]:
        """Context with the scene and the device to render it.

        Turns do not nest: whoever has the device must not ask for it again.

        Args:
            cost: As `DeviceShare.guest_turn` has it.
        """
        with self.device.guest_turn(cost):
            scene = self._taken.get(self.version)
            if scene is None:
                scene = self.take()
                self._taken.clear()
                self._taken[self.version] = scene
            yield scene

    @contextmanager
    def borrowed_materials(self) -> Iterator[TrainedScene]:
        """The same for a scene that must have endmembers.

        Raises:
            ConfigError: it has none.
        """
        with self.borrowed() as scene:
            yield require_materials(scene, "of this run")

    @property
    def version(self) -> int:
        """Rises with each change of the scene: training steps that it has seen."""
        return self.device.training_turns

    @property
    def is_changing(self) -> bool:
        """Whether the next picture of the same view would be another one."""
        return self.device.is_training


def source_of_run(run: LoadedRun) -> SceneSource:
    """The scene of a finished run."""
    return SceneSource(run.folder, run.record, DeviceShare(), lambda: run.scene)


def source_of_training(trainer: Trainer, record: SceneRecord) -> SceneSource:
    """The scene of a training, before or while it runs.

    Raises:
        ConfigError: its method offers no scene.
    """
    name, model = trainer.config.method_name, trainer.pipeline.model

    def take() -> RenderableScene:
        averages = None if trainer.average is None else trainer.average.state_dict()
        return snapshot(model, name, record, averages)

    source = SceneSource(trainer.run, record, trainer.control.device, take, trainer.control)
    with source.borrowed():
        pass  # refuses a method without a scene before the page is served
    return source
