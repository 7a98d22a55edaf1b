"""What a product of `unmix-export` is, and what it is given to do its work."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from unmix_plugin.engine.configs import DeviceName
from unmix_plugin.formats.files import refuse_to_overwrite

if TYPE_CHECKING:
    from unmix_plugin.engine.processes import Processes
    from unmix_plugin.scenes.scene import Normalisation
    from unmix_plugin.spectral.materials import Materials
    from unmix_plugin.trained.evaluation import PredictedView
    from unmix_plugin.trained.open_run import LoadedRun
    from unmix_plugin.trained.run_views import RunView, ViewChoice
    from unmix_plugin.trained.surface import SeenSurface
    from unmix_plugin.trained.trained_scene import TrainedScene


@dataclass(frozen=True)
class RunWork(ABC):
    """What is done with a run of any method: a product, or what is kept in its folder."""

    name: ClassVar[str]
    """Of the product, and of its folder."""

    run: Path | None = None
    """Run folder, as training printed it; None takes the newest under --output-dir."""
    output_dir: Path = Path("outputs")
    """Folder in which to look for the newest run."""
    device: DeviceName = "auto"
    """Where to compute; auto takes CUDA where there is one."""

    @abstractmethod
    def write(self, job: Job) -> list[Path]:
        """Write the product.

        Returns:
            Its files.
        Raises:
            UnmixError: something that a user can fix.
        """


@dataclass(frozen=True)
class RunProduct(RunWork):
    """Options that every product of any method has."""

    output: Path | None = None
    """Folder to write to; None: exports/ and the product's name, in the run folder."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace files of an earlier export."""


@dataclass(frozen=True)
class Product(RunProduct):
    """A product of a scene of mixed materials, which can be edited before."""

    edits: Path | None = None
    """Recipe (YAML) of edits of materials and light to apply first."""
    illuminant: str | None = None
    """Light to show the scene under: D65, A, E, FL2, ... or a .csv file; None: the one it was taken under."""
    sensor: Path | None = None
    """CSV file (wavelength,NAME,...) of the spectral responses of another camera, to see the result with."""

    def write(self, job: Job) -> list[Path]:
        """Write the product by `export` of the module of its name, which is imported for it alone."""
        module = import_module(f"unmix_plugin.products.{self.name.replace('-', '_')}")
        return module.export(job, self)


@dataclass(frozen=True)
class ViewProduct(Product):
    """A product of which every view has files of its own."""

    views: Literal["eval", "train", "all"] = "eval"
    """Which of the scene's views to render."""
    num_devices: int = 1
    """Processes that share the views, on CUDA each on a device of its own."""


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
        """The trained scene.

        Raises:
            ConfigError: its method does not unmix spectra.
        """
        return self.loaded.materials_scene

    @property
    def materials(self) -> Materials:
        """Its endmembers and the light that they are seen in.

        Raises:
            ConfigError: its method does not unmix spectra.
        """
        return self.scene.materials

    @property
    def frame(self) -> Normalisation:
        """From the scene's world to model space."""
        return self.loaded.scene.frame

    def claim(self, paths: Collection[Path]) -> None:
        """Refuse to overwrite files, before anything is computed.

        Raises:
            ConfigError: one of them exists, and overwriting was not asked for.
        """
        refuse_to_overwrite(paths, self.overwrite)

    def views(self, choice: ViewChoice) -> list[RunView]:
        """Views of the run."""
        from unmix_plugin.trained.run_views import views_of

        return views_of(self.loaded.scene.views, choice)

    def render(self, view: RunView) -> PredictedView:
        """A view of the run."""
        from unmix_plugin.trained.evaluation import render_view

        return render_view(self.scene, view.camera)

    def write_views(
        self,
        choice: ViewChoice,
        paths: Callable[[Path, str], list[Path]],
        write: Callable[[Path, str, PredictedView, Materials], None],
    ) -> list[Path]:
        """Render views, one after the other, each at its own size, and write each; several processes share them.

        Args:
            choice: Of the run's views.
            paths: Files of a view, from the folder and its name.
            write: Writes them.
        """
        views, processes = self.views(choice), self.processes
        files = [path for view in views for path in paths(self.folder, view.name)]
        with processes.together():
            self.claim(files)
        with processes.together():
            for view in self.follow("rendering views", views[processes.rank :: processes.count]):
                write(self.folder, view.name, self.render(view), self.materials)
        return files

    def surface(self, num_rays: int) -> SeenSurface:
        """What all cameras of the run see, with about so many rays."""
        from unmix_plugin.trained.surface import SeenSurface

        cameras = [view.camera for view in self.views("all")]
        surface = SeenSurface(self.scene, num_rays, cameras)
        for camera in self.follow("looking at the surface", cameras):
            surface.look(camera)
        return surface
