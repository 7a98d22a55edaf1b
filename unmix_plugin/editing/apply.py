"""Recipes applied to a trained scene: another scene that shares its weights.

*Materials.* Each kind of edit is one function of the state of the materials.

*Light.* A spectrum in a new light is the one seen, divided by the light that the scene was recorded in, times the new
one. That is right if the recorded light has one spectrum everywhere; shadows, shading and gloss stay as they are. Bands
that either light does not reach become 0: nothing is known of them. The power of the new light is chosen so that a
perfect white is as bright as before: as luminous if the bands see colours (CIE Y), otherwise of the same mean radiance.
So single bands may exceed 1, the full scale of the sensor.

*Colour.* Retinting makes the smoothest change of a spectrum that gives it a wanted colour, or the nearest colour that a
surface can have. With `r` a reflectance, `L` the light and M (B, 3) the matrix from radiance to linear RGB, the changed
reflectance is r + (r + f) d with a floor f, so that d is a relative change that still reaches where r is 0. Of all d
with M^T L (r + (r + f) d) = colour and bounds on the result, the one is taken whose

    integral of d'^2 + (d / reach)^2 over wavelength

is least: it changes with wavelength as little as the colour allows, and fades far from where colour is seen. The
equation is solved in least squares, with a large weight: exactly if the bounds allow it, otherwise as nearly as they
do. Channels count by the slope of the sRGB curve at the wanted colour, so that "near" is near on a display.

*Sensor.* A rendered spectrum is linear in endmembers and specular spectra, and so is what another camera makes of it:
both are seen through its sensor once. Radiance and light become the channels' means of them, neither of them rescaled,
so that their ratio stays reflectance.

Notation: `B` bands, `S` channels of a sensor, `K` endmembers, `J` specular spectra, `G` mirrors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from unmix_plugin.editing.edited_field import (
    Appearance,
    EditedField,
    MaterialState,
    appearance_of,
    sample_seen,
)
from unmix_plugin.editing.recipe import (
    Colour,
    Gloss,
    Isolate,
    Light,
    Operation,
    Recipe,
    Remove,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
)
from unmix_plugin.errors import ConfigError, SpectrumError, UnmixError
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.formats.libraries import read_library
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import brightness, covered_bands, illuminant_power, rgb_matrix
from unmix_plugin.spectral.library.material_library import (
    DARK_LIGHT,
    MaterialLibrary,
    measured_library,
)
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.spectral.sensor import SpectralResponses
from unmix_plugin.trained.trained_scene import TrainedScene


def relighting_factors(
    bands: Bands, recorded: Float64[np.ndarray, " B"] | None, light: Light
) -> tuple[Float64[np.ndarray, " B"], list[str]]:
    """What radiance is multiplied with, band by band, to be seen in another light; and what a user has to be told.

    Args:
        bands: Of the scene.
        recorded: Light that the scene was recorded in, relative power; None if unknown: taken as flat, CIE E.
        light: The new one.
    Raises:
        SpectrumError: the new light is unknown or invisible in all bands that the recorded one reaches.
    """
    before = np.ones(len(bands)) if recorded is None else recorded
    is_lit = before > DARK_LIGHT * before.max()
    is_covered = covered_bands(light.light, bands) | light.extrapolate
    notes = []
    if not is_lit.all():
        notes.append(
            f"the scene's own light does not reach {_listed(bands, ~is_lit)}: black in any other light"
        )
    if not is_covered.all():
        dark = _listed(bands, ~is_covered)
        notes.append(f"light {light.light} is not known at {dark}: black there; in a recipe, {_hold(light)}")
    is_known = is_lit & is_covered
    if not is_known.any():
        raise SpectrumError(f"light {light.light} is not known in {bands}; in a recipe, {_hold(light)}")
    after = np.where(is_known, illuminant_power(light.light, bands, "hold"), 0.0)
    new_brightness = brightness(after, bands)
    if not new_brightness > 0:
        raise SpectrumError(f"light {light.light} is invisible in {bands}; choose one with visible power")
    scale = brightness(np.where(is_known, before, 0.0), bands) / new_brightness
    return np.divide(after * scale, before, out=np.zeros(len(bands)), where=is_known), notes


def _listed(bands: Bands, chosen: Bool[np.ndarray, " B"]) -> str:
    found = bands.centers_nm[chosen]
    return f"{len(found)} of {bands} ({found[0]:g} to {found[-1]:g} nm)"


def _hold(light: Light) -> str:
    return f"illuminant: {{light: {light.light}, extrapolate: true}} holds its outermost values"


_FLOOR = 0.05
"""f: reflectance below which a change counts as absolute rather than relative."""

_REACH_NM = 300.0
"""Distance over which the change fades outside the wavelengths that make the colour."""

_EXACTNESS = 1e5
"""Weight of the colour against smoothness; the error of the colour falls with its square."""


def retinted(
    bands: Bands,
    reflectance: Float64[np.ndarray, " B"],
    to_rgb: Float64[np.ndarray, "B 3"],
    linear_rgb: Float64[np.ndarray, "3"],
    greatest: float = 1.0,
) -> Float64[np.ndarray, " B"]:
    """The reflectance most like a surface's own that has the wanted colour in its light, or comes nearest to it.

    Args:
        bands: Of the reflectance.
        reflectance: The surface's own.
        to_rgb: Matrix from reflectance to linear RGB of the light that the surface sends.
        linear_rgb: Wanted.
        greatest: Bound of the reflectance.
    """
    from scipy.optimize import lsq_linear

    base = reflectance + _FLOOR
    # The sRGB curve is 12.92 steep in the dark and 0.44 at white.
    bright = 1.055 / 2.4 * np.clip(linear_rgb, 0.0031308, 1.0) ** (1 / 2.4 - 1)
    weights = (_EXACTNESS * np.where(linear_rgb <= 0.0031308, 12.92, bright))[:, None]
    # Rows whose squares sum to the integral that is minimised, wavelengths in units of the reach.
    centers, widths = bands.centers_nm / _REACH_NM, bands.widths_nm / _REACH_NM
    slopes = np.diff(np.eye(len(centers)), axis=0) / np.sqrt(np.diff(centers))[:, None]
    smoothness = np.concatenate([slopes, np.diag(np.sqrt(widths))])
    lower, upper = -reflectance / base, np.maximum(greatest - reflectance, 0.0) / base
    solution = lsq_linear(
        np.concatenate([smoothness, weights * (to_rgb * base[:, None]).T]),
        np.concatenate([np.zeros(len(smoothness)), weights[:, 0] * (linear_rgb - reflectance @ to_rgb)]),
        (lower, np.maximum(upper, lower + 1e-12)),
        method="bvls",
    )
    return np.clip(reflectance + base * solution.x, 0.0, max(greatest, float(reflectance.max())))


def with_sensor(scene: TrainedScene, sensor: SpectralResponses) -> TrainedScene:
    """The scene as the sensor sees it; its `notes` say what of the sensor the bands do not cover.

    The result can't be edited any more: edits and lights need the bands.

    Raises:
        SpectrumError: no channel of the sensor lies in what the scene's bands cover.
    """
    seen, materials = sensor.seen_by(scene.bands), scene.materials
    through = replace(
        materials,
        bands=seen.bands,
        endmembers=_through(materials.endmembers, seen.matrix),
        specular_spectra=_through(materials.specular_spectra, seen.matrix),
        light=None if materials.light is None else _through(materials.light, seen.matrix),
        sensor=sensor.name,
    )
    notes = (*scene.notes, seen.description, *seen.notes)
    return replace(scene, materials=through, notes=notes, unedited=scene.as_trained)


def _through(spectra: Float[Tensor, "*n B"], matrix: Float64[np.ndarray, "B S"]) -> Float[Tensor, "*n S"]:
    return (spectra.detach().cpu().double() @ torch.from_numpy(matrix)).to(spectra)


_VISIBLE_DIFFERENCE = 2.5 / 255
"""Of sRGB channels, above which the user gets a note."""

_REPLACED, _RETINTED, _NAMED, _COLOURED = "replaced", "retinted", "renamed", "given a colour of gloss"
_REMOVED, _ISOLATED = "removed", "isolated"


def _swap(state: MaterialState, edit: Swap, _: str) -> None:
    first, second = state.index_of(edit.first), state.index_of(edit.second)
    if first == second:
        raise ConfigError(
            f"an endmember can't be swapped with itself; found {edit.first!r} and {edit.second!r}"
        )
    state.spectra[[first, second]] = state.spectra[[second, first]]
    # What was done to looks goes with the looks.
    places = {(what, one): (what, first + second - one) for what in _OF_LOOKS for one in (first, second)}
    state.done = {places.get(key, key): edit for key, edit in state.done.items()}
    places = {("retint", one): ("retint", first + second - one) for one in (first, second)}
    state.reached = {places.get(key, key): colour for key, colour in state.reached.items()}


_OF_LOOKS = (_REPLACED, _RETINTED)


def _replace(state: MaterialState, edit: Replace, where: str) -> None:
    index = state.index_of(edit.endmember)
    state.note(_REPLACED, index, where)
    library, name = _library_of(edit)
    material = library.find(name)
    try:
        reflectance = library.reflectance(name, state.bands, "hold" if edit.extrapolate else "refuse")
    except SpectrumError as error:
        raise SpectrumError(f"{error}; extrapolate: true holds the outermost values instead") from error
    is_unknown = ~np.isfinite(MaterialLibrary((material,)).resampled(state.bands)[0])
    if edit.extrapolate and is_unknown.any():
        unknown = _listed(state.bands, is_unknown)
        state.notes.append(f"{where}: {name} was not measured at {unknown}: the values beside are held there")
    library.require_reflectance(name, reflectance, name)
    state.spectra[index] = reflectance * state.light


def _library_of(edit: Replace) -> tuple[MaterialLibrary, str]:
    """Where a reflectance is looked up, and its name there."""
    if edit.library is not None:
        return measured_library(), edit.library
    assert edit.file is not None
    library = MaterialLibrary(tuple(read_library(edit.file)))
    names = list(library.names)
    if edit.spectrum is None and len(names) > 1:
        raise SpectrumError(
            f"{edit.file} has {len(names)} spectra ({', '.join(names[:5])}, ...); choose one with spectrum"
        )
    return library, edit.spectrum or names[0]


def _retint(state: MaterialState, edit: Retint, where: str) -> None:
    index = state.index_of(edit.endmember)
    state.note(_RETINTED, index, where)
    seen = appearance_of(state, index) if edit.match == "picture" else None
    shown = _IN_FULL_LIGHT if seen is None else seen
    is_lit = state.light > DARK_LIGHT * state.light.max()
    light = np.where(is_lit, state.light, 0.0)
    reflectance = np.where(is_lit, state.spectra[index] / np.where(is_lit, light, 1.0), 0.0)
    to_rgb, wanted = light[:, None] * _rgb_matrix(state), shown.full_colour(edit.colour)
    changed = retinted(state.bands, reflectance, to_rgb, wanted, shown.greatest_reflectance)
    state.spectra[index] = changed * light
    what = state.names[index] if seen is None else f"pictures of {state.names[index]}"
    reached = _reached_colour(state, f"{where}: {what}", edit.colour, shown.mean_srgb(changed @ to_rgb))
    state.reached["retint", index] = reached


_IN_FULL_LIGHT = Appearance(np.ones(1), np.zeros((1, 3)), np.ones(1))
"""Of a spectrum itself."""


def _rgb_matrix(state: MaterialState) -> Float64[np.ndarray, "B 3"]:
    return rgb_matrix(state.bands, torch.float64).numpy()


def _reached_colour(state: MaterialState, what: str, asked: Colour, reached: np.ndarray) -> Colour:
    """The colour asked for, or the one reached if it visibly differs, which is noted."""
    if np.abs(reached - asked).max() <= _VISIBLE_DIFFERENCE:
        return asked
    state.notes.append(
        f"{what} can't be {css_colour(asked)} in this light; took the nearest colour, {css_colour(reached)}"
    )
    red, green, blue = reached.tolist()
    return red, green, blue


def _scale(state: MaterialState, edit: Scale, _: str) -> None:
    state.spectra[state.index_of(edit.endmember)] *= edit.factor


def _remove(state: MaterialState, edit: Remove, where: str) -> None:
    for index in [state.index_of(endmember) for endmember in edit.endmembers]:
        state.note(_REMOVED, index, where, refuse_after=_ISOLATED)
        state.is_kept[index] = False
    if not state.is_kept.any():
        raise ConfigError("nothing is left: every endmember is removed; keep at least one")


def _isolate(state: MaterialState, edit: Isolate, where: str) -> None:
    earlier = [before for (what, _), before in state.done.items() if what == _ISOLATED]
    if earlier:
        raise ConfigError(f"{earlier[0]} isolates already; name all that are to stay in one edit")
    kept = [state.index_of(endmember) for endmember in edit.endmembers]
    for index in kept:
        state.note(_ISOLATED, index, where, refuse_after=_REMOVED)
    state.is_kept &= np.isin(np.arange(len(state.names)), kept)


def _rename(state: MaterialState, edit: Rename, where: str) -> None:
    index = state.index_of(edit.endmember)
    state.note(_NAMED, index, where)
    state.names[index] = edit.name


def _gloss(state: MaterialState, edit: Gloss, where: str) -> None:
    if len(state.specular_spectra) == 0:
        raise ConfigError(
            "this run has no view-dependent part (--pipeline.model.specular none), hence no gloss"
        )
    chosen = range(len(state.names)) if edit.endmember is None else [state.index_of(edit.endmember)]
    if edit.colour is not None and edit.colour not in state.mirror_reflectances:
        white, to_rgb = np.ones(len(state.bands)), _rgb_matrix(state)
        mirror = retinted(state.bands, white, to_rgb, _IN_FULL_LIGHT.full_colour(edit.colour))
        state.mirror_reflectances[edit.colour] = mirror
        shown = _IN_FULL_LIGHT.mean_srgb(mirror @ to_rgb)
        state.mirror_colours[edit.colour] = _reached_colour(state, f"{where}: highlights", edit.colour, shown)
    for index in chosen:
        state.gloss[index] *= edit.scale
        if edit.colour is not None:
            state.note(_COLOURED, index, where)
            state.mirrors[index] = edit.colour
            state.reached["gloss", index] = state.mirror_colours[edit.colour]


_HANDLERS: dict[type[Operation], Callable[[MaterialState, Any, str], None]] = {
    Swap: _swap,
    Replace: _replace,
    Retint: _retint,
    Scale: _scale,
    Remove: _remove,
    Isolate: _isolate,
    Rename: _rename,
    Gloss: _gloss,
}


def edit_scene(
    scene: TrainedScene, recipe: Recipe, see: Callable[[TrainedScene], Coefficients | None] = sample_seen
) -> TrainedScene:
    """The edited scene. Edits are made in order, in the light that the scene was recorded in; then the recipe's light
    is lit. Endmembers keep their numbers.

    Args:
        scene: Stays as it is.
        recipe: What to change.
        see: What cameras see of a scene, in any leading axes, None where it is not known: retints that match the
            picture look at the scene that the edits before them have made.
    Raises:
        ConfigError: the recipe does not fit the scene or contradicts itself; the message says where.
    """
    light = scene.light_power
    state, seen_as = MaterialState.of(scene.materials, light), None
    for position, operation in enumerate(recipe.operations):
        where = recipe.where(position)
        looks = isinstance(operation, Retint) and operation.match == "picture"
        if looks and state.visibility != seen_as:
            state.seen, seen_as = see(_with_visibility(scene, state)), state.visibility
        try:
            _HANDLERS[type(operation)](state, operation, where)
        except UnmixError as error:
            raise ConfigError(f"{where}: {error}") from error
    _require_names_that_differ(state, recipe)
    factors, light_notes = light_factors(scene, recipe)
    materials = replace(
        scene.materials,
        names=tuple(state.names),
        endmembers=_tensor(state.spectra * factors, scene),
        specular_spectra=_tensor(state.mirrored()[0] * factors, scene),
    )
    if recipe.illuminant is not None:
        asked = recipe.illuminant.light
        materials = replace(
            materials,
            light=_tensor(factors if light is None else light * factors, scene),
            is_light_assumed=not scene.materials.is_light_known,
            light_name=asked.stem if isinstance(asked, Path) else asked,
        )
    assumed = assumption_of_light(scene, recipe)
    notes = [*scene.notes, *([] if assumed is None else [assumed]), *state.notes, *light_notes]
    edited = _with_visibility(scene, state)
    return replace(
        edited,
        materials=materials,
        notes=tuple(notes),
        reached_colours=state.reached,
        unedited=scene.as_trained,
    )


def _require_names_that_differ(state: MaterialState, recipe: Recipe) -> None:
    """Names may be exchanged: only those that all edits together leave have to differ."""
    for position, edit in reversed(list(enumerate(recipe.operations))):
        if isinstance(edit, Rename) and state.names.count(edit.name) > 1:
            first, second = (index for index, name in enumerate(state.names) if name == edit.name)
            raise ConfigError(
                f"{recipe.where(position)}: endmembers {first} and {second} would both be called {edit.name!r}; names "
                "must differ"
            )


def _with_visibility(scene: TrainedScene, state: MaterialState) -> TrainedScene:
    """The scene without what is removed, and with the gloss of each material."""
    _, gloss = state.mirrored()
    if gloss is None and state.is_kept.all():
        return scene
    shine = np.ones((1, len(state.gloss))) if gloss is None else gloss
    edited = EditedField.over(scene.field, torch.from_numpy(state.is_kept), torch.from_numpy(shine).float())
    return replace(
        scene, field=edited.to(scene.device), visibility=edited.visibility, has_removed=edited.removes
    )


def changes_geometry(recipe: Recipe) -> bool:
    """Whether the edited scene has to be rendered again; otherwise coefficients of the unedited one serve with its
    materials."""
    return any(
        isinstance(one, Remove | Isolate) or (isinstance(one, Gloss) and one.endmember is not None)
        for one in recipe.operations
    )


def assumption_of_light(scene: TrainedScene, recipe: Recipe) -> str | None:
    """What a user has to be told of the light that edits start from; None if nothing."""
    depends = any(isinstance(one, Replace | Retint) for one in recipe.operations)
    if scene.materials.is_light_known or not (depends or recipe.illuminant):
        return None
    return "the scene does not say what light it was recorded in: taken as flat (CIE illuminant E)"


def light_factors(scene: TrainedScene, recipe: Recipe) -> tuple[Float64[np.ndarray, " B"], list[str]]:
    """What radiance measured in the scene's light is multiplied with, to be as in the recipe's, and what of that a user
    has to be told.

    Raises:
        ConfigError: the light is unknown, or covers no band.
    """
    if recipe.illuminant is None:
        return np.ones(len(scene.bands)), []
    try:
        return relighting_factors(scene.bands, scene.light_power, recipe.illuminant)
    except SpectrumError as error:
        raise ConfigError(f"{recipe.source}: {error}") from error


def _tensor(values: Float64[np.ndarray, "*axes B"], scene: TrainedScene) -> Float[Tensor, "*axes B"]:
    return torch.tensor(values, dtype=torch.float32, device=scene.device)
