"""What layers and edits need of the scene beside the view itself: made again as training goes on."""

from __future__ import annotations

from unmix_plugin.editing import sample_seen
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.layers.layer_aids import LayerAids
from unmix_plugin.viewer.rendering.measured import MeasuredViews
from unmix_plugin.viewer.rendering.reference import render_reference
from unmix_plugin.viewer.rendering.scene_source import SceneSource

_RENEWAL_STEPS = 200
"""Training steps after which the rays are rendered again."""


class SceneAids:
    """Rays through the whole scene, what cameras see of it, and what was measured."""

    def __init__(self, source: SceneSource, has_materials: bool) -> None:
        self.measured: MeasuredViews | None = None
        """What the training views measured, once the scene is read."""
        self.why_not_measured = "the scene is still being read"
        """What is said where `measured` is missing."""
        self._source, self._has_materials = source, has_materials
        self._for_layers: tuple[int, LayerAids] | None = None
        self._seen: tuple[int, Coefficients] | None = None

    def set_measured(self, measured: MeasuredViews | None, why_not: str = "") -> None:
        """Note what was measured, or why that is unknown."""
        self.measured, self.why_not_measured = measured, why_not
        self._for_layers = None

    def for_layers(self) -> LayerAids | None:
        """What layers need; None without materials. Must not be called while the scene is lent."""
        if not self._has_materials:
            return None
        kept, version = self._for_layers, self._source.version
        age = 0 if kept is None else version - kept[0]
        if kept is None or age >= _RENEWAL_STEPS or (age > 0 and not self._source.is_changing):
            kept = self._for_layers = (version, self._made())
        return kept[1]

    def see(self, scene: TrainedScene) -> Coefficients:
        """What the training cameras see of the unedited scene, not long ago; called while it is lent."""
        version = self._source.version
        if self._seen is None or version - self._seen[0] >= _RENEWAL_STEPS:
            self._seen = (version, sample_seen(scene))
        return self._seen[1]

    def _made(self) -> LayerAids:
        error_of = None if self.measured is None else self.measured.error
        why_not = self.why_not_measured
        record = self._source.record
        with self._source.borrowed_materials() as scene:
            reference = render_reference(scene, record.train_cameras)
        return LayerAids(reference, record.scene_box, error_of, why_not)
