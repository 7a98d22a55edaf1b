"""Materials and light: every change is an edit of a recipe, the same that `--edits` takes, and can be undone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from unmix_plugin.editing import (
    Gloss,
    LibrarySpectrum,
    Light,
    Recipe,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
    assumption_of_light,
    read_recipe,
    recipe_to_yaml,
)
from unmix_plugin.errors import ConfigError, UnmixError
from unmix_plugin.exports.files import write_file
from unmix_plugin.spectral.colour import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.composition import Materials
from unmix_plugin.spectral.library import measured_library
from unmix_plugin.viewer import html
from unmix_plugin.viewer.charts import Chart, Line
from unmix_plugin.viewer.edits import Edit
from unmix_plugin.viewer.inputs import new_file, number, text
from unmix_plugin.viewer.recipe_editor import (
    RecipeHistory,
    change_of,
    numbered,
    visibility,
    with_change,
    with_light,
    with_swap,
    with_visible,
)
from unmix_plugin.viewer.session import Session

_OWN_LIGHT = "as recorded"
_LIGHTS: tuple[str, ...] = ("D65", "D50", "A", "E", "C", "FL2", "FL7", "FL11", "LED-B1", "LED-B5", "HP1")
_FACTOR_BOUNDS = (0.0, 5.0)
_NO_RECIPE = "none saved yet"
_LONGEST_LIST = 64
"""Endmembers that are listed with their nearest known materials."""


class MaterialsPanel:
    """Builds the recipe of one client."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._history = RecipeHistory()
        self._is_showing = False
        self._gui = session.client.gui
        self._listing = self._gui.add_html("")
        self._light = self._gui.add_dropdown("light", (_OWN_LIGHT, *_LIGHTS))
        self._on(self._light, self._change_light)
        self._add_history()
        names = session.materials().names
        self._chosen = self._gui.add_dropdown("endmember", names)
        self._on(self._chosen, self._show_chosen)
        self._add_changes(names)
        self._chart = Chart(self._gui, "spectra under the light")
        self._add_files()
        self._show_materials()
        session.on_edit.append(self._show_materials)

    def _show_materials(self) -> None:
        """Show the materials as they are now."""
        materials = self._session.materials()
        for menu in (self._chosen, self._other):
            if tuple(menu.options) != materials.names:
                index = tuple(menu.options).index(menu.value)
                menu.options = materials.names
                menu.value = materials.names[index]
        colours, spectra = self._session.colours(), materials.endmembers.double().cpu().numpy()
        lines = zip(materials.names, spectra, colours, strict=True)
        self._chart.draw(materials.bands, [Line(name, row, colour) for name, row, colour in lines])
        self._listing.content = self._list()
        self._show_chosen()

    def _add_history(self) -> None:
        buttons = self._gui.add_button_group("changes", ("undo", "redo", "start anew"))
        steps: dict[str, Callable[[], Recipe | None]] = {
            "undo": self._history.undone,
            "redo": self._history.redone,
            "start anew": lambda: self._taken(Recipe()),
        }

        def step() -> None:
            recipe = steps.get(str(buttons.value), lambda: None)()
            if recipe is None:
                raise ConfigError("there is nothing more to undo or redo")
            self._session.change_edit(Edit(recipe))

        buttons.on_click(self._session.guarded(step))

    def _add_changes(self, names: tuple[str, ...]) -> None:
        gui = self._gui
        with gui.add_folder("this endmember"):
            self._is_visible = gui.add_checkbox("visible", True)
            self._is_alone = gui.add_checkbox("only this one", False)
            self._factor = gui.add_slider("brightness", *_FACTOR_BOUNDS, 0.05, 1.0)
            self._gloss = gui.add_slider("gloss", *_FACTOR_BOUNDS, 0.05, 1.0)
            self._colour = gui.add_rgb("colour", (128, 128, 128))
            self._name = gui.add_text("name", names[0])
            self._library = gui.add_dropdown("known material", measured_library().names)
            replace_button = gui.add_button("replace by the known material")
            self._other = gui.add_dropdown("other endmember", names, initial_value=names[-1])
            swap_button = gui.add_button("swap with the other")
        for control, make in (
            (self._factor, lambda index: Scale(index, self._number(self._factor))),
            (self._gloss, lambda index: Gloss(index, self._number(self._gloss))),
            (self._colour, lambda index: Retint(index, _srgb(self._colour.value))),
            (self._name, lambda index: Rename(index, text(self._name.value).strip())),
        ):
            self._on(control, lambda make=make: self._change(with_change(self._recipe, make(self._index))))
        for control in (self._is_visible, self._is_alone):
            self._on(control, lambda control=control: self._change_visibility(control))
        replace_button.on_click(
            self._session.guarded(lambda: self._change(with_change(self._recipe, self._replacement())))
        )
        swap_button.on_click(self._session.guarded(self._swap))

    def _add_files(self) -> None:
        gui = self._gui
        with gui.add_folder("recipes"):
            self._recipe_text = gui.add_text("recipe", "", multiline=True, disabled=True)
            self._recipe_name = gui.add_text("save as", "recipe")
            gui.add_button("save").on_click(self._session.guarded(self._save))
            self._saved = gui.add_dropdown("saved", self._recipe_files())
            gui.add_button("load").on_click(self._session.guarded(self._load))

    @property
    def _recipe(self) -> Recipe:
        return self._history.present

    @property
    def _index(self) -> int:
        """Number of the endmember chosen."""
        return self._index_in(self._chosen)

    def _on(self, control: Any, work: Callable[[], None]) -> None:
        """Do something when a user changes a control, not when the panel itself does."""

        def change() -> None:
            if not self._is_showing:
                work()

        control.on_update(self._session.guarded(change))

    def _change(self, recipe: Recipe) -> None:
        """Put a recipe in force if it fits the run; else the controls go back to what is in force."""
        edit = Edit(recipe)
        try:
            self._session.services.maker.edited(edit)
        except UnmixError:
            self._show_chosen()
            raise
        self._taken(recipe)
        self._session.change_edit(edit)

    def _taken(self, recipe: Recipe) -> Recipe:
        self._history.take(recipe)
        return recipe

    def _change_light(self) -> None:
        name = str(self._light.value)
        light = None if name == _OWN_LIGHT or name not in _LIGHTS else Light(name)
        self._change(with_light(self._recipe, light))
        metadata = self._session.services.source.scene.metadata
        assumed = assumption_of_light(metadata, self._recipe)
        if assumed is not None:
            self._session.say("light", assumed)

    def _change_visibility(self, control: Any) -> None:
        hidden, _ = visibility(self._recipe)
        index = self._index
        if control is self._is_alone:
            alone = index if self._is_alone.value is True else None
            self._change(with_visible(self._recipe, hidden - {index}, alone))
        else:
            now_hidden = hidden - {index} if self._is_visible.value is True else hidden | {index}
            self._change(with_visible(self._recipe, now_hidden, None))

    def _replacement(self) -> Replace:
        return Replace(self._index, LibrarySpectrum(text(self._library.value)), extrapolate=True)

    def _swap(self) -> None:
        self._change(with_swap(self._recipe, Swap(self._index, self._index_in(self._other))))

    def _save(self) -> None:
        content = recipe_to_yaml(self._recipe).encode()
        path = write_file(
            new_file(self._session.services.recipes_folder, self._recipe_name.value, ".yml", "recipe"),
            content,
        )
        self._saved.options = self._recipe_files()
        self._saved.value = path.name
        self._session.client.send_file_download(path.name, content)
        self._session.say("saved", f"{path}; other commands take it as --edits {path}")

    def _load(self) -> None:
        files = self._recipe_files()
        self._saved.options = files
        if self._saved.value not in files or self._saved.value == _NO_RECIPE:
            raise ConfigError("choose one of the recipes saved in the run folder")
        recipe = read_recipe(self._session.services.recipes_folder / str(self._saved.value))
        self._change(numbered(recipe, self._session.services.maker.edited(Edit()).names))

    def _recipe_files(self) -> tuple[str, ...]:
        folder = self._session.services.recipes_folder
        found = sorted(path.name for path in folder.glob("*.y*ml")) if folder.is_dir() else []
        return tuple(found) or (_NO_RECIPE,)

    def _index_in(self, menu: Any) -> int:
        names = tuple(menu.options)
        if menu.value not in names:
            raise ConfigError(f"there is no endmember {str(menu.value)[:40]!r}")
        return names.index(menu.value)

    def _number(self, control: Any) -> float:
        return number(control.value, *_FACTOR_BOUNDS, fallback=1.0)

    def _show_chosen(self) -> None:
        """Let the controls say what the recipe does to the endmember chosen."""
        self._is_showing = True
        try:
            materials, index = self._session.materials(), self._index
            hidden, isolated = visibility(self._recipe)
            self._is_visible.value = index not in hidden and (not isolated or index in isolated)
            self._is_alone.value = index in isolated
            scale, gloss = (change_of(self._recipe, kind, index) for kind in (Scale, Gloss))
            self._factor.value = scale.factor if isinstance(scale, Scale) else 1.0
            self._gloss.value = gloss.scale if isinstance(gloss, Gloss) else 1.0
            self._colour.value = self._colour_of(materials, index)
            self._name.value = materials.names[index]
            light = self._recipe.illuminant
            self._light.value = (
                str(light.light) if light is not None and light.light in _LIGHTS else _OWN_LIGHT
            )
            self._recipe_text.value = recipe_to_yaml(self._recipe)
        finally:
            self._is_showing = False

    def _colour_of(self, materials: Materials, index: int) -> tuple[int, int, int]:
        """8-bit sRGB colour that was asked for an endmember, or else that of its spectrum in full light."""
        retint = change_of(self._recipe, Retint, index)
        if isinstance(retint, Retint):
            shown = torch.tensor(retint.colour)
        else:
            linear = materials.endmembers[index] @ rgb_matrix(materials.bands).to(materials.endmembers)
            shown = linear_to_srgb(linear.clamp(0, 1)).cpu()
        red, green, blue = (shown * 255).round().int().tolist()
        return red, green, blue

    def _list(self) -> str:
        """Every endmember with its colour, its nearest known material, and whether it is hidden."""
        materials = self._session.materials()
        hidden, isolated = visibility(self._recipe)
        spectra = materials.endmembers[:_LONGEST_LIST].double().cpu().numpy()
        matches = self._session.nearest_materials(spectra, materials.bands, 1)
        entries, colours = [], self._session.colours()
        for index, (name, found) in enumerate(zip(materials.names, matches, strict=False)):
            is_gone = index in hidden or (isolated and index not in isolated)
            like = f", like {found[0].name} ({found[0].angle_rad:.2f} rad)" if found else ""
            entries.append((f"{name}{' (hidden)' if is_gone else ''}{like}", colours[index]))
        return html.swatches(entries)


def _srgb(value: Any) -> tuple[float, float, float]:
    """A colour picker's value as sRGB in [0, 1]."""
    red, green, blue = (number(part, 0, 255, fallback=128) / 255 for part in tuple(value)[:3])
    return red, green, blue
