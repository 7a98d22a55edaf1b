"""The controls: one file a panel, listed here in the order of their tabs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from unmix_plugin.viewer.panels.capture_panel import CapturePanel
from unmix_plugin.viewer.panels.layer_panel import LayerPanel
from unmix_plugin.viewer.panels.materials_panel import MaterialsPanel
from unmix_plugin.viewer.panels.probe_panel import ProbePanel
from unmix_plugin.viewer.panels.scene_panel import ScenePanel
from unmix_plugin.viewer.panels.training_panel import TrainingPanel, is_training
from unmix_plugin.viewer.services import Services
from unmix_plugin.viewer.session import Session


@dataclass(frozen=True)
class Panel:
    """One tab of a client's controls."""

    title: str
    """Label of the tab."""
    build: Callable[[Session], object]
    """Builds the controls in the tab that is open; what follows a run or an edit asks the session to be told."""
    applies: Callable[[Services], bool] = lambda _: True
    """Whether clients of a viewer have it."""


PANELS = (
    Panel("view", LayerPanel),
    Panel("scene", ScenePanel),
    Panel("probe", ProbePanel),
    Panel("materials", MaterialsPanel),
    Panel("capture", CapturePanel),
    Panel("training", TrainingPanel, is_training),
)
"""Every panel."""

__all__ = ["PANELS", "Panel"]
