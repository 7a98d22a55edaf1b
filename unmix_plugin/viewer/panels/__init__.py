"""The controls: one file a panel, listed here in the order of their tabs."""

from __future__ import annotations

from unmix_plugin.viewer.panels.capture_panel import CapturePanel
from unmix_plugin.viewer.panels.layer_panel import LayerPanel
from unmix_plugin.viewer.panels.materials_panel import MaterialsPanel
from unmix_plugin.viewer.panels.probe_panel import ProbePanel
from unmix_plugin.viewer.panels.scene_panel import ScenePanel
from unmix_plugin.viewer.panels.training_panel import TrainingPanel, is_training
from unmix_plugin.viewer.session import Panel

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
