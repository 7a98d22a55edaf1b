"""A run with edits applied: what commands load for `--edits`, `--illuminant` and `--sensor`.

Without any of them it is the run as it is. A light given on the command line goes before that of the recipe; the sensor
looks at what edits and light have made.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.editing.apply import assumption_of_light, edit_model
from unmix_plugin.editing.recipe import Light, Recipe
from unmix_plugin.editing.seen import sample_seen
from unmix_plugin.editing.simulated_sensor import with_sensor
from unmix_plugin.editing.yaml_reading import read_recipe
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.model import Model
from unmix_plugin.engine.runs.load_run import LoadedModel, load_model, read_scene_record
from unmix_plugin.errors import ConfigError
from unmix_plugin.model import UnmixModel
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.illuminants import parse_light
from unmix_plugin.spectral.sensor import read_sensor


@dataclass(frozen=True)
class EditedModel:
    """A model with edits applied."""

    model: UnmixModel
    light_factors: Float64[np.ndarray, " B"]
    """What radiance measured in the scene's light is multiplied with, to compare it with what this model renders."""
    notes: list[str]
    """What a user has to be told about the result."""


def load_edited_model(
    path: Path,
    device: str = "auto",
    edits: Path | None = None,
    illuminant: str | None = None,
    sensor: Path | None = None,
) -> LoadedModel:
    """A run's newest model as `engine.load_run.load_model` gives it, edited; its scene record has the new light and the
    sensor's wavelengths.

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
    loaded = load_model(path, device)
    edited = loaded.model
    if recipe is not None:
        edited = apply_recipe(edited, recipe, loaded.scene.train_cameras).model
    if camera is not None:
        if not isinstance(edited, UnmixModel):
            raise ConfigError(f"{type(edited).__name__} has no spectra; leave out --sensor")
        edited = with_sensor(edited, camera)[0]
    if edited is loaded.model:
        return loaded
    new = {key: edited.metadata[key] for key in ("wavelengths_nm", "illuminant")}
    scene = replace(loaded.scene, metadata={**loaded.scene.metadata, **new})
    return replace(loaded, model=edited, scene=scene)


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
    return (
        Recipe(illuminant=light, source="--illuminant")
        if recipe is None
        else replace(recipe, illuminant=light)
    )


def apply_recipe(model: Model, recipe: Recipe, cameras: Cameras) -> EditedModel:
    """A model as a recipe has it.

    Args:
        model: Of the scene as it is.
        recipe: What to change.
        cameras: What some of see decides how retinted materials look in pictures.
    Raises:
        ConfigError: the recipe does not fit the model, or the method does not unmix spectra.
    """
    if not isinstance(model, UnmixModel):
        raise ConfigError(
            f"{type(model).__name__} has no materials to edit; leave out --edits and --illuminant"
        )
    seen = sample_seen(model, cameras) if recipe.wants_pictures else None
    edited = edit_model(model, recipe, seen)
    factors = np.ones(len(model.bands))
    if recipe.illuminant is not None:
        recorded = model.metadata["illuminant"]
        before = np.ones(len(factors)) if recorded is None else np.array(recorded)
        factors = np.array(edited.metadata["illuminant"])
        factors = np.divide(factors, before, out=np.zeros(len(before)), where=before > 0)
    note = assumption_of_light(model.metadata, recipe)
    return EditedModel(edited, factors, [*([] if note is None else [note]), *edited.metadata["edit_notes"]])


def light_note(loaded: LoadedModel, edits: Path | None, illuminant: str | None) -> str | None:
    """What a command should say of the light that an edited run starts from; None where it is recorded.

    Args:
        loaded: The run, edited or not: whether its light was recorded is in its summary.
        edits, illuminant: As `load_edited_model` takes them.
    """
    recipe = requested_recipe(edits, illuminant)
    if recipe is None:
        return None
    return assumption_of_light({"illuminant": loaded.scene.summary.get("illuminant")}, recipe)


def edit_notes(
    loaded: LoadedModel, edits: Path | None, illuminant: str | None, sensor: Path | None
) -> list[str]:
    """All that a command should say of a run that was loaded with these."""
    note = light_note(loaded, edits, illuminant)
    found = loaded.model.metadata.get("edit_notes", []) if isinstance(loaded.model, UnmixModel) else []
    return [*([] if note is None else [note]), *found, *sensor_notes(loaded, sensor)]


def sensor_notes(loaded: LoadedModel, sensor: Path | None) -> list[str]:
    """What a command should say of the sensor that a run is seen through; nothing without one.

    Args:
        loaded: The run, seen through it or not: its bands are in its folder.
        sensor: As `load_edited_model` takes it.
    """
    if sensor is None:
        return []
    bands = Bands.of(read_scene_record(loaded.run).metadata["wavelengths_nm"])
    seen = read_sensor(sensor).seen_by(bands)
    return [seen.description, *seen.notes]
