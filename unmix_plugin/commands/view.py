"""`unmix-view --run PATH`: a trained run in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from unmix_plugin.engine.printing import tell
from unmix_plugin.products.product import RunOptions
from unmix_plugin.viewer.access import ViewerOptions

if TYPE_CHECKING:
    from unmix_plugin.scenes.scene import Scene
    from unmix_plugin.viewer.rendering.scene import SceneSource
    from unmix_plugin.viewer.server import Viewer


@dataclass(frozen=True)
class ViewOptions(RunOptions):
    """Show a trained run in the browser: fly around, choose what to see, probe spectra, change materials and light."""

    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it; without the scene only what was measured is
    missing."""
    edits: Path | None = None
    """Recipe (YAML) of edits of materials and light to start with."""
    illuminant: str | None = None
    """Light to start with: its name, such as D65, A or FL2, or a CSV file (wavelength,power)."""
    library: tuple[Path, ...] = ()
    """Known materials to compare with and to choose from, in place of the built-in ones: .csv, ENVI spectral libraries,
    texts of ECOSTRESS or USGS, or folders of them; +builtin adds the built-in ones."""
    viewer: ViewerOptions = ViewerOptions()
    """How the viewer is served."""


def view(argv: list[str]) -> None:
    """Parse the arguments, serve until Ctrl-C or until the process is asked to end."""
    options = tyro.cli(ViewOptions, prog="unmix-view", args=argv)
    viewer = prepared(options)
    viewer.start()
    tell("stop with Ctrl-C")
    try:
        viewer.wait()
    except KeyboardInterrupt:
        tell("stopped")
    finally:
        viewer.stop()


def prepared(options: ViewOptions) -> Viewer:
    """The viewer of a run, not yet listening."""
    from unmix_plugin.commands.reporting import CommandConsole, chosen_run, working
    from unmix_plugin.editing.apply import assumption_of_light
    from unmix_plugin.editing.edited_run import requested_recipe
    from unmix_plugin.formats.libraries import library_of
    from unmix_plugin.trained.open_run import load_run
    from unmix_plugin.viewer.rendering.scene import source_of_run
    from unmix_plugin.viewer.server import Viewer
    from unmix_plugin.viewer.session import Services

    console = CommandConsole()
    recipe = requested_recipe(options.edits, options.illuminant)
    path = chosen_run(options.run, options.output_dir)
    with working(console, f"reading {path}"):
        loaded = load_run(path, options.device)
        source = source_of_run(loaded)
    note = None if recipe is None else assumption_of_light(loaded.materials_scene, recipe)
    if note is not None:
        tell(note)
    shown = loaded.materials_scene if options.library else None
    known = None if shown is None else library_of(options.library, shown.bands, shown.light_power)
    with working(console, "looking at the scene"):
        scene = partial(_scene_of, source, options.data)
        services = Services(source, scene, recipe, options.viewer.environments, known)
        return Viewer(services, options.viewer, tell)


def _scene_of(source: SceneSource, data: Path | None) -> Scene:
    """The scene that the run was trained on."""
    from unmix_plugin.errors import SceneError
    from unmix_plugin.trained.open_run import find_scene

    summary = source.record.summary
    scene = find_scene(summary, source.run.path, data)
    if scene is None:
        place = summary.get("root")
        raise SceneError(f"it is no longer, or no longer the same, at {place}; name it with --data")
    return scene
