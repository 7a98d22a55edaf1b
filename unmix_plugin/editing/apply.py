"""Recipes applied to a trained scene: another scene that shares its weights.

Notation: `B` bands, `K` endmembers, `J` specular spectra, `G` mirrors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.editing.edited_field import EditedField
from unmix_plugin.editing.handlers import carry_out
from unmix_plugin.editing.light import relighting_factors
from unmix_plugin.editing.material_state import MaterialState
from unmix_plugin.editing.operations import Gloss, Replace, Retint
from unmix_plugin.editing.recipe import Light, Recipe
from unmix_plugin.editing.seen import sample_seen
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.trained.trained_scene import TrainedScene


def edit_scene(scene: TrainedScene, recipe: Recipe, seen: Coefficients | None = None) -> TrainedScene:
    """The edited scene. Edits are made in order, in the light that the scene was recorded in; then the recipe's light
    is lit. Endmembers keep their numbers.

    Args:
        scene: Stays as it is.
        recipe: What to change.
        seen: What cameras see of `scene`, in any leading axes: retints that match the picture look at it. None: what
            `sample_seen` finds, where it is needed.
    Raises:
        ConfigError: the recipe does not fit the scene or contradicts itself; the message says where.
    """
    light = scene.light_power
    if seen is None and recipe.wants_pictures:
        seen = sample_seen(scene)
    state = MaterialState.of(scene.materials, light, seen)
    carry_out(recipe, state)
    factors, told = _light_factors(scene, recipe)
    specular_spectra, gloss = _specular(state)
    materials = replace(
        scene.materials,
        names=tuple(state.names),
        endmembers=_tensor(state.spectra * factors, scene),
        specular_spectra=_tensor(specular_spectra * factors, scene),
    )
    if recipe.illuminant is not None:
        lit = factors if light is None else light * factors
        materials = replace(materials, light=_tensor(lit, scene))
    field = scene.field
    if gloss is not None or not state.is_kept.all():
        shine = np.ones((1, len(state.gloss))) if gloss is None else gloss
        edited = EditedField.over(field, torch.from_numpy(state.is_kept), torch.from_numpy(shine).float())
        field = edited.to(scene.device)
    assumed = assumption_of_light(scene, recipe)
    notes = [*scene.notes, *([] if assumed is None else [assumed]), *state.notes, *told]
    return replace(scene, field=field, materials=materials, notes=tuple(notes))


def relight(scene: TrainedScene, light: Light) -> TrainedScene:
    """The scene in another light.

    Raises:
        ConfigError: the light is unknown, or does not cover the bands.
    """
    return edit_scene(scene, Recipe(illuminant=light))


def changes_geometry(recipe: Recipe) -> bool:
    """Whether the edited scene has to be rendered again; otherwise coefficients of the unedited one serve with its
    materials."""
    return recipe.removes_parts or any(
        isinstance(one, Gloss) and one.endmember is not None for one in recipe.operations
    )


def assumption_of_light(scene: TrainedScene, recipe: Recipe) -> str | None:
    """What a user has to be told of the light that edits start from; None if nothing."""
    depends = any(isinstance(one, Replace | Retint) for one in recipe.operations)
    if scene.light is not None or not (depends or recipe.illuminant):
        return None
    return "the scene does not say what light it was recorded in: taken as flat (CIE illuminant E)"


def light_factors(scene: TrainedScene, recipe: Recipe) -> Float64[np.ndarray, " B"]:
    """What radiance measured in the scene's light is multiplied with, to be as in the recipe's.

    Raises:
        ConfigError: the light is unknown, or covers no band.
    """
    return _light_factors(scene, recipe)[0]


def _light_factors(scene: TrainedScene, recipe: Recipe) -> tuple[Float64[np.ndarray, " B"], list[str]]:
    if recipe.illuminant is None:
        return np.ones(len(scene.bands)), []
    try:
        return relighting_factors(scene.bands, scene.light_power, recipe.illuminant)
    except SpectrumError as error:
        raise ConfigError(f"{recipe.source}: {error}") from error


def _specular(
    state: MaterialState,
) -> tuple[Float64[np.ndarray, "GJ B"], Float64[np.ndarray, "G K"] | None]:
    """Specular spectra mirrored in each colour, one after the other, and the gloss of each endmember in each of them;
    None where all materials have the same gloss, which the spectra describe fully."""
    colours = list(dict.fromkeys(state.mirrors))
    gloss = np.array(
        [
            [
                strength if mirror == colour else 0.0
                for strength, mirror in zip(state.gloss, state.mirrors, strict=True)
            ]
            for colour in colours
        ]
    )
    mirrored = [state.mirror_reflectances[colour] * state.specular_spectra for colour in colours]
    if len(colours) == 1 and np.ptp(gloss) == 0:
        return mirrored[0] * gloss[0, 0], None
    return np.concatenate(mirrored), gloss


def _tensor(values: Float64[np.ndarray, "*axes B"], scene: TrainedScene) -> Float[Tensor, "*axes B"]:
    return torch.tensor(values, dtype=torch.float32, device=scene.device)
