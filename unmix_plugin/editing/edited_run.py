"""A run with edits applied: what commands load for `--edits`, `--illuminant` and `--sensor`.

A light given on the command line overrides the recipe's; the sensor looks at what edits and light have made.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from unmix_plugin.editing.apply import edit_scene, with_sensor
from unmix_plugin.editing.recipe import Light, Recipe
from unmix_plugin.editing.recipe_files import read_recipe
from unmix_plugin.spectral.colour.conversion import parse_light
from unmix_plugin.spectral.sensor import read_sensor
from unmix_plugin.trained.open_run import LoadedRun, load_run


def load_edited_run(
    path: Path,
    device: str = "auto",
    edits: Path | None = None,
    illuminant: str | None = None,
    sensor: Path | None = None,
) -> LoadedRun:
    """A run whose scene is edited; `scene.notes` has what a user has to be told of that.

    Args:
        path: Run folder.
        device: Where to compute.
        edits: Recipe to apply.
        illuminant: Name of a light, or a CSV file (wavelength,power), to see the scene in.
        sensor: CSV file (wavelength,NAME,...) of the spectral responses of another camera, to see the result with.
    Raises:
        RunError: the run is missing, half-written, damaged, or from a newer version.
        ConfigError: the recipe is wrong or does not fit the run, the method does not unmix spectra, or the device is
            not there.
        SpectrumError: there is no such light, or the sensor is malformed or sees nothing in the run's bands.
    """
    recipe = requested_recipe(edits, illuminant)
    camera = None if sensor is None else read_sensor(sensor)
    run = load_run(path, device)
    if recipe is not None:
        run = replace(run, scene=edit_scene(run.materials_scene, recipe))
    if camera is not None:
        run = replace(run, scene=with_sensor(run.materials_scene, camera))
    return run


def requested_recipe(edits: Path | None, illuminant: str | None) -> Recipe | None:
    """What `--edits` and `--illuminant` ask for together; None for nothing.

    Raises:
        ConfigError: the recipe is wrong.
        SpectrumError: there is no such light.
    """
    recipe = None if edits is None else read_recipe(edits)
    if illuminant is None:
        return recipe
    light = Light(parse_light(illuminant))
    if recipe is None:
        return Recipe(illuminant=light, source="--illuminant")
    return replace(recipe, illuminant=light)
