"""Recipes applied to a model: a light copy of it that renders the edited scene, for every export and the viewer alike.

Notation: `B` bands, `K` endmembers, `J` specular spectra, `G` mirrors.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import nn

from unmix_plugin.editing.edited_field import EditedField
from unmix_plugin.editing.handlers import carry_out
from unmix_plugin.editing.light import relighting_factors
from unmix_plugin.editing.material_state import MaterialState
from unmix_plugin.editing.operations import Gloss, Replace, Retint
from unmix_plugin.editing.recipe import Light, Recipe
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.model import UnmixModel
from unmix_plugin.spectral.composition import Coefficients


def edit_model(model: UnmixModel, recipe: Recipe, seen: Coefficients | None = None) -> UnmixModel:
    """The model of an edited scene: renders like any other, shares its weights with `model`, which stays as it is.

    Edits are made in order, in the light that the scene was recorded in; then the recipe's light is lit. Endmembers
    keep their numbers. The result is for rendering, not for training; its metadata have the new light.

    Args:
        model: Of the scene as it is.
        recipe: What to change.
        seen: What cameras see of `model`, in any leading axes, as `seen.sample_seen` has it for a run or as a view on
            display: retints that match the picture look at it. Without it they match the spectrum.
    Raises:
        ConfigError: the recipe does not fit the model or contradicts itself; the message says where.
    """
    light = _recorded_light(model.metadata)
    state = MaterialState.of(model.materials, light, seen)
    carry_out(recipe, state)
    factors = _light_factors(state, light, recipe)
    edited = _light_copy(model)
    edited.endmember_names = tuple(state.names)
    edited.endmembers = _spectra(state.spectra * factors, model)
    specular_spectra, gloss = _specular(state)
    if model.config.specular == "full":
        edited.every_band = _spectra(specular_spectra * factors, model).detach()
    else:
        edited.specular_spectra = _spectra(specular_spectra * factors, model)
    if gloss is not None or not state.is_kept.all():
        shine = np.ones((1, len(state.gloss))) if gloss is None else gloss
        edited_field = EditedField.over(
            model.field, torch.from_numpy(state.is_kept), torch.from_numpy(shine).float()
        )
        edited.add_module("field", edited_field.to(model.device))
    edited.metadata = {**model.metadata, "edit_notes": [*state.notes]}
    if recipe.illuminant is not None:
        lit = factors if light is None else light * factors
        edited.metadata["illuminant"] = lit.tolist()
    return edited


def relight(model: UnmixModel, light: Light) -> UnmixModel:
    """The model of the scene in another light, as `edit_model` makes it.

    Raises:
        ConfigError: the light is unknown, or does not cover the bands.
    """
    return edit_model(model, Recipe(illuminant=light))


def changes_geometry(recipe: Recipe) -> bool:
    """Whether the edited model has to render anew; else coefficients of the unedited one serve with its materials."""
    return recipe.removes_matter or any(
        isinstance(one, Gloss) and one.endmember is not None for one in recipe.operations
    )


def assumption_of_light(metadata: Mapping[str, Any], recipe: Recipe) -> str | None:
    """What a user has to be told of the light that edits start from; None if nothing."""
    depends = any(isinstance(one, Replace | Retint) for one in recipe.operations)
    if _recorded_light(metadata) is not None or not (depends or recipe.illuminant):
        return None
    return "the scene does not say what light it was recorded in: taken as flat (CIE illuminant E)"


def _recorded_light(metadata: Mapping[str, Any]) -> Float64[np.ndarray, " B"] | None:
    light = metadata["illuminant"]
    return None if light is None else np.array(light, dtype=np.float64)


def _light_factors(
    state: MaterialState, light: Float64[np.ndarray, " B"] | None, recipe: Recipe
) -> Float64[np.ndarray, " B"]:
    if recipe.illuminant is None:
        return np.ones(len(state.bands))
    try:
        factors, notes = relighting_factors(state.bands, light, recipe.illuminant)
        state.notes += notes
        return factors
    except SpectrumError as error:
        raise ConfigError(f"{recipe.source}: {error}") from error


def _specular(
    state: MaterialState,
) -> tuple[Float64[np.ndarray, "GJ B"], Float64[np.ndarray, "G K"] | None]:
    """Specular spectra mirrored in each colour, one after the other, and the gloss of each endmember in each of them;
    None where all materials shine alike, so that the spectra say all."""
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


def _light_copy(model: UnmixModel) -> UnmixModel:
    """A copy whose spectra are its own, and whose heavy parts are the model's."""
    shared = (model.field, model.renderer, model.scene_box, model.config, model.metadata)
    return copy.deepcopy(model, {id(part): part for part in shared})


def _spectra(values: Float64[np.ndarray, "N B"], model: UnmixModel) -> nn.Parameter:
    tensor = torch.tensor(values, dtype=torch.float32, device=model.device)
    return nn.Parameter(tensor, requires_grad=False)
