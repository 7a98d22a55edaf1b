"""What a product of `unmix-export` is, and what it is given to do its work."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from unmix_plugin.engine.configs import DeviceName

if TYPE_CHECKING:
    from unmix_plugin.engine.processes import Processes
    from unmix_plugin.scenes.scene import Normalisation, Scene
    from unmix_plugin.spectral.materials import Materials
    from unmix_plugin.trained.evaluation import PredictedView
    from unmix_plugin.trained.open_run import LoadedRun
    from unmix_plugin.trained.run_views import RunView, ViewChoice
    from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene


@dataclass(frozen=True)
class RunOptions:
    """Which run a command is about, and where it computes."""

    run: Path | None = None
    """Run folder, as training printed it; None takes the newest under --output-dir."""
    output_dir: Path | None = None
    """Folder in which to look for the newest run; None: outputs/, where training writes."""
    device: DeviceName = "auto"
    """Where to compute; auto takes CUDA where there is one."""


@dataclass(frozen=True)
class WriteOptions:
    """Where files go."""

    output: Path | None = None
    """Folder to write to; None: exports/ and the product's name, in the run folder."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace earlier files."""


@dataclass(frozen=True)
class EditOptions:
    """How a scene of mixed materials is shown."""

    edits: Path | None = None
    """Recipe (YAML) of edits of materials and light to apply first."""
    illuminant: str | None = None
    """Light to show the scene under: D65, A, E, FL2, ... or a .csv file; None: the one it was taken under."""
    sensor: Path | None = None
    """CSV file (wavelength,NAME,...) of the spectral responses of another camera, to see the result with."""


@dataclass(frozen=True)
class SharedViews:
    """How many work on views."""

    num_devices: int = 1
    """Processes that share the views, on CUDA each on a device of its own."""


@dataclass(frozen=True)
class RunWork(RunOptions, ABC):
    """What is done with a run of any method: a product, or what is kept in its folder."""

    name: ClassVar[str]
    """Of the product, and of its folder."""

    @abstractmethod
    def write(self, job: Job) -> list[Path]:
        """Write the product, and return its files; an UnmixError is something that a user can fix."""


@dataclass(frozen=True)
class RunProduct(WriteOptions, RunWork):
    """Options that every product of any method has."""


@dataclass(frozen=True)
class Product(EditOptions, RunProduct):
    """A product of a scene of mixed materials, which can be edited before; named for its class if it has no name."""

    def __init_subclass__(cls) -> None:
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<=[a-z])(?=[A-Z])", "-", cls.__name__).lower()

    def write(self, job: Job) -> list[Path]:
        """Write the product by `export` of the module of its name, which is imported for it alone."""
        module = import_module(f"unmix_plugin.products.{self.name.replace('-', '_')}")
        return module.export(job, self)


@dataclass(frozen=True)
class ViewProduct(SharedViews, Product):
    """A product of which every view has files of its own."""

    views: Literal["eval", "train", "all"] = "eval"
    """Which of the scene's views to render."""

    def write(self, job: Job) -> list[Path]:
        """Write the product by the function of its name."""
        return getattr(import_module("unmix_plugin.products.views"), self.name)(job, self)


@dataclass(frozen=True)
class Job:
    """A loaded run, a folder to write to, and ways to show how far the work is."""

    loaded: LoadedRun
    folder: Path
    """Absolute."""
    overwrite: bool
    say: Callable[[str], None]
    """Show a line."""
    working: Callable[[str], AbstractContextManager[None]]
    """Context that shows that something of unknown length is under way."""
    follow: Callable[[str, Sequence[Any]], Iterator[Any]]
    """The items given, while it is shown how many are done."""
    processes: Processes
    """That share the views."""

    @property
    def scene(self) -> TrainedScene:
        """The trained scene; a ConfigError if its method does not unmix spectra."""
        return self.loaded.materials_scene

    @property
    def materials(self) -> Materials:
        """Its endmembers and the light that they are seen in; an error as `scene` has it."""
        return self.scene.materials

    @property
    def frame(self) -> Normalisation:
        """From the scene's world to model space."""
        return self.loaded.scene.frame

    def claim(self, paths: Collection[Path]) -> None:
        """Refuse to overwrite files, before anything is computed, unless that was asked for."""
        from unmix_plugin.formats.files import refuse_to_overwrite

        refuse_to_overwrite(paths, self.overwrite)

    def views(self, choice: ViewChoice) -> list[RunView]:
        """Views of the run."""
        from unmix_plugin.trained.run_views import views_of

        return views_of(self.loaded.scene.views, choice)

    def measured_scene(self, data: Path | None) -> Scene | None:
        """The scene that the run was trained on, where it was or at `data`; None, which is said, if it is not there."""
        from unmix_plugin.trained.open_run import find_scene

        with self.working("looking for the scene"):
            scene = find_scene(self.loaded.record.summary, self.loaded.folder.path, data)
        if scene is None:
            place = self.loaded.record.summary.get("root")
            self.say(
                f"no scene, or no longer the same, at {place}: nothing measured is shown; name it with --data"
            )
        return scene

    def render(self, view: RunView) -> PredictedView:
        """A view of the run."""
        from unmix_plugin.trained.evaluation import render_view

        return render_view(self.scene, view.camera)

    def write_views(
        self,
        choice: ViewChoice,
        paths: Callable[[str], list[Path]],
        write: Callable[[str, MaterialView], None],
    ) -> list[Path]:
        """Render views, one after the other, each at its own size, and write each to the paths of its name; several
        processes share them."""
        views, processes = self.views(choice), self.processes
        files = [path for view in views for path in paths(view.name)]
        with processes.together():
            self.claim(files)
        with processes.together():
            for view in self.follow("rendering views", views[processes.rank :: processes.count]):
                write(view.name, self.scene.look(view.camera))
        return files
