"""`unmix-export abundances|endmembers|segmentation --run PATH`: files for others, from the run folder alone."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, TypeAlias

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.engine.configs import DeviceName
from unmix_plugin.exports.run_views import ViewChoice

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.load_run import LoadedModel
    from unmix_plugin.exports.view_rendering import RenderedView
    from unmix_plugin.spectral.composition import Materials

    ViewWriter: TypeAlias = Callable[[Path, str, RenderedView, Materials], list[Path]]


@dataclass(frozen=True)
class ExportOptions:
    """What every export is told."""

    product: ClassVar[str]
    """Name of what is exported, and of its folder."""

    run: Path | None = None
    """Run folder, as training printed it; None takes the newest under --output-dir."""
    output: Path | None = None
    """Folder to write to; None: exports/ and the product's name, in the run folder."""
    output_dir: Path = Path("outputs")
    """Folder in which to look for the newest run."""
    device: DeviceName = "auto"
    """Where to compute; auto takes CUDA where there is one."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace files of an earlier export."""


@dataclass(frozen=True)
class AbundancesOptions(ExportOptions):
    """Abundance of each endmember: VIEW.npy, (H, W, K) float32, 0 where nothing is, and VIEW.png, a figure."""

    product = "abundances"

    views: ViewChoice = "eval"
    """Which of the scene's views to render."""


@dataclass(frozen=True)
class EndmembersOptions(ExportOptions):
    """Spectra of the endmembers: endmembers.csv and a plot over wavelength, endmembers.png."""

    product = "endmembers"


@dataclass(frozen=True)
class SegmentationOptions(ExportOptions):
    """Material of each pixel: labels/VIEW.png with ids (255: nothing), VIEW.npy with scores (H, W, K) float32, and
    VIEW.png, a figure with a legend."""

    product = "segmentation"

    views: ViewChoice = "eval"
    """Which of the scene's views to render."""


_PRODUCTS = (AbundancesOptions(), EndmembersOptions(), SegmentationOptions())


def export(words: list[str]) -> None:
    """Parse the words, write the product, say what is where.

    Raises:
        RunError: the run is unusable, or the folder can't be written.
        ConfigError: files would be overwritten, the method does not unmix spectra, or the device is not there.
    """
    products = tyro.extras.subcommand_type_from_defaults(
        {options.product: options for options in _PRODUCTS},
        {options.product: inspect.getdoc(options) or "" for options in _PRODUCTS},
    )
    options: ExportOptions = tyro.cli(
        products, prog="unmix-export", description="Write products of a run as files.", args=words
    )

    from rich.console import Console

    from unmix_plugin.commands.reporting import working
    from unmix_plugin.commands.run_choice import chosen_run
    from unmix_plugin.engine.load_run import load_model

    console = Console()
    path = chosen_run(options.run, options.output_dir)
    with working(console, f"reading {path}"):
        loaded = load_model(path, options.device)
    written = _WRITERS[type(options)](options, loaded, console)
    for file in written:
        print(file)
    print(f"{len(written)} files written to {_folder(options, loaded)}")


def _write_abundances(options: ExportOptions, loaded: LoadedModel, console: Console) -> list[Path]:
    from unmix_plugin.exports.abundances import abundance_paths, write_abundances

    return _write_views(options, loaded, console, abundance_paths, write_abundances)


def _write_segmentation(options: ExportOptions, loaded: LoadedModel, console: Console) -> list[Path]:
    from unmix_plugin.exports.segmentation import segmentation_paths, write_segmentation

    return _write_views(options, loaded, console, segmentation_paths, write_segmentation)


def _write_endmembers(options: ExportOptions, loaded: LoadedModel, _console: Console) -> list[Path]:
    from unmix_plugin.exports.endmembers import endmember_paths, write_endmembers
    from unmix_plugin.exports.files import refuse_to_overwrite
    from unmix_plugin.exports.run_materials import materials_of

    materials, folder = materials_of(loaded.model), _folder(options, loaded)
    refuse_to_overwrite(endmember_paths(folder), options.overwrite)
    return write_endmembers(folder, materials)


def _write_views(
    options: ExportOptions,
    loaded: LoadedModel,
    console: Console,
    paths_of: Callable[[Path, str], list[Path]],
    write: ViewWriter,
) -> list[Path]:
    """Render the views asked for, one after the other, and write each."""
    from unmix_plugin.commands.reporting import follow
    from unmix_plugin.exports.files import refuse_to_overwrite
    from unmix_plugin.exports.run_materials import materials_of
    from unmix_plugin.exports.run_views import views_of
    from unmix_plugin.exports.view_rendering import render_view

    assert isinstance(options, AbundancesOptions | SegmentationOptions)
    materials, folder = materials_of(loaded.model), _folder(options, loaded)
    views = views_of(loaded.scene, options.views)
    refuse_to_overwrite([path for view in views for path in paths_of(folder, view.name)], options.overwrite)
    written: list[Path] = []
    for view in follow(console, "rendering views", views):
        written += write(folder, view.name, render_view(loaded.model, view.camera), materials)
    return written


_WRITERS: dict[type[ExportOptions], Callable[[ExportOptions, LoadedModel, Console], list[Path]]] = {
    AbundancesOptions: _write_abundances,
    EndmembersOptions: _write_endmembers,
    SegmentationOptions: _write_segmentation,
}


def _folder(options: ExportOptions, loaded: LoadedModel) -> Path:
    """Where the product goes: absolute."""
    return (options.output or loaded.run.exports / options.product).resolve()


def main() -> None:
    """Console script."""
    run_command(export)
