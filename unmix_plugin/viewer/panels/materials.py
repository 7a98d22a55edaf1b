"""Materials and light: every change is an edit of a recipe, the same that `--edits` takes, and can be undone."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from unmix_plugin.editing import (
    Gloss,
    Light,
    Recipe,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
    read_recipe,
    recipe_to_yaml,
)
from unmix_plugin.errors import ConfigError, UnmixError
from unmix_plugin.formats.files import write_file
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.material_library import LibraryMatch, LibraryMaterial, MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.viewer.page import (
    Chart,
    Debounced,
    Line,
    index_in,
    new_file,
    number,
    paragraph,
    swatches,
    table,
    text,
)
from unmix_plugin.viewer.recipes import change_of, numbered, visibility, with_change, with_swap, with_visible
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.session import Session

_ALIKE_RAD = 0.1
"""Spectral angle up to which two materials are alike."""


def _nearest_materials(
    library: MaterialLibrary, spectra: Float[np.ndarray, "N B"], materials: Materials, count: int
) -> list[list[LibraryMatch]]:
    """Known materials that spectra resemble, seen in the light of `materials`."""
    light = None if materials.light is None else materials.light.cpu().double().numpy()
    return library.nearest(spectra, materials.bands, light, count)


def _likeness(match: LibraryMatch) -> str:
    """A known material, its spectral angle and its source; matches that say little are marked."""
    remark = "" if match.angle_rad <= _ALIKE_RAD else ", not alike"
    return f"{match.name} ({match.angle_rad:.3f} rad{remark}; {match.source})"


def likeness_rows(
    library: MaterialLibrary, spectrum: Float[np.ndarray, "B"], materials: Materials
) -> list[tuple[str, str]]:
    """Rows of a table of the three known materials that a spectrum resembles most."""
    matches = _nearest_materials(library, spectrum[None], materials, 3)[0]
    return [("like" if rank == 0 else "", _likeness(match)) for rank, match in enumerate(matches)]


_NO_RECIPE = "none saved yet"
_NO_MATERIAL = "choose one"
_OWN_LIGHT = "as recorded"
_COMMON_LIGHTS = ("D65", "D50", "A", "E", "C", "FL2", "FL7", "FL11")
_FACTOR_BOUNDS = (0.0, 5.0)
_WHITE = (255, 255, 255)
_LONGEST_LIST = 64
"""Endmembers that are listed with their nearest known material."""


class MaterialsPanel:
    """Changes materials and light of one client."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._is_showing = False
        self._named = 0
        self._gui = session.client.gui
        self._listing = self._gui.add_html("")
        self._light = self._gui.add_dropdown("light", self._lights())
        self._on(self._light, self._change_light)
        buttons = self._gui.add_button_group("changes", ("undo", "redo", "start again"))
        buttons.on_click(session.guarded(lambda: self._step(buttons.value)))
        names = session.materials().names
        self._chosen = self._gui.add_dropdown("endmember", names)
        self._on(self._chosen, self._choose)
        self._add_changes(names)
        self._chart = Chart(self._gui, "spectra under the light", session.materials().quantity)
        with self._gui.add_folder("recipes"):
            self._text = self._gui.add_text("recipe", "", multiline=True, disabled=True)
            self._recipe_name = self._gui.add_text("save as", "recipe")
            session.add_button("save", self._save)
            self._saved = self._gui.add_dropdown("saved", self._files())
            session.add_button("load", self._load)
        self._show_materials()
        session.on_edit.append(self._show_materials)

    def _step(self, action: str) -> None:
        history = self._session.history
        if action == "start again":
            self._change_recipe(Recipe())
            return
        recipe = history.undone() if action == "undo" else history.redone()
        if recipe is None:
            raise ConfigError("there is nothing more to undo or redo")
        self._session.change_edit(Edit(recipe))

    def _save(self) -> None:
        content = recipe_to_yaml(self._recipe).encode()
        folder = self._session.services.recipes_folder
        path = write_file(new_file(folder, self._recipe_name.value, ".yml", "recipe"), content)
        self._saved.options = self._files()
        self._saved.value = path.name
        self._session.client.send_file_download(path.name, content)
        self._session.say("saved", f"{path}; other commands take it as --edits {path}")

    def _load(self) -> None:
        files = self._files()
        self._saved.options = files
        if self._saved.value not in files or self._saved.value == _NO_RECIPE:
            raise ConfigError("choose one of the recipes saved in the run folder")
        services = self._session.services
        recipe = read_recipe(services.recipes_folder / str(self._saved.value))
        self._change_recipe(numbered(recipe, services.maker.edited(Edit()).materials.names))

    def _files(self) -> tuple[str, ...]:
        folder = self._session.services.recipes_folder
        found = sorted(path.name for path in folder.glob("*.y*ml")) if folder.is_dir() else []
        return tuple(found) or (_NO_RECIPE,)

    def _add_changes(self, names: tuple[str, ...]) -> None:
        gui = self._gui
        with gui.add_folder("this endmember"):
            self._alike = gui.add_html("")
            self._is_visible = gui.add_checkbox("visible", True)
            self._is_alone = gui.add_checkbox("only this one", False)
            self._factor = gui.add_slider("brightness", *_FACTOR_BOUNDS, 0.05, 1.0)
            self._colour = gui.add_rgb("colour", (128, 128, 128))
            self._gloss = gui.add_slider("gloss", *_FACTOR_BOUNDS, 0.05, 1.0)
            self._gloss_colour = gui.add_rgb("colour of gloss", _WHITE)
            self._name = gui.add_text("name", names[0])
            names_known = (_NO_MATERIAL, *self._session.services.library.names)
            self._known = gui.add_dropdown("known material", names_known)
            self._known_source = gui.add_html("")
            self._session.add_button("replace by the known material", self._replace)
            self._other = gui.add_dropdown("other endmember", names, initial_value=names[-1])
            self._session.add_button(
                "swap with the other",
                lambda: self._change_recipe(
                    with_swap(self._recipe, Swap(self._index, index_in(self._other)))
                ),
            )
        self._known.on_update(self._session.guarded(self._show_known))
        self._on(self._factor, lambda: self._change(Scale(self._index, _factor(self._factor))))
        self._on(self._colour, lambda: self._change(Retint(self._index, _srgb(self._colour.value))))
        for control in (self._gloss, self._gloss_colour):
            self._on(control, self._change_gloss)
        for control in (self._is_visible, self._is_alone):
            self._on(control, lambda control=control: self._change_visibility(control))
        self._typed_name = Debounced(self._rename)
        self._on(self._name, self._type_name)
        self._session.on_tick.append(self._typed_name.tick)

    @property
    def _recipe(self) -> Recipe:
        """The one in force; endmembers are given by their numbers."""
        return self._session.history.present

    def _change_recipe(self, recipe: Recipe, subject: Hashable = None) -> None:
        """Put a recipe in force; if it does not fit the run nothing changes, and the controls show what is in force."""
        edit = Edit(recipe)
        try:
            self._session.services.maker.edited(edit)
        except UnmixError:
            self._show_chosen()
            raise
        self._session.history.take(recipe, subject)
        self._session.change_edit(edit)

    @property
    def _index(self) -> int:
        """Number of the endmember chosen."""
        return index_in(self._chosen)

    def _on(self, control: Any, work: Callable[[], None]) -> None:
        """Do something when a user changes a control, not when the panel itself does."""
        control.on_update(self._session.guarded(lambda: None if self._is_showing else work()))

    def _change(self, change: Replace | Retint | Scale | Rename | Gloss) -> None:
        self._change_recipe(with_change(self._recipe, change), (type(change), change.endmember))

    def _chosen_known(self) -> LibraryMaterial | None:
        name = text(self._known.value)
        return None if name == _NO_MATERIAL else self._session.services.library.find(name)

    def _show_known(self) -> None:
        """Say where the known material is from, and over which wavelengths."""
        chosen = self._chosen_known()
        said = "" if chosen is None else f"{chosen.source}; {chosen.bands}"
        self._known_source.content = paragraph(said) if said else ""

    def _replace(self) -> None:
        chosen = self._chosen_known()
        if chosen is None:
            raise ConfigError("choose a known material first")
        library = chosen.name if chosen.origin is None else None
        file, spectrum = chosen.origin or (None, None)
        known = MaterialLibrary((chosen,)).resampled(self._session.materials().bands)
        is_partly_known = bool(np.isfinite(known).any())  # what is known nowhere is refused
        self._change(Replace(self._index, library, file, spectrum, extrapolate=is_partly_known))

    def _type_name(self) -> None:
        self._named = self._index
        self._typed_name.note()

    def _rename(self) -> None:
        """Take the name that was typed, once nothing more is; an empty field waits for more."""
        name = text(self._name.value).strip()
        if name:
            self._change(Rename(self._named, name))

    def _choose(self) -> None:
        self._typed_name.tick(at_once=True)
        self._show_chosen()

    def _change_light(self) -> None:
        name, recipe = str(self._light.value), self._recipe
        if name not in self._lights(recipe.illuminant):
            raise ConfigError(f"there is no light {name[:40]!r} to choose")
        self._change_recipe(replace(recipe, illuminant=None if name == _OWN_LIGHT else Light(name)))

    def _change_visibility(self, control: Any) -> None:
        hidden, _ = visibility(self._recipe)
        index, is_on = self._index, control.value is True
        is_hidden = control is self._is_visible and not is_on
        alone = index if control is self._is_alone and is_on else None
        hidden = hidden | {index} if is_hidden else hidden - {index}
        self._change_recipe(with_visible(self._recipe, hidden, alone))

    def _change_gloss(self) -> None:
        is_white = tuple(self._gloss_colour.value[:3]) == _WHITE
        colour = None if is_white else _srgb(self._gloss_colour.value)
        self._change(Gloss(self._index, _factor(self._gloss), colour))

    def _show_materials(self) -> None:
        """Show the materials as they are now; the menus have the same endmembers chosen as before."""
        materials = self._session.materials()
        self._is_showing = True
        try:
            for menu in (self._chosen, self._other):
                index = index_in(menu)
                if tuple(menu.options) != materials.names:
                    menu.options = materials.names
                    menu.value = materials.names[index]
        finally:
            self._is_showing = False
        colours, spectra = self._session.colours_of(materials), materials.endmembers.double().cpu().numpy()
        lines = [Line(*one) for one in zip(materials.names, spectra, colours, strict=True)]
        self._chart.draw(materials.bands.centers_nm, lines, materials.quantity)
        self._listing.content = self._list(materials, colours)
        self._show_chosen(materials)

    def _show_chosen(self, materials: Materials | None = None) -> None:
        """Let the controls say what the recipe does to the endmember chosen."""
        self._is_showing = True
        try:
            materials = self._session.materials() if materials is None else materials
            index, recipe = self._index, self._recipe
            hidden, isolated = visibility(recipe)
            self._is_visible.value = index not in hidden and (not isolated or index in isolated)
            self._is_alone.value = index in isolated
            scale, gloss = (change_of(recipe, kind, index) for kind in (Scale, Gloss))
            self._factor.value = scale.factor if isinstance(scale, Scale) else 1.0
            self._gloss.value = gloss.scale if isinstance(gloss, Gloss) else 1.0
            tint = gloss.colour if isinstance(gloss, Gloss) else None
            self._gloss_colour.value = _WHITE if tint is None else _bytes(torch.tensor(tint))
            self._colour.value = self._colour_of(materials, index)
            # While a name is typed the field is the user's: "blue " may become "blue cloth".
            if not self._typed_name.is_waiting and text(self._name.value).strip() != materials.names[index]:
                self._name.value = materials.names[index]
            self._light.options = self._lights(recipe.illuminant)
            self._light.value = _OWN_LIGHT if recipe.illuminant is None else str(recipe.illuminant.light)
            spectrum = materials.endmembers[index].double().cpu().numpy()
            self._alike.content = table(likeness_rows(self._session.services.library, spectrum, materials))
            self._text.value = recipe_to_yaml(recipe)
        finally:
            self._is_showing = False

    def _lights(self, present: Light | None = None) -> tuple[str, ...]:
        """Lights to choose from: those that reach the bands, usual ones first, and the present one in any case."""
        usable = self._session.services.usable_lights
        common = [name for name in _COMMON_LIGHTS if name in usable]
        names = (_OWN_LIGHT, *common, *(name for name in usable if name not in common))
        shown = _OWN_LIGHT if present is None else str(present.light)
        return names if shown in names else (*names, shown)

    def _colour_of(self, materials: Materials, index: int) -> tuple[int, int, int]:
        """8-bit sRGB colour that was asked for an endmember, or that of its spectrum in full light."""
        retint = change_of(self._recipe, Retint, index)
        if isinstance(retint, Retint):
            return _bytes(torch.tensor(retint.colour))
        linear = materials.endmembers[index] @ rgb_matrix(materials.bands).to(materials.endmembers)
        return _bytes(linear_to_srgb(linear.clamp(0, 1)).cpu())

    def _list(self, materials: Materials, colours: list[tuple[float, ...]]) -> str:
        """Every endmember with its colour, its nearest known material, and whether it is hidden."""
        hidden, isolated = visibility(self._recipe)
        spectra = materials.endmembers[:_LONGEST_LIST].double().cpu().numpy()
        matches = _nearest_materials(self._session.services.library, spectra, materials, 1)
        entries = []
        for index, (name, found) in enumerate(zip(materials.names, matches, strict=False)):
            is_gone = index in hidden or (isolated and index not in isolated)
            like = f", like {_likeness(found[0])}" if found else ""
            entries.append((f"{name}{' (hidden)' if is_gone else ''}{like}", colours[index]))
        return swatches(entries)


def _factor(slider: Any) -> float:
    return number(slider.value, *_FACTOR_BOUNDS, fallback=1.0)


def _srgb(value: Any) -> tuple[float, float, float]:
    """A colour picker's value as sRGB in [0, 1]."""
    red, green, blue = (number(part, 0, 255, fallback=128) / 255 for part in tuple(value)[:3])
    return red, green, blue


def _bytes(srgb: torch.Tensor) -> tuple[int, int, int]:
    red, green, blue = (srgb * 255).round().int().tolist()
    return red, green, blue
