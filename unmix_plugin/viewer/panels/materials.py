"""Materials and light: every change is an edit of a recipe, the same that `--edits` takes, and can be undone."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from unmix_plugin.editing import (
    Gloss,
    Isolate,
    Light,
    Recipe,
    Remove,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
    read_recipe,
    recipe_to_yaml,
)
from unmix_plugin.editing.recipe import COMMON_LIGHTS, light_title
from unmix_plugin.errors import ConfigError, UnmixError
from unmix_plugin.formats.files import write_file
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.material_library import LibraryMatch, LibraryMaterial, MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.viewer import recipes
from unmix_plugin.viewer.page import (
    Chart,
    Debounced,
    Line,
    index_in,
    new_file,
    number,
    number_of,
    paragraph,
    swatches,
    table,
    text,
)
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.session import Session


def _matches(
    library: MaterialLibrary, spectra: Float[np.ndarray, "N B"], materials: Materials, count: int
) -> list[list[LibraryMatch]]:
    """Known materials that spectra resemble most, by their angle in the light of `materials`."""
    light = None if materials.light is None else materials.light.cpu().double().numpy()
    return library.nearest(spectra, materials.bands, light, count)


def likeness_rows(
    library: MaterialLibrary, spectrum: Float[np.ndarray, "B"], materials: Materials
) -> list[tuple[str, str]]:
    """Rows of a table of the known materials, three at most, that a spectrum is like, and of where they are from."""
    (found,) = _matches(library, spectrum[None], materials, 3)
    alike = [one for one in found if one.is_alike]
    if not alike:
        nearest = f"; nearest is {found[0].name}, {found[0].angle_rad:.3f} rad" if found else ""
        return [("like", f"nothing that is known{nearest}")]
    rows = [
        ("" if rank else "like", f"{one.name}, {one.angle_rad:.3f} rad") for rank, one in enumerate(alike)
    ]
    return [*rows, ("known from", "; ".join(dict.fromkeys(one.source for one in alike)))]


_NO_RECIPE = "none saved yet"
_NO_MATERIAL = "choose one"
_OWN_LIGHT = "as recorded"
_FACTORS = (0.0, 5.0, 0.05, 1.0)
"""Least, greatest, step and first of a slider."""

_WHITE = (255, 255, 255)
_LONGEST_LIST = 64
"""Endmembers that are listed with their nearest known material."""


class MaterialsPanel:
    """Changes materials and light of one client."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._library = session.services.library
        self._named = 0
        gui = session.client.gui
        self._listing = gui.add_html("")
        self._light = session.on_change(gui.add_dropdown("light", tuple(self._lights())), self._change_light)
        session.add_buttons("changes", ("undo", "redo", "start again"), self._step)
        names = session.materials().names
        self._chosen = session.on_change(gui.add_dropdown("endmember", names), self._choose)
        with gui.add_folder("this endmember"):
            self._add_changes(names)
        self._chart = Chart(gui, "spectra under the light")
        with gui.add_folder("recipes"):
            self._text = gui.add_text("recipe", "", multiline=True, disabled=True)
            self._recipe_name = gui.add_text("save as", "recipe")
            session.add_button("save", self._save)
            self._saved = gui.add_dropdown("saved", self._files())
            session.add_button("load", self._load)
        self._show_materials()
        session.on_edit.append(self._show_materials)

    def _add_changes(self, names: tuple[str, ...]) -> None:
        gui, on_change = self._session.client.gui, self._session.on_change
        self._alike = gui.add_html("")
        self._is_visible = on_change(gui.add_checkbox("visible", True), self._change_visible)
        self._is_alone = on_change(gui.add_checkbox("only this one", False), self._change_alone)
        self._factor = gui.add_slider("brightness", *_FACTORS)
        on_change(self._factor, lambda: self._change(Scale(self._index, number_of(self._factor, 1.0))))
        self._colour = gui.add_rgb("colour", (128, 128, 128))
        on_change(self._colour, lambda: self._change(Retint(self._index, _srgb(self._colour.value))))
        self._gloss = on_change(gui.add_slider("gloss", *_FACTORS), self._change_gloss)
        self._gloss_colour = on_change(gui.add_rgb("colour of gloss", _WHITE), self._change_gloss)
        self._name = on_change(gui.add_text("name", names[0]), self._type_name)
        self._typed_name = Debounced(self._rename)
        self._session.on_tick.append(self._typed_name.tick)
        known = gui.add_dropdown("known material", (_NO_MATERIAL, *self._library.names))
        self._known = on_change(known, self._show_known)
        self._known_source = gui.add_html("")
        self._session.add_button("replace by the known material", self._replace)
        self._other = gui.add_dropdown("other endmember", names, initial_value=names[-1])
        self._session.add_button(
            "swap with the other",
            lambda: self._change_recipe(
                recipes.with_swap(self._recipe, Swap(self._index, index_in(self._other)))
            ),
        )

    # Recipes.

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
            self._show_chosen(self._session.materials())
            raise
        self._session.history.take(recipe, subject)
        self._session.change_edit(edit)

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
        self._session.say("saved", f"{path.name} in {path.parent}; other commands take it as --edits")

    def _load(self) -> None:
        files = self._saved.options = self._files()
        if self._saved.value not in files or self._saved.value == _NO_RECIPE:
            raise ConfigError("choose one of the recipes saved in the run folder")
        services = self._session.services
        recipe = read_recipe(services.recipes_folder / str(self._saved.value))
        self._change_recipe(recipes.numbered(recipe, services.maker.edited(Edit()).materials.names))

    def _files(self) -> tuple[str, ...]:
        folder = self._session.services.recipes_folder
        return tuple(sorted(path.name for path in folder.glob("*.y*ml"))) or (_NO_RECIPE,)

    # Changes.

    @property
    def _index(self) -> int:
        return index_in(self._chosen)

    def _change(self, change: Replace | Retint | Scale | Rename | Gloss) -> None:
        self._change_recipe(recipes.with_change(self._recipe, change), (type(change), change.endmember))

    def _change_light(self) -> None:
        title, recipe = str(self._light.value), self._recipe
        lights = self._lights(recipe.illuminant)
        if title not in lights:
            raise ConfigError(f"there is no light {title[:40]!r} to choose")
        name = lights[title]
        self._change_recipe(replace(recipe, illuminant=None if name is None else Light(name)))

    def _change_visible(self) -> None:
        hidden, index = recipes.named_by(self._recipe, Remove), {self._index}
        hidden = hidden - index if self._is_visible.value is True else hidden | index
        self._change_recipe(recipes.with_visible(self._recipe, hidden))

    def _change_alone(self) -> None:
        hidden = recipes.named_by(self._recipe, Remove) - {self._index}
        alone = self._index if self._is_alone.value is True else None
        self._change_recipe(recipes.with_visible(self._recipe, hidden, alone))

    def _change_gloss(self) -> None:
        is_white = tuple(self._gloss_colour.value[:3]) == _WHITE
        colour = None if is_white else _srgb(self._gloss_colour.value)
        self._change(Gloss(self._index, number_of(self._gloss, 1.0), colour))

    def _type_name(self) -> None:
        self._named = self._index
        self._typed_name.note()

    def _rename(self) -> None:
        """Take the name that was typed, once nothing more is; an empty field waits for more."""
        name = text(self._name.value).strip()
        if name:
            self._change(Rename(self._named, name))

    def _chosen_known(self) -> LibraryMaterial | None:
        name = text(self._known.value)
        return None if name == _NO_MATERIAL else self._library.find(name)

    def _show_known(self) -> None:
        chosen = self._chosen_known()
        self._known_source.content = "" if chosen is None else paragraph(f"{chosen.source}; {chosen.bands}")

    def _replace(self) -> None:
        chosen = self._chosen_known()
        if chosen is None:
            raise ConfigError("choose a known material first")
        library = chosen.name if chosen.origin is None else None
        file, spectrum = chosen.origin or (None, None)
        known = MaterialLibrary((chosen,)).resampled(self._session.materials().bands)
        is_partly_known = bool(np.isfinite(known).any())  # what is known nowhere is refused
        self._change(Replace(self._index, library, file, spectrum, extrapolate=is_partly_known))

    # What is in force.

    def _choose(self) -> None:
        self._typed_name.tick(at_once=True)
        self._show_chosen(self._session.materials())

    def _show_materials(self) -> None:
        """Show the materials as they are now; the menus have the same endmembers chosen as before."""
        materials = self._session.materials()
        with self._session.filling():
            for menu in (self._chosen, self._other):
                index = index_in(menu)
                if tuple(menu.options) != materials.names:
                    menu.options = materials.names
                    menu.value = materials.names[index]
        colours, spectra = self._session.colours_of(materials), materials.endmembers.double().cpu().numpy()
        lines = [Line(*one) for one in zip(materials.names, spectra, colours, strict=True)]
        self._chart.draw(materials.bands.centers_nm, lines, materials.quantity)
        entries = []
        for index, found in enumerate(_matches(self._library, spectra[:_LONGEST_LIST], materials, 1)):
            hidden = "" if recipes.is_shown(self._recipe, index) else " (hidden)"
            like = [one.name.rpartition("/")[2] for one in found if one.is_alike]
            entries.append(
                (
                    f"{materials.names[index]}{hidden}{''.join(f', like {one}' for one in like)}",
                    colours[index],
                )
            )
        self._listing.content = swatches(entries)
        self._show_chosen(materials)

    def _show_chosen(self, materials: Materials) -> None:
        """Let the controls say what the recipe does to the endmember chosen."""
        with self._session.filling():
            index, recipe = self._index, self._recipe
            scale, gloss = recipes.change_of(recipe, Scale, index), recipes.change_of(recipe, Gloss, index)
            retint = recipes.change_of(recipe, Retint, index)
            reached = self._session.services.maker.edited(self._session.view.edit).reached_colours
            self._is_visible.value = recipes.is_shown(recipe, index)
            self._is_alone.value = index in recipes.named_by(recipe, Isolate)
            self._factor.value = scale.factor if scale else 1.0
            self._gloss.value = gloss.scale if gloss else 1.0
            # The colours that were reached, which may not be those asked for.
            gloss_colour = reached.get(("gloss", index)) if gloss and gloss.colour else None
            self._gloss_colour.value = _bytes(gloss_colour) if gloss_colour else _WHITE
            colour = reached.get(("retint", index)) if retint else None
            if colour is None:  # that of its spectrum in full light
                linear = materials.endmembers[index] @ rgb_matrix(materials.bands).to(materials.endmembers)
                colour = linear_to_srgb(linear.clamp(0, 1)).cpu()
            self._colour.value = _bytes(colour)
            # While a name is typed the field is the user's: "blue " may become "blue cloth".
            if not self._typed_name.is_waiting and text(self._name.value).strip() != materials.names[index]:
                self._name.value = materials.names[index]
            lights = self._lights(recipe.illuminant)
            present = None if recipe.illuminant is None else str(recipe.illuminant.light)
            self._light.options = tuple(lights)
            self._light.value = next(title for title, name in lights.items() if name == present)
            spectrum = materials.endmembers[index].double().cpu().numpy()
            self._alike.content = table(likeness_rows(self._library, spectrum, materials))
            self._text.value = recipe_to_yaml(recipe)

    def _lights(self, present: Light | None = None) -> dict[str, str | None]:
        """Lights to choose from, by how the menu has them: the recorded one, those that reach the bands, usual ones
        first, and the present one in any case."""
        usable = self._session.services.usable_lights
        names = [name for name in COMMON_LIGHTS if name in usable]
        names += [*usable, *([] if present is None else [str(present.light)])]
        return {_OWN_LIGHT: None, **{light_title(name): name for name in dict.fromkeys(names)}}


def _srgb(value: Any) -> tuple[float, float, float]:
    red, green, blue = (number(part, 0, 255, fallback=128) / 255 for part in tuple(value)[:3])
    return red, green, blue


def _bytes(srgb: Any) -> tuple[int, int, int]:
    red, green, blue = (torch.as_tensor(srgb) * 255).round().int().tolist()
    return red, green, blue
