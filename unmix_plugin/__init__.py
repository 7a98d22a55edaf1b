"""From posed spectral images to a 3-D scene that knows what it is made of.

The public names, for scripts and notebooks; docs/guides/python.md shows each. They are imported when first used,
so that `import unmix_plugin` costs nothing.
"""

import os
import sys
import warnings
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from unmix_plugin.commands.training import train as train
    from unmix_plugin.comparing.comparison import Comparison as Comparison
    from unmix_plugin.comparing.comparison import compare_runs as compare_runs
    from unmix_plugin.editing.apply import edit_scene as edit_scene
    from unmix_plugin.editing.recipe import Light as Light
    from unmix_plugin.editing.recipe import Recipe as Recipe
    from unmix_plugin.editing.recipe_files import read_recipe as read_recipe
    from unmix_plugin.engine.geometry.cameras import Cameras as Cameras
    from unmix_plugin.products.save import save as save
    from unmix_plugin.spectral.unmixing.image import unmix_image as unmix_image
    from unmix_plugin.trained.open_run import open_run as open_run
    from unmix_plugin.trained.protocol import Probe as Probe
    from unmix_plugin.trained.trained_scene import MaterialView as MaterialView
    from unmix_plugin.trained.trained_scene import TrainedScene as TrainedScene

# Threads that wait for each other by spinning take the time slices of those they wait for as soon as anything else
# runs on the machine: on two shared cores a training step took three times as long. Read once, when torch loads OpenMP.
if (
    "torch" in sys.modules
    and "OMP_WAIT_POLICY" not in os.environ
    and sys.modules["torch"].get_num_threads() > 1
):
    warnings.warn(
        "torch was imported before unmix_plugin, so its threads spin while they wait: where anything else runs on the "
        "machine, everything takes many times as long. Import unmix_plugin first, or set OMP_WAIT_POLICY=PASSIVE "
        "before Python starts (ACTIVE keeps it as it is, without this warning)",
        RuntimeWarning,
        stacklevel=2,
    )
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"

_MODULES = {
    "Cameras": "engine.geometry.cameras",
    "Comparison": "comparing.comparison",
    "Light": "editing.recipe",
    "MaterialView": "trained.trained_scene",
    "Probe": "trained.protocol",
    "Recipe": "editing.recipe",
    "TrainedScene": "trained.trained_scene",
    "compare_runs": "comparing.comparison",
    "edit_scene": "editing.apply",
    "open_run": "trained.open_run",
    "read_recipe": "editing.recipe_files",
    "save": "products.save",
    "train": "commands.training",
    "unmix_image": "spectral.unmixing.image",
}
__all__ = list(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
