"""What each kind of edit does to the materials: one function of the state for each kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from unmix_plugin.editing.material_state import MaterialState
from unmix_plugin.editing.operations import (
    Colour,
    FileSpectrum,
    Gloss,
    Isolate,
    LibrarySpectrum,
    Operation,
    Remove,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
)
from unmix_plugin.editing.recipe import Recipe
from unmix_plugin.editing.retint import LitReflectance, retinted
from unmix_plugin.editing.seen import appearance_of
from unmix_plugin.errors import ConfigError, SpectrumError, UnmixError
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.formats.envi import read_library_table
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, srgb_to_linear
from unmix_plugin.spectral.library.material_library import DARK_LIGHT, MaterialLibrary, measured_library

_GREATEST_REFLECTANCE = 2.0
"""Of a table of reflectances; more is a sign of per cent. Fluorescent ones exceed 1."""

_VISIBLE_DIFFERENCE = 2.5 / 255
"""Of sRGB channels, above which the user gets a note."""

_REPLACED, _RETINTED, _NAMED, _COLOURED = "replaced", "retinted", "renamed", "given a colour of gloss"
_REMOVED, _ISOLATED = "removed", "isolated"


def carry_out(recipe: Recipe, state: MaterialState) -> None:
    """Make all edits of a recipe, in order.

    Raises:
        ConfigError: an edit can't be made, or contradicts another; the message says where it is.
    """
    for position, operation in enumerate(recipe.operations):
        where = recipe.where(position)
        try:
            _HANDLERS[type(operation)](state, operation, where)
        except UnmixError as error:
            raise ConfigError(f"{where}: {error}") from error


def _swap(state: MaterialState, edit: Swap, _: str) -> None:
    first, second = state.index_of(edit.first), state.index_of(edit.second)
    if first == second:
        raise ConfigError(
            f"an endmember can't be swapped with itself; found {edit.first!r} and {edit.second!r}"
        )
    state.spectra[[first, second]] = state.spectra[[second, first]]
    state.swap_notes((_REPLACED, _RETINTED), first, second)


def _replace(state: MaterialState, edit: Replace, where: str) -> None:
    index = state.index_of(edit.endmember)
    state.note(_REPLACED, index, where)
    library, name = _library_of(edit.spectrum)
    library.find(name)
    try:
        reflectance = library.reflectance(name, state.bands, "hold" if edit.extrapolate else "refuse")
    except SpectrumError as error:
        raise SpectrumError(f"{error}; extrapolate: true holds the outermost values instead") from error
    if reflectance.max() > _GREATEST_REFLECTANCE:
        raise SpectrumError(
            f"{name} has reflectances of up to {reflectance.max():g}; give values from 0 to 1, not per cent"
        )
    state.spectra[index] = reflectance * state.light


def _library_of(spectrum: LibrarySpectrum | FileSpectrum) -> tuple[MaterialLibrary, str]:
    """Where a reflectance is looked up, and its name there."""
    if isinstance(spectrum, LibrarySpectrum):
        return measured_library(), spectrum.library
    table = read_library_table(spectrum.file)
    names = list(table.names)
    if spectrum.spectrum is None and len(names) > 1:
        raise SpectrumError(
            f"{spectrum.file} has {len(names)} spectra ({', '.join(names[:5])}, ...); choose one with spectrum"
        )
    library = MaterialLibrary(()).extended(table, spectrum.file.name)
    return library, spectrum.spectrum or names[0]


def _retint(state: MaterialState, edit: Retint, where: str) -> None:
    index = state.index_of(edit.endmember)
    state.note(_RETINTED, index, where)
    seen = appearance_of(state, index) if edit.match == "picture" else None
    is_lit = state.light > DARK_LIGHT * state.light.max()
    light = np.where(is_lit, state.light, 0.0)
    reflectance = np.where(is_lit, state.spectra[index] / np.where(is_lit, light, 1.0), 0.0)
    surface = LitReflectance(state.bands, reflectance, light)
    if seen is None:
        changed = retinted(surface, _linear(edit.colour))
        reached = _srgb(changed @ surface.to_linear_rgb)
    else:
        changed = retinted(surface, seen.full_colour(edit.colour), seen.greatest_reflectance)
        reached = seen.mean_srgb(changed @ surface.to_linear_rgb)
    state.spectra[index] = changed * light
    what = state.names[index] if seen is None else f"pictures of {state.names[index]}"
    _note_nearest(state, f"{where}: {what}", edit.colour, reached)


def _note_nearest(state: MaterialState, what: str, asked: Colour, reached: np.ndarray) -> None:
    """Note if a colour visibly differs from the one asked for."""
    if np.abs(reached - asked).max() > _VISIBLE_DIFFERENCE:
        state.notes.append(
            f"{what} can't be {css_colour(asked)} in this light; took the nearest colour, {css_colour(reached)}"
        )


def _scale(state: MaterialState, edit: Scale, _: str) -> None:
    state.spectra[state.index_of(edit.endmember)] *= edit.factor


def _remove(state: MaterialState, edit: Remove, where: str) -> None:
    for index in [state.index_of(endmember) for endmember in edit.endmembers]:
        _refuse_both(state, index, _ISOLATED, _REMOVED)
        state.done[_REMOVED, index] = where
        state.is_kept[index] = False
    _require_something(state)


def _isolate(state: MaterialState, edit: Isolate, where: str) -> None:
    earlier = [before for (what, _), before in state.done.items() if what == _ISOLATED]
    if earlier:
        raise ConfigError(f"{earlier[0]} isolates already; name all that are to stay in one edit")
    kept = [state.index_of(endmember) for endmember in edit.endmembers]
    for index in kept:
        _refuse_both(state, index, _REMOVED, _ISOLATED)
        state.done[_ISOLATED, index] = where
    state.is_kept &= np.isin(np.arange(len(state.names)), kept)


def _rename(state: MaterialState, edit: Rename, where: str) -> None:
    index = state.index_of(edit.endmember)
    state.note(_NAMED, index, where)
    if edit.name in state.names and state.names.index(edit.name) != index:
        other = state.names.index(edit.name)
        raise ConfigError(f"endmember {other} is called {edit.name!r} already; names must differ")
    state.names[index] = edit.name


def _gloss(state: MaterialState, edit: Gloss, where: str) -> None:
    if len(state.specular_spectra) == 0:
        raise ConfigError(
            "this run has no view-dependent part (--pipeline.model.specular none), hence no gloss"
        )
    chosen = range(len(state.names)) if edit.endmember is None else [state.index_of(edit.endmember)]
    if edit.colour is not None and edit.colour not in state.mirror_reflectances:
        flat = np.ones(len(state.bands))
        white = LitReflectance(state.bands, flat, flat)
        mirror = retinted(white, _linear(edit.colour))
        state.mirror_reflectances[edit.colour] = mirror
        _note_nearest(state, f"{where}: highlights", edit.colour, _srgb(mirror @ white.to_linear_rgb))
    for index in chosen:
        state.gloss[index] *= edit.scale
        if edit.colour is not None:
            state.note(_COLOURED, index, where)
            state.mirrors[index] = edit.colour


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


def _linear(srgb: tuple[float, float, float]) -> np.ndarray:
    return srgb_to_linear(torch.tensor(srgb, dtype=torch.float64)).numpy()


def _srgb(linear_rgb: np.ndarray) -> np.ndarray:
    return linear_to_srgb(torch.from_numpy(np.clip(linear_rgb, 0, 1))).numpy()


def _refuse_both(state: MaterialState, index: int, before: str, now: str) -> None:
    edit = state.done.get((before, index))
    if edit is not None:
        raise ConfigError(
            f"{state.names[index]!r} can't be {now}: {edit} has it {before}; keep one of the two"
        )


def _require_something(state: MaterialState) -> None:
    if not state.is_kept.any():
        raise ConfigError("nothing is left: every endmember is removed; keep at least one")
