"""Recipes as the viewer applies them: cheaply, and again as training changes the scene."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from unmix_plugin.editing import Recipe, changes_geometry, edit_scene
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.trained.open_run import require_materials
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.relighting import LightChoice, relit
from unmix_plugin.trained.trained_scene import TrainedScene

_RENEWAL_S = 0.5
"""Seconds between two edited scenes while training changes the unedited one."""

See = Callable[[TrainedScene], Coefficients]
"""What cameras see of a scene, for edits that depend on it."""


@dataclass(frozen=True)
class _Kept:
    """The edited scene made last."""

    edited: RenderableScene
    version: int
    made_at: float

    def serves(self, version: int) -> bool:
        return self.version == version or time.monotonic() - self.made_at < _RENEWAL_S


@dataclass(frozen=True, eq=False)
class Edit:
    """A recipe or another light, and the scene that it last gave; compared by identity."""

    recipe: Recipe = Recipe()
    light: LightChoice = LightChoice()
    """For scenes whose light can be exchanged; such scenes have no recipes."""
    _kept: list[_Kept] = field(default_factory=list, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def is_none(self) -> bool:
        """Whether nothing is changed."""
        return not self.has_recipe and self.light == LightChoice()

    @property
    def has_recipe(self) -> bool:
        """Whether materials, or the light of a scene of mixed materials, are changed."""
        return bool(self.recipe.operations) or self.recipe.illuminant is not None

    @property
    def changes_geometry(self) -> bool:
        """Whether pictures must be rendered for it: shape or gloss change."""
        return changes_geometry(self.recipe)

    def reuses(self, other: Edit) -> bool:
        """Whether what was rendered with `other` can be shown with this edit's materials."""
        if self.light != other.light:
            return False
        return self is other or (not self.changes_geometry and not other.changes_geometry)

    def apply(self, scene: RenderableScene, version: int, see: See) -> RenderableScene:
        """The edited scene; must be called while the scene is lent.

        Args:
            scene: The unedited one.
            version: Rises as training changes it.
            see: Asked only if the recipe depends on pictures.
        Raises:
            ConfigError: the recipe does not fit the run.
        """
        if self.is_none:
            return scene
        with self._lock:
            if not self._kept or not self._kept[0].serves(version):
                self._kept[:] = [_Kept(self._applied(scene, see), version, time.monotonic())]
            return self._kept[0].edited

    def _applied(self, scene: RenderableScene, see: See) -> RenderableScene:
        if self.light != LightChoice():
            return relit(scene, self.light, "of this run")
        scene = require_materials(scene, "of this run")
        return edit_scene(scene, self.recipe, see(scene) if self.recipe.wants_pictures else None)
