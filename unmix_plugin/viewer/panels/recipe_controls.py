"""The recipe of one client: undo and redo, its text, its files."""

from __future__ import annotations

from collections.abc import Callable, Hashable

from unmix_plugin.editing import Recipe, read_recipe, recipe_to_yaml
from unmix_plugin.errors import ConfigError, UnmixError
from unmix_plugin.formats.files import write_file
from unmix_plugin.viewer.inputs import new_file
from unmix_plugin.viewer.recipe_editor import numbered
from unmix_plugin.viewer.rendering.edits import Edit
from unmix_plugin.viewer.session import Session

_NO_RECIPE = "none saved yet"


class RecipeControls:
    """Keeps the recipe in force and lets it be undone, saved and loaded."""

    def __init__(self, session: Session, refused: Callable[[], None]) -> None:
        """
        Args:
            session: Of the client.
            refused: Called when a change does not fit the run, so that controls can show what is in force.
        """
        self._session, self._refused = session, refused
        self._gui = session.client.gui
        self._history = session.history

    @property
    def recipe(self) -> Recipe:
        """The one in force; endmembers are given by their numbers."""
        return self._history.present

    def change(self, recipe: Recipe, subject: Hashable = None) -> None:
        """Put a recipe in force if it fits the run.

        Args:
            recipe: The new one.
            subject: As `RecipeHistory.take` has it.
        Raises:
            UnmixError: it does not; nothing has changed.
        """
        edit = Edit(recipe)
        try:
            self._session.services.maker.edited(edit)
        except UnmixError:
            self._refused()
            raise
        self._history.take(recipe, subject)
        self._session.change_edit(edit)

    def add_history(self) -> None:
        """Buttons to go back and forth."""
        buttons = self._gui.add_button_group("changes", ("undo", "redo", "start again"))

        def step() -> None:
            if buttons.value == "start again":
                self.change(Recipe())
                return
            recipe = self._history.undone() if buttons.value == "undo" else self._history.redone()
            if recipe is None:
                raise ConfigError("there is nothing more to undo or redo")
            self._session.change_edit(Edit(recipe))

        buttons.on_click(self._session.guarded(step))

    def add_files(self) -> None:
        """The recipe's text, and files of the run folder to save it to and to load it from."""
        with self._gui.add_folder("recipes"):
            self._text = self._gui.add_text("recipe", "", multiline=True, disabled=True)
            self._name = self._gui.add_text("save as", "recipe")
            self._gui.add_button("save").on_click(self._session.guarded(self._save))
            self._saved = self._gui.add_dropdown("saved", self._files())
            self._gui.add_button("load").on_click(self._session.guarded(self._load))

    def show(self) -> None:
        """Show the text of the recipe in force."""
        self._text.value = recipe_to_yaml(self.recipe)

    def _save(self) -> None:
        content = recipe_to_yaml(self.recipe).encode()
        folder = self._session.services.recipes_folder
        path = write_file(new_file(folder, self._name.value, ".yml", "recipe"), content)
        self._saved.options = self._files()
        self._saved.value = path.name
        self._session.client.send_file_download(path.name, content)
        self._session.say("saved", f"{path}; other commands take it as --edits {path}")

    def _load(self) -> None:
        files = self._files()
        self._saved.options = files
        if self._saved.value not in files or self._saved.value == _NO_RECIPE:
            raise ConfigError("choose one of the recipes saved in the run folder")
        recipe = read_recipe(self._session.services.recipes_folder / str(self._saved.value))
        self.change(numbered(recipe, self._session.services.maker.edited(Edit()).materials.names))

    def _files(self) -> tuple[str, ...]:
        folder = self._session.services.recipes_folder
        found = sorted(path.name for path in folder.glob("*.y*ml")) if folder.is_dir() else []
        return tuple(found) or (_NO_RECIPE,)
